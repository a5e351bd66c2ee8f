//! Webhooks of organisations, and the messages that are to be sent to them when jobs end.

use super::digest::Digest;
use super::error::StoreError;
use super::ids::{DeliveryId, JobId, OrganisationId, WebhookId};
use super::jobs::Job;
use super::listing::Page;
use heliomap_model::PlantId;
use jiff::Timestamp;
use std::fmt;
use std::str::FromStr;
use std::time::Duration;
use uuid::Uuid;

/// Maximum number of webhooks of an organisation.
pub const MAX_WEBHOOKS: u32 = 100;
/// Maximum number of attempts to send a message.
pub const MAX_ATTEMPTS: u32 = 8;

/// The key by which messages to a webhook are signed.
#[derive(Clone)]
pub struct SigningSecret(String);

impl SigningSecret {
    /// A new one, of the operating system's randomness.
    pub fn random() -> Result<Self, getrandom::Error> {
        let mut bytes = [0; 32];
        getrandom::fill(&mut bytes)?;
        Ok(Self(format!("whs_{}", Digest(bytes))))
    }

    /// A secret chosen by the caller; `None` where it is not 16 to 200 visible ASCII characters.
    pub fn given(text: &str) -> Option<Self> {
        let good = (16..=200).contains(&text.len()) && text.bytes().all(|byte| byte.is_ascii_graphic());
        good.then(|| Self(text.to_owned()))
    }

    /// A secret from the database.
    pub(super) fn kept(text: String) -> Self {
        Self(text)
    }

    /// The secret itself.
    pub fn reveal(&self) -> &str {
        &self.0
    }
}

impl fmt::Debug for SigningSecret {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("SigningSecret(…)")
    }
}

/// A URL that is notified when jobs end.
#[derive(Clone)]
pub struct Webhook {
    pub seq: i64,
    pub id: WebhookId,
    pub organisation: OrganisationId,
    /// The plant of these jobs; `None` for all plants of the organisation.
    pub plant: Option<PlantId>,
    pub url: String,
    pub created: Timestamp,
}

/// The URL may contain a secret, which must not be logged.
impl fmt::Debug for Webhook {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Webhook").field("id", &self.id).finish_non_exhaustive()
    }
}

/// A webhook to be stored.
#[derive(Clone)]
pub struct NewWebhook {
    pub organisation: OrganisationId,
    pub plant: Option<PlantId>,
    pub url: String,
    pub secret: SigningSecret,
}

/// State of a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DeliveryState {
    Waiting,
    Delivered,
    /// All attempts failed.
    Dead,
}

impl DeliveryState {
    /// All states.
    pub const ALL: [Self; 3] = [Self::Waiting, Self::Delivered, Self::Dead];

    /// The word in rows and answers.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Waiting => "waiting",
            Self::Delivered => "delivered",
            Self::Dead => "dead",
        }
    }
}

impl FromStr for DeliveryState {
    type Err = ();

    fn from_str(text: &str) -> Result<Self, ()> {
        Self::ALL.into_iter().find(|state| state.as_str() == text).ok_or(())
    }
}

/// One message to one webhook: that a job has ended.
#[derive(Debug, Clone)]
pub struct Delivery {
    pub seq: i64,
    pub id: DeliveryId,
    pub webhook: WebhookId,
    pub job: JobId,
    pub state: DeliveryState,
    /// Number of attempts so far.
    pub attempts: u32,
    /// Number of attempts left.
    pub attempts_left: u32,
    /// When a waiting message is sent next.
    pub run_after: Timestamp,
    /// Why the last attempt failed.
    pub error: Option<String>,
    pub created: Timestamp,
    /// When it was delivered, or its last attempt failed.
    pub finished: Option<Timestamp>,
}

/// A message that this process has claimed for sending.
#[derive(Clone)]
pub struct DeliveryClaim {
    /// The organisation of the webhook.
    pub organisation: OrganisationId,
    pub delivery: Delivery,
    pub url: String,
    pub secret: SigningSecret,
    pub job: Job,
}

/// Outcome of an attempt to send a message.
#[derive(Debug, Clone)]
pub enum Sent {
    Arrived,
    /// Sent again from `at`, unless that was the last attempt.
    Failed {
        error: String,
        at: Timestamp,
    },
}

/// Webhooks and the messages to them.
#[async_trait::async_trait]
pub trait WebhookStore: Send + Sync + 'static {
    /// Stores a webhook; `None` where the organisation has [`MAX_WEBHOOKS`].
    async fn create_webhook(&self, webhook: &NewWebhook, now: Timestamp) -> Result<Option<Webhook>, StoreError>;
    /// One webhook of an organisation.
    async fn webhook(&self, organisation: OrganisationId, id: WebhookId) -> Result<Option<Webhook>, StoreError>;
    /// An organisation's webhooks in the order of their creation.
    async fn webhooks(&self, organisation: OrganisationId, page: Page) -> Result<Vec<Webhook>, StoreError>;
    /// Deletes a webhook with its messages; `false` where there was none.
    async fn delete_webhook(&self, organisation: OrganisationId, id: WebhookId) -> Result<bool, StoreError>;

    /// A webhook's messages, optionally in one state, newest first.
    async fn deliveries(
        &self,
        webhook: WebhookId,
        state: Option<DeliveryState>,
        page: Page,
    ) -> Result<Vec<Delivery>, StoreError>;
    /// Queues a message in any state for sending again, with all attempts. Under the same identifier `once` it is done once
    /// a day: after that the message is returned as it is.
    async fn resend_delivery(
        &self,
        webhook: WebhookId,
        id: DeliveryId,
        once: Option<Uuid>,
        now: Timestamp,
    ) -> Result<Option<Delivery>, StoreError>;

    /// Claims the message that has been due for the longest time, except those of `busy` organisations. Without an outcome within
    /// `lease` it is claimed again.
    async fn claim_delivery(
        &self,
        busy: &[OrganisationId],
        lease: Duration,
        now: Timestamp,
    ) -> Result<Option<DeliveryClaim>, StoreError>;
    /// Records the outcome of an attempt; `false` where the message was claimed again or deleted.
    async fn end_delivery(&self, claim: &DeliveryClaim, sent: &Sent, now: Timestamp) -> Result<bool, StoreError>;
    /// Deletes messages that were delivered, or failed for good, before a time.
    async fn forget_old_deliveries(&self, before: Timestamp) -> Result<(), StoreError>;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn secrets_are_long_enough_and_are_not_printed() {
        let secret = SigningSecret::random().unwrap();
        assert_ne!(secret.reveal(), SigningSecret::random().unwrap().reveal());
        assert_eq!(secret.reveal().len(), 4 + 64);
        assert!(!format!("{secret:?}").contains(&secret.reveal()[4..]));
        assert!(SigningSecret::given("0123456789abcdef").is_some());
        for wrong in ["0123456789abcde", "0123456789abcde ", "0123456789abcde\u{e9}", &"x".repeat(201)] {
            assert!(SigningSecret::given(wrong).is_none(), "{wrong}");
        }
    }
}
