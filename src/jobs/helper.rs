//! A worker without a job runs image tasks of other workers' jobs.

use super::error::AttemptError;
use super::mapper::Mapper;
use super::publisher::read_task;
use super::settings::WorkerSettings;
use crate::store::{Blobs, GivenBack, Store, StoreError, TaskClaim};
use crate::telemetry::Metrics;
use heliomap_mapping::pipeline::{Found, Loaded, MapError};
use jiff::Timestamp;
use std::collections::HashMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use tokio::runtime::Handle;
use tokio_util::sync::CancellationToken;
use uuid::Uuid;

/// The tasks that this worker holds.
#[derive(Debug, Default)]
struct HeldTasks {
    tasks: Mutex<HashMap<Uuid, TaskClaim>>,
    /// Set when no more tasks are to be taken and those held are to be given back.
    stop: AtomicBool,
}

impl HeldTasks {
    fn tasks(&self) -> MutexGuard<'_, HashMap<Uuid, TaskClaim>> {
        self.tasks.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn stopped(&self) -> bool {
        self.stop.load(Ordering::Acquire)
    }
}

/// Runs image tasks of other workers' jobs.
#[derive(Clone)]
pub(super) struct Helper {
    pub store: Arc<dyn Store>,
    pub blobs: Blobs,
    pub mapper: Arc<dyn Mapper>,
    pub settings: WorkerSettings,
    pub metrics: Metrics,
}

impl Helper {
    /// Runs tasks of other workers' jobs for as long as there are some and no job waits; returns how many.
    ///
    /// # Errors
    /// A detector that cannot be opened or fails; a store that does not answer.
    pub async fn help(&self, stop: &CancellationToken) -> Result<usize, AttemptError> {
        if self.store.waiting_tasks(Timestamp::now()).await? == 0 {
            return Ok(0);
        }
        let mapper = self.mapper.clone();
        let identity =
            tokio::task::spawn_blocking(move || mapper.identity()).await.map_err(|_| AttemptError::Panicked)?;
        let Some(first) = self.store.take_task(&identity, self.settings.lease, Timestamp::now()).await? else {
            return Ok(0);
        };
        tracing::info!(job = %first.job, "helping with the images of a job");
        let held = Arc::new(HeldTasks::default());
        held.tasks().insert(first.token, first.clone());
        let runner = TaskRunner {
            helper: self.clone(),
            held: held.clone(),
            identity,
            first: Some(first),
            runtime: Handle::current(),
        };
        let searching = tokio::task::spawn_blocking(move || runner.run());
        tokio::pin!(searching);
        let outcome = tokio::select! {
            outcome = &mut searching => Some(outcome),
            () = self.extend_leases(&held, stop) => None,
        };
        let outcome = match outcome {
            Some(outcome) => outcome,
            None => {
                // Others need not wait for the leases to expire, nor for the image that is being processed.
                self.give_back(&held).await;
                searching.await
            }
        };
        let outcome = outcome.map_err(|_| AttemptError::Panicked).flatten();
        self.give_back(&held).await;
        match outcome {
            Err(AttemptError::Map(MapError::Cancelled)) => Ok(0),
            other => other,
        }
    }

    /// Extends the leases of held tasks until `stop`.
    async fn extend_leases(&self, held: &HeldTasks, stop: &CancellationToken) {
        loop {
            tokio::select! {
                () = tokio::time::sleep(self.settings.heartbeat) => {}
                () = stop.cancelled() => {
                    held.stop.store(true, Ordering::Release);
                    return;
                }
            }
            let tokens: Vec<Uuid> = held.tasks().keys().copied().collect();
            let extended = self.store.extend_tasks(&tokens, self.settings.lease, Timestamp::now());
            let extended = tokio::time::timeout(self.settings.lease, extended).await;
            match extended.unwrap_or(Err(StoreError::Silent)) {
                // Results of lost tasks are discarded later.
                Ok(kept) if kept.len() < tokens.len() => tracing::info!("a job that this worker helps with has ended"),
                Ok(_) => {}
                Err(error) => tracing::warn!(%error, "cannot extend the leases of images"),
            }
        }
    }

    /// Gives back all tasks that are still held.
    async fn give_back(&self, held: &HeldTasks) {
        let held: Vec<TaskClaim> = held.tasks().drain().map(|(_, claim)| claim).collect();
        for claim in held {
            if let Err(error) = self.store.give_back_task(&claim, GivenBack::ToAll).await {
                tracing::warn!(%error, "cannot give back an image; its lease will expire");
            }
        }
    }
}

/// Takes and runs tasks one after the other, on threads that may block.
struct TaskRunner {
    helper: Helper,
    held: Arc<HeldTasks>,
    identity: String,
    first: Option<TaskClaim>,
    runtime: Handle,
}

impl TaskRunner {
    /// Runs until there are no more tasks; returns how many were completed.
    fn run(mut self) -> Result<usize, AttemptError> {
        let (helper, held, runtime) = (self.helper.clone(), self.held.clone(), self.runtime.clone());
        let mapper: Arc<dyn Mapper> = helper.mapper.clone();
        let mut completed = 0;
        let mut found = |claim: TaskClaim, found: Found| {
            held.tasks().remove(&claim.token);
            let mut document = Vec::new();
            if ciborium::into_writer(&found, &mut document).is_err() {
                return;
            }
            match runtime.block_on(helper.store.finish_task(&claim, &document)) {
                Ok(true) => {
                    completed += 1;
                    helper.metrics.images_helped.inc();
                }
                Ok(false) => tracing::info!(job = %claim.job, "lease of an image lost; discarding result"),
                Err(error) => tracing::warn!(%error, "cannot store the result of an image"),
            }
        };
        let stopping = self.held.clone();
        let mut next = || self.next();
        mapper.search(&mut next, &mut found, &move || stopping.stopped())?;
        Ok(completed)
    }

    /// The next image, loaded; `None` where this worker gets no more.
    fn next(&mut self) -> Option<Result<Loaded<TaskClaim>, MapError>> {
        loop {
            if self.held.stopped() {
                return None;
            }
            let claim = match self.first.take() {
                Some(first) => first,
                None => self.take()?,
            };
            match self.runtime.block_on(self.load(&claim)) {
                Ok(loaded) => return Some(Ok(loaded)),
                Err(error) => {
                    self.held.tasks().remove(&claim.token);
                    // The job's own worker has the photo, or reports what is wrong with it.
                    tracing::warn!(%error, job = %claim.job, image = claim.task.image, "leaving an image to its job's own worker");
                    let back = self.helper.store.give_back_task(&claim, GivenBack::ToOwner);
                    if let Err(error) = self.runtime.block_on(back) {
                        tracing::warn!(%error, "cannot give back an image; its lease will expire");
                        return None;
                    }
                }
            }
        }
    }

    /// Takes another task, unless a job waits, which comes first.
    fn take(&self) -> Option<TaskClaim> {
        let (store, lease) = (&self.helper.store, self.helper.settings.lease);
        let taken = self.runtime.block_on(async {
            let now = Timestamp::now();
            if store.queue(now).await?.waiting > 0 {
                Ok(None)
            } else {
                store.take_task(&self.identity, lease, now).await
            }
        });
        match taken {
            Ok(taken) => {
                let claim = taken?;
                self.held.tasks().insert(claim.token, claim.clone());
                Some(claim)
            }
            Err(error) => {
                tracing::warn!(%error, "cannot look for image tasks");
                None
            }
        }
    }

    async fn load(&self, claim: &TaskClaim) -> Result<Loaded<TaskClaim>, AttemptError> {
        let (task, sha256) = read_task(&claim.task.document, claim.plant)?;
        let blobs = &self.helper.blobs;
        let folder = tempfile::Builder::new().prefix("image-").tempdir_in(blobs.staging())?;
        let name = task.request.path.file_name().ok_or(StoreError::Gone { what: "image" })?;
        let path = folder.path().join(name);
        blobs.place(claim.plant, sha256, &path).await?;
        let pixels = task.request.load(&path)?;
        let (image, gsd_m) = (task.request.image, task.request.gsd_m);
        Ok(Loaded { key: claim.clone(), image, pixels, gsd_m })
    }
}
