//! A worker: claims a job, maps its survey, hands in the model.

use super::watch::{Stop, Watch};
use super::{AttemptError, Mapper, folder, rows};
use crate::pipeline::{MapError, MapOptions, Mapping, Subject};
use crate::plant::PlantModel;
use crate::store::{Blobs, Claim, Completed, Ending, Heartbeat, NewModel, Store, StoreError};
use jiff::Timestamp;
use std::sync::Arc;
use std::time::{Duration, Instant};
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
    /// How long after a first failure of the environment a job is tried again; four times as long after the next.
    pub backoff: Duration,
}

impl Default for WorkerSettings {
    fn default() -> Self {
        Self {
            lease: Duration::from_secs(30),
            heartbeat: Duration::from_secs(1),
            poll: Duration::from_secs(1),
            backoff: Duration::from_secs(5),
        }
    }
}

/// Runs jobs one after the other.
pub struct Worker {
    pub name: String,
    pub store: Arc<dyn Store>,
    pub blobs: Blobs,
    pub mapper: Arc<dyn Mapper>,
    pub settings: WorkerSettings,
    /// Rung when a job was queued in this process.
    pub bell: Arc<Notify>,
}

impl Worker {
    /// Runs until `stop`; a job that is running then goes back to the queue.
    pub async fn run(&self, stop: CancellationToken) {
        tracing::info!(worker = self.name, "worker started");
        while !stop.is_cancelled() {
            let pause = match self.store.claim_job(&self.name, self.settings.lease, Timestamp::now()).await {
                Ok(Some(claim)) => {
                    let span = tracing::info_span!("job", job = %claim.job.id, attempt = claim.job.attempt);
                    self.work(claim, &stop).instrument(span).await;
                    continue;
                }
                Ok(None) => self.settings.poll,
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
        tracing::info!(worker = self.name, "worker stopped");
    }

    /// Runs one job to whatever end.
    async fn work(&self, claim: Claim, stop: &CancellationToken) {
        let begun = Instant::now();
        tracing::info!(plant = %claim.job.plant, survey = %claim.job.survey, "job started");
        let watch = Arc::new(Watch::default());
        let outcome = tokio::select! {
            outcome = self.attempt(&claim, &watch) => outcome,
            () = self.beat(&claim, &watch, stop) => unreachable!("beats until the attempt ends"),
        };
        if let Err(error) = self.settle(&claim, &watch, outcome).await {
            // The lease runs out and the job is taken up again.
            tracing::error!(%error, "cannot record the end of the job");
        }
        tracing::info!(seconds = begun.elapsed().as_secs_f64(), "job left");
    }

    /// Reports for as long as it is polled.
    async fn beat(&self, claim: &Claim, watch: &Watch, stop: &CancellationToken) {
        let mut heard = Instant::now();
        loop {
            tokio::select! {
                () = tokio::time::sleep(self.settings.heartbeat) => {}
                () = stop.cancelled(), if watch.stopped().is_none() => watch.stop(Stop::Shutdown),
            }
            match self.store.heartbeat(claim, watch.progress(), self.settings.lease, Timestamp::now()).await {
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
        }
    }

    /// Maps the survey and stores the model's bytes; the rows are left to [`Self::settle`].
    async fn attempt(&self, claim: &Claim, watch: &Arc<Watch>) -> Result<NewModel, AttemptError> {
        let job = &claim.job;
        let options: MapOptions = serde_json::from_str(&job.options).map_err(|error| MapError::Input {
            code: "invalid_options",
            message: format!("the job's options cannot be read: {error}; start a new job"),
        })?;
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
        let folder = folder::lay_out(&self.blobs, job.plant, &files).await?;

        let (mapper, watch) = (self.mapper.clone(), watch.clone());
        let span = tracing::Span::current();
        let mapping = tokio::task::spawn_blocking(move || {
            let _entered = span.enter();
            let Mapping { mut model, timings } = mapper.map(folder.path(), &options, &subject, &*watch)?;
            for timing in timings {
                tracing::debug!(stage = timing.stage.as_str(), seconds = timing.wall.as_secs_f64(), "stage finished");
            }
            model.version = version;
            let bytes = serde_json::to_vec(&model).map_err(std::io::Error::from)?;
            let layers = rows::layers(&model);
            Ok::<_, AttemptError>((bytes, layers, model.warnings))
        });
        let (bytes, layers, warnings) = mapping.await.map_err(|_| AttemptError::Panicked)??;
        let size = bytes.len() as u64;
        let sha256 = self.blobs.put_bytes(job.plant, bytes).await?;
        Ok(NewModel { version, sha256, size, warnings, layers })
    }

    /// Records how an attempt ended.
    async fn settle(
        &self,
        claim: &Claim,
        watch: &Watch,
        outcome: Result<NewModel, AttemptError>,
    ) -> Result<(), StoreError> {
        let now = Timestamp::now();
        let ending = match (outcome, watch.stopped()) {
            (_, Some(Stop::Lost)) => {
                tracing::warn!("the job is in other hands or gone; its result is dropped");
                return Ok(());
            }
            (Ok(model), _) => {
                let _ = self.store.heartbeat(claim, watch.progress(), self.settings.lease, now).await?;
                match self.store.complete_job(claim, &model, now).await? {
                    Completed::Done(model) => {
                        tracing::info!(version = model.version, "model stored");
                        return Ok(());
                    }
                    Completed::Fenced => {
                        tracing::warn!("the job is in other hands or gone; its result is dropped");
                        return Ok(());
                    }
                    Completed::Outdated => Ending::Retry {
                        code: "outdated".to_owned(),
                        message: "the plant got another model meanwhile; the survey is mapped again".to_owned(),
                        at: now,
                    },
                }
            }
            (Err(_), Some(Stop::Cancelled)) => Ending::Cancelled,
            (Err(_), Some(Stop::Shutdown)) => Ending::Released,
            (Err(error), _) => self.ending(claim, error, now),
        };
        tracing::info!(?ending, "job ends without a model");
        if !self.store.end_job(claim, &ending, now).await? {
            tracing::warn!("the job is in other hands or gone");
        }
        Ok(())
    }

    /// What is said of an error, and whether the job is tried again.
    fn ending(&self, claim: &Claim, error: AttemptError, now: Timestamp) -> Ending {
        let retry = |code: &str, message: String| Ending::Retry {
            code: code.to_owned(),
            message,
            at: now + self.settings.backoff * 4_u32.saturating_pow(claim.job.attempt.saturating_sub(1).min(8)),
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
            AttemptError::Map(MapError::Cancelled) | AttemptError::PreviousModel { .. } | AttemptError::Panicked => {
                tracing::error!(%error, "the mapping failed");
                internal()
            }
        }
    }
}
