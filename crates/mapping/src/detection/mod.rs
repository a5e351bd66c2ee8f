//! From an image to the modules in it (paper, 3.2).
//!
//! A semantic network ([`Unet`]) marks the pixels of modules; [`mask_to_boxes`] turns its masks into oriented boxes;
//! [`filter`] drops what no module can be. An instance network ([`Yolo`]) complements it, or stands alone, behind the same
//! [`Detector`].

mod detectors;
pub mod external;
pub mod filter;
mod halves;
mod lattice;
pub mod mask_to_boxes;
mod merge;
mod neighbours;
mod open;
mod outline;
mod periodicity;
pub mod probability;
mod profile;
mod registration;
pub mod runtime;
pub mod scale;
mod tiles;
mod unet;
mod yolo;

pub use open::open;
pub use runtime::{ExecutionProvider, RuntimeSettings};
pub use unet::Unet;
pub use yolo::Yolo;

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

/// Something that finds modules in an image.
pub trait Detector: Send + Sync {
    /// The modules that lie wholly inside `image` (8-bit RGB, free of distortion), in pixels of `image`. `gsd_m` is its
    /// ground sampling distance in metres per pixel, where it is known.
    ///
    /// # Errors
    /// Inference that fails, or gives numbers that are none.
    fn detect(&self, image: &RgbImage, gsd_m: Option<f64>) -> Result<Vec<Detection>, DetectionError>;

    /// One line for people: which model, which version, what runs it.
    fn describe(&self) -> String;

    /// Tells this detector from every other that may find something else in the same image: the models' digests, and what
    /// runs them. On how many threads does not matter.
    fn identity(&self) -> String {
        self.describe()
    }
}

/// Why nothing can be detected. Each sentence says what to do.
#[derive(Debug, thiserror::Error)]
pub enum DetectionError {
    #[error(
        "ONNX Runtime is not installed: run `make setup`, or set ORT_DYLIB_PATH to libonnxruntime.so (1.24 or newer)"
    )]
    RuntimeMissing,
    #[error("ONNX Runtime cannot be loaded from {library}: {what}; run `make setup`, or set ORT_DYLIB_PATH to another")]
    RuntimeUnusable { library: String, what: String },
    #[error(
        "this build of ONNX Runtime cannot run models on {provider} ({what}): choose --execution-provider cpu, or name a \
         library that can with ORT_DYLIB_PATH"
    )]
    ProviderMissing { provider: &'static str, what: String },
    #[error("{0}")]
    ModelChoice(String),
    #[error("the model {name} cannot be read: {source}")]
    ModelUnreadable { name: String, source: std::io::Error },
    #[error(
        "the model {name}, which comes with heliomap, is not there: it is looked for in models/ of the working directory, and \
         in models/ and share/heliomap/models/ of the program's folder and those above it; put it there, or name an ONNX file \
         with --detector"
    )]
    ShippedModelMissing { name: String },
    #[error("the model {name} is larger than the {limit} bytes that are read")]
    ModelTooLarge { name: String, limit: u64 },
    #[error("{name} is no ONNX model: {what}")]
    NotAModel { name: String, what: String },
    #[error("the model {name} does not fit: {what}")]
    UnfitModel { name: String, what: String },
    #[error("the network failed: {what}")]
    Inference { what: String },
    #[error(
        "the network gave no numbers for {percent:.0} % of the pixels: the model is damaged, or unfit for this machine"
    )]
    NotFinite { percent: f64 },
}

impl DetectionError {
    /// A stable word for programs.
    pub fn code(&self) -> &'static str {
        match self {
            Self::RuntimeMissing => "onnx_runtime_missing",
            Self::RuntimeUnusable { .. } => "onnx_runtime_unusable",
            Self::ProviderMissing { .. } => "execution_provider_missing",
            Self::ModelChoice(_) => "model_choice",
            Self::ModelUnreadable { .. } => "model_unreadable",
            Self::ShippedModelMissing { .. } => "model_unreadable",
            Self::ModelTooLarge { .. } => "model_too_large",
            Self::NotAModel { .. } => "model_invalid",
            Self::UnfitModel { .. } => "model_unfit",
            Self::Inference { .. } => "inference_failed",
            Self::NotFinite { .. } => "model_output_not_finite",
        }
    }
}
