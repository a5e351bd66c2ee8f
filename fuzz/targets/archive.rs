//! A zip or tar of a survey, sent to the service.

#![no_main]

use axum::body::Body;
use axum::http::Request;
use heliomap_fuzz::Service;
use libfuzzer_sys::fuzz_target;
use std::sync::LazyLock;
use std::sync::atomic::{AtomicUsize, Ordering};

static SENT: AtomicUsize = AtomicUsize::new(0);
static SERVICE: LazyLock<Service> = LazyLock::new(Service::start);

fuzz_target!(|bytes: &[u8]| {
    let uri = format!("{}/reconstruction", SERVICE.survey);
    SERVICE.send(Request::put(uri).body(Body::from(bytes.to_vec())).unwrap());
    SERVICE.assert_tidy();
    if SENT.fetch_add(1, Ordering::Relaxed) % 1000 == 999 {
        SERVICE.empty();
    }
});
