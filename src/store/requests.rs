//! Requests with an idempotency key of the client, and their answers.

use super::digest::Digest;
use super::error::StoreError;
use super::ids::OrganisationId;
use jiff::Timestamp;
use uuid::Uuid;

/// The stored answer to a request.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct KeptAnswer {
    /// Digest of the request.
    pub fingerprint: Digest,
    pub status: u16,
    /// Names and values, a JSON object.
    pub headers: String,
    pub body: Vec<u8>,
}

/// What is known of a request with this key.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Begun {
    /// Nothing: this request is to be answered.
    New,
    /// Another request with this key is being answered.
    Running,
    /// It was answered before.
    Answered(Box<KeptAnswer>),
}

/// Requests by the idempotency keys of their clients, apart for each organisation.
#[async_trait::async_trait]
pub trait RequestStore: Send + Sync + 'static {
    /// Reserves a key until a time, unless it is reserved; `token` identifies this reservation.
    async fn begin_request(
        &self,
        organisation: OrganisationId,
        name: &str,
        token: Uuid,
        now: Timestamp,
        until: Timestamp,
    ) -> Result<Begun, StoreError>;
    /// Extends a reservation.
    async fn renew_request(
        &self,
        organisation: OrganisationId,
        name: &str,
        token: Uuid,
        until: Timestamp,
    ) -> Result<(), StoreError>;
    /// Stores the answer to a reserved request until a time.
    async fn keep_answer(
        &self,
        organisation: OrganisationId,
        name: &str,
        token: Uuid,
        answer: &KeptAnswer,
        until: Timestamp,
    ) -> Result<(), StoreError>;
    /// Releases a reservation without an answer.
    async fn forget_request(&self, organisation: OrganisationId, name: &str, token: Uuid) -> Result<(), StoreError>;
    /// Deletes expired reservations and answers.
    async fn forget_old_requests(&self, now: Timestamp) -> Result<(), StoreError>;
}
