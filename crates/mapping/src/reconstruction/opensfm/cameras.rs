//! OpenSfM's camera models.

use super::json::CameraEntry;
use crate::geometry::Camera;
use crate::geometry::camera::Lens;
use crate::reconstruction::ReconstructionError;
use std::path::Path;

/// Longest side of an image, pixels.
const MAX_SIDE_PX: f64 = 1e6;

/// Whether a camera of this model can be read. A panorama (`spherical`) shows no module well enough.
pub(super) fn is_known(entry: &CameraEntry) -> bool {
    matches!(
        entry.projection_type.as_str(),
        "perspective" | "simple_radial" | "radial" | "brown" | "fisheye" | "fisheye_opencv"
    )
}

/// The camera `name` of the file at `path`.
///
/// # Errors
/// A model that is not known, and numbers that no camera has.
pub(super) fn camera(path: &Path, name: &str, entry: &CameraEntry) -> Result<Camera, ReconstructionError> {
    let zero = |value: Option<f64>| value.unwrap_or(0.0);
    let [k1, k2, k3, k4, p1, p2] = [entry.k1, entry.k2, entry.k3, entry.k4, entry.p1, entry.p2].map(zero);
    let lens = match entry.projection_type.as_str() {
        "perspective" | "simple_radial" | "radial" | "brown" => Lens::Radial { k1, k2, k3, p1, p2 },
        "fisheye" | "fisheye_opencv" => Lens::Fisheye { k: [k1, k2, k3, k4] },
        other => {
            return Err(ReconstructionError::UnknownCameraModel {
                path: path.to_owned(),
                camera: name.to_owned(),
                model: other.chars().take(64).collect(),
            });
        }
    };
    let malformed =
        |what: &str| ReconstructionError::Malformed { path: path.to_owned(), what: format!("camera `{name}` {what}") };
    let focal_x = entry.focal_x.or(entry.focal).ok_or_else(|| malformed("has no focal length"))?;
    let focal_y = entry.focal_y.unwrap_or(focal_x);
    let (principal_x, principal_y) = (zero(entry.c_x), zero(entry.c_y));
    let sound = |focal: f64| focal.is_finite() && (1e-3..1e3).contains(&focal);
    if !sound(focal_x) || !sound(focal_y) || !principal_x.is_finite() || !principal_y.is_finite() {
        return Err(malformed("has a focal length or principal point that no camera has"));
    }
    let side = |pixels: f64| (1.0..=MAX_SIDE_PX).contains(&pixels);
    if [k1, k2, k3, k4, p1, p2].iter().any(|k| !k.is_finite() || k.abs() > 1e3)
        || !side(entry.width)
        || !side(entry.height)
    {
        return Err(malformed("has a distortion or size that no camera has"));
    }
    let (width_px, height_px) = (entry.width as u32, entry.height as u32);
    Ok(Camera { width_px, height_px, focal_x, focal_y, principal_x, principal_y, lens })
}

/// The camera of the image that OpenSfM undistorts from a photo of `original`: perspective, the mean of both focal
/// lengths, and the principal point in the middle (`perspective_camera_from_*` in its `undistort.py`).
pub(super) fn of_undistorted_image(original: &Camera) -> Camera {
    Camera::pinhole(original.width_px, original.height_px, (original.focal_x + original.focal_y) / 2.0)
}
