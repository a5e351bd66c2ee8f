//! Images of running jobs as tasks that other workers may run.

use super::error::StoreError;
use super::ids::JobId;
use super::jobs::{Checkpoint, Claim};
use heliomap_model::PlantId;
use jiff::Timestamp;
use std::time::Duration;
use uuid::Uuid;

/// An image of a running job.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ImageTask {
    pub image: String,
    /// The task's input, JSON.
    pub document: String,
}

/// A task that a worker other than the job's own has claimed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TaskClaim {
    pub plant: PlantId,
    pub job: JobId,
    pub task: ImageTask,
    /// Identifies this claim.
    pub token: Uuid,
}

/// The next task for the job's own worker.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum OwnTask {
    /// This image is claimed for it.
    Image(String),
    /// Other workers hold all remaining tasks.
    HeldByOthers,
    /// No task is left, or the lease was lost.
    None,
}

/// Who may run a returned task.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum GivenBack {
    /// Any worker.
    ToAll,
    /// Only the job's own worker, because another one failed.
    ToOwner,
}

/// Image tasks of running jobs.
#[async_trait::async_trait]
pub trait TaskStore: Send + Sync + 'static {
    /// Publishes images of a claimed job, in place of all earlier ones, for workers with this mapper; `false` where the lease was
    /// lost. Results are stored under this fingerprint.
    async fn offer_tasks(
        &self,
        claim: &Claim,
        fingerprint: &str,
        mapper: &str,
        tasks: &[ImageTask],
    ) -> Result<bool, StoreError>;
    /// Claims a task of a claimed job for the job's own worker, for as long as it has the job.
    async fn take_own_task(&self, claim: &Claim, now: Timestamp) -> Result<OwnTask, StoreError>;
    /// Takes results of other workers for a claimed job.
    async fn gather_tasks(&self, claim: &Claim) -> Result<Vec<Checkpoint>, StoreError>;

    /// Number of tasks that wait for a worker, of all organisations.
    async fn waiting_tasks(&self, now: Timestamp) -> Result<u64, StoreError>;
    /// Claims a task for a worker with this mapper: of the oldest running job of the highest priority.
    async fn take_task(&self, mapper: &str, lease: Duration, now: Timestamp) -> Result<Option<TaskClaim>, StoreError>;
    /// Extends the leases of tasks and returns those that are still held.
    async fn extend_tasks(&self, tokens: &[Uuid], lease: Duration, now: Timestamp) -> Result<Vec<Uuid>, StoreError>;
    /// Stores a task's result as a checkpoint of its job; `false` where the lease was lost.
    async fn finish_task(&self, claim: &TaskClaim, document: &[u8]) -> Result<bool, StoreError>;
    /// Returns a task; does nothing where the lease was lost.
    async fn give_back_task(&self, claim: &TaskClaim, to: GivenBack) -> Result<(), StoreError>;
}
