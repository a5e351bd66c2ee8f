//! Files of a reconstruction that are as they should be and hold next to nothing.

/// Of the shots `a.jpg` and `b.jpg`.
pub const RECONSTRUCTION: &str = r#"[{"cameras": {"c": {"projection_type": "perspective", "width": 32, "height": 24, "focal": 0.8}}, "shots": {"a.jpg": {"rotation": [0, 0, 0], "translation": [0, 0, 1], "camera": "c"}, "b.jpg": {"rotation": [0, 0, 0], "translation": [0, 0, 1], "camera": "c"}}}]"#;

pub const REFERENCE: &str = r#"{"latitude": 50.0, "longitude": 8.0, "altitude": 0.0}"#;
