//! What a dashboard asks of a model's features: the input is the query.

#![no_main]

use axum::body::Body;
use axum::http::{Request, StatusCode, Uri};
use heliomap_fuzz::Service;
use libfuzzer_sys::fuzz_target;
use std::sync::LazyLock;

static SERVICE: LazyLock<Service> = LazyLock::new(Service::start);

fuzz_target!(|query: &str| {
    let Ok(uri) = format!("{}/models/1/modules?{query}", SERVICE.plant).parse::<Uri>() else { return };
    let (answer, body) = SERVICE.send(Request::get(uri).body(Body::empty()).unwrap());
    if answer.status == StatusCode::OK {
        let collection: serde_json::Value = serde_json::from_slice(&body).expect("an answer is JSON");
        assert!(collection["features"].as_array().is_some_and(|features| features.len() <= 20));
    }
});
