//! What is said when something does not work: RFC 9457 problem documents with a stable code.

use crate::store::{InvalidPath, StoreError};
use axum::Json;
use axum::http::{HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use serde_json::{Map, Value};
use std::borrow::Cow;
use std::collections::{BTreeMap, BTreeSet};
use utoipa::openapi::header::HeaderBuilder;
use utoipa::openapi::path::Operation;
use utoipa::openapi::schema::{ObjectBuilder, Type};
use utoipa::openapi::{ContentBuilder, OpenApi, PathItem, Ref, RefOr, ResponseBuilder, Schema};

/// The media type of a problem document.
pub const PROBLEM_JSON: &str = "application/problem+json";

macro_rules! codes {
    ($($(#[$doc:meta])* $name:ident = $status:ident, $code:literal, $title:literal;)*) => {
        /// Every kind of problem, with its status, its stable word and its title.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
        pub enum Code {
            $($(#[$doc])* $name,)*
        }

        impl Code {
            /// All kinds.
            pub const ALL: &[Self] = &[$(Self::$name),*];

            /// The kind that a word is of.
            pub fn of_word(word: &str) -> Option<Self> {
                Self::ALL.iter().copied().find(|code| code.parts().1 == word)
            }

            /// Status, word and title.
            pub fn parts(self) -> (StatusCode, &'static str, &'static str) {
                match self {
                    $(Self::$name => (StatusCode::$status, $code, $title),)*
                }
            }
        }
    };
}

codes! {
    BadRequest = BAD_REQUEST, "bad_request", "The request cannot be read";
    InvalidQuery = BAD_REQUEST, "invalid_query", "A query parameter is wrong";
    InvalidJson = BAD_REQUEST, "invalid_json", "The body is no JSON";
    UploadInterrupted = BAD_REQUEST, "upload_interrupted", "The upload ended early";
    Unauthorized = UNAUTHORIZED, "unauthorized", "A key is needed";
    Forbidden = FORBIDDEN, "forbidden", "The key does not open this";
    NotFound = NOT_FOUND, "not_found", "There is nothing here";
    PlantNotFound = NOT_FOUND, "plant_not_found", "There is no such plant";
    SurveyNotFound = NOT_FOUND, "survey_not_found", "There is no such survey";
    JobNotFound = NOT_FOUND, "job_not_found", "There is no such job";
    ModelNotFound = NOT_FOUND, "model_not_found", "There is no such model";
    KeyNotFound = NOT_FOUND, "key_not_found", "There is no such key";
    UploadNotFound = NOT_FOUND, "upload_not_found", "There is no such upload";
    WebhookNotFound = NOT_FOUND, "webhook_not_found", "There is no such webhook";
    DeliveryNotFound = NOT_FOUND, "delivery_not_found", "There is no such message";
    ModuleNotFound = NOT_FOUND, "module_not_found", "There is no such module";
    FileNotFound = NOT_FOUND, "file_not_found", "There is no such file";
    MethodNotAllowed = METHOD_NOT_ALLOWED, "method_not_allowed", "The method does not apply here";
    Timeout = REQUEST_TIMEOUT, "timeout", "The request took too long";
    UploadStalled = REQUEST_TIMEOUT, "upload_stalled", "The upload stood still";
    SurveyIncomplete = CONFLICT, "survey_incomplete", "The survey cannot be mapped yet";
    JobFinished = CONFLICT, "job_finished", "The job has ended";
    NameTaken = CONFLICT, "name_taken", "Another has this name";
    KeyRevoked = CONFLICT, "key_revoked", "The key is revoked";
    JobStopping = CONFLICT, "job_stopping", "The survey's cancelled job has not stopped yet";
    TooManyWebhooks = CONFLICT, "too_many_webhooks", "There are as many webhooks as there may be";
    IdempotencyBusy = CONFLICT, "idempotency_busy", "The request is being answered";
    UploadOffset = CONFLICT, "upload_offset", "The bytes do not go on where the upload is";
    PreconditionFailed = PRECONDITION_FAILED, "precondition_failed", "What is there is not what the request speaks of";
    TusVersion = PRECONDITION_FAILED, "tus_version", "The protocol's version is missing or another";
    UploadBusy = LOCKED, "upload_busy", "The upload is in other hands";
    TooLarge = PAYLOAD_TOO_LARGE, "too_large", "The upload is too large";
    ArchiveTooLarge = PAYLOAD_TOO_LARGE, "archive_too_large", "The archive unpacks to too much";
    ImageTooLarge = PAYLOAD_TOO_LARGE, "image_too_large", "The image has too many pixels";
    UnsupportedMediaType = UNSUPPORTED_MEDIA_TYPE, "unsupported_media_type", "The body's media type does not apply here";
    UnsupportedArchive = UNSUPPORTED_MEDIA_TYPE, "unsupported_archive", "The body is no zip or tar";
    ChecksumMismatch = UNPROCESSABLE_ENTITY, "checksum_mismatch", "The bytes came changed";
    IdempotencyKeyReused = UNPROCESSABLE_ENTITY, "idempotency_key_reused", "The key belongs to another request";
    InvalidName = UNPROCESSABLE_ENTITY, "invalid_name", "The name cannot be used";
    NameTwice = UNPROCESSABLE_ENTITY, "name_twice", "Two files have the same name";
    WebhookUrl = UNPROCESSABLE_ENTITY, "webhook_url", "The webhook's URL cannot be used";
    InvalidFields = UNPROCESSABLE_ENTITY, "invalid_fields", "The document has the wrong fields";
    UnknownFile = UNPROCESSABLE_ENTITY, "unknown_file", "The file is no part of a reconstruction";
    ImageFormatMismatch = UNPROCESSABLE_ENTITY, "image_format_mismatch", "The image is not what its name says";
    ImageUnreadable = UNPROCESSABLE_ENTITY, "image_unreadable", "The file is no image that can be read";
    ImageTruncated = UNPROCESSABLE_ENTITY, "image_truncated", "The image is cut short";
    FileUnreadable = UNPROCESSABLE_ENTITY, "file_unreadable", "The file does not hold what its name says";
    ReconstructionMalformed = UNPROCESSABLE_ENTITY, "reconstruction_malformed", "The file is not what OpenSfM writes";
    ReconstructionNotFinite = UNPROCESSABLE_ENTITY, "reconstruction_not_finite", "The file holds numbers that are none";
    CameraModelUnknown = UNPROCESSABLE_ENTITY, "camera_model_unknown", "The cameras are of a model that is not read";
    TooFewImages = UNPROCESSABLE_ENTITY, "too_few_images", "The reconstruction is of too few images";
    PointCloudEmpty = UNPROCESSABLE_ENTITY, "point_cloud_empty", "The point cloud holds no points";
    PointCloudTruncated = UNPROCESSABLE_ENTITY, "point_cloud_truncated", "The point cloud is cut short";
    PointCloudTooLarge = UNPROCESSABLE_ENTITY, "point_cloud_too_large", "The point cloud has too many points";
    BoxesInvalid = UNPROCESSABLE_ENTITY, "boxes_invalid", "The boxes cannot be used";
    FilesRefused = UNPROCESSABLE_ENTITY, "files_refused", "Some files were refused";
    ArchiveUnsafe = UNPROCESSABLE_ENTITY, "archive_unsafe", "The archive holds entries that no archive should";
    ArchiveUnreadable = UNPROCESSABLE_ENTITY, "archive_unreadable", "The archive cannot be read";
    ArchiveEmpty = UNPROCESSABLE_ENTITY, "archive_empty", "The archive holds no file of a survey";
    TooManyRequests = TOO_MANY_REQUESTS, "too_many_requests", "Too many requests";
    TooManyUploads = TOO_MANY_REQUESTS, "too_many_uploads", "There are as many unfinished uploads as there may be";
    Internal = INTERNAL_SERVER_ERROR, "internal_error", "The service failed";
    Unavailable = SERVICE_UNAVAILABLE, "unavailable", "The service is not ready";
    QuotaExceeded = INSUFFICIENT_STORAGE, "quota_exceeded", "The organisation may not keep so much";
    StorageFull = INSUFFICIENT_STORAGE, "storage_full", "The service's storage is full";
}

/// A request that cannot be fulfilled, as the client hears of it.
#[derive(Debug, Clone)]
pub struct ApiError {
    pub code: Code,
    /// What does not work and what to do.
    pub detail: Cow<'static, str>,
    /// Further members of the document.
    pub members: Map<String, Value>,
    pub retry_after_s: Option<u64>,
}

impl ApiError {
    /// A problem of a kind; `detail` says what does not work and what to do.
    pub fn new(code: Code, detail: impl Into<Cow<'static, str>>) -> Self {
        Self { code, detail: detail.into(), members: Map::new(), retry_after_s: None }
    }

    /// Adds a member to the document.
    pub fn with(mut self, name: &str, value: impl Serialize) -> Self {
        self.members.insert(name.to_owned(), serde_json::json!(value));
        self
    }

    /// Says when to try again.
    pub fn retry_after(mut self, seconds: u64) -> Self {
        self.retry_after_s = Some(seconds);
        self
    }

    /// A fault of the service: logged here, once, and not told.
    pub fn internal(error: &dyn std::error::Error) -> Self {
        tracing::error!(error = %chain(error), "request failed");
        Self::new(
            Code::Internal,
            "this is a fault of the service; its log tells more under the x-request-id of this response",
        )
    }

    /// A problem of which the document was kept.
    pub fn told_before(document: &Value) -> Self {
        let code = document["code"].as_str().and_then(Code::of_word);
        let detail = document["detail"].as_str().unwrap_or("the same was refused before").to_owned();
        let mut problem = Self::new(code.unwrap_or(Code::BadRequest), detail);
        let own = ["type", "title", "status", "code", "detail"];
        let members = document.as_object().into_iter().flatten().filter(|(name, _)| !own.contains(&name.as_str()));
        problem.members.extend(members.map(|(name, value)| (name.clone(), value.clone())));
        problem
    }

    /// The problem document.
    pub fn document(&self) -> Value {
        let (status, code, title) = self.code.parts();
        let mut document = Map::new();
        document.insert("type".to_owned(), format!("urn:heliomap:problem:{code}").into());
        document.insert("title".to_owned(), title.into());
        document.insert("status".to_owned(), status.as_u16().into());
        document.insert("code".to_owned(), code.into());
        document.insert("detail".to_owned(), self.detail.as_ref().into());
        document.extend(self.members.clone());
        Value::Object(document)
    }
}

impl IntoResponse for ApiError {
    fn into_response(self) -> Response {
        let mut response = (self.code.parts().0, Json(self.document())).into_response();
        response.headers_mut().insert(header::CONTENT_TYPE, HeaderValue::from_static(PROBLEM_JSON));
        if let Some(seconds) = self.retry_after_s {
            response.headers_mut().insert(header::RETRY_AFTER, HeaderValue::from(seconds));
        }
        response
    }
}

impl From<StoreError> for ApiError {
    fn from(error: StoreError) -> Self {
        match &error {
            StoreError::Gone { what: "plant" } => Self::new(Code::PlantNotFound, "the plant was deleted meanwhile"),
            StoreError::NameTaken => {
                Self::new(Code::NameTaken, "another one has this name: choose another name, or rename the other one first")
            }
            StoreError::OverQuota { what, used, quota } => crate::http::controllers::usage::over_quota(what, *used, *quota),
            StoreError::TooManyUploads { open, max } => Self::new(
                Code::TooManyUploads,
                format!(
                    "the organisation has {open} unfinished uploads of the {max} that it may have at once: go on with some of \
                     them or end them, `GET` of a survey's uploads with `state=unfinished` lists them; else they end by themselves"
                ),
            )
            .retry_after(60),
            StoreError::BeingFreed { .. } => Self::new(
                Code::Unavailable,
                "the same bytes were replaced before and are just being deleted; send the request again",
            )
            .retry_after(10),
            StoreError::Gone { .. } => Self::new(Code::SurveyNotFound, "the survey was deleted meanwhile"),
            error if error.is_full() => {
                tracing::error!(%error, "storage is full");
                Self::new(Code::StorageFull, "nothing of this request was stored; make room, then send it again")
                    .retry_after(60)
            }
            error => Self::internal(error),
        }
    }
}

impl From<InvalidPath> for ApiError {
    fn from(error: InvalidPath) -> Self {
        let code = match error {
            InvalidPath::Name { .. } => Code::InvalidName,
            InvalidPath::Unknown { .. } => Code::UnknownFile,
        };
        Self::new(code, error.to_string())
    }
}

/// An error with all that caused it.
fn chain(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut source = error.source();
    while let Some(cause) = source {
        let cause_text = cause.to_string();
        if !text.contains(&cause_text) {
            text.push_str(": ");
            text.push_str(&cause_text);
        }
        source = cause.source();
    }
    text
}

/// A problem document (RFC 9457). Further members depend on the code.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub struct Problem {
    /// A URN that ends in the code.
    #[schema(example = "urn:heliomap:problem:plant_not_found")]
    pub r#type: String,
    #[schema(example = "There is no such plant")]
    pub title: String,
    #[schema(example = 404)]
    pub status: u16,
    /// A stable word to tell problems apart by.
    #[schema(example = "plant_not_found")]
    pub code: String,
    /// What does not work and what to do, for people.
    #[schema(example = "no plant has the identifier 0b7a3f7e-59b1-4f0c-9f0d-3d6f3d1f7a11")]
    pub detail: String,
}

/// Names every code in the description, and of each operation every status with the codes that it comes with: what the
/// operation itself says under `4XX`, and what any operation may answer.
pub fn describe(description: &mut OpenApi) {
    let problem = description.components.as_mut().and_then(|components| components.schemas.get_mut("Problem"));
    if let Some(RefOr::T(Schema::Object(problem))) = problem
        && let Some(RefOr::T(Schema::Object(code))) = problem.properties.get_mut("code")
    {
        code.enum_values = Some(Code::ALL.iter().map(|code| code.parts().1.into()).collect());
    }
    // What operations say of themselves, by their path and method.
    let mut own: BTreeMap<(String, &str), String> = BTreeMap::new();
    for (path, item) in &mut description.paths.paths {
        for (method, operation) in operations(item) {
            if let Some(RefOr::T(said)) = operation.responses.responses.remove("4XX") {
                own.insert((path.clone(), method), said.description);
            }
        }
    }
    for (path, item) in &mut description.paths.paths {
        for (method, operation) in operations(item) {
            let said = own.get(&(path.clone(), method)).map_or("", String::as_str);
            let mut codes = named(said);
            for ((other, other_method), text) in &own {
                // "As `PUT`": of the same path, or of the survey's files where this is their upload in steps.
                let meant = match (said.contains("s `PUT`"), said.contains("As the method")) {
                    (true, _) => *other_method == "put" && (other == path || !own.contains_key(&(path.clone(), "put"))),
                    (_, stands) => stands && other == path,
                };
                if meant {
                    codes.extend(named(text));
                }
            }
            codes.insert(Code::Internal);
            if path.contains('{') {
                codes.insert(Code::NotFound);
            }
            if method == "post" || method == "put" || method == "patch" {
                codes.extend([Code::UnsupportedMediaType, Code::TooLarge, Code::BadRequest]);
            }
            if !codes.contains(&Code::UploadStalled) {
                codes.insert(Code::Timeout);
            }
            answer_with(operation, &codes, method == "head");
        }
    }
}

pub fn operations(item: &mut PathItem) -> impl Iterator<Item = (&'static str, &mut Operation)> {
    let PathItem { get, put, post, delete, patch, head, .. } = item;
    [("get", get), ("put", put), ("post", post), ("delete", delete), ("patch", patch), ("head", head)]
        .into_iter()
        .filter_map(|(method, operation)| Some((method, operation.as_mut()?)))
}

/// The codes that a text names in backticks.
pub fn named(text: &str) -> BTreeSet<Code> {
    let words: BTreeSet<&str> = text.split('`').skip(1).step_by(2).collect();
    Code::ALL.iter().copied().filter(|code| words.contains(code.parts().1)).collect()
}

/// Describes the answers of these codes, each under its status; what is described there already is added to.
fn answer_with(operation: &mut Operation, codes: &BTreeSet<Code>, without_body: bool) {
    let responses = &mut operation.responses.responses;
    for code in codes {
        let (status, word, title) = code.parts();
        let entry = responses.entry(status.as_u16().to_string()).or_insert_with(|| {
            let content = ContentBuilder::new().schema(Some(Ref::from_schema_name("Problem"))).build();
            match without_body {
                true => ResponseBuilder::new().build().into(),
                false => ResponseBuilder::new().content(PROBLEM_JSON, content).build().into(),
            }
        });
        let RefOr::T(response) = entry else { continue };
        if named(&response.description).contains(code) {
            continue;
        }
        if !response.description.is_empty() {
            response.description.push_str("; ");
        }
        response.description.push_str(&format!("`{word}`: {title}"));
    }
    for (status, response) in responses {
        if let ("429" | "503" | "507", RefOr::T(response)) = (status.as_str(), response) {
            let seconds = ObjectBuilder::new().schema_type(Type::Integer).minimum(Some(0)).build();
            let header =
                HeaderBuilder::new().schema(Some(seconds)).description(Some("Seconds until the next try")).build();
            response.headers.insert("retry-after".to_owned(), header.into());
        }
    }
}

/// The same document on every error, wherever it arose: what the framework answered with plain text becomes a problem.
pub async fn only_problems(response: Response) -> Response {
    let status = response.status();
    let is_problem = response.headers().get(header::CONTENT_TYPE).is_some_and(|kind| kind == PROBLEM_JSON);
    if !(status.is_client_error() || status.is_server_error()) || is_problem {
        return response;
    }
    let (code, detail) = match status {
        StatusCode::NOT_FOUND => (Code::NotFound, "see /openapi.yaml for what this service offers"),
        StatusCode::METHOD_NOT_ALLOWED => (Code::MethodNotAllowed, "the header `allow` names the methods that do"),
        StatusCode::REQUEST_TIMEOUT => (Code::Timeout, "send it again; ask for less at once where that fails too"),
        StatusCode::PAYLOAD_TOO_LARGE => (Code::TooLarge, "send less at once"),
        StatusCode::UNSUPPORTED_MEDIA_TYPE => (Code::UnsupportedMediaType, "see /openapi.yaml for what is expected"),
        status if status.is_client_error() => (Code::BadRequest, "see /openapi.yaml for what is expected"),
        _ => (Code::Internal, "this is a fault of the service"),
    };
    let mut problem = ApiError::new(code, detail).into_response();
    for (name, value) in response.headers() {
        if name != header::CONTENT_TYPE && name != header::CONTENT_LENGTH {
            problem.headers_mut().insert(name, value.clone());
        }
    }
    problem
}
