//! The queue's workers. A job is one run of the pipeline over a survey. A worker holds no transaction while it computes: a
//! short claim, a lease with heartbeats, a fenced completion. The images of a job are published as tasks for all workers
//! (`publisher.rs`); a worker without a job runs such tasks (`helper.rs`).

pub mod mapper;
pub mod readiness;
pub mod settings;
pub mod worker;

mod error;
mod folder;
mod helper;
mod publisher;
mod rows;
mod watch;

pub use mapper::{FoundInTask, Mapper, NextTask, PipelineMapper, Stopped};
pub use readiness::{Missing, RECONSTRUCTIONS, ShotNames, missing, shots, shots_without_image};
pub use settings::WorkerSettings;
pub use worker::Worker;
