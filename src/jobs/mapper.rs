//! What a worker runs.

use crate::pipeline::{self, MapError, MapOptions, Mapping, Observer, Subject};
use std::path::{Path, PathBuf};

/// Maps the plant in a folder. Called on a thread of its own.
pub trait Mapper: Send + Sync + 'static {
    /// As [`pipeline::map_folder`].
    fn map(
        &self,
        folder: &Path,
        options: &MapOptions,
        subject: &Subject,
        observer: &dyn Observer,
    ) -> Result<Mapping, MapError>;
}

/// The pipeline with its detector.
#[derive(Debug, Clone)]
pub struct PipelineMapper {
    /// The detector's ONNX file.
    pub detector: PathBuf,
}

impl Mapper for PipelineMapper {
    fn map(
        &self,
        folder: &Path,
        options: &MapOptions,
        subject: &Subject,
        observer: &dyn Observer,
    ) -> Result<Mapping, MapError> {
        pipeline::map_folder(folder, &self.detector, options, subject, observer)
    }
}
