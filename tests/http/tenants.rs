//! Organisations never see each other's plants. Generated from the description of the API: every operation that there is
//! is tried, so that a new one cannot be forgotten.

use crate::app::{App, json_of, plant_path};
use heliomap::http::openapi;
use heliomap::store::Scope;
use reqwest::{Method, StatusCode};
use serde_json::{Value, json};
use std::collections::BTreeMap;

/// Whether an operation is open to everyone.
fn is_open(method: &Method, template: &str) -> bool {
    *method == Method::OPTIONS || ["/health", "/ready", "/openapi.yaml", "/openapi.json"].contains(&template)
}

const ELSEWHERE: &str = "00000000-0000-4000-8000-000000000000";

/// Method and path template of every operation.
fn operations() -> Vec<(Method, String)> {
    let description = serde_json::to_value(openapi()).unwrap();
    let mut operations = Vec::new();
    for (path, item) in description["paths"].as_object().unwrap() {
        for method in item.as_object().unwrap().keys() {
            if let Ok(method) = Method::from_bytes(method.to_ascii_uppercase().as_bytes())
                && item[method.as_str().to_ascii_lowercase()]["responses"].is_object()
            {
                operations.push((method, path.clone()));
            }
        }
    }
    assert!(operations.len() > 25, "the description lists {} operations", operations.len());
    operations
}

/// A path with its parameters filled in.
fn filled(template: &str, parameters: &BTreeMap<&str, String>) -> String {
    let filled = template.split('/').map(|part| match part.strip_prefix('{').and_then(|part| part.strip_suffix('}')) {
        None => part.to_owned(),
        Some(name) => {
            let name = name.trim_start_matches('*');
            parameters.get(name).unwrap_or_else(|| panic!("say here what {{{name}}} of {template} is")).clone()
        }
    });
    filled.collect::<Vec<_>>().join("/")
}

/// Everything that an organisation may own, and what its objects are called.
async fn world(app: &App) -> BTreeMap<&'static str, String> {
    let survey = app.complete_survey().await;
    let (_, webhook) = app.post("/api/v1/webhooks", json!({"url": "https://example.org/"})).await;
    let webhook = webhook["id"].as_str().unwrap().to_owned();
    let job = app.map(&survey).await;
    let (_, deliveries) = app.get(&format!("/api/v1/webhooks/{webhook}/deliveries")).await;
    let plant = plant_path(&survey);
    let (_, modules) = app.get(&format!("{plant}/models/latest/modules")).await;
    let (_, keys) = app.get("/api/v1/keys").await;
    let metadata = "filename Yi5qcGc=";
    let begun = app.request(Method::POST, &format!("{survey}/uploads")).header("tus-resumable", "1.0.0");
    let begun = begun.header("upload-length", 9).header("upload-metadata", metadata).send().await.unwrap();
    let upload = begun.headers()["location"].to_str().unwrap().to_owned();
    let last = |path: &str| path.rsplit('/').next().unwrap().to_owned();
    BTreeMap::from([
        ("plant", last(plant)),
        ("survey", last(&survey)),
        ("upload", last(&upload)),
        ("job", job["id"].as_str().unwrap().to_owned()),
        ("module", modules["features"][0]["id"].as_str().unwrap().to_owned()),
        ("key", keys["items"][0]["id"].as_str().unwrap().to_owned()),
        ("webhook", webhook),
        ("delivery", deliveries["items"][0]["id"].as_str().unwrap().to_owned()),
        ("version", "1".to_owned()),
        ("layer", "modules".to_owned()),
        ("name", "a.jpg".to_owned()),
        ("path", "reconstruction.json".to_owned()),
    ])
}

/// All that can be read of a world.
async fn seen(app: &App, parameters: &BTreeMap<&str, String>) -> Vec<(String, Value)> {
    let mut seen = Vec::new();
    for (method, template) in operations() {
        // A key's last use and the audit log change by looking.
        if method == Method::GET && !template.contains("keys") && template != "/api/v1/audit" {
            let path = filled(&template, parameters);
            let (status, answer) = app.get(&path).await;
            assert_eq!(status, StatusCode::OK, "{path}: {answer}");
            seen.push((path, answer));
        }
    }
    seen
}

async fn attempt(app: &App, method: &Method, path: &str) -> (StatusCode, Value) {
    let request = app.request(method.clone(), path);
    // Whatever the operation takes: who may not use it must not even hear that the body is wrong.
    let request = if *method == Method::GET { request } else { request.json(&json!({})) };
    json_of(request.send().await.unwrap()).await
}

#[tokio::test]
async fn what_another_organisation_owns_is_not_there() {
    let mut app = App::with_keys().await;
    let stranger = app.key("stranger", &[Scope::Admin, Scope::Upload, Scope::Read, Scope::Review], None).await;
    app.secret = Some(app.key("owner", &[Scope::Admin], None).await);
    let owned = world(&app).await;
    let before = seen(&app, &owned).await;
    let owner = app.secret.replace(stranger);

    let nothing: BTreeMap<&str, String> = owned
        .iter()
        .map(|(name, value)| (*name, if value.len() == 36 { ELSEWHERE.to_owned() } else { value.clone() }))
        .collect();
    for (method, template) in operations() {
        if is_open(&method, &template) {
            continue;
        }
        let path = filled(&template, &owned);
        let (status, answer) = attempt(&app, &method, &path).await;
        if template.contains('{') {
            assert_eq!(status, StatusCode::NOT_FOUND, "{method} {path}: {answer}");
            // As for what does not exist, to the letter.
            let absent = attempt(&app, &method, &filled(&template, &nothing)).await;
            let mut text = answer.to_string();
            for value in owned.values().filter(|value| value.len() == 36) {
                text = text.replace(value, ELSEWHERE);
            }
            assert_eq!((status, text), (absent.0, absent.1.to_string()), "{method} {path}");
        } else {
            let text = answer.to_string();
            for value in owned.values().filter(|value| value.len() == 36) {
                assert!(!text.contains(value), "{method} {path} tells of {value}: {text}");
            }
        }
    }
    app.secret = owner;
    assert_eq!(seen(&app, &owned).await, before, "a stranger changed something");
    println!("{} operations tried on another organisation's objects", operations().len());
}

#[tokio::test]
async fn without_a_key_only_the_open_operations_answer() {
    let mut app = App::with_keys().await;
    app.secret = Some(app.key("owner", &[Scope::Admin], None).await);
    let owned = world(&app).await;
    for secret in [None, Some("hm_0000".to_owned()), Some(String::new())] {
        app.secret = secret;
        for (method, template) in operations() {
            let (status, answer) = attempt(&app, &method, &filled(&template, &owned)).await;
            let let_in = status.is_success();
            assert_eq!(let_in, is_open(&method, &template), "{method} {template}: {answer}");
            assert!(let_in || status == StatusCode::UNAUTHORIZED, "{method} {template}: {answer}");
        }
    }
}

#[tokio::test]
async fn a_key_for_one_plant_sees_no_other_and_makes_no_keys() {
    let mut app = App::with_keys().await;
    app.secret = Some(app.key("owner", &[Scope::Admin], None).await);
    let owned = world(&app).await;
    let (_, other) = app.post("/api/v1/plants", json!({"name": "other"})).await;
    let only = serde_json::from_value(other["id"].clone()).unwrap();
    app.secret = Some(app.key("owner", &[Scope::Admin], Some(vec![only])).await);
    let (_, plants) = app.get("/api/v1/plants").await;
    assert_eq!(plants["items"], json!([other]));
    for (method, template) in operations() {
        if is_open(&method, &template) {
            continue;
        }
        if template.contains("{plant}") {
            let (status, answer) = attempt(&app, &method, &filled(&template, &owned)).await;
            assert_eq!(status, StatusCode::NOT_FOUND, "{method} {template}: {answer}");
        } else if (method, template.as_str()) != (Method::GET, "/api/v1/plants") {
            let (status, answer) = app.post(&filled(&template, &owned), json!({})).await;
            assert!(status.is_client_error() && status != StatusCode::CONFLICT, "{template}: {answer}");
        }
    }
    for path in ["/api/v1/keys", "/api/v1/audit", "/api/v1/webhooks"] {
        assert_eq!(app.get(path).await.0, StatusCode::FORBIDDEN);
    }
    let ask = json!({"name": "more", "scopes": ["admin"]});
    assert_eq!(app.post("/api/v1/keys", ask).await.0, StatusCode::FORBIDDEN);
    assert_eq!(app.post("/api/v1/plants", json!({"name": "third"})).await.0, StatusCode::FORBIDDEN);
}
