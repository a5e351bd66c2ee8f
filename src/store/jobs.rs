//! Mappings that are asked for, run and ended: the queue.

use super::error::StoreError;
use super::ids::{JobId, SurveyId};
use super::listing::Page;
use super::models::{Model, NewModel};
use heliomap_model::{PlantId, Warning};
use jiff::Timestamp;
use std::str::FromStr;
use std::time::Duration;

/// Where a job stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum JobState {
    Queued,
    Running,
    Succeeded,
    Failed,
    Cancelled,
}

impl JobState {
    /// All states.
    pub const ALL: [Self; 5] = [Self::Queued, Self::Running, Self::Succeeded, Self::Failed, Self::Cancelled];

    /// The word in rows and answers.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Queued => "queued",
            Self::Running => "running",
            Self::Succeeded => "succeeded",
            Self::Failed => "failed",
            Self::Cancelled => "cancelled",
        }
    }

    /// Whether nothing will change any more.
    pub fn is_final(self) -> bool {
        matches!(self, Self::Succeeded | Self::Failed | Self::Cancelled)
    }
}

impl FromStr for JobState {
    type Err = ();

    fn from_str(text: &str) -> Result<Self, ()> {
        Self::ALL.into_iter().find(|state| state.as_str() == text).ok_or(())
    }
}

/// How far a job has come: `done` of `total` units of a stage.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Progress {
    pub stage: String,
    pub done: u64,
    pub total: u64,
    /// Estimated milliseconds until the job ends.
    pub remaining_ms: Option<u64>,
}

/// An intermediate result of a job.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Checkpoint {
    /// The image, or part of the structure, that it belongs to.
    pub name: String,
    pub document: Vec<u8>,
}

/// One mapping of a survey.
#[derive(Debug, Clone)]
pub struct Job {
    pub seq: i64,
    pub id: JobId,
    pub plant: PlantId,
    pub survey: SurveyId,
    pub state: JobState,
    /// The mapping's options, JSON.
    pub options: String,
    /// The higher, the sooner.
    pub priority: i32,
    pub progress: Option<Progress>,
    pub warnings: Vec<Warning>,
    /// Code and message of the last failure.
    pub error: Option<(String, String)>,
    /// How often it was started.
    pub attempt: u32,
    pub max_attempts: u32,
    pub cancel_requested: bool,
    /// The version of the model that it created.
    pub model_version: Option<u32>,
    pub created: Timestamp,
    pub started: Option<Timestamp>,
    pub finished: Option<Timestamp>,
}

/// State of the queue, over all organisations.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Queue {
    /// Number of jobs in each state, all states.
    pub jobs: Vec<(JobState, u64)>,
    /// Number of jobs that a worker may claim now.
    pub waiting: u64,
    /// How long the oldest of these has been waiting.
    pub oldest: Option<Duration>,
    /// Number of images of running jobs that wait for a worker.
    pub images: u64,
}

/// A mapping to be queued.
#[derive(Debug, Clone)]
pub struct JobRequest {
    /// The identifier of the job, new for each but those that are asked for again.
    pub id: JobId,
    pub plant: PlantId,
    pub survey: SurveyId,
    /// The mapping's options, JSON.
    pub options: String,
    /// The higher, the sooner.
    pub priority: i32,
    /// How often it is started without progress before it fails.
    pub max_attempts: u32,
}

/// Outcome of queueing a mapping.
#[derive(Debug, Clone)]
pub enum Enqueued {
    New(Job),
    /// The survey's unfinished job.
    Existing(Job),
}

/// Outcome of cancelling a job.
#[derive(Debug, Clone)]
pub enum Cancelled {
    /// The job is cancelled, or its worker will stop.
    Accepted(Job),
    /// The job had ended before.
    TooLate(Job),
}

/// A job that a worker has claimed. The fence distinguishes this claim from every later one.
#[derive(Debug, Clone)]
pub struct Claim {
    pub job: Job,
    pub fence: i64,
}

/// Answer to a worker's heartbeat.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Heartbeat {
    Continue,
    /// The job was cancelled.
    Cancel,
    /// The job was deleted, or another worker has claimed it.
    Lost,
}

/// Maximum pause between two attempts at a job.
pub const MAX_BACKOFF: Duration = Duration::from_secs(600);

/// How a claimed job ends without a model.
#[derive(Debug, Clone)]
pub enum Ending {
    /// It failed, without a retry.
    Failed { code: String, message: String },
    /// Retried, unless all attempts without progress are used up: after `backoff` the first time, four times as long after
    /// each further attempt, at most [`MAX_BACKOFF`].
    Retry { code: String, message: String, backoff: Duration },
    /// Back to the queue, as if it had not been claimed, for another worker after `pause`.
    Declined { code: String, message: String, pause: Duration },
    /// Cancelled by request.
    Cancelled,
    /// Back to the queue as if it had not been claimed, because the worker stops.
    Released,
}

/// Outcome of completing a job.
#[derive(Debug, Clone)]
pub enum Completed {
    Done(Box<Model>),
    /// The lease was lost; nothing was written.
    Fenced,
    /// The plant has that version already; nothing was written.
    Outdated,
}

/// The queue of jobs.
#[async_trait::async_trait]
pub trait JobStore: Send + Sync + 'static {
    /// Queues a mapping of a survey, or returns its unfinished job.
    async fn enqueue_job(&self, request: &JobRequest, now: Timestamp) -> Result<Enqueued, StoreError>;
    /// One job of a plant.
    async fn job(&self, plant: PlantId, id: JobId) -> Result<Option<Job>, StoreError>;
    /// A plant's jobs, optionally of one survey or in one state, newest first.
    async fn jobs(
        &self,
        plant: PlantId,
        survey: Option<SurveyId>,
        state: Option<JobState>,
        page: Page,
    ) -> Result<Vec<Job>, StoreError>;
    /// Cancels a queued job at once; asks a running one to stop; leaves a finished one unchanged.
    async fn cancel_job(&self, plant: PlantId, id: JobId, now: Timestamp) -> Result<Option<Cancelled>, StoreError>;
    /// State of the queue.
    async fn queue(&self, now: Timestamp) -> Result<Queue, StoreError>;
    /// Claims the oldest job of the highest priority that may run: queued and due, or abandoned by its worker, of a plant
    /// without a running job. Ends jobs that were abandoned too often. The attempt is counted here, so that a job that kills
    /// its worker does not run for ever.
    async fn claim_job(&self, worker: &str, lease: Duration, now: Timestamp) -> Result<Option<Claim>, StoreError>;
    /// Extends the lease of a claimed job and records its progress.
    async fn heartbeat(
        &self,
        claim: &Claim,
        progress: Option<Progress>,
        lease: Duration,
        now: Timestamp,
    ) -> Result<Heartbeat, StoreError>;
    /// Stores checkpoints of a claimed job, valid for input, options and program with this fingerprint; `false` where the
    /// lease was lost. Progress gives the job all its attempts back.
    async fn checkpoint(&self, claim: &Claim, fingerprint: &str, found: &[Checkpoint]) -> Result<bool, StoreError>;
    /// The checkpoints of an unfinished job with this fingerprint.
    async fn checkpoints(&self, job: JobId, fingerprint: &str) -> Result<Vec<Checkpoint>, StoreError>;
    /// The durations of the last completed job's stages, JSON, of any organisation.
    async fn last_stage_ms(&self) -> Result<Option<String>, StoreError>;
    /// Completes a claimed job with its model, both in one transaction.
    async fn complete_job(&self, claim: &Claim, model: &NewModel, now: Timestamp) -> Result<Completed, StoreError>;
    /// Ends a claimed job without a model, or returns it to the queue; `false` where the lease was lost.
    async fn end_job(&self, claim: &Claim, ending: &Ending, now: Timestamp) -> Result<bool, StoreError>;
}
