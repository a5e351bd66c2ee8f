//! What a worker runs.

use crate::store::{Digest, TaskClaim};
use heliomap_mapping::detection::{DetectionError, Detector};
use heliomap_mapping::pipeline::{self, Boxes, Found, Loaded, MapError, MapOptions, Observer, Subject, search};
use heliomap_mapping::reconstruction::ProjectFolder;
use heliomap_model::PlantModel;
use std::path::Path;
use std::sync::{Arc, Mutex, OnceLock, PoisonError, TryLockError};

/// Maps the plant in a folder. Called on a thread of its own.
pub trait Mapper: Send + Sync + 'static {
    /// Runs [`pipeline::map_folder`] and returns the model.
    fn run(
        &self,
        folder: &dyn ProjectFolder,
        options: &MapOptions,
        subject: &Subject,
        observer: &dyn Observer,
    ) -> Result<PlantModel, MapError>;

    /// Runs the detector on images of other workers' jobs, as [`search::search`] does, and hands each result to `found`.
    fn search(&self, next: &mut NextTask<'_>, found: &mut FoundInTask<'_>, stop: &Stopped<'_>) -> Result<(), MapError>;

    /// Identifies mappers that give the same results: equal only for equal programs with equal detectors.
    fn identity(&self) -> String;
}

/// Gives the next image of another worker's job.
pub type NextTask<'a> = dyn FnMut() -> Option<Result<Loaded<TaskClaim>, MapError>> + Send + 'a;
/// Takes the result of an image.
pub type FoundInTask<'a> = dyn FnMut(TaskClaim, Found) + Send + 'a;
/// Whether to stop.
pub type Stopped<'a> = dyn Fn() -> bool + Sync + 'a;

/// The file of a survey with boxes to use instead of a detector.
const BOXES_FILE: &str = "boxes.json";

/// Opens a detector.
pub type OpenDetector = dyn Fn() -> Result<Arc<dyn Detector>, DetectionError> + Send + Sync;

/// The pipeline with its detector, which is opened once and kept. Where it cannot be opened, every job tries again.
pub struct PipelineMapper {
    open: Box<OpenDetector>,
    detector: Mutex<Option<Arc<dyn Detector>>>,
}

impl PipelineMapper {
    /// A mapper whose detector `open` gives.
    pub fn new(open: Box<OpenDetector>) -> Self {
        Self { open, detector: Mutex::new(None) }
    }

    /// Opens the detector, so that errors appear before a job needs it.
    ///
    /// # Errors
    /// A detector that cannot be opened.
    pub fn open(&self) -> Result<(), DetectionError> {
        self.opened().map(drop)
    }

    /// Whether the detector is open, or just being opened.
    pub fn has_detector(&self) -> bool {
        match self.detector.try_lock() {
            Ok(kept) => kept.is_some(),
            Err(TryLockError::WouldBlock) => true,
            Err(TryLockError::Poisoned(kept)) => kept.into_inner().is_some(),
        }
    }

    fn detector(&self) -> Result<Arc<dyn Detector>, MapError> {
        self.opened().map_err(|error| MapError::Environment { message: error.to_string() })
    }

    fn opened(&self) -> Result<Arc<dyn Detector>, DetectionError> {
        let mut kept = self.detector.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(detector) = &*kept {
            return Ok(detector.clone());
        }
        let detector = (self.open)()?;
        tracing::info!(detector = detector.describe(), "detector opened");
        *kept = Some(detector.clone());
        Ok(detector)
    }
}

impl Mapper for PipelineMapper {
    fn run(
        &self,
        folder: &dyn ProjectFolder,
        options: &MapOptions,
        subject: &Subject,
        observer: &dyn Observer,
    ) -> Result<PlantModel, MapError> {
        let boxes = folder.path().join(BOXES_FILE);
        let mapping = if boxes.is_file() {
            pipeline::map_folder(folder, Boxes::File(&boxes), options, subject, observer)
        } else {
            let detector = self.detector()?;
            pipeline::map_folder(folder, Boxes::Detector(&*detector), options, subject, observer)
        };
        let mapping = mapping.map_err(|error| as_in_the_survey(error, folder.path()))?;
        for timing in &mapping.timings {
            tracing::debug!(stage = timing.stage.as_str(), seconds = timing.wall.as_secs_f64(), "stage finished");
        }
        Ok(mapping.model)
    }

    fn search(&self, next: &mut NextTask<'_>, found: &mut FoundInTask<'_>, stop: &Stopped<'_>) -> Result<(), MapError> {
        search::search(&*self.detector()?, next, found, stop).map(drop)
    }

    fn identity(&self) -> String {
        // Without a detector it maps surveys that have boxes.
        let detector = self.opened().map_or_else(|_| "without a detector".to_owned(), |detector| detector.identity());
        format!("{} {detector}", program())
    }
}

/// The digest of this program's file: another build may give other results. A file that cannot be read is never equal.
fn program() -> &'static str {
    static PROGRAM: OnceLock<String> = OnceLock::new();
    PROGRAM.get_or_init(|| {
        let digest = std::env::current_exe().and_then(|program| Digest::of_file(&program));
        digest.map_or_else(|_| uuid::Uuid::new_v4().to_string(), |digest| digest.to_string())
    })
}

/// Replaces paths in this worker's folders by the names of the survey's files.
fn as_in_the_survey(error: MapError, folder: &Path) -> MapError {
    match error {
        MapError::Input { code, message } => {
            MapError::Input { code, message: message.replace(&format!("{}/", folder.display()), "") }
        }
        other => other,
    }
}
