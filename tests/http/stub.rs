//! Files of a reconstruction that are as they should be, as a test wants them.

#[path = "../common/stub.rs"]
mod files;

pub use files::{RECONSTRUCTION, REFERENCE};

/// A reconstruction with a component for each list of shots.
pub fn reconstruction_of(components: &[&[&str]]) -> String {
    let camera = serde_json::json!({"projection_type": "perspective", "width": 32, "height": 24, "focal": 0.8});
    let shot = serde_json::json!({"rotation": [0, 0, 0], "translation": [0, 0, 1], "camera": "c"});
    let component = |names: &&[&str]| {
        let shots = names.iter().map(|name| ((*name).to_owned(), shot.clone()));
        serde_json::json!({"cameras": {"c": camera}, "shots": shots.collect::<serde_json::Map<_, _>>()})
    };
    serde_json::json!(components.iter().map(component).collect::<Vec<_>>()).to_string()
}

/// A point cloud of one point and so many bytes.
pub fn cloud(bytes: usize) -> Vec<u8> {
    let properties = ["x", "y", "z"].map(|name| format!("property float {name}\n")).concat();
    let mut cloud = format!("ply\nformat ascii 1.0\nelement vertex 1\n{properties}end_header\n1 2 3\n").into_bytes();
    assert!(cloud.len() <= bytes);
    cloud.resize(bytes, b' ');
    cloud
}
