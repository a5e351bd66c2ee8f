//! A worker without a job of its own helps with the images of those that run.

use super::{AttemptError, Mapper, Worker, share};
use crate::store::{GivenBack, StoreError, TaskClaim};
use heliomap_mapping::pipeline::{Found, Loaded, MapError};
use jiff::Timestamp;
use std::collections::HashMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use tokio::runtime::Handle;
use tokio_util::sync::CancellationToken;
use uuid::Uuid;

/// The tasks in this worker's hands.
#[derive(Debug, Default)]
struct Hands {
    held: Mutex<HashMap<Uuid, TaskClaim>>,
    /// Raised when no more are to be taken and those held are to be left.
    stop: AtomicBool,
}

impl Hands {
    fn held(&self) -> MutexGuard<'_, HashMap<Uuid, TaskClaim>> {
        self.held.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn stopped(&self) -> bool {
        self.stop.load(Ordering::Acquire)
    }
}

impl Worker {
    /// Searches images of other workers' jobs for as long as there are some and no job waits; how many that were.
    ///
    /// # Errors
    /// A detector that cannot be opened or fails; a store that does not answer.
    pub(super) async fn help(&self, stop: &CancellationToken) -> Result<usize, AttemptError> {
        if self.store.waiting_tasks(Timestamp::now()).await? == 0 {
            return Ok(0);
        }
        let mapper = self.mapper.clone();
        let identity =
            tokio::task::spawn_blocking(move || mapper.identity()).await.map_err(|_| AttemptError::Panicked)?;
        let Some(first) = self.store.take_task(&identity, self.settings.lease, Timestamp::now()).await? else {
            return Ok(0);
        };
        tracing::info!(job = %first.job, "helps with the images of a job");
        let hands = Arc::new(Hands::default());
        hands.held().insert(first.token, first.clone());
        let errands = Errands {
            worker: self.clone(),
            hands: hands.clone(),
            identity,
            first: Some(first),
            runtime: Handle::current(),
        };
        let searching = tokio::task::spawn_blocking(move || errands.run());
        tokio::pin!(searching);
        let outcome = tokio::select! {
            outcome = &mut searching => Some(outcome),
            () = self.keep_hands(&hands, stop) => None,
        };
        let outcome = match outcome {
            Some(outcome) => outcome,
            None => {
                // Others need not wait for the leases to end, nor for the image that is being searched.
                self.leave(&hands).await;
                searching.await
            }
        };
        let outcome = outcome.map_err(|_| AttemptError::Panicked).flatten();
        self.leave(&hands).await;
        match outcome {
            Err(AttemptError::Map(MapError::Cancelled)) => Ok(0),
            other => other,
        }
    }

    /// Extends the leases for as long as it is polled, until the worker is told to stop.
    async fn keep_hands(&self, hands: &Hands, stop: &CancellationToken) {
        loop {
            tokio::select! {
                () = tokio::time::sleep(self.settings.heartbeat) => {}
                () = stop.cancelled() => {
                    hands.stop.store(true, Ordering::Release);
                    return;
                }
            }
            let tokens: Vec<Uuid> = hands.held().keys().copied().collect();
            let extended = self.store.extend_tasks(&tokens, self.settings.lease, Timestamp::now());
            let extended = tokio::time::timeout(self.settings.lease, extended).await;
            match extended.unwrap_or(Err(StoreError::Silent)) {
                // What is lost meanwhile is dropped when it is found.
                Ok(held) if held.len() < tokens.len() => tracing::info!("a job that this worker helps with is over"),
                Ok(_) => {}
                Err(error) => tracing::warn!(%error, "the leases of images cannot be extended"),
            }
        }
    }

    /// Gives back all tasks that are still held.
    async fn leave(&self, hands: &Hands) {
        let held: Vec<TaskClaim> = hands.held().drain().map(|(_, claim)| claim).collect();
        for claim in held {
            if let Err(error) = self.store.give_back_task(&claim, GivenBack::ToAll).await {
                tracing::warn!(%error, "an image cannot be given back; its lease ends");
            }
        }
    }
}

/// The tasks that are taken and searched one after the other, on threads that may block.
struct Errands {
    worker: Worker,
    hands: Arc<Hands>,
    identity: String,
    first: Option<TaskClaim>,
    runtime: Handle,
}

impl Errands {
    /// How many images were searched.
    fn run(mut self) -> Result<usize, AttemptError> {
        let (worker, hands, runtime) = (self.worker.clone(), self.hands.clone(), self.runtime.clone());
        let mapper: Arc<dyn Mapper> = worker.mapper.clone();
        let mut searched = 0;
        let mut found = |claim: TaskClaim, found: Found| {
            hands.held().remove(&claim.token);
            let mut document = Vec::new();
            if ciborium::into_writer(&found, &mut document).is_err() {
                return;
            }
            match runtime.block_on(worker.store.finish_task(&claim, &document)) {
                Ok(true) => {
                    searched += 1;
                    worker.metrics.images_helped.inc();
                }
                Ok(false) => tracing::info!(job = %claim.job, "an image was searched that is in other hands by now"),
                Err(error) => tracing::warn!(%error, "what was found in an image cannot be kept"),
            }
        };
        let stopping = self.hands.clone();
        let mut next = || self.next();
        mapper.search(&mut next, &mut found, &move || stopping.stopped())?;
        Ok(searched)
    }

    /// The next image, loaded; `None` where there is no more for this worker.
    fn next(&mut self) -> Option<Result<Loaded<TaskClaim>, MapError>> {
        loop {
            if self.hands.stopped() {
                return None;
            }
            let claim = match self.first.take() {
                Some(first) => first,
                None => self.take()?,
            };
            match self.runtime.block_on(self.load(&claim)) {
                Ok(loaded) => return Some(Ok(loaded)),
                Err(error) => {
                    self.hands.held().remove(&claim.token);
                    // The job's own worker has the photo, or says better what is wrong with it.
                    tracing::warn!(%error, job = %claim.job, image = claim.task.image, "an image is left to its job");
                    let back = self.worker.store.give_back_task(&claim, GivenBack::ToOwner);
                    if let Err(error) = self.runtime.block_on(back) {
                        tracing::warn!(%error, "an image cannot be given back; its lease ends");
                        return None;
                    }
                }
            }
        }
    }

    /// Takes another task, unless a job waits, which comes first.
    fn take(&self) -> Option<TaskClaim> {
        let (store, lease) = (&self.worker.store, self.worker.settings.lease);
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
                self.hands.held().insert(claim.token, claim.clone());
                Some(claim)
            }
            Err(error) => {
                tracing::warn!(%error, "cannot look for images of other workers' jobs");
                None
            }
        }
    }

    async fn load(&self, claim: &TaskClaim) -> Result<Loaded<TaskClaim>, AttemptError> {
        let (errand, sha256) = share::errand(&claim.task.document, claim.plant)?;
        let blobs = &self.worker.blobs;
        let folder = tempfile::Builder::new().prefix("image-").tempdir_in(blobs.staging())?;
        let name = errand.sought.path.file_name().ok_or(StoreError::Gone { what: "image" })?;
        let path = folder.path().join(name);
        blobs.place(claim.plant, sha256, &path).await?;
        let pixels = errand.sought.load(&path)?;
        let (image, gsd_m) = (errand.sought.image, errand.sought.gsd_m);
        Ok(Loaded { key: claim.clone(), image, pixels, gsd_m })
    }
}
