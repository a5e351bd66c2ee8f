//! All repositories of a database together.

use super::access::AccessStore;
use super::error::StoreError;
use super::jobs::JobStore;
use super::models::ModelStore;
use super::plants::PlantStore;
use super::requests::RequestStore;
use super::surveys::SurveyStore;
use super::tasks::TaskStore;
use super::uploads::UploadStore;
use super::usage::UsageStore;
use super::webhooks::WebhookStore;
use tokio::sync::Notify;

/// Connections to the database.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Pool {
    pub name: &'static str,
    pub open: u64,
    /// Of those that are open.
    pub idle: u64,
}

/// A database with its repositories. Absence is `Ok(None)`; the time is a parameter.
#[async_trait::async_trait]
pub trait Store:
    AccessStore
    + JobStore
    + ModelStore
    + PlantStore
    + RequestStore
    + SurveyStore
    + TaskStore
    + UploadStore
    + UsageStore
    + WebhookStore
{
    /// Fails where the database does not answer, or a newer version of the program has changed its schema.
    async fn ping(&self) -> Result<(), StoreError>;
    /// Writes and deletes a row; fails where the database cannot be written.
    async fn try_to_write(&self) -> Result<(), StoreError>;
    /// Notifies, for as long as it is polled, when any process has queued a job, published images or returned work. Not every
    /// database can notify, and connections are lost: workers poll as well.
    async fn listen_for_work(&self, work_notify: &Notify);
    /// The connections of this process.
    fn pools(&self) -> Vec<Pool>;
}
