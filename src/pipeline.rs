//! The whole story on one page: what structure from motion left in a folder becomes a model of every module.

use crate::plant::{PlantId, PlantModel, Warning};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

/// The stages in the order in which they run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Stage {
    /// Reconstruction, point cloud and image headers read and checked.
    Read,
    /// Modules detected, image by image (paper, 3.2).
    Detect,
    /// Rows, benches, gaps and hypotheses of each image (3.3).
    Layout,
    /// Pixels to 3D (3.4).
    Locate,
    /// Layouts of all images matched and merged (3.4, 3.5).
    Fuse,
    /// Positions refined (3.6).
    Refine,
    /// Identifiers given, model assembled.
    Assemble,
}

impl Stage {
    /// All stages, in order.
    pub const ALL: [Self; 7] =
        [Self::Read, Self::Detect, Self::Layout, Self::Locate, Self::Fuse, Self::Refine, Self::Assemble];

    /// The word in progress reports.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Read => "read",
            Self::Detect => "detect",
            Self::Layout => "layout",
            Self::Locate => "locate",
            Self::Fuse => "fuse",
            Self::Refine => "refine",
            Self::Assemble => "assemble",
        }
    }
}

/// What a mapping may be told.
#[derive(Debug, Clone, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MapOptions {
    /// Rows of modules per bench; inferred where it is not given.
    pub rows_per_bench: Option<u32>,
    /// Ground sampling distance in metres per pixel above which an image does not resolve modules and is left out of
    /// detection; chosen from the images where it is not given.
    pub max_gsd_m_per_px: Option<f64>,
    /// Known spacing of module centres along and across the row, metres (3.6, last paragraph of 4.3.1).
    pub spacing_m: Option<[f64; 2]>,
    /// Seed of every random choice.
    pub seed: u64,
}

impl Default for MapOptions {
    fn default() -> Self {
        Self { rows_per_bench: None, max_gsd_m_per_px: None, spacing_m: None, seed: 1 }
    }
}

/// What the model is of.
#[derive(Debug, Clone)]
pub struct Subject {
    pub plant: PlantId,
    pub plant_name: String,
    pub survey: String,
    /// The plant's newest model, whose identifiers live on where the same modules are found again.
    pub previous: Option<Arc<PlantModel>>,
}

/// Told of progress, asked whether to stop. Called from several threads.
pub trait Observer: Sync {
    /// `done` of `total` units of a stage are finished (images, benches, or one unit where a stage has no parts).
    fn progress(&self, stage: Stage, done: usize, total: usize);
    /// Whether the mapping should end early with [`MapError::Cancelled`].
    fn cancelled(&self) -> bool {
        false
    }
}

/// What one stage cost.
#[derive(Debug, Clone, Copy)]
pub struct StageTiming {
    pub stage: Stage,
    pub wall: Duration,
    /// Highest resident memory of the process so far, bytes; `None` where the system does not say.
    pub peak_memory_bytes: Option<u64>,
}

/// A finished mapping.
#[derive(Debug)]
pub struct Mapping {
    pub model: PlantModel,
    pub timings: Vec<StageTiming>,
}

/// Why a mapping could not be made.
#[derive(Debug, thiserror::Error)]
pub enum MapError {
    #[error("the mapping was cancelled")]
    Cancelled,
    /// Bad input: the sentence names the file and says what to do. Trying again does not help.
    #[error("{message}")]
    Input { code: &'static str, message: String },
    /// Something outside the input failed (a full disk, a missing runtime); trying again may help.
    #[error("{message}")]
    Environment { message: String },
}

/// Maps the plant in a folder as OpenSfM leaves it: `reconstruction.json`, `reference_lla.json`, `images/`,
/// `undistorted/` with `depthmaps/merged.ply`. `model_path` is the detector's ONNX file.
pub fn map_folder(
    folder: &Path,
    detector: &PathBuf,
    options: &MapOptions,
    subject: &Subject,
    observer: &dyn Observer,
) -> Result<Mapping, MapError> {
    let _ = (folder, detector, options, subject, observer, Warning::new("", "", []));
    todo!()
}
