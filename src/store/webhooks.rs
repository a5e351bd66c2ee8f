//! Where organisations want to hear of the ends of their jobs, and what is to be sent there.

use super::records::row_id;
use super::{Digest, Job, JobId, OrganisationId, Page, StoreError};
use heliomap_model::PlantId;
use jiff::Timestamp;
use std::fmt;
use std::str::FromStr;
use std::time::Duration;
use uuid::Uuid;

row_id!(
    /// Identifies a webhook: an address that is told of the ends of jobs.
    WebhookId
);
row_id!(
    /// Identifies a delivery: one message to one webhook.
    DeliveryId
);

/// Most webhooks of an organisation.
pub const MAX_WEBHOOKS: u32 = 100;
/// How often a message is tried before it is dead.
pub const MAX_ATTEMPTS: u32 = 8;

/// What the messages to a webhook are signed with.
#[derive(Clone)]
pub struct SigningSecret(String);

impl SigningSecret {
    /// A new one, of the operating system's randomness.
    pub fn random() -> Result<Self, getrandom::Error> {
        let mut bytes = [0; 32];
        getrandom::fill(&mut bytes)?;
        Ok(Self(format!("whs_{}", Digest(bytes))))
    }

    /// One that someone else made; `None` where it is not 16 to 200 visible ASCII characters.
    pub fn given(text: &str) -> Option<Self> {
        let good = (16..=200).contains(&text.len()) && text.bytes().all(|byte| byte.is_ascii_graphic());
        good.then(|| Self(text.to_owned()))
    }

    /// One that the store kept.
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

/// An address that is told of the ends of jobs.
#[derive(Clone)]
pub struct Webhook {
    pub seq: i64,
    pub id: WebhookId,
    pub organisation: OrganisationId,
    /// The plant whose jobs it is told of; all of the organisation's where there is none.
    pub plant: Option<PlantId>,
    pub url: String,
    pub created: Timestamp,
}

/// The URL may hold what opens the receiver, which no log shall.
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

/// Where a message stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DeliveryState {
    Waiting,
    Delivered,
    /// Tried as often as it is tried.
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
    /// How often it was tried.
    pub attempts: u32,
    /// How often it is still tried.
    pub attempts_left: u32,
    /// When it is tried next, where it waits.
    pub run_after: Timestamp,
    /// Why it did not arrive the last time.
    pub error: Option<String>,
    pub created: Timestamp,
    /// When it arrived or was given up.
    pub finished: Option<Timestamp>,
}

/// A message in the hands of whoever sends it.
#[derive(Clone)]
pub struct DeliveryClaim {
    /// Whose webhook it goes to.
    pub organisation: OrganisationId,
    pub delivery: Delivery,
    pub url: String,
    pub secret: SigningSecret,
    pub job: Job,
}

/// What became of a message that was sent.
#[derive(Debug, Clone)]
pub enum Sent {
    Arrived,
    /// To be tried again from `at`, unless that was the last time.
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
    /// Deletes a webhook with its messages; whether there was one.
    async fn delete_webhook(&self, organisation: OrganisationId, id: WebhookId) -> Result<bool, StoreError>;

    /// A webhook's messages, or those in one state, the newest first.
    async fn deliveries(
        &self,
        webhook: WebhookId,
        state: Option<DeliveryState>,
        page: Page,
    ) -> Result<Vec<Delivery>, StoreError>;
    /// Has a message sent anew, as often tried as a new one, whether it arrived, was given up or waits.
    async fn resend_delivery(
        &self,
        webhook: WebhookId,
        id: DeliveryId,
        now: Timestamp,
    ) -> Result<Option<Delivery>, StoreError>;

    /// Takes the message that is due for the longest time, those to webhooks of `busy` organisations apart. Where it is not
    /// said within `lease` what became of it, it is taken again.
    async fn claim_delivery(
        &self,
        busy: &[OrganisationId],
        lease: Duration,
        now: Timestamp,
    ) -> Result<Option<DeliveryClaim>, StoreError>;
    /// Notes what became of a message; `false` where it was taken again, or is gone.
    async fn end_delivery(&self, claim: &DeliveryClaim, sent: &Sent, now: Timestamp) -> Result<bool, StoreError>;
    /// Forgets messages that arrived, or were given up, before a time.
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
