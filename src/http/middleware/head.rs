//! Heads of requests that two programs may read in two ways: a proxy in front takes the body to end elsewhere, or the request to
//! be for another host. They are refused, and the connection ends (RFC 9112, 3.2 and 6.1).

use crate::http::error::{ApiError, Code};
use crate::http::middleware::access::refuse;
use axum::extract::Request;
use axum::http::{HeaderMap, HeaderValue, Version, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};

/// Largest JSON body.
pub const MAX_JSON_BYTES: usize = 1 << 20;

/// Lets a request through whose head can be read in one way only.
pub async fn unambiguous(request: Request, next: Next) -> Response {
    match fault(request.version(), request.headers()) {
        None => next.run(request).await,
        Some(what) => {
            let mut response = ApiError::new(Code::BadRequest, what).into_response();
            response.headers_mut().insert(header::CONNECTION, HeaderValue::from_static("close"));
            response
        }
    }
}

fn fault(version: Version, headers: &HeaderMap) -> Option<&'static str> {
    let hosts = headers.get_all(header::HOST).iter().count();
    if hosts > 1 || (hosts == 0 && version == Version::HTTP_11) {
        return Some("a request has one header `host`");
    }
    let mut codings = headers.get_all(header::TRANSFER_ENCODING).iter();
    let is_plain = codings.all(|coding| coding.as_bytes().trim_ascii().eq_ignore_ascii_case(b"chunked"));
    if !is_plain || headers.get_all(header::TRANSFER_ENCODING).iter().count() > 1 {
        return Some("a body comes as it is or with `transfer-encoding: chunked`, in no other coding");
    }
    None
}

/// Refuses a body that says that it is larger than any document.
pub async fn small(request: Request, next: Next) -> Response {
    let length = request.headers().get(header::CONTENT_LENGTH).and_then(|value| value.to_str().ok()?.parse().ok());
    if length.is_some_and(|length: u64| length > MAX_JSON_BYTES as u64) {
        let detail = format!("a document has at most {MAX_JSON_BYTES} bytes");
        return refuse(request, ApiError::new(Code::TooLarge, detail)).await;
    }
    next.run(request).await
}
