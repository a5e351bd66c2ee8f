//! A worker: claims a job, maps its survey, stores the model.

use super::error::AttemptError;
use super::folder::JobFolder;
use super::helper::Helper;
use super::mapper::Mapper;
use super::publisher::TaskPublisher;
use super::rows;
use super::settings::WorkerSettings;
use super::watch::{Stop, Watch};
use crate::store::{Blobs, Claim, Completed, Digest, Ending, FileRecord, Heartbeat, NewModel, Store, StoreError};
use crate::telemetry::Metrics;
use crate::telemetry::metrics::OutcomeLabels;
use heliomap_mapping::pipeline::{MapError, MapOptions, Subject};
use heliomap_mapping::reconstruction::ProjectFolder;
use heliomap_model::PlantModel;
use jiff::{SignedDuration, Timestamp};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};
use tokio::runtime::Handle;
use tokio::sync::Notify;
use tokio_util::sync::CancellationToken;
use tracing::Instrument;

/// How long a job that this version cannot run waits for a worker of another version, from its creation.
const MAX_WAIT: SignedDuration = SignedDuration::from_hours(24);

/// How long a mapping may take to stop before its job ends without it.
const LINGER: Duration = Duration::from_millis(300);

/// Digest of all that checkpoints depend on: files, options and mapper.
fn fingerprint(files: &[FileRecord], options: &str, mapper: &str) -> String {
    let files: Vec<_> = files.iter().map(|file| (file.path.as_str(), file.sha256.to_string())).collect();
    Digest::of(serde_json::json!([files, options, mapper]).to_string().as_bytes()).to_string()
}

/// Runs jobs one after the other, and image tasks of other workers' jobs in between.
#[derive(Clone)]
pub struct Worker {
    pub name: String,
    pub store: Arc<dyn Store>,
    pub blobs: Blobs,
    pub mapper: Arc<dyn Mapper>,
    pub settings: WorkerSettings,
    pub metrics: Metrics,
    /// Notified when there may be work: by this process when it queues a job, and by the store.
    pub work_notify: Arc<Notify>,
}

impl Worker {
    /// Runs until `stop`; a job that is running then returns to the queue.
    pub async fn run(&self, stop: CancellationToken) {
        tracing::info!(worker = self.name, "worker started");
        tokio::select! {
            () = self.store.listen_for_work(&self.work_notify) => {}
            () = self.look_for_work(&stop) => {}
        }
        tracing::info!(worker = self.name, "worker stopped");
    }

    async fn look_for_work(&self, stop: &CancellationToken) {
        while !stop.is_cancelled() {
            let pause = match self.store.claim_job(&self.name, self.settings.lease, Timestamp::now()).await {
                Ok(Some(claim)) => {
                    let span = tracing::info_span!("job", job = %claim.job.id, plant = %claim.job.plant, attempt = claim.job.attempt);
                    self.work(claim, stop).instrument(span).await;
                    continue;
                }
                Ok(None) => match self.helper().help(stop).await {
                    Ok(0) => self.settings.poll,
                    Ok(images) => {
                        tracing::info!(images, "helped with the images of other workers' jobs");
                        continue;
                    }
                    Err(error) => {
                        tracing::error!(%error, "cannot help with the images of other workers' jobs");
                        self.settings.poll * 4
                    }
                },
                Err(error) => {
                    tracing::error!(%error, "cannot look for jobs");
                    self.settings.poll * 4
                }
            };
            tokio::select! {
                () = stop.cancelled() => {}
                () = self.work_notify.notified() => {}
                () = tokio::time::sleep(pause) => {}
            }
        }
    }

    /// The part of this worker that runs image tasks of other workers' jobs.
    fn helper(&self) -> Helper {
        Helper {
            store: self.store.clone(),
            blobs: self.blobs.clone(),
            mapper: self.mapper.clone(),
            settings: self.settings,
            metrics: self.metrics.clone(),
        }
    }

    /// Runs one job and records its outcome.
    async fn work(&self, claim: Claim, stop: &CancellationToken) {
        let begun = Instant::now();
        tracing::info!(plant = %claim.job.plant, survey = %claim.job.survey, "job started");
        let watch = Arc::new(Watch::default());
        let attempt = self.attempt(&claim, &watch);
        tokio::pin!(attempt);
        let outcome = tokio::select! {
            outcome = &mut attempt => Some(outcome),
            () = self.heartbeat_loop(&claim, &watch, stop) => None,
        };
        watch.end();
        let straggles = outcome.is_none();
        let outcome = outcome.unwrap_or(Err(MapError::Cancelled.into()));
        if let Err(error) = self.record_outcome(&claim, &watch, outcome).await {
            // The lease expires and the job is claimed again.
            tracing::error!(%error, "cannot record the end of the job");
        }
        if straggles && !stop.is_cancelled() {
            // The job has ended; its thread has to, before it and the next job's share this machine.
            let _ = attempt.await;
        }
        tracing::info!(seconds = begun.elapsed().as_secs_f64(), "job left");
    }

    /// Extends the lease and stores checkpoints for as long as it is polled. Returns where the attempt was ordered to stop and
    /// did not within [`LINGER`].
    async fn heartbeat_loop(&self, claim: &Claim, watch: &Watch, stop: &CancellationToken) {
        let mut last_answer = Instant::now();
        let mut stopping = false;
        loop {
            let pause = if stopping { LINGER } else { self.settings.heartbeat };
            tokio::select! {
                () = tokio::time::sleep(pause) => {}
                () = stop.cancelled(), if watch.stopped().is_none() => watch.stop(Stop::Shutdown),
            }
            self.store_checkpoints(claim, watch).await;
            let heartbeat = self.store.heartbeat(claim, watch.progress(), self.settings.lease, Timestamp::now());
            // Without a network there may be no answer at all, not even an error.
            let answer = tokio::time::timeout(self.settings.lease, heartbeat).await;
            match answer.unwrap_or(Err(StoreError::Silent)) {
                Ok(answer) => {
                    last_answer = Instant::now();
                    match answer {
                        Heartbeat::Continue => {}
                        Heartbeat::Cancel => watch.stop(Stop::Cancelled),
                        Heartbeat::Lost => watch.stop(Stop::Lost),
                    }
                }
                Err(error) => {
                    tracing::warn!(%error, "heartbeat failed");
                    let is_upgraded = matches!(error, StoreError::NewerSchema { .. });
                    if is_upgraded || last_answer.elapsed() > self.settings.lease {
                        watch.stop(Stop::Lost);
                    }
                }
            }
            if watch.stopped().is_some() {
                if stopping {
                    return;
                }
                stopping = true;
            }
        }
    }

    /// Keeps the lease of a job whose model is being stored, however long that takes; returns where the job was cancelled.
    async fn hold_until_cancelled(&self, claim: &Claim, watch: &Watch) {
        loop {
            tokio::time::sleep(self.settings.heartbeat).await;
            match self.store.heartbeat(claim, watch.progress(), self.settings.lease, Timestamp::now()).await {
                Ok(Heartbeat::Continue) => {}
                Ok(Heartbeat::Cancel) => return,
                // Either the model is stored now or the lease is lost: storing it returns which.
                Ok(Heartbeat::Lost) => std::future::pending().await,
                Err(error) => tracing::warn!(%error, "heartbeat failed"),
            }
        }
    }

    /// Stores new checkpoints; those that cannot be stored are kept for the next time.
    async fn store_checkpoints(&self, claim: &Claim, watch: &Watch) {
        let (fingerprint, found) = watch.take_checkpoints();
        if found.is_empty() {
            return;
        }
        let stored =
            tokio::time::timeout(self.settings.lease, self.store.checkpoint(claim, &fingerprint, &found)).await;
        match stored.unwrap_or(Err(StoreError::Silent)) {
            Ok(true) => {}
            Ok(false) => watch.stop(Stop::Lost),
            Err(error) => {
                tracing::warn!(%error, "cannot store checkpoints; trying again with the next heartbeat");
                watch.return_checkpoints(found);
            }
        }
    }

    /// Maps the survey and stores the model's bytes; the rows are left to [`Self::record_outcome`].
    async fn attempt(&self, claim: &Claim, watch: &Arc<Watch>) -> Result<NewModel, AttemptError> {
        let job = &claim.job;
        let options: MapOptions = serde_json::from_str(&job.options).map_err(AttemptError::Options)?;
        let gone = |what| StoreError::Gone { what };
        let plant = self.store.plant(job.plant).await?.ok_or(gone("plant"))?;
        let previous = match self.store.model(job.plant, None).await? {
            Some(model) => {
                let bytes = self.blobs.get(job.plant, model.sha256).await?;
                let model: PlantModel = serde_json::from_slice(&bytes)
                    .map_err(|source| AttemptError::PreviousModel { version: model.version, source })?;
                Some(Arc::new(model))
            }
            None => None,
        };
        let version = previous.as_ref().map_or(1, |previous| previous.version + 1);
        let subject = Subject { plant: plant.id, plant_name: plant.name, survey: job.survey.to_string(), previous };
        let files = self.store.files(job.survey).await?;
        let mapper = self.mapper.clone();
        let identity =
            tokio::task::spawn_blocking(move || mapper.identity()).await.map_err(|_| AttemptError::Panicked)?;
        let fingerprint = fingerprint(&files, &job.options, &identity);
        let known = self.store.checkpoints(job.id, &fingerprint).await?;
        if !known.is_empty() {
            tracing::info!(checkpoints = known.len(), "resuming from checkpoints");
        }
        let pace = self.store.last_stage_ms().await?;
        watch.begin(fingerprint.clone(), known, pace.and_then(|text| serde_json::from_str(&text).ok()));
        let folder = JobFolder::lay_out(&self.blobs, job.plant, &files).await?;
        watch.publish_by(TaskPublisher {
            store: self.store.clone(),
            claim: claim.clone(),
            fingerprint,
            mapper: identity,
            digests: TaskPublisher::digests(&files),
            folder: folder.path().to_owned(),
            runtime: Handle::current(),
            state: Mutex::default(),
        });

        let (mapper, observer) = (self.mapper.clone(), watch.clone());
        let span = tracing::Span::current();
        let mapping = tokio::task::spawn_blocking(move || {
            let _entered = span.enter();
            let mut model = mapper.run(&folder, &options, &subject, &*observer)?;
            model.version = version;
            let bytes = serde_json::to_vec(&model).map_err(std::io::Error::from)?;
            let layers = rows::layers(&model);
            Ok::<_, AttemptError>((bytes, layers, model.warnings))
        });
        let (bytes, layers, warnings) = mapping.await.map_err(|_| AttemptError::Panicked)??;
        let (sha256, size) = (Digest::of(&bytes), bytes.len() as u64);
        tracing::debug!(bytes = size, "storing the model begins");
        // Where the job does not complete, the model is an unused blob and is deleted later.
        self.store.reserve_model(job.plant, (sha256, size), Timestamp::now()).await?;
        self.blobs.put_bytes(job.plant, bytes).await?;
        let pace = watch.pace();
        if let Some(pace) = &pace {
            self.metrics.mapped(&pace.stage_ms);
        }
        let stage_ms = pace.map(|pace| serde_json::json!(pace).to_string());
        Ok(NewModel { version, sha256, size, warnings, stage_ms, layers })
    }

    /// Records how an attempt ended.
    async fn record_outcome(
        &self,
        claim: &Claim,
        watch: &Watch,
        outcome: Result<NewModel, AttemptError>,
    ) -> Result<(), StoreError> {
        let now = Timestamp::now();
        if outcome.is_err() {
            self.store_checkpoints(claim, watch).await;
        }
        let ending = match (outcome, watch.stopped()) {
            (_, Some(Stop::Lost)) => {
                tracing::warn!("lease lost; discarding result");
                return Ok(());
            }
            (Ok(model), _) => {
                let _ = self.store.heartbeat(claim, watch.progress(), self.settings.lease, now).await?;
                let completed = tokio::select! {
                    completed = self.store.complete_job(claim, &model, now) => Some(completed?),
                    () = self.hold_until_cancelled(claim, watch) => None,
                };
                match completed {
                    None => Ending::Cancelled,
                    Some(Completed::Done(model)) => {
                        self.count("succeeded");
                        tracing::info!(version = model.version, "model stored");
                        return Ok(());
                    }
                    Some(Completed::Fenced) => {
                        tracing::warn!("lease lost; discarding result");
                        return Ok(());
                    }
                    Some(Completed::Outdated) => Ending::Retry {
                        code: "outdated".to_owned(),
                        message: "the plant got another model meanwhile; the survey will be mapped again".to_owned(),
                        backoff: Duration::ZERO,
                    },
                }
            }
            (Err(_), Some(Stop::Cancelled)) => Ending::Cancelled,
            (Err(_), Some(Stop::Shutdown)) => Ending::Released,
            (Err(error), _) => self.ending(error, claim.job.created),
        };
        tracing::info!(?ending, "job ends without a model");
        self.count(match &ending {
            Ending::Failed { .. } => "failed",
            Ending::Retry { .. } => "tried_again",
            Ending::Declined { .. } => "declined",
            Ending::Cancelled => "cancelled",
            Ending::Released => "released",
        });
        if !self.store.end_job(claim, &ending, now).await? {
            tracing::warn!("lease lost; the end of the job is not recorded");
        }
        Ok(())
    }

    fn count(&self, outcome: &'static str) {
        self.metrics.attempts.get_or_create(&OutcomeLabels { outcome }).inc();
    }

    /// How a job ends after an error: its code and message, and whether it is retried.
    fn ending(&self, error: AttemptError, created: Timestamp) -> Ending {
        let retry = |code: &str, message: String| Ending::Retry {
            code: code.to_owned(),
            message,
            backoff: self.settings.backoff,
        };
        let internal = || Ending::Failed {
            code: "internal_error".to_owned(),
            message: "the mapping failed because of a fault in this program; see the log of the service".to_owned(),
        };
        match error {
            AttemptError::Map(MapError::Input { code, message }) => Ending::Failed { code: code.to_owned(), message },
            AttemptError::Map(MapError::Environment { message }) => retry("environment", message),
            AttemptError::Store(StoreError::Gone { what }) => {
                Ending::Failed { code: "gone".to_owned(), message: format!("the {what} was deleted meanwhile") }
            }
            AttemptError::Store(_) | AttemptError::Folder(_) => {
                tracing::error!(%error, "the environment failed");
                retry("environment", "the service's storage failed; see the log of the service".to_owned())
            }
            AttemptError::Options(_) | AttemptError::PreviousModel { .. } => {
                tracing::warn!(%error, "this job needs a worker of another version");
                let code = "another_version".to_owned();
                if created.duration_until(Timestamp::now()) > MAX_WAIT {
                    let message = format!("{error}, and no worker of the version that wrote it came within a day");
                    return Ending::Failed { code, message };
                }
                let message = format!("{error}: the job waits for a worker of the version that wrote it");
                Ending::Declined { code, message, pause: self.settings.backoff }
            }
            AttemptError::Map(MapError::Cancelled) | AttemptError::Panicked => {
                tracing::error!(%error, "the mapping failed");
                internal()
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cancelled_job_ends_within_two_seconds_whatever_the_lease() {
        for lease_s in [1, 30, 3600] {
            let settings = WorkerSettings::with_lease(Duration::from_secs(lease_s));
            // The worker notices at the next heartbeat, and leaves a mapping that does not stop a moment later.
            let latest = settings.heartbeat + LINGER;
            assert!(latest <= Duration::from_millis(1500), "{latest:?} with a lease of {lease_s} s");
        }
    }
}
