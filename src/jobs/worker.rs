//! A worker: claims a job, maps its survey, hands in the model.

use super::folder::JobFolder;
use super::share::Share;
use super::watch::{Stop, Watch};
use super::{AttemptError, Mapper, rows};
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

/// A worker's times.
#[derive(Debug, Clone, Copy)]
pub struct WorkerSettings {
    /// How long a silent worker keeps its job.
    pub lease: Duration,
    /// How often a worker reports and hears of cancellation; far below `lease`.
    pub heartbeat: Duration,
    /// How often an idle worker looks for work.
    pub poll: Duration,
    /// How long after a first failure of the environment a job is tried again, as [`Ending::Retry`] has it.
    pub backoff: Duration,
}

impl WorkerSettings {
    /// The usual times, but for the lease.
    pub fn with_lease(lease: Duration) -> Self {
        Self {
            lease,
            heartbeat: Duration::from_secs(1).min(lease / 4),
            poll: Duration::from_secs(1),
            backoff: Duration::from_secs(5),
        }
    }
}

/// How long a job that this version cannot do waits for another, from its beginning.
const LONGEST_WAIT: SignedDuration = SignedDuration::from_hours(24);

/// How long a mapping that was told to stop may take before its job ends without it.
const LINGER: Duration = Duration::from_millis(300);

/// What a job's findings depend on: its files, its options, and what looks at them.
fn fingerprint(files: &[FileRecord], options: &str, mapper: &str) -> String {
    let files: Vec<_> = files.iter().map(|file| (file.path.as_str(), file.sha256.to_string())).collect();
    Digest::of(serde_json::json!([files, options, mapper]).to_string().as_bytes()).to_string()
}

/// Runs jobs one after the other, and helps others with theirs in between.
#[derive(Clone)]
pub struct Worker {
    pub name: String,
    pub store: Arc<dyn Store>,
    pub blobs: Blobs,
    pub mapper: Arc<dyn Mapper>,
    pub settings: WorkerSettings,
    pub metrics: Metrics,
    /// Rung when there may be work: by this process when it queues a job, and by the store.
    pub bell: Arc<Notify>,
}

impl Worker {
    /// Runs until `stop`; a job that is running then goes back to the queue.
    pub async fn run(&self, stop: CancellationToken) {
        tracing::info!(worker = self.name, "worker started");
        tokio::select! {
            () = self.store.ring_for_work(&self.bell) => {}
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
                Ok(None) => match self.help(stop).await {
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
                () = self.bell.notified() => {}
                () = tokio::time::sleep(pause) => {}
            }
        }
    }

    /// Runs one job to whatever end.
    async fn work(&self, claim: Claim, stop: &CancellationToken) {
        let begun = Instant::now();
        tracing::info!(plant = %claim.job.plant, survey = %claim.job.survey, "job started");
        let watch = Arc::new(Watch::default());
        let attempt = self.attempt(&claim, &watch);
        tokio::pin!(attempt);
        let outcome = tokio::select! {
            outcome = &mut attempt => Some(outcome),
            () = self.beat(&claim, &watch, stop) => None,
        };
        watch.end();
        let straggles = outcome.is_none();
        let outcome = outcome.unwrap_or(Err(MapError::Cancelled.into()));
        if let Err(error) = self.settle(&claim, &watch, outcome).await {
            // The lease runs out and the job is taken up again.
            tracing::error!(%error, "cannot record the end of the job");
        }
        if straggles && !stop.is_cancelled() {
            // The job has ended; its thread has to, before it and the next job's share this machine.
            let _ = attempt.await;
        }
        tracing::info!(seconds = begun.elapsed().as_secs_f64(), "job left");
    }

    /// Reports and keeps what was found, for as long as it is polled, or until the attempt was told to stop and did not
    /// within a moment.
    async fn beat(&self, claim: &Claim, watch: &Watch, stop: &CancellationToken) {
        let mut heard = Instant::now();
        let mut told = false;
        loop {
            let pause = if told { LINGER } else { self.settings.heartbeat };
            tokio::select! {
                () = tokio::time::sleep(pause) => {}
                () = stop.cancelled(), if watch.stopped().is_none() => watch.stop(Stop::Shutdown),
            }
            self.keep(claim, watch).await;
            let heartbeat = self.store.heartbeat(claim, watch.progress(), self.settings.lease, Timestamp::now());
            // Who is cut off gets no answer, not even that.
            let answer = tokio::time::timeout(self.settings.lease, heartbeat).await;
            match answer.unwrap_or(Err(StoreError::Silent)) {
                Ok(answer) => {
                    heard = Instant::now();
                    match answer {
                        Heartbeat::Continue => {}
                        Heartbeat::Cancel => watch.stop(Stop::Cancelled),
                        Heartbeat::Lost => watch.stop(Stop::Lost),
                    }
                }
                Err(error) => {
                    tracing::warn!(%error, "heartbeat failed");
                    if heard.elapsed() > self.settings.lease {
                        watch.stop(Stop::Lost);
                    }
                }
            }
            if watch.stopped().is_some() {
                if told {
                    return;
                }
                told = true;
            }
        }
    }

    /// Holds on to a job whose model is being stored, however long that takes; comes back where the job was cancelled.
    async fn hold_until_cancelled(&self, claim: &Claim, watch: &Watch) {
        loop {
            tokio::time::sleep(self.settings.heartbeat).await;
            match self.store.heartbeat(claim, watch.progress(), self.settings.lease, Timestamp::now()).await {
                Ok(Heartbeat::Continue) => {}
                Ok(Heartbeat::Cancel) => return,
                // Whether that is because the model is stored, its storing tells.
                Ok(Heartbeat::Lost) => std::future::pending().await,
                Err(error) => tracing::warn!(%error, "heartbeat failed"),
            }
        }
    }

    /// Stores what was found since the last time. What cannot be stored now is tried again the next time.
    async fn keep(&self, claim: &Claim, watch: &Watch) {
        let (fingerprint, found) = watch.take_found();
        if found.is_empty() {
            return;
        }
        let kept = tokio::time::timeout(self.settings.lease, self.store.checkpoint(claim, &fingerprint, &found)).await;
        match kept.unwrap_or(Err(StoreError::Silent)) {
            Ok(true) => {}
            Ok(false) => watch.stop(Stop::Lost),
            Err(error) => {
                tracing::warn!(%error, "what was found so far cannot be kept now");
                watch.give_back(found);
            }
        }
    }

    /// Maps the survey and stores the model's bytes; the rows are left to [`Self::settle`].
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
            tracing::info!(findings = known.len(), "the job goes on where it was");
        }
        let pace = self.store.last_stage_ms().await?;
        watch.begin(fingerprint.clone(), known, pace.and_then(|text| serde_json::from_str(&text).ok()));
        let folder = JobFolder::lay_out(&self.blobs, job.plant, &files).await?;
        watch.share(Share {
            store: self.store.clone(),
            claim: claim.clone(),
            fingerprint,
            mapper: identity,
            digests: Share::digests(&files),
            folder: folder.path().to_owned(),
            runtime: Handle::current(),
            state: Mutex::default(),
        });

        let (mapper, observer) = (self.mapper.clone(), watch.clone());
        let span = tracing::Span::current();
        let mapping = tokio::task::spawn_blocking(move || {
            let _entered = span.enter();
            let mut model = mapper.map(&folder, &options, &subject, &*observer)?;
            model.version = version;
            let bytes = serde_json::to_vec(&model).map_err(std::io::Error::from)?;
            let layers = rows::layers(&model);
            Ok::<_, AttemptError>((bytes, layers, model.warnings))
        });
        let (bytes, layers, warnings) = mapping.await.map_err(|_| AttemptError::Panicked)??;
        let (sha256, size) = (Digest::of(&bytes), bytes.len() as u64);
        tracing::debug!(bytes = size, "storing the model begins");
        // Where the job does not come to its end, the model is one of the blobs that nothing names.
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
    async fn settle(
        &self,
        claim: &Claim,
        watch: &Watch,
        outcome: Result<NewModel, AttemptError>,
    ) -> Result<(), StoreError> {
        let now = Timestamp::now();
        if outcome.is_err() {
            self.keep(claim, watch).await;
        }
        let ending = match (outcome, watch.stopped()) {
            (_, Some(Stop::Lost)) => {
                tracing::warn!("the job is in other hands or gone; its result is dropped");
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
                        tracing::warn!("the job is in other hands or gone; its result is dropped");
                        return Ok(());
                    }
                    Some(Completed::Outdated) => Ending::Retry {
                        code: "outdated".to_owned(),
                        message: "the plant got another model meanwhile; the survey is mapped again".to_owned(),
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
            tracing::warn!("the job is in other hands or gone");
        }
        Ok(())
    }

    fn count(&self, outcome: &'static str) {
        self.metrics.attempts.get_or_create(&OutcomeLabels { outcome }).inc();
    }

    /// What is said of an error, and whether the job is tried again.
    fn ending(&self, error: AttemptError, created: Timestamp) -> Ending {
        let retry = |code: &str, message: String| Ending::Retry {
            code: code.to_owned(),
            message,
            backoff: self.settings.backoff,
        };
        let internal = || Ending::Failed {
            code: "internal_error".to_owned(),
            message: "the mapping failed for a reason that is a fault of this program; its log says more".to_owned(),
        };
        match error {
            AttemptError::Map(MapError::Input { code, message }) => Ending::Failed { code: code.to_owned(), message },
            AttemptError::Map(MapError::Environment { message }) => retry("environment", message),
            AttemptError::Store(StoreError::Gone { what }) => {
                Ending::Failed { code: "gone".to_owned(), message: format!("the {what} was deleted meanwhile") }
            }
            AttemptError::Store(_) | AttemptError::Folder(_) => {
                tracing::error!(%error, "the environment failed");
                retry("environment", "the service's storage failed; its log says more".to_owned())
            }
            AttemptError::Options(_) | AttemptError::PreviousModel { .. } => {
                tracing::warn!(%error, "a worker of another version has to do it");
                let code = "another_version".to_owned();
                if created.duration_until(Timestamp::now()) > LONGEST_WAIT {
                    let message = format!("{error}, and for a day no worker of the version that wrote that was there");
                    return Ending::Failed { code, message };
                }
                let message = format!("{error}: the job waits for a worker of the version that wrote that");
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
            // It is heard of at the next heartbeat, and a mapping that does not listen is left a moment later.
            let latest = settings.heartbeat + LINGER;
            assert!(latest <= Duration::from_millis(1500), "{latest:?} with a lease of {lease_s} s");
        }
    }
}
