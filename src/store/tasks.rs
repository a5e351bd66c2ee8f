//! Images of running jobs that other workers may search.

use super::{Checkpoint, Claim, JobId, StoreError};
use heliomap_model::PlantId;
use jiff::Timestamp;
use std::time::Duration;
use uuid::Uuid;

/// An image that a running job has to search.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ImageTask {
    pub image: String,
    /// What a worker needs to know, JSON.
    pub document: String,
}

/// A task in the hands of a worker that is not the job's own.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TaskClaim {
    pub plant: PlantId,
    pub job: JobId,
    pub task: ImageTask,
    /// Tells this claim from every other.
    pub token: Uuid,
}

/// What a job's own worker gets when it asks for one of its images.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum OwnTask {
    /// This one is its.
    Image(String),
    /// Others are at work on all that are left.
    InOtherHands,
    /// None is left, or the job is not its any more.
    None,
}

/// What becomes of a task that is given back.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum GivenBack {
    /// Anybody may take it.
    ToAll,
    /// It could not be done: the job's own worker shall see why.
    ToOwner,
}

/// Images of running jobs that other workers may search.
#[async_trait::async_trait]
pub trait TaskStore: Send + Sync + 'static {
    /// Offers images of a claimed job, in place of all that it had offered, to workers with this mapper; `false` where the
    /// claim was lost. What is found holds under this fingerprint.
    async fn offer_tasks(
        &self,
        claim: &Claim,
        fingerprint: &str,
        mapper: &str,
        tasks: &[ImageTask],
    ) -> Result<bool, StoreError>;
    /// Takes one of a claimed job's own images, for as long as the job is claimed.
    async fn take_own_task(&self, claim: &Claim, now: Timestamp) -> Result<OwnTask, StoreError>;
    /// What others have found for a claimed job since the last time.
    async fn gather_tasks(&self, claim: &Claim) -> Result<Vec<Checkpoint>, StoreError>;

    /// How many images wait for a worker, whoever's jobs they are of.
    async fn waiting_tasks(&self, now: Timestamp) -> Result<u64, StoreError>;
    /// Takes an image of a running job for a worker with this mapper: of the job of the highest priority, of these the
    /// oldest.
    async fn take_task(&self, mapper: &str, lease: Duration, now: Timestamp) -> Result<Option<TaskClaim>, StoreError>;
    /// Extends the leases of tasks; those that are lost are not among the answers.
    async fn extend_tasks(&self, tokens: &[Uuid], lease: Duration, now: Timestamp) -> Result<Vec<Uuid>, StoreError>;
    /// Keeps what was found in a task's image as a checkpoint of its job; `false` where the task was lost.
    async fn finish_task(&self, claim: &TaskClaim, document: &[u8]) -> Result<bool, StoreError>;
    /// Gives a task back; nothing happens where it was lost.
    async fn give_back_task(&self, claim: &TaskClaim, to: GivenBack) -> Result<(), StoreError>;
}
