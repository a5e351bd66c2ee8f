//! Requests of the tus protocol: the first byte of the input says which, its lines are headers, `name: value`.

#![no_main]

use axum::body::Body;
use axum::http::{HeaderName, HeaderValue, Method, Request, StatusCode};
use heliomap_fuzz::Service;
use libfuzzer_sys::fuzz_target;
use std::sync::LazyLock;

static SERVICE: LazyLock<Service> = LazyLock::new(Service::start);

/// Begins an upload of four bytes.
fn begin(uploads: &str) -> axum::http::request::Builder {
    Request::post(uploads)
        .header("tus-resumable", "1.0.0")
        .header("upload-length", "4")
        .header("upload-metadata", "filename YS5qcGc=")
}

/// Where an answer says that an upload is.
fn location(answer: &axum::http::response::Parts) -> Option<String> {
    Some(answer.headers.get("location")?.to_str().expect("a place is text").to_owned())
}

fuzz_target!(|bytes: &[u8]| {
    let Some((kind, lines)) = bytes.split_first() else { return };
    let uploads = format!("{}/uploads", SERVICE.survey);
    let mut made = None;
    let mut request = match kind % 4 {
        0 => Request::post(&uploads),
        1 => begin(&uploads),
        other => {
            let (answer, _) = SERVICE.send(begin(&uploads).body(Body::empty()).unwrap());
            assert_eq!(answer.status, StatusCode::CREATED);
            made = location(&answer);
            let method = if other == 2 { Method::PATCH } else { Method::HEAD };
            let place = made.as_deref().expect("the upload has a place");
            Request::builder().method(method).uri(place).header("content-type", "application/offset+octet-stream")
        }
    };
    for line in lines.split(|byte| *byte == b'\n') {
        let mut parts = line.splitn(2, |byte| *byte == b':');
        let (Some(name), Some(value)) = (parts.next(), parts.next()) else { continue };
        let (Ok(name), Ok(value)) = (HeaderName::from_bytes(name), HeaderValue::from_bytes(value.trim_ascii())) else {
            continue;
        };
        request = request.header(name, value);
    }
    let (answer, _) = SERVICE.send(request.body(Body::from("abcd")).unwrap());
    for place in [made, location(&answer)].into_iter().flatten() {
        SERVICE.send(Request::delete(place).header("tus-resumable", "1.0.0").body(Body::empty()).unwrap());
    }
    SERVICE.assert_tidy();
});
