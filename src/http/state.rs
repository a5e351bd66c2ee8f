//! What every handler may use.

use crate::config::{Limits, NetworkArgs};
use crate::http::error::{ApiError, Code};
use crate::http::middleware::rates::Rates;
use crate::http::turns::Turns;
use crate::http::uploads::tus::Desk;
use crate::http::writable::Writable;
use crate::jobs::PipelineMapper;
use crate::oidc::Oidc;
use crate::store::{Blobs, Plant, Store, Survey, SurveyId};
use crate::telemetry::Metrics;
use crate::webhooks::Targets;
use heliomap_model::PlantId;
use std::sync::Arc;
use tokio::sync::Notify;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

/// What every handler may use.
#[derive(Clone)]
pub struct AppState {
    pub store: Arc<dyn Store>,
    pub blobs: Blobs,
    pub limits: Arc<Limits>,
    pub network: Arc<NetworkArgs>,
    pub metrics: Metrics,
    pub rates: Arc<Rates>,
    pub desk: Arc<Desk>,
    /// Turns at looking through what came: photos are decoded.
    pub checking: Turns,
    /// Whether rows and files can be written.
    pub writable: Arc<Writable>,
    /// Rung when a job was queued.
    pub bell: Arc<Notify>,
    /// Requests that change something, until they have.
    pub answering: TaskTracker,
    /// Raised when the service stops: answers without an end end then.
    pub stop: CancellationToken,
    /// Checks tokens of an identity provider, where there is one.
    pub oidc: Option<Arc<Oidc>>,
    /// Where webhooks may lead.
    pub targets: Targets,
    /// What the worker of this process maps with, where it has one.
    pub mapper: Option<Arc<PipelineMapper>>,
    /// Whether anyone may do anything, without a key.
    pub insecure: bool,
}

/// How many photos may be decoded at once: half of the cores answer requests.
fn decoders() -> Turns {
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    Turns::new((cores / 2).max(1))
}

impl AppState {
    /// Of a service that asks for keys, alone in the world.
    pub fn new(store: Arc<dyn Store>, blobs: Blobs, limits: Limits) -> Self {
        Self {
            store,
            blobs,
            rates: Arc::new(Rates::new(&limits)),
            limits: Arc::new(limits),
            network: Arc::default(),
            metrics: Metrics::default(),
            desk: Arc::default(),
            checking: decoders(),
            writable: Arc::default(),
            bell: Arc::default(),
            answering: TaskTracker::new(),
            stop: CancellationToken::new(),
            oidc: None,
            targets: Targets::Public,
            mapper: None,
            insecure: false,
        }
    }

    /// The plant, or a problem.
    pub async fn require_plant(&self, plant: PlantId) -> Result<Plant, ApiError> {
        self.store.plant(plant).await?.ok_or_else(|| Self::no_plant(plant))
    }

    /// What is said of a plant that is not there, or not for the caller to see.
    pub fn no_plant(plant: PlantId) -> ApiError {
        let detail = format!("no plant has the identifier {plant}; GET /api/v1/plants lists them");
        ApiError::new(Code::PlantNotFound, detail)
    }

    /// The survey of the plant, or a problem.
    pub async fn require_survey(&self, plant: PlantId, survey: SurveyId) -> Result<Survey, ApiError> {
        if let Some(survey) = self.store.survey(plant, survey).await? {
            return Ok(survey);
        }
        self.require_plant(plant).await?;
        Err(ApiError::new(
            Code::SurveyNotFound,
            format!(
                "no survey of this plant has the identifier {survey}; GET /api/v1/plants/{plant}/surveys lists them"
            ),
        ))
    }
}
