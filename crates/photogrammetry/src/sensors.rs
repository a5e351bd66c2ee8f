//! Sensors of common drones' cameras. With the focal length in millimetres, which cameras write to a hundredth, they give it
//! in pixels better than the 35-mm equivalent, which is rounded to a whole millimetre.

/// Start of the model in EXIF, and the longer side of its sensor by the manufacturer's specification, millimetres. The longer
/// of two starts stands first.
const SENSORS: &[(&str, f64)] = &[
    ("FC6310", 13.2),    // Phantom 4 Pro, Pro V2, RTK
    ("FC6320", 13.2),    // Phantom 4 Advanced
    ("FC6510", 13.2),    // Zenmuse X4S
    ("FC6520", 17.3),    // Zenmuse X5S
    ("FC6540", 23.5),    // Zenmuse X7
    ("FC550", 17.3),     // Zenmuse X5
    ("FC3411", 13.2),    // Air 2S
    ("L1D-20c", 13.2),   // Mavic 2 Pro
    ("L2D-20c", 17.3),   // Mavic 3
    ("M3E", 17.3),       // Mavic 3 Enterprise
    ("M3M", 17.3),       // Mavic 3 Multispectral
    ("ZenmuseP1", 35.9), // Zenmuse P1
    ("FC220", 6.17),     // Mavic Pro
    ("FC300", 6.17),     // Phantom 3
    ("FC330", 6.17),     // Phantom 4
    ("FC350", 6.17),     // Zenmuse X3
];

/// The longer side of the sensor of `camera`, make and model as EXIF has them, millimetres.
pub(crate) fn longer_side_mm(camera: &str) -> Option<f64> {
    let model = camera.rsplit(' ').next()?;
    SENSORS.iter().find(|(start, _)| model.starts_with(start)).map(|(_, side_mm)| *side_mm)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn models_are_found_behind_their_make() {
        assert_eq!(longer_side_mm("DJI FC6310S"), Some(13.2));
        assert_eq!(longer_side_mm("Hasselblad L1D-20c"), Some(13.2));
        assert_eq!(longer_side_mm("Hasselblad TWIN-L1D"), None);
        assert_eq!(longer_side_mm(""), None);
    }
}
