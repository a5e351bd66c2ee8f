//! Publishes the images of a running job as tasks that other workers may run, and collects their results.

use crate::store::{Claim, Digest, FileRecord, ImageTask, OwnTask, Store, StoreError};
use heliomap_mapping::pipeline::{Found, ImageRequest, NextImage};
use heliomap_model::PlantId;
use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use std::collections::{HashMap, VecDeque};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};
use tokio::runtime::Handle;

/// How often results of other workers are collected.
const GATHER_EVERY: Duration = Duration::from_millis(100);

/// What a worker needs to know of an image to run the detector on it.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct TaskDocument {
    /// The image; its path is relative to the survey's folder.
    pub request: ImageRequest,
    /// Digest of its photo, hexadecimal.
    pub sha256: String,
}

/// Publishes the images of one claimed job. Its methods block: they are called from the mapping's threads.
pub(super) struct TaskPublisher {
    pub store: Arc<dyn Store>,
    pub claim: Claim,
    pub fingerprint: String,
    pub mapper: String,
    /// Of the survey's files, by their paths.
    pub digests: HashMap<PathBuf, Digest>,
    /// Where the survey's files are laid out.
    pub folder: PathBuf,
    pub runtime: Handle,
    pub state: Mutex<State>,
}

/// Tasks that were published, and results that came back.
#[derive(Debug, Default)]
pub(super) struct State {
    /// Positions of the published images, by name; empty while all images are processed here.
    places: HashMap<String, usize>,
    found: VecDeque<(usize, Box<Found>)>,
    gathered: Option<Instant>,
}

impl TaskPublisher {
    pub fn digests(files: &[FileRecord]) -> HashMap<PathBuf, Digest> {
        files.iter().map(|file| (PathBuf::from(file.path.as_str()), file.sha256)).collect()
    }

    /// Publishes images; `false` where the lease of the job was lost. Images that cannot be published are processed here.
    pub fn offer(&self, images: &[ImageRequest]) -> bool {
        let tasks: Option<Vec<ImageTask>> = images.iter().map(|image| self.task(image)).collect();
        let Some(tasks) = tasks else { return true };
        let offer = self.store.offer_tasks(&self.claim, &self.fingerprint, &self.mapper, &tasks);
        match self.runtime.block_on(offer) {
            Ok(true) => {
                let places = images.iter().enumerate().map(|(place, image)| (image.image.clone(), place));
                let mut state = self.state();
                state.places = places.collect();
                // Positions of images that were offered before are none of these.
                state.found.clear();
                true
            }
            Ok(false) => false,
            Err(error) => {
                tracing::warn!(%error, "cannot publish the job's images to other workers");
                true
            }
        }
    }

    fn task(&self, image: &ImageRequest) -> Option<ImageTask> {
        let path = image.path.strip_prefix(&self.folder).ok()?.to_owned();
        let sha256 = self.digests.get(&path)?.to_string();
        let document = TaskDocument { request: ImageRequest { path, ..image.clone() }, sha256 };
        Some(ImageTask { image: image.image.clone(), document: serde_json::to_string(&document).ok()? })
    }

    /// What to do next, of the images `left`.
    pub fn next(&self, left: &[usize]) -> NextImage {
        let mut state = self.state();
        if state.places.is_empty() {
            return NextImage::Search(left[0]);
        }
        if state.gathered.is_none_or(|last| last.elapsed() >= GATHER_EVERY) {
            self.gather(&mut state);
        }
        if let Some((place, found)) = state.found.pop_front() {
            return NextImage::Found(place, found);
        }
        match self.runtime.block_on(self.store.take_own_task(&self.claim, Timestamp::now())) {
            Ok(OwnTask::Image(image)) => match state.places.get(&image) {
                Some(place) if left.contains(place) => NextImage::Search(*place),
                _ => NextImage::Wait,
            },
            Ok(OwnTask::HeldByOthers) => NextImage::Wait,
            // Results that cannot be read, or tasks that are gone: the image is processed here.
            Ok(OwnTask::None) => {
                self.gather(&mut state);
                match state.found.pop_front() {
                    Some((place, found)) => NextImage::Found(place, found),
                    None => NextImage::Search(left[0]),
                }
            }
            Err(error) => {
                // The heartbeat ends the job where this lasts too long.
                tracing::warn!(%error, "cannot take the next image");
                NextImage::Wait
            }
        }
    }

    /// Collects results of other workers.
    fn gather(&self, state: &mut State) {
        state.gathered = Some(Instant::now());
        let found = match self.runtime.block_on(self.store.gather_tasks(&self.claim)) {
            Ok(found) => found,
            Err(error) => return tracing::warn!(%error, "cannot collect results of other workers"),
        };
        for checkpoint in found {
            let document: Result<Found, _> = ciborium::from_reader(checkpoint.document.as_slice());
            if let (Some(place), Ok(found)) = (state.places.get(&checkpoint.name).copied(), document) {
                state.found.push_back((place, Box::new(found)));
            }
        }
    }

    fn state(&self) -> std::sync::MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Reads the document of a task; the digest of its photo comes apart.
///
/// # Errors
/// A document that this program does not write.
pub(super) fn read_task(document: &str, plant: PlantId) -> Result<(TaskDocument, Digest), StoreError> {
    let corrupt = || StoreError::Corrupt { what: "task", value: format!("a document of a job of plant {plant}") };
    let task: TaskDocument = serde_json::from_str(document).map_err(|_| corrupt())?;
    let sha256 = task.sha256.parse().map_err(|()| corrupt())?;
    let inside = |path: &Path| path.components().all(|part| matches!(part, std::path::Component::Normal(_)));
    if inside(&task.request.path) { Ok((task, sha256)) } else { Err(corrupt()) }
}
