//! What structure from motion gives us, as one type, with one reader per producer.

use crate::geometry::{Camera, GeodeticReference, PointCloud, Pose};
use nalgebra::Vector3;

/// One photo: its camera and its pose. Pixels are those of the undistorted image.
#[derive(Debug, Clone)]
pub struct Shot {
    /// File name of the original image, the key of everything.
    pub name: String,
    pub camera: Camera,
    pub pose: Pose,
    /// Where the GNSS receiver put the camera, local frame, metres.
    pub gnss_enu_m: Option<Vector3<f64>>,
}

/// A reconstructed scene in a local east-north-up frame.
#[derive(Debug, Clone)]
pub struct Reconstruction {
    pub reference: GeodeticReference,
    /// Sorted by name.
    pub shots: Vec<Shot>,
    /// Sparse points (tie points), metres.
    pub sparse_points_m: Vec<Vector3<f64>>,
    /// The dense cloud, where there is one.
    pub dense: Option<PointCloud>,
}
