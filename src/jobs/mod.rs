//! The queue's workers: a job is one run of the pipeline over a survey. A worker holds no transaction while it
//! computes: a short claim, a lease with heartbeat, a fenced completion. The images of a job are offered to all workers
//! (`share.rs`), and whoever has no job of its own helps with them (`helper.rs`).

pub mod mapper;
pub mod readiness;
pub mod worker;

mod folder;
mod helper;
mod rows;
mod share;
mod watch;

pub use mapper::{FoundInTask, Mapper, NextTask, PipelineMapper, Stopped};
pub use readiness::{Missing, RECONSTRUCTIONS, is_shot, missing, shots, shots_without_image};
pub use worker::{Worker, WorkerSettings};

use crate::store::StoreError;
use heliomap_mapping::pipeline::MapError;

/// Why an attempt at a job made no model.
#[derive(Debug, thiserror::Error)]
pub(crate) enum AttemptError {
    #[error(transparent)]
    Map(#[from] MapError),
    #[error(transparent)]
    Store(#[from] StoreError),
    #[error("prepare the folder of the job: {0}")]
    Folder(#[from] std::io::Error),
    #[error("the job's options cannot be read: {0}")]
    Options(serde_json::Error),
    #[error("the plant's model {version} cannot be read: {source}")]
    PreviousModel { version: u32, source: serde_json::Error },
    #[error("the mapper panicked")]
    Panicked,
}
