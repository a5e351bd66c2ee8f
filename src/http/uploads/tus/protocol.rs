//! What the protocol says in headers and statuses.

use crate::http::error::{ApiError, Code};
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode};
use axum::response::{IntoResponse, Response};
use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use jiff::Timestamp;
use sha2::Digest as _;

pub(super) const VERSION: &str = "1.0.0";

pub(super) const EXTENSIONS: &str = "creation,expiration,checksum,termination,concatenation";

pub(super) const ALGORITHMS: &str = "sha1,sha256";

pub(super) const UPLOAD_EXPIRES: HeaderName = HeaderName::from_static("upload-expires");

pub(super) const UPLOAD_OFFSET: HeaderName = HeaderName::from_static("upload-offset");

/// Every answer says which protocol it is of.
pub(super) fn answer(outcome: Result<Response, ApiError>) -> Response {
    // The protocol has a status of its own for this.
    const MISMATCH: u16 = 460;
    let mismatch = matches!(&outcome, Err(problem) if problem.code == Code::ChecksumMismatch);
    let outcome = outcome.map_err(|problem| if mismatch { problem.with("status", MISMATCH) } else { problem });
    let mut response = outcome.unwrap_or_else(IntoResponse::into_response);
    if mismatch && let Ok(status) = StatusCode::from_u16(MISMATCH) {
        *response.status_mut() = status;
    }
    let headers = response.headers_mut();
    headers.insert("tus-resumable", HeaderValue::from_static(VERSION));
    if response.status() == StatusCode::PRECONDITION_FAILED {
        response.headers_mut().insert("tus-version", HeaderValue::from_static(VERSION));
    }
    response
}

pub(super) fn wrong(what: impl Into<String>) -> ApiError {
    ApiError::new(Code::BadRequest, what.into())
}

pub(super) fn text<'a>(headers: &'a HeaderMap, name: &str) -> Result<Option<&'a str>, ApiError> {
    let value = headers.get(name).map(HeaderValue::to_str).transpose();
    value.map_err(|_| wrong(format!("the header {name} holds what is no text")))
}

pub(super) fn number(headers: &HeaderMap, name: &str) -> Result<u64, ApiError> {
    let value = text(headers, name)?.ok_or_else(|| wrong(format!("the header {name} is missing")))?;
    value.parse().map_err(|_| wrong(format!("the header {name} must be a whole number, and not `{value}`")))
}

pub(super) fn require_version(headers: &HeaderMap) -> Result<(), ApiError> {
    match text(headers, "tus-resumable")? {
        Some(VERSION) => Ok(()),
        _ => Err(ApiError::new(Code::TusVersion, "send the header `Tus-Resumable: 1.0.0`")),
    }
}

/// The time of an upload's end, as the protocol writes it.
pub(super) fn http_date(time: Timestamp) -> String {
    time.strftime("%a, %d %b %Y %H:%M:%S GMT").to_string()
}

/// The digest that the bytes of a request must have.
pub(super) struct Checksum {
    expected: Vec<u8>,
    hasher: Hasher,
}

enum Hasher {
    Sha1(Box<sha1::Sha1>),
    Sha256(Box<sha2::Sha256>),
}

impl Checksum {
    pub(super) fn parse(header: &str) -> Result<Self, ApiError> {
        let (algorithm, digest) = header.split_once(' ').unwrap_or((header, ""));
        let (hasher, length) = match algorithm {
            "sha1" => (Hasher::Sha1(Box::default()), 20),
            "sha256" => (Hasher::Sha256(Box::default()), 32),
            _ => return Err(wrong(format!("Upload-Checksum must be of one of {ALGORITHMS}"))),
        };
        let expected = BASE64_STANDARD.decode(digest.trim()).ok().filter(|digest| digest.len() == length);
        let expected = expected.ok_or_else(|| wrong("Upload-Checksum must hold the digest in base64"))?;
        Ok(Self { expected, hasher })
    }

    pub(super) fn update(&mut self, bytes: &[u8]) {
        match &mut self.hasher {
            Hasher::Sha1(hasher) => hasher.update(bytes),
            Hasher::Sha256(hasher) => hasher.update(bytes),
        }
    }

    pub(super) fn mismatch(self) -> Option<ApiError> {
        let digest = match self.hasher {
            Hasher::Sha1(hasher) => hasher.finalize().to_vec(),
            Hasher::Sha256(hasher) => hasher.finalize().to_vec(),
        };
        let what = "the bytes came changed, and nothing of them counts; send them again";
        (digest != self.expected).then(|| ApiError::new(Code::ChecksumMismatch, what))
    }
}
