//! Sends messages. Each server and worker process claims due messages under a lease, so that no two processes send the same
//! message at once and none is lost with its process.

use super::message::Message;
use super::signature::{HEADER, sign};
use super::target::Targets;
use crate::store::{DeliveryClaim, OrganisationId, Sent, Store};
use crate::telemetry::Metrics;
use crate::telemetry::metrics::OutcomeLabels;
use jiff::Timestamp;
use reqwest::{Client, redirect};
use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;
use tokio::task::JoinSet;
use tokio_util::sync::CancellationToken;

/// Maximum number of messages that one process sends at the same time.
const MAX_IN_FLIGHT: usize = 32;
/// Maximum number of these for one organisation, so that its slow receivers do not delay others.
const MAX_IN_FLIGHT_PER_ORGANISATION: usize = 2;
/// Maximum pause between two attempts.
const MAX_PAUSE: Duration = Duration::from_secs(6 * 3600);

/// A sender's times.
#[derive(Debug, Clone, Copy)]
pub struct SenderSettings {
    /// How often it looks for messages.
    pub poll: Duration,
    /// How long a receiver may take to answer.
    pub timeout: Duration,
    /// How long a claimed message is not claimed again; far above `timeout`.
    pub lease: Duration,
    /// Pause after a first failure; five times as long after each further one, up to [`MAX_PAUSE`].
    pub backoff: Duration,
}

impl Default for SenderSettings {
    fn default() -> Self {
        Self {
            poll: Duration::from_secs(1),
            timeout: Duration::from_secs(10),
            lease: Duration::from_secs(60),
            backoff: Duration::from_secs(5),
        }
    }
}

/// Sends messages.
#[derive(Clone)]
pub struct Sender {
    store: Arc<dyn Store>,
    targets: Targets,
    settings: SenderSettings,
    metrics: Metrics,
    client: Client,
}

impl Sender {
    /// A sender to these targets.
    ///
    /// # Errors
    /// No certificates of authorities on this system.
    pub fn new(
        store: Arc<dyn Store>,
        targets: Targets,
        settings: SenderSettings,
        metrics: Metrics,
    ) -> Result<Self, reqwest::Error> {
        crate::tls::provide();
        let client = Client::builder()
            .user_agent(concat!("heliomap/", env!("CARGO_PKG_VERSION")))
            .timeout(settings.timeout)
            // A redirection or a proxy would bypass the check of addresses.
            .redirect(redirect::Policy::none())
            .no_proxy()
            .dns_resolver(targets)
            .build()?;
        Ok(Self { store, targets, settings, metrics, client })
    }

    /// Sends due messages until `stop`, then waits for those being sent.
    pub async fn run(&self, stop: CancellationToken) {
        let mut sending = JoinSet::new();
        let mut of: HashMap<OrganisationId, usize> = HashMap::new();
        while !stop.is_cancelled() {
            while sending.len() < MAX_IN_FLIGHT {
                let busy = of
                    .iter()
                    .filter(|(_, count)| **count >= MAX_IN_FLIGHT_PER_ORGANISATION)
                    .map(|(organisation, _)| *organisation);
                let busy: Vec<_> = busy.collect();
                match self.store.claim_delivery(&busy, self.settings.lease, Timestamp::now()).await {
                    Ok(Some(claim)) => {
                        let (sender, organisation) = (self.clone(), claim.organisation);
                        *of.entry(organisation).or_default() += 1;
                        sending.spawn(async move {
                            sender.deliver(claim).await;
                            organisation
                        });
                    }
                    Ok(None) => break,
                    Err(error) => {
                        tracing::error!(%error, "cannot claim messages to webhooks");
                        break;
                    }
                }
            }
            tokio::select! {
                () = stop.cancelled() => {}
                Some(sent) = sending.join_next() => match sent {
                    Ok(organisation) => {
                        let left = of.remove(&organisation).unwrap_or_default().saturating_sub(1);
                        of.extend((left > 0).then_some((organisation, left)));
                    }
                    // The organisation of a panicked task is unknown: count anew.
                    Err(error) => {
                        tracing::error!(%error, "a message to a webhook was not sent");
                        while sending.join_next().await.is_some() {}
                        of.clear();
                    }
                },
                () = tokio::time::sleep(self.settings.poll) => {}
            }
        }
        while sending.join_next().await.is_some() {}
    }

    /// Sends one message and records the result.
    async fn deliver(&self, claim: DeliveryClaim) {
        let sent = match self.send(&claim).await {
            Ok(()) => Sent::Arrived,
            Err(error) => Sent::Failed { error, at: Timestamp::now() + self.pause(claim.delivery.attempts_left) },
        };
        let outcome = match &sent {
            Sent::Arrived => "delivered",
            Sent::Failed { .. } if claim.delivery.attempts_left == 0 => "given_up",
            Sent::Failed { .. } => "failed",
        };
        self.metrics.deliveries.get_or_create(&OutcomeLabels { outcome }).inc();
        let (webhook, delivery) = (claim.delivery.webhook, claim.delivery.id);
        tracing::info!(%webhook, %delivery, outcome, attempt = claim.delivery.attempts, "message to a webhook");
        if let Err(error) = self.store.end_delivery(&claim, &sent, Timestamp::now()).await {
            // The lease expires and it is sent again.
            tracing::error!(%error, %delivery, "cannot record the result of a message to a webhook");
        }
    }

    /// How long to wait after a failure.
    fn pause(&self, attempts_left: u32) -> Duration {
        let failed_before = crate::store::webhooks::MAX_ATTEMPTS.saturating_sub(attempts_left + 1);
        self.settings.backoff.saturating_mul(5_u32.saturating_pow(failed_before)).min(MAX_PAUSE)
    }

    /// Sends a message; the error says why it did not arrive. Only the status of the answer is read.
    async fn send(&self, claim: &DeliveryClaim) -> Result<(), String> {
        let url = self.targets.check(&claim.url).map_err(|error| error.to_string())?;
        let message = Message::from(claim);
        let body = serde_json::to_vec(&message).map_err(|error| error.to_string())?;
        let signature = sign(&claim.secret, Timestamp::now(), &body);
        let request = self.client.post(url).header("content-type", "application/json").header(HEADER, signature);
        let answer = request.body(body).send().await.map_err(|error| reason(&error))?;
        match answer.status() {
            status if status.is_success() => Ok(()),
            status if status.is_redirection() => {
                Err(format!("the receiver answered {status}; redirections are not followed: register their target"))
            }
            status => Err(format!("the receiver answered {status}")),
        }
    }
}

/// Why a request failed, without its URL.
fn reason(error: &reqwest::Error) -> String {
    if error.is_timeout() {
        return "the receiver did not answer in time".to_owned();
    }
    let mut cause: &dyn std::error::Error = error;
    while let Some(source) = cause.source() {
        cause = source;
    }
    format!("no connection: {cause}")
}
