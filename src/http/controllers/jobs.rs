//! Jobs.

use crate::config::StartJob;
use crate::http::controllers::surveys::missing_views;
use crate::http::error::{ApiError, Code, Problem};
use crate::http::extract::{ApiPath, ApiQuery, Object};
use crate::http::middleware::idempotency::{KEPT, Once};
use crate::http::paging::{List, filtered_list, state_filter};
use crate::http::state::AppState;
use crate::store::{Cancelled, Enqueued, Job, JobId, JobRequest, JobState, SurveyId};
use axum::body::Bytes;
use axum::extract::State;
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::{Extension, Json};
use heliomap_mapping::pipeline::{MapOptions, Stage};
use heliomap_model::{BenchId, PlantId, Warning};
use jiff::Timestamp;
use serde::Serialize;
use uuid::Uuid;

/// One mapping of a survey.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub struct JobView {
    #[schema(value_type = Uuid)]
    pub id: JobId,
    #[schema(value_type = Uuid)]
    pub plant: PlantId,
    #[schema(value_type = Uuid)]
    pub survey: SurveyId,
    /// `queued`, `running`, `succeeded`, `failed` or `cancelled`; the last three are final.
    #[schema(example = "running")]
    pub state: &'static str,
    /// Whether someone asked it to stop.
    pub cancel_requested: bool,
    /// Where it is; there once it has begun.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub progress: Option<ProgressView>,
    /// What people should know about its model.
    pub warnings: Vec<WarningView>,
    /// Why it failed, or why it is tried again.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub error: Option<JobErrorView>,
    /// How often it was started.
    pub attempt: u32,
    /// How often it is started without getting anywhere before it fails.
    pub max_attempts: u32,
    /// Among waiting jobs the highest is taken first.
    pub priority: i32,
    pub options: serde_json::Value,
    /// Where its model is, once it has succeeded.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(example = "/api/v1/plants/0b7a3f7e-59b1-4f0c-9f0d-3d6f3d1f7a11/models/1")]
    pub model: Option<String>,
    /// The version of its model.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub model_version: Option<u32>,
    #[schema(value_type = String, format = DateTime)]
    pub created: Timestamp,
    #[schema(value_type = Option<String>, format = DateTime)]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub started: Option<Timestamp>,
    #[schema(value_type = Option<String>, format = DateTime)]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub finished: Option<Timestamp>,
}

/// How far a job has come.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub struct ProgressView {
    /// `read`, `detect`, `layout`, `locate`, `fuse`, `refine` or `assemble`.
    #[schema(example = "detect")]
    pub stage: String,
    /// The stage's place among all stages, 1 the first.
    pub stage_number: usize,
    pub stage_count: usize,
    /// Units of this stage that are finished.
    pub done: u64,
    /// Units of this stage.
    pub total: u64,
    /// Seconds until the job ends, by the pace of this stage and what the later ones took in the last job; left out while
    /// that cannot be told.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub remaining_s: Option<u64>,
}

/// Why a job failed.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub struct JobErrorView {
    /// A stable word.
    #[schema(example = "no_modules")]
    pub code: String,
    /// What is wrong and what to do.
    #[schema(example = "no module was found in any of 12 images")]
    pub message: String,
}

/// Something a person should know about a model.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub struct WarningView {
    /// A stable word.
    #[schema(example = "images_supplementary")]
    pub code: String,
    /// One sentence with the place in it.
    #[schema(example = "2 of 12 images are too coarse to resolve modules")]
    pub message: String,
    /// Images concerned, sorted.
    #[schema(example = json!(["DJI_0001.jpg"]))]
    pub images: Vec<String>,
    /// Benches concerned, by their identifiers; what was left out of the model has none.
    #[schema(value_type = Vec<Uuid>)]
    pub benches: Vec<BenchId>,
}

impl From<Warning> for WarningView {
    fn from(warning: Warning) -> Self {
        Self { code: warning.code, message: warning.message, images: warning.images, benches: warning.benches }
    }
}

impl From<Job> for JobView {
    fn from(job: Job) -> Self {
        let stage_number =
            |name: &str| Stage::ALL.iter().position(|stage| stage.as_str() == name).map_or(0, |at| at + 1);
        Self {
            id: job.id,
            plant: job.plant,
            survey: job.survey,
            state: job.state.as_str(),
            cancel_requested: job.cancel_requested,
            progress: job.progress.map(|progress| ProgressView {
                stage_number: stage_number(&progress.stage),
                stage_count: Stage::ALL.len(),
                stage: progress.stage,
                done: progress.done,
                total: progress.total,
                remaining_s: progress.remaining_ms.map(|ms| ms.div_ceil(1000)),
            }),
            warnings: job.warnings.into_iter().map(WarningView::from).collect(),
            error: job.error.map(|(code, message)| JobErrorView { code, message }),
            attempt: job.attempt,
            max_attempts: job.max_attempts,
            priority: job.priority,
            // In full, unless a newer version wrote them.
            options: serde_json::from_str::<MapOptions>(&job.options)
                .map_or_else(|_| serde_json::from_str(&job.options).unwrap_or_default(), |all| serde_json::json!(all)),
            model: job.model_version.map(|version| format!("/api/v1/plants/{}/models/{version}", job.plant)),
            model_version: job.model_version,
            created: job.created,
            started: job.started,
            finished: job.finished,
        }
    }
}

const STATES: &str = "queued, running, succeeded, failed and cancelled";

filtered_list!(
    /// Which jobs of a survey.
    JobsOfSurveyQuery {
        /// Only those in this state: `queued`, `running`, `succeeded`, `failed` or `cancelled`.
        #[param(pattern = "^(queued|running|succeeded|failed|cancelled)$")]
        state: String,
    }
);
filtered_list!(
    /// Which jobs of a plant.
    JobsQuery {
        /// Only those in this state: `queued`, `running`, `succeeded`, `failed` or `cancelled`.
        #[param(pattern = "^(queued|running|succeeded|failed|cancelled)$")]
        state: String,
        /// Only those of this survey.
        survey: uuid::Uuid,
    }
);

fn place(plant: PlantId, job: JobId) -> String {
    format!("/api/v1/plants/{plant}/jobs/{job}")
}

/// Start a mapping of a survey
///
/// Answers 202 and where to poll. While the survey has an unfinished job, that job is the answer (200), with the options
/// that it was started with: a survey is never mapped twice at once. The survey's files are taken as they are when the
/// job begins.
#[utoipa::path(
    post,
    path = "/api/v1/plants/{plant}/surveys/{survey}/jobs",
    tag = "jobs",
    security(("key" = ["upload"])),
    params(
        ("plant" = Uuid, Path, description = "The plant's identifier"),
        ("survey" = Uuid, Path, description = "The survey's identifier")
    ),
    request_body(content = Option<StartJob>, description = "Options; an empty body takes the defaults"),
    responses(
        (status = 202, description = "Queued; poll `location`", body = JobView, headers(("location" = String))),
        (status = 200, description = "The survey's unfinished job", body = JobView, headers(("location" = String))),
        (status = "4XX", description = "`plant_not_found`, `survey_not_found`, `survey_incomplete` (with the member `missing`), \
            `job_stopping`, `invalid_json`, `invalid_fields`, `too_large`", body = Problem,
            content_type = "application/problem+json")
    )
)]
pub async fn start(
    State(state): State<AppState>,
    ApiPath((plant, survey)): ApiPath<(PlantId, SurveyId)>,
    once: Option<Extension<Once>>,
    body: Bytes,
) -> Result<Response, ApiError> {
    let asked = if body.trim_ascii().is_empty() {
        StartJob::default()
    } else {
        let Json(asked) = Json::<Option<Object<StartJob>>>::from_bytes(&body)?;
        asked.map_or_else(StartJob::default, |Object(asked)| asked)
    };
    let priority = asked.priority.unwrap_or(0);
    let options = asked.into_options().map_err(|what| ApiError::new(Code::InvalidFields, what))?;
    state.require_survey(plant, survey).await?;
    let missing = missing_views(&state.store.files(survey).await?);
    if !missing.is_empty() {
        let what: Vec<&str> = missing.iter().map(|missing| missing.message.as_str()).collect();
        return Err(ApiError::new(Code::SurveyIncomplete, what.join("; ")).with("missing", missing));
    }
    let options = options.said();
    let now = Timestamp::now();
    let id = match once {
        Some(Extension(Once(id))) => {
            let earlier = state.store.job(plant, JobId(id)).await?;
            // A key is free again after a day.
            earlier.is_none_or(|job| job.created > now - KEPT).then_some(JobId(id))
        }
        None => None,
    };
    let id = id.unwrap_or_else(|| JobId(Uuid::new_v4()));
    let request = JobRequest { id, plant, survey, options, priority, max_attempts: state.limits.max_attempts };
    let (status, job) = match state.store.enqueue_job(&request, now).await? {
        Enqueued::New(job) => {
            state.bell.notify_one();
            (StatusCode::ACCEPTED, job)
        }
        // The service died before it could keep the answer to this very request.
        Enqueued::Existing(job) if job.id == request.id => (StatusCode::ACCEPTED, job),
        Enqueued::Existing(job) if job.cancel_requested => {
            return Err(ApiError::new(
                Code::JobStopping,
                "the survey's job was cancelled and has not stopped yet; start the new one in a moment",
            )
            .with("job", place(plant, job.id))
            .retry_after(2));
        }
        Enqueued::Existing(job) => (StatusCode::OK, job),
    };
    Ok((status, [(header::LOCATION, place(plant, job.id))], Json(JobView::from(job))).into_response())
}

/// List a survey's jobs, the newest first
#[utoipa::path(
    get,
    path = "/api/v1/plants/{plant}/surveys/{survey}/jobs",
    tag = "jobs",
    security(("key" = ["read"]), ("key" = ["review"]), ("key" = ["upload"])),
    params(
        ("plant" = Uuid, Path, description = "The plant's identifier"),
        ("survey" = Uuid, Path, description = "The survey's identifier"),
        JobsOfSurveyQuery
    ),
    responses(
        (status = 200, body = List<JobView>),
        (status = "4XX", description = "`plant_not_found`, `survey_not_found`, `invalid_query`", body = Problem,
            content_type = "application/problem+json")
    )
)]
pub async fn list_of_survey(
    State(state): State<AppState>,
    ApiPath((plant, survey)): ApiPath<(PlantId, SurveyId)>,
    ApiQuery(query): ApiQuery<JobsOfSurveyQuery>,
) -> Result<List<JobView>, ApiError> {
    let part = query.part();
    let (page, wanted) = (part.page()?, state_filter(query.state.as_deref(), STATES)?);
    state.require_survey(plant, survey).await?;
    let jobs = state.store.jobs(plant, Some(survey), wanted, page).await?;
    let path = query.path(&format!("/api/v1/plants/{plant}/surveys/{survey}/jobs"));
    part.items(&path, jobs, |job| job.seq, JobView::from)
}

/// List a plant's jobs, the newest first
#[utoipa::path(
    get,
    path = "/api/v1/plants/{plant}/jobs",
    tag = "jobs",
    security(("key" = ["read"]), ("key" = ["review"]), ("key" = ["upload"])),
    params(("plant" = Uuid, Path, description = "The plant's identifier"), JobsQuery),
    responses(
        (status = 200, body = List<JobView>),
        (status = "4XX", description = "`plant_not_found`, `invalid_query`", body = Problem,
            content_type = "application/problem+json")
    )
)]
pub async fn list(
    State(state): State<AppState>,
    ApiPath(plant): ApiPath<PlantId>,
    ApiQuery(query): ApiQuery<JobsQuery>,
) -> Result<List<JobView>, ApiError> {
    let part = query.part();
    let (page, wanted) = (part.page()?, state_filter(query.state.as_deref(), STATES)?);
    state.require_plant(plant).await?;
    let jobs = state.store.jobs(plant, query.survey.map(SurveyId), wanted, page).await?;
    let path = query.path(&format!("/api/v1/plants/{plant}/jobs"));
    part.items(&path, jobs, |job| job.seq, JobView::from)
}

/// One job: poll it until its state is final
///
/// While it is not, the header `retry-after` says after how many seconds to ask again. `GET …/events` tells as it happens.
#[utoipa::path(
    get,
    path = "/api/v1/plants/{plant}/jobs/{job}",
    tag = "jobs",
    security(("key" = ["read"]), ("key" = ["review"]), ("key" = ["upload"])),
    params(
        ("plant" = Uuid, Path, description = "The plant's identifier"),
        ("job" = Uuid, Path, description = "The job's identifier")
    ),
    responses(
        (status = 200, body = JobView),
        (status = 404, description = "`plant_not_found`, `job_not_found`", body = Problem,
            content_type = "application/problem+json")
    )
)]
pub async fn get(
    State(state): State<AppState>,
    ApiPath((plant, job)): ApiPath<(PlantId, JobId)>,
) -> Result<Response, ApiError> {
    let found = require_job(&state, plant, job).await?;
    let retry_after = (!found.state.is_final()).then_some([(header::RETRY_AFTER, "1")]);
    Ok((retry_after, Json(JobView::from(found))).into_response())
}

/// Cancel a job
///
/// A queued job is cancelled at once, a running one as soon as its worker hears of it. Cancelling again changes nothing.
#[utoipa::path(
    post,
    path = "/api/v1/plants/{plant}/jobs/{job}/cancel",
    tag = "jobs",
    security(("key" = ["upload"])),
    params(
        ("plant" = Uuid, Path, description = "The plant's identifier"),
        ("job" = Uuid, Path, description = "The job's identifier")
    ),
    responses(
        (status = 202, description = "Cancelled, or about to be", body = JobView),
        (status = 404, description = "`plant_not_found`, `job_not_found`", body = Problem,
            content_type = "application/problem+json"),
        (status = 409, description = "`job_finished`: it ended before", body = Problem,
            content_type = "application/problem+json")
    )
)]
pub async fn cancel(
    State(state): State<AppState>,
    ApiPath((plant, job)): ApiPath<(PlantId, JobId)>,
) -> Result<Response, ApiError> {
    match state.store.cancel_job(plant, job, Timestamp::now()).await? {
        Some(Cancelled::Accepted(job)) => Ok((StatusCode::ACCEPTED, Json(JobView::from(job))).into_response()),
        Some(Cancelled::TooLate(job)) if job.state == JobState::Cancelled => {
            Ok((StatusCode::ACCEPTED, Json(JobView::from(job))).into_response())
        }
        Some(Cancelled::TooLate(job)) => Err(ApiError::new(
            Code::JobFinished,
            format!("the job is {} and cannot be cancelled any more", job.state.as_str()),
        )),
        None => Err(no_job(&state, plant, job).await?),
    }
}

/// The job of the plant, or a problem.
pub async fn require_job(state: &AppState, plant: PlantId, job: JobId) -> Result<Job, ApiError> {
    match state.store.job(plant, job).await? {
        Some(job) => Ok(job),
        None => Err(no_job(state, plant, job).await?),
    }
}

async fn no_job(state: &AppState, plant: PlantId, job: JobId) -> Result<ApiError, ApiError> {
    state.require_plant(plant).await?;
    Ok(ApiError::new(
        Code::JobNotFound,
        format!("no job of this plant has the identifier {job}; GET /api/v1/plants/{plant}/jobs lists them"),
    ))
}
