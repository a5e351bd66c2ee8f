//! A running job's images, shared with other workers: the side of the worker whose job it is.

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

/// How often it is looked whether others have found something.
const GATHER_EVERY: Duration = Duration::from_millis(100);

/// What a worker needs to know of an image to search it.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Errand {
    /// The image; its path is relative to the survey's folder.
    pub sought: ImageRequest,
    /// The bytes of its photo, SHA-256, hexadecimal.
    pub sha256: String,
}

/// The images of a claimed job, offered to all workers. Its methods block: they are called from the mapping's threads.
pub(super) struct Share {
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

/// What was offered, and what came back.
#[derive(Debug, Default)]
pub(super) struct State {
    /// The places of the images that were offered, by name; none while all are to be searched here.
    places: HashMap<String, usize>,
    found: VecDeque<(usize, Box<Found>)>,
    gathered: Option<Instant>,
}

impl Share {
    pub fn digests(files: &[FileRecord]) -> HashMap<PathBuf, Digest> {
        files.iter().map(|file| (PathBuf::from(file.path.as_str()), file.sha256)).collect()
    }

    /// Offers images; `false` where the job is in other hands. What cannot be offered is searched here.
    pub fn offer(&self, images: &[ImageRequest]) -> bool {
        let tasks: Option<Vec<ImageTask>> = images.iter().map(|image| self.task(image)).collect();
        let Some(tasks) = tasks else { return true };
        let offer = self.store.offer_tasks(&self.claim, &self.fingerprint, &self.mapper, &tasks);
        match self.runtime.block_on(offer) {
            Ok(true) => {
                let places = images.iter().enumerate().map(|(place, image)| (image.image.clone(), place));
                self.state().places = places.collect();
                true
            }
            Ok(false) => false,
            Err(error) => {
                tracing::warn!(%error, "the job's images cannot be offered to other workers");
                true
            }
        }
    }

    fn task(&self, image: &ImageRequest) -> Option<ImageTask> {
        let path = image.path.strip_prefix(&self.folder).ok()?.to_owned();
        let sha256 = self.digests.get(&path)?.to_string();
        let errand = Errand { sought: ImageRequest { path, ..image.clone() }, sha256 };
        Some(ImageTask { image: image.image.clone(), document: serde_json::to_string(&errand).ok()? })
    }

    /// What is next, of the images `left`.
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
            Ok(OwnTask::InOtherHands) => NextImage::Wait,
            // What others did and cannot be read, or what nobody has: it is searched here.
            Ok(OwnTask::None) => {
                self.gather(&mut state);
                match state.found.pop_front() {
                    Some((place, found)) => NextImage::Found(place, found),
                    None => NextImage::Search(left[0]),
                }
            }
            Err(error) => {
                // The heartbeat tells when this has lasted too long.
                tracing::warn!(%error, "cannot look which image is next");
                NextImage::Wait
            }
        }
    }

    /// Looks what others have found.
    fn gather(&self, state: &mut State) {
        state.gathered = Some(Instant::now());
        let found = match self.runtime.block_on(self.store.gather_tasks(&self.claim)) {
            Ok(found) => found,
            Err(error) => return tracing::warn!(%error, "cannot look what other workers have found"),
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

/// Where a photo of another worker's job is, read from a task.
///
/// # Errors
/// A task that this program does not write.
pub(super) fn errand(document: &str, plant: PlantId) -> Result<(Errand, Digest), StoreError> {
    let corrupt = || StoreError::Corrupt { what: "task", value: format!("a document of a job of plant {plant}") };
    let errand: Errand = serde_json::from_str(document).map_err(|_| corrupt())?;
    let sha256 = errand.sha256.parse().map_err(|()| corrupt())?;
    let inside = |path: &Path| path.components().all(|part| matches!(part, std::path::Component::Normal(_)));
    if inside(&errand.sought.path) { Ok((errand, sha256)) } else { Err(corrupt()) }
}
