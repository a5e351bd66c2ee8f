//! Requests that a client named, so that it may send them again, and how they were answered.

use super::{Digest, OrganisationId, StoreError};
use jiff::Timestamp;
use uuid::Uuid;

/// A request that was answered.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct KeptAnswer {
    /// What was asked.
    pub fingerprint: Digest,
    pub status: u16,
    /// Names and values, a JSON object.
    pub headers: String,
    pub body: Vec<u8>,
}

/// What is known of a request that begins.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Begun {
    /// Nothing: it is this one's to answer.
    New,
    /// Another one of that name is being answered.
    Running,
    /// It was answered before.
    Answered(Box<KeptAnswer>),
}

/// Requests by the names that their clients gave them, each organisation's its own.
#[async_trait::async_trait]
pub trait RequestStore: Send + Sync + 'static {
    /// Takes a name until a time, unless it is taken already; `token` is whoever takes it.
    async fn begin_request(
        &self,
        organisation: OrganisationId,
        name: &str,
        token: Uuid,
        now: Timestamp,
        until: Timestamp,
    ) -> Result<Begun, StoreError>;
    /// Keeps a name until another time, for whoever took it last.
    async fn renew_request(
        &self,
        organisation: OrganisationId,
        name: &str,
        token: Uuid,
        until: Timestamp,
    ) -> Result<(), StoreError>;
    /// Keeps the answer to the request of that name until a time, of whoever took it last.
    async fn keep_answer(
        &self,
        organisation: OrganisationId,
        name: &str,
        token: Uuid,
        answer: &KeptAnswer,
        until: Timestamp,
    ) -> Result<(), StoreError>;
    /// Gives a name back, where no answer is kept, for whoever took it last.
    async fn forget_request(&self, organisation: OrganisationId, name: &str, token: Uuid) -> Result<(), StoreError>;
    /// Forgets what was kept long enough.
    async fn forget_old_requests(&self, now: Timestamp) -> Result<(), StoreError>;
}
