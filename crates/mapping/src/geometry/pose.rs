//! Where a camera stood and where it looked.

use nalgebra::{Rotation3, Vector3};
use serde::{Deserialize, Serialize};

/// A rigid transform from the world to the camera: `p_camera = rotation * p_world + translation`. Camera axes: x right,
/// y down, z forward (OpenSfM, OpenCV, COLMAP).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Pose {
    pub camera_from_world: Rotation3<f64>,
    pub translation_m: Vector3<f64>,
}

impl Pose {
    /// A pose from an axis-angle rotation in radians and a translation in metres, as OpenSfM writes them.
    pub fn from_axis_angle(axis_angle_rad: Vector3<f64>, translation_m: Vector3<f64>) -> Self {
        Self { camera_from_world: Rotation3::new(axis_angle_rad), translation_m }
    }

    /// The camera centre in the world frame, metres: `-R^T t`.
    pub fn center(&self) -> Vector3<f64> {
        -(self.camera_from_world.inverse() * self.translation_m)
    }

    /// A world point in the camera frame, metres.
    pub fn to_camera(&self, world_m: &Vector3<f64>) -> Vector3<f64> {
        self.camera_from_world * world_m + self.translation_m
    }

    /// A direction of the camera frame in the world frame.
    pub fn direction_to_world(&self, camera_direction: &Vector3<f64>) -> Vector3<f64> {
        self.camera_from_world.inverse() * camera_direction
    }
}
