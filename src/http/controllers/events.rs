//! A job's progress as it happens: server-sent events.

use crate::http::controllers::jobs::{JobView, require_job};
use crate::http::error::{ApiError, Problem};
use crate::http::extract::ApiPath;
use crate::http::state::AppState;
use crate::store::{Job, JobId};
use axum::extract::State;
use axum::http::{HeaderName, HeaderValue, header};
use axum::response::sse::{Event, KeepAlive, Sse};
use futures::Stream;
use heliomap_model::PlantId;
use std::convert::Infallible;
use std::time::Duration;

/// How often the job is looked at; the worker may be another process on another machine.
const LOOK: Duration = Duration::from_millis(500);
/// How often an idle line is kept open.
const KEEP_ALIVE: Duration = Duration::from_secs(15);

/// One of the events of a stream (`text/event-stream`).
#[derive(utoipa::ToSchema)]
#[expect(dead_code, reason = "it describes what is written as text")]
struct JobEvent {
    /// `job`
    event: Option<String>,
    /// The job as JSON, as `GET …/jobs/{job}` answers it.
    data: String,
}

/// Follow a job
///
/// An event `job` with the job as `GET …/jobs/{job}` answers it, now and whenever something of it has changed; the stream
/// ends with the job. Where the line breaks, ask again: the first event tells how the job stands.
#[utoipa::path(
    get,
    path = "/api/v1/plants/{plant}/jobs/{job}/events",
    tag = "jobs",
    security(("key" = ["read"]), ("key" = ["review"]), ("key" = ["upload"])),
    params(
        ("plant" = Uuid, Path, description = "The plant's identifier"),
        ("job" = Uuid, Path, description = "The job's identifier")
    ),
    responses(
        (status = 200, description = "Events `job`, each with a job as data", content_type = "text/event-stream", body = JobEvent),
        (status = 404, description = "`plant_not_found`, `job_not_found`", body = Problem,
            content_type = "application/problem+json")
    )
)]
pub async fn events(
    State(state): State<AppState>,
    ApiPath((plant, job)): ApiPath<(PlantId, JobId)>,
) -> Result<([(HeaderName, HeaderValue); 2], Sse<impl Stream<Item = Result<Event, Infallible>>>), ApiError> {
    let first = require_job(&state, plant, job).await?;
    // Proxies must not hold events back.
    let headers = [
        (header::CACHE_CONTROL, HeaderValue::from_static("no-cache")),
        (HeaderName::from_static("x-accel-buffering"), HeaderValue::from_static("no")),
    ];
    Ok((headers, Sse::new(follow(state, first)).keep_alive(KeepAlive::new().interval(KEEP_ALIVE))))
}

/// The job whenever something of it has changed, until it has ended, is gone, or the service stops.
fn follow(state: AppState, first: Job) -> impl Stream<Item = Result<Event, Infallible>> {
    let (plant, id) = (first.plant, first.id);
    let begin = (state, Some(first), String::new());
    futures::stream::unfold(begin, move |(state, mut known, mut sent)| async move {
        loop {
            let job = match known.take() {
                Some(job) => job,
                None => {
                    tokio::select! {
                        () = state.stop.cancelled() => return None,
                        () = tokio::time::sleep(LOOK) => {}
                    }
                    match state.store.job(plant, id).await {
                        Ok(Some(job)) => job,
                        Ok(None) => return None,
                        Err(error) => {
                            tracing::warn!(%error, "the job cannot be looked at");
                            return None;
                        }
                    }
                }
            };
            let ended = job.state.is_final();
            let text = serde_json::to_string(&JobView::from(job)).unwrap_or_default();
            if text != sent {
                let event = Event::default().event("job").data(&text);
                sent = text;
                return Some((Ok(event), (state, None, sent)));
            }
            if ended {
                return None;
            }
        }
    })
}
