//! The same request under the same key is done once and answered the same.

use crate::app::{Act, App, assert_problem, jpeg, json_of, plant_path};
use heliomap::store::Scope;
use reqwest::multipart::{Form, Part};
use reqwest::{Method, RequestBuilder, StatusCode};
use serde_json::{Value, json};

async fn sent(request: RequestBuilder) -> (StatusCode, bool, Value) {
    let answer = request.send().await.unwrap();
    let replayed = answer.headers().get("idempotency-replayed").is_some_and(|value| value == "true");
    let (status, value) = json_of(answer).await;
    (status, replayed, value)
}

fn create(app: &App, key: &str, name: &str) -> RequestBuilder {
    app.request(Method::POST, "/api/v1/plants").header("idempotency-key", key).json(&json!({"name": name}))
}

#[tokio::test]
async fn the_same_request_is_done_once() {
    let app = App::new(&[]).await;
    let first = sent(create(&app, "one", "Sunfield")).await;
    assert_eq!((first.0, first.1), (StatusCode::CREATED, false));
    // Without the key the answer would be 200 now.
    assert_eq!(sent(create(&app, "one", "Sunfield")).await, (StatusCode::CREATED, true, first.2.clone()));
    assert_eq!(sent(create(&app, "\"one\"", "Sunfield")).await.2, first.2);
    assert_eq!(sent(create(&app, "two", "Sunfield")).await.0, StatusCode::OK);
    let other = sent(create(&app, "one", "Hill")).await;
    assert_problem((other.0, other.2), 422, "idempotency_key_reused", "one of its own");
    assert_eq!(app.get("/api/v1/plants").await.1["items"].as_array().unwrap().len(), 1);
    for key in ["", "ä", &"x".repeat(256)] {
        let request = app.request(Method::POST, "/api/v1/plants").json(&json!({"name": "x"}));
        let answer = request.header("idempotency-key", key.as_bytes()).send().await.unwrap();
        assert_problem(json_of(answer).await, 400, "bad_request", "idempotency-key");
    }
}

#[tokio::test]
async fn what_was_refused_may_be_sent_again() {
    let app = App::new(&[]).await;
    let survey = app.survey().await;
    let start = || app.request(Method::POST, &format!("{survey}/jobs")).header("idempotency-key", "job");
    let refused = sent(start()).await;
    assert_problem((refused.0, refused.2), 409, "survey_incomplete", "");
    app.fill(&survey).await;
    let mut begun = sent(start()).await;
    // The key comes back a moment after the refusal.
    while begun.2["code"] == "idempotency_busy" {
        begun = sent(start()).await;
    }
    assert_eq!((begun.0, begun.1), (StatusCode::ACCEPTED, false), "{}", begun.2);
    assert_eq!(sent(start()).await, (StatusCode::ACCEPTED, true, begun.2));
    let jobs = app.get(&format!("{}/jobs", plant_path(&survey))).await.1;
    assert_eq!(jobs["items"].as_array().unwrap().len(), 1);
}

#[tokio::test]
async fn uploads_too_whatever_parts_the_form() {
    let app = App::new(&[]).await;
    let survey = app.survey().await;
    let put = |photo: Vec<u8>| {
        app.request(Method::PUT, &format!("{survey}/images/a.jpg")).header("idempotency-key", "put").body(photo)
    };
    let first = sent(put(jpeg(32, 24))).await;
    assert_eq!((first.0, first.1), (StatusCode::CREATED, false));
    assert_eq!(sent(put(jpeg(32, 24))).await, (StatusCode::CREATED, true, first.2));
    let other = sent(put(jpeg(24, 24))).await;
    assert_problem((other.0, other.2), 422, "idempotency_key_reused", "");
    // A form's boundary is another each time.
    let form = |photo: Vec<u8>| {
        let form = Form::new().part("file", Part::bytes(photo).file_name("b.jpg"));
        app.request(Method::POST, &format!("{survey}/images")).header("idempotency-key", "form").multipart(form)
    };
    let first = sent(form(jpeg(40, 30))).await;
    assert_eq!(first.2["files"][0]["result"], "created");
    assert_eq!(sent(form(jpeg(40, 30))).await, (StatusCode::OK, true, first.2));
    assert_eq!(sent(form(jpeg(40, 31))).await.0, StatusCode::UNPROCESSABLE_ENTITY);
    // An upload that is begun again is the same one.
    let begin = || {
        let request = app.request(Method::POST, &format!("{survey}/uploads")).header("tus-resumable", "1.0.0");
        request
            .header("upload-length", 9)
            .header("upload-metadata", "filename Yi5qcGc=")
            .header("idempotency-key", "tus")
    };
    let place = async || begin().send().await.unwrap().headers()["location"].clone();
    assert_eq!(place().await, place().await);
}

#[tokio::test]
async fn each_organisation_has_keys_of_its_own_and_secrets_are_not_kept() {
    let mut app = App::with_keys().await;
    app.secret = Some(app.key("a", &[Scope::Admin], None).await);
    let of_a = sent(create(&app, "one", "Sunfield")).await;
    let ask = app.request(Method::POST, "/api/v1/keys").header("idempotency-key", "key");
    let refused = sent(ask.json(&json!({"name": "x", "scopes": ["read"]}))).await;
    assert_problem((refused.0, refused.2), 400, "bad_request", "secret");
    app.secret = Some(app.key("b", &[Scope::Admin], None).await);
    let of_b = sent(create(&app, "one", "Sunfield")).await;
    assert_eq!((of_b.0, of_b.1), (StatusCode::CREATED, false));
    assert_ne!(of_a.2["id"], of_b.2["id"]);
}

#[tokio::test]
async fn a_job_is_started_once_though_the_answer_was_lost_with_the_service() {
    let app = App::new(&[Act::Map(1)]).await;
    let survey = app.complete_survey().await;
    let start = async |key: &str| {
        let request = app.request(Method::POST, &format!("{survey}/jobs")).header("idempotency-key", key);
        json_of(request.send().await.unwrap()).await
    };
    let (status, job) = start("once").await;
    assert_eq!(status, StatusCode::ACCEPTED, "{job}");
    app.follow(&job).await;
    // As where it was killed before the answer was kept: the key is free again, and the job has ended.
    let file = app.folder.path().join("heliomap.db");
    let rows = sqlx::SqlitePool::connect(&format!("sqlite:{}", file.display())).await.unwrap();
    sqlx::query("DELETE FROM requests").execute(&rows).await.unwrap();
    let (status, again) = start("once").await;
    assert_eq!((status, &again["id"], &again["state"]), (StatusCode::ACCEPTED, &job["id"], &json!("succeeded")));
    assert_eq!(app.get(&format!("{survey}/jobs")).await.1["items"].as_array().unwrap().len(), 1);
    let (_, other) = start("twice").await;
    assert_ne!(other["id"], job["id"]);
}
