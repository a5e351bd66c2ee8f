//! The content of a message.

use crate::store::{DeliveryClaim, DeliveryId, JobId, SurveyId};
use heliomap_model::PlantId;
use jiff::Timestamp;
use serde::Serialize;

/// The message: a job has ended. The API has the rest.
#[derive(Debug, Serialize)]
pub struct Message {
    /// The same for every attempt, so that a receiver can drop duplicates.
    pub id: DeliveryId,
    /// `job.succeeded`, `job.failed` or `job.cancelled`.
    pub event: String,
    /// When the job ended.
    pub at: Timestamp,
    pub plant: PlantId,
    pub survey: SurveyId,
    pub job: JobId,
    /// The path of the job in the API.
    pub job_path: String,
    /// The version of the model that it made.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub model_version: Option<u32>,
    /// The path of that model in the API.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub model_path: Option<String>,
    /// Why it failed: the code and the message of the job.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub error: Option<Failure>,
}

/// Why a job failed.
#[derive(Debug, Serialize)]
pub struct Failure {
    pub code: String,
    pub message: String,
}

impl From<&DeliveryClaim> for Message {
    fn from(claim: &DeliveryClaim) -> Self {
        let (delivery, job) = (&claim.delivery, &claim.job);
        Self {
            id: delivery.id,
            event: format!("job.{}", job.state.as_str()),
            at: job.finished.unwrap_or(delivery.created),
            plant: job.plant,
            survey: job.survey,
            job: job.id,
            job_path: format!("/api/v1/plants/{}/jobs/{}", job.plant, job.id),
            model_version: job.model_version,
            model_path: job.model_version.map(|version| format!("/api/v1/plants/{}/models/{version}", job.plant)),
            error: job.error.clone().map(|(code, message)| Failure { code, message }),
        }
    }
}
