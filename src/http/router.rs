//! The table of contents.

use super::controllers::{
    events, features, file_deletion, files, health, images, jobs, keys, models, openapi as api_description, page,
    plants, surveys, usage, webhooks,
};
use super::description::{examples, responses};
use super::error;
use super::middleware::access::{Gate, Policy};
use super::middleware::head::{self, MAX_JSON_BYTES};
use super::middleware::{access, admission, conditional, encoding, idempotency, loopback};
use super::state::AppState;
use super::uploads::tus;
use crate::config::NetworkArgs;
use crate::telemetry::metrics::RequestLabels;
use crate::telemetry::{Metrics, traces};
use axum::Router;
use axum::body::Body;
use axum::extract::{DefaultBodyLimit, MatchedPath, Request, State};
use axum::http::{HeaderName, HeaderValue, Method, StatusCode, header};
use axum::middleware::{self, Next};
use axum::response::{IntoResponse, Response};
use std::sync::Arc;
use std::time::{Duration, Instant};
use tower::{Layer, ServiceExt};
use tower_http::CompressionLevel;
use tower_http::catch_panic::CatchPanicLayer;
use tower_http::compression::CompressionLayer;
use tower_http::cors::CorsLayer;
use tower_http::request_id::{MakeRequestUuid, PropagateRequestIdLayer, SetRequestIdLayer};
use tower_http::timeout::TimeoutLayer;
use tower_http::trace::TraceLayer;
use tracing::Span;
use utoipa::OpenApi;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

const REQUEST_ID: HeaderName = HeaderName::from_static("x-request-id");

#[derive(OpenApi)]
#[openapi(
    info(
        title = "heliomap",
        description = "Turns drone overview photos of a photovoltaic plant into a georeferenced model of every module.\n\n\
            Every error is a problem document (RFC 9457, `application/problem+json`) with a stable `code`. \
            Plants and surveys are found again by their names: creating one of the same name answers 200 with the one \
            that is there, so that every request may be repeated."
    ),
    components(schemas(error::Problem)),
    tags(
        (name = "plants", description = "Photovoltaic plants."),
        (name = "surveys", description = "Flights over a plant: photos and their reconstruction."),
        (name = "jobs", description = "Mappings of a survey."),
        (name = "models", description = "What was found: modules, sectors, benches and lines as GeoJSON."),
        (name = "webhooks", description = "Who is told of the ends of jobs."),
        (name = "access", description = "Keys, and what was done with them."),
        (name = "operation", description = "Whether the service runs, and what it offers.")
    )
)]
struct Description;

/// Requests that are answered at once.
fn prompt() -> OpenApiRouter<AppState> {
    OpenApiRouter::new()
        .routes(routes!(plants::create, plants::list))
        .routes(routes!(plants::get, plants::rename, plants::delete))
        .routes(routes!(surveys::create, surveys::list))
        .routes(routes!(surveys::get, surveys::rename, surveys::delete))
        .routes(routes!(images::list))
        .routes(routes!(images::positions))
        .routes(routes!(jobs::start, jobs::list_of_survey))
        .routes(routes!(jobs::list))
        .routes(routes!(jobs::get))
        .routes(routes!(jobs::cancel))
        .routes(routes!(events::events))
        .routes(routes!(models::list))
        .routes(routes!(models::get))
        .routes(routes!(features::layer))
        .routes(routes!(features::module))
        .routes(routes!(keys::create, keys::list))
        .routes(routes!(keys::get, keys::revoke))
        .routes(routes!(keys::rotate))
        .routes(routes!(keys::audit))
        .routes(routes!(webhooks::create, webhooks::list))
        .routes(routes!(webhooks::get, webhooks::delete))
        .routes(routes!(webhooks::deliveries))
        .routes(routes!(webhooks::resend))
        .routes(routes!(usage::get))
        .routes(routes!(health::health))
        .routes(routes!(health::ready))
        .routes(routes!(api_description::openapi_yaml))
        .routes(routes!(api_description::openapi_json))
}

/// Requests that take as long as their bytes come.
fn uploads() -> OpenApiRouter<AppState> {
    OpenApiRouter::new()
        .routes(routes!(files::put_image, file_deletion::delete_image))
        .routes(routes!(files::post_images))
        .routes(routes!(files::put_reconstruction, files::post_reconstruction))
        .routes(routes!(files::put_reconstruction_file, file_deletion::delete_reconstruction_file))
        .routes(routes!(tus::begin::create, tus::list::list, tus::options))
        .routes(routes!(tus::head, tus::get, tus::append::patch, tus::terminate, tus::post))
}

/// The description of the whole API.
pub fn openapi() -> utoipa::openapi::OpenApi {
    let mut description =
        OpenApiRouter::with_openapi(Description::openapi()).merge(prompt()).merge(uploads()).into_openapi();
    // What a wildcard matches is a parameter like any other.
    let paths = std::mem::take(&mut description.paths.paths);
    description.paths.paths = paths.into_iter().map(|(path, item)| (path.replace("{*", "{"), item)).collect();
    access::describe(&mut description);
    idempotency::describe(&mut description);
    conditional::describe(&mut description);
    error::describe(&mut description);
    examples::describe(&mut description);
    responses::share(&mut description);
    description
}

/// The whole service.
pub fn router(state: AppState) -> Router {
    let timeout = TimeoutLayer::with_status_code(StatusCode::REQUEST_TIMEOUT, state.limits.request_timeout);
    let small = middleware::from_fn(head::small);
    let prompt = prompt().layer(DefaultBodyLimit::max(MAX_JSON_BYTES)).layer(small).layer(timeout);
    let admission = middleware::from_fn_with_state(state.clone(), admission::admit);
    let uploads = uploads().layer(DefaultBodyLimit::disable()).layer(admission);
    let (router, description) = OpenApiRouter::new().merge(prompt).merge(uploads).split_for_parts();
    let (metrics, cors) = (state.metrics.clone(), cors(&state.network));
    let local = state.insecure.then(|| middleware::from_fn_with_state(state.network.clone(), loopback::only));
    let gate = Gate { state: state.clone(), policy: Arc::new(Policy::of(&description)) };
    router
        .route_layer(middleware::from_fn(conditional::conditional))
        .route_layer(middleware::from_fn_with_state(state.clone(), idempotency::once))
        .route_layer(middleware::from_fn_with_state(gate, access::guard))
        .route_layer(middleware::from_fn_with_state(metrics, count))
        .fallback(page::serve)
        .method_not_allowed_fallback(|| async { StatusCode::METHOD_NOT_ALLOWED })
        .with_state(state)
        // The innermost first.
        .layer(tower::util::option_layer(local))
        .layer(middleware::from_fn(head::unambiguous))
        .layer(CatchPanicLayer::custom(panicked))
        .layer(middleware::map_response(error::only_problems))
        // A plant is megabytes of JSON, which little effort makes small.
        .layer(CompressionLayer::new().quality(CompressionLevel::Fastest))
        .layer(middleware::from_fn(encoding::choose))
        .layer(middleware::map_response(as_it_says))
        .layer(tower::util::option_layer(cors.map(|layer| middleware::from_fn_with_state(layer, cross_origin))))
        .layer(PropagateRequestIdLayer::new(REQUEST_ID))
        .layer(TraceLayer::new_for_http().make_span_with(span).on_response(log_response).on_failure(()))
        .layer(SetRequestIdLayer::new(REQUEST_ID, MakeRequestUuid))
        .layer(middleware::from_fn(sane_request_id))
}

/// Lets scripts of web pages elsewhere use the service, where that is configured. They show a key like everyone else.
fn cors(network: &NetworkArgs) -> Option<CorsLayer> {
    let headers = ["authorization", "content-type", "content-digest", "if-match", "if-none-match", "repr-digest"];
    let headers = headers.into_iter().chain(["idempotency-key", "tus-resumable", "upload-checksum", "upload-concat"]);
    let headers =
        headers.chain(["upload-length", "upload-metadata", "upload-offset", "x-http-method-override", "traceparent"]);
    let exposed = ["etag", "idempotency-replayed", "link", "location", "retry-after", "x-request-id"];
    let exposed =
        exposed.into_iter().chain(["tus-checksum-algorithm", "tus-extension", "tus-max-size", "tus-resumable"]);
    let exposed = exposed.chain(["tus-version", "upload-concat", "upload-expires", "upload-length", "upload-metadata"]);
    let exposed = exposed.chain(["upload-offset"]);
    let methods =
        [Method::GET, Method::HEAD, Method::POST, Method::PUT, Method::PATCH, Method::DELETE, Method::OPTIONS];
    (!network.cors_origin.is_empty()).then(|| {
        CorsLayer::new()
            .allow_origin(network.cors_origin.clone())
            .allow_methods(methods)
            .allow_headers(headers.chain(["x-request-id"]).map(HeaderName::from_static).collect::<Vec<_>>())
            .expose_headers(exposed.map(HeaderName::from_static).collect::<Vec<_>>())
            .max_age(Duration::from_secs(3600))
    })
}

/// Answers what a browser asks before a script's request. Other requests for the options of a resource are answered by it:
/// the layer, which takes each of them for such a question, is shown another method.
async fn cross_origin(State(layer): State<CorsLayer>, mut request: Request, next: Next) -> Response {
    let preflight = request.headers().contains_key(header::ACCESS_CONTROL_REQUEST_METHOD);
    let options = *request.method() == Method::OPTIONS && !preflight;
    if options {
        *request.method_mut() = Method::GET;
    }
    let inner = next.map_request(move |mut request: Request| {
        if options {
            *request.method_mut() = Method::OPTIONS;
        }
        request
    });
    layer.layer(inner).oneshot(request).await.unwrap_or_else(|never| match never {})
}

/// What is answered is what its type says, whatever it looks like to a browser.
async fn as_it_says(mut response: Response) -> Response {
    response.headers_mut().insert(header::X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff"));
    response
}

/// Counts requests by their routes.
async fn count(State(metrics): State<Metrics>, route: MatchedPath, request: Request, next: Next) -> Response {
    struct InFlight(Metrics);
    impl Drop for InFlight {
        fn drop(&mut self) {
            self.0.requests_in_flight.dec();
        }
    }
    metrics.requests_in_flight.inc();
    // Also where the client goes before it is answered.
    let in_flight = InFlight(metrics);
    let (begun, method) = (Instant::now(), request.method().to_string());
    let response = next.run(request).await;
    let labels = RequestLabels { method, route: route.as_str().to_owned(), status: response.status().as_u16() };
    in_flight.0.answered(&labels, begun.elapsed());
    response
}

/// A client may name its requests, but only with what is safe in a log.
async fn sane_request_id(mut request: Request, next: Next) -> Response {
    let sane = |id: &HeaderValue| {
        id.len() <= 64 && id.as_bytes().iter().all(|b| b.is_ascii_alphanumeric() || matches!(b, b'-' | b'_' | b'.'))
    };
    if request.headers().get(REQUEST_ID).is_some_and(|id| !sane(id)) {
        request.headers_mut().remove(REQUEST_ID);
    }
    next.run(request).await
}

fn span(request: &axum::http::Request<Body>) -> Span {
    let (id, method, path) = (access::request_id(request), request.method(), request.uri().path());
    if !traces::are_on() {
        return tracing::info_span!("request", %method, path, id);
    }
    // By its route, as metrics are: what clients put into paths makes no new name.
    let route = request.extensions().get::<MatchedPath>().map_or("", MatchedPath::as_str);
    let name = format!("{method} {route}");
    let span = tracing::info_span!("request", %method, path, id, otel.name = name.trim_end(), otel.kind = "server");
    traces::join(&span, request.headers());
    span
}

fn log_response<B>(response: &axum::http::Response<B>, latency: Duration, _: &Span) {
    tracing::info!(status = response.status().as_u16(), milliseconds = latency.as_secs_f64() * 1e3, "answered");
}

fn panicked(panic: Box<dyn std::any::Any + Send>) -> Response {
    let text = panic.downcast_ref::<&str>().copied().or_else(|| panic.downcast_ref::<String>().map(String::as_str));
    tracing::error!(panic = text.unwrap_or("unknown"), "a handler panicked");
    error::ApiError::new(error::Code::Internal, "this is a fault of the service; its log tells more").into_response()
}
