//! From an image to the modules in it.

pub mod external;

use crate::geometry::Quad;
use image::RgbImage;
use serde::{Deserialize, Serialize};

/// Which detector found a module.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Source {
    /// The semantic segmentation network (paper, 3.2).
    Unet,
    /// The instance segmentation network that complements it.
    Yolo,
    /// Boxes made by another program or a person.
    External,
}

/// One module seen in one image.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Detection {
    /// Corners in pixels of the undistorted image.
    pub quad: Quad,
    /// 0 to 1.
    pub score: f32,
    pub source: Source,
}

/// All modules seen in one image.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ImageDetections {
    /// Name of the shot.
    pub image: String,
    pub width_px: u32,
    pub height_px: u32,
    pub detections: Vec<Detection>,
}

/// Finds modules in images.
pub trait Detector: Send + Sync {
    /// The modules in an image whose ground sampling distance (metres per pixel) may be known.
    fn detect(&self, image: &RgbImage, gsd_m: Option<f64>) -> Result<Vec<Detection>, DetectionError>;
    /// One line for logs: the model, and what runs it.
    fn describe(&self) -> String;
}

#[derive(Debug, thiserror::Error)]
pub enum DetectionError {
    #[error("{0}")]
    Runtime(String),
}
