//! Photos alone to a reconstruction: reads what cameras and drones wrote into the photos, has COLMAP reconstruct them in a
//! process of its own, and writes the result as an OpenSfM project, which the mapping reads.

mod engine;
mod error;
mod export;
mod photos;
mod sensors;

pub use engine::Stage;
pub use error::ReconstructError;
pub use export::{CameraReport, Report, ShotReport};
pub use photos::FocalSource;

use engine::Request;
use photos::Survey;
use std::path::{Path, PathBuf};

/// How photos are reconstructed.
#[derive(Debug, Clone)]
pub struct Options {
    /// A Python interpreter that has pycolmap.
    pub python: PathBuf,
    /// Focal length of every photo as a share of its longer side, where it is known better than the photos state it.
    pub focal_share: Option<f64>,
    /// Most pixels of a photo.
    pub max_image_pixels: u64,
    pub threads: usize,
    /// The same seed and photos give the same reconstruction.
    pub seed: u64,
}

/// Follows a reconstruction.
pub trait Observer {
    /// `done` of `total` photos, pairs of photos or placed photos of a stage.
    fn progress(&self, stage: Stage, done: usize, total: usize);

    /// Whether to stop; asked several times a second.
    fn is_cancelled(&self) -> bool {
        false
    }
}

/// Reconstructs the photos in `folder/images` and writes `reconstruction.json`, `reference_lla.json` and
/// `reconstruction-report.json` into `folder`, in place of those that are there. The world is local, east-north-up about
/// the mean of the photos' GNSS positions, height 0, metres.
///
/// # Errors
/// What keeps the photos from being reconstructed, with what to do. Nothing is written then.
pub fn reconstruct(folder: &Path, options: &Options, observer: &dyn Observer) -> Result<Report, ReconstructError> {
    let survey = Survey::read(folder, options)?;
    let work = tempfile::tempdir_in(folder)
        .map_err(|source| ReconstructError::NotWritable { path: folder.to_owned(), source })?;
    let request = Request::of(&survey, work.path(), options);
    let outcome = engine::run(&options.python, &request, observer)?;
    let report = Report::of(&survey, &outcome)?;
    export::write(folder, &survey, &outcome, &report)?;
    Ok(report)
}
