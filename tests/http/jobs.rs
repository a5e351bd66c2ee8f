use crate::app::{Act, App, assert_problem, job_path, plant_path};
use reqwest::StatusCode;
use serde_json::json;
use std::time::Duration;

#[tokio::test]
async fn from_upload_to_model() {
    let app = App::new(&[Act::Map(3)]).await;
    let survey = app.complete_survey().await;
    let job = app.map(&survey).await;
    assert_eq!((&job["state"], &job["model_version"], &job["attempt"]), (&json!("succeeded"), &json!(1), &json!(1)));
    assert_eq!(job["warnings"][0]["code"], "high_image");
    assert_eq!((&job["progress"]["stage"], &job["progress"]["done"]), (&json!("detect"), &json!(1)));
    assert_eq!(
        app.mapper.seen.lock().unwrap()[0],
        ["images/a.jpg", "images/b.jpg", "reconstruction.json", "reference_lla.json"]
    );
    let (status, model) = app.get(job["model"].as_str().unwrap()).await;
    assert_eq!((status, &model["layers"][0]["features"]), (StatusCode::OK, &json!(3)));
    assert_eq!(std::fs::read_dir(app.folder.path().join("incoming")).unwrap().count(), 0);
}

#[tokio::test]
async fn a_survey_is_never_mapped_twice_at_once() {
    let app = App::new(&[Act::Wait]).await;
    let survey = app.complete_survey().await;
    let (first, job) = app.post(&format!("{survey}/jobs"), json!({"rows_per_bench": 2})).await;
    let (second, again) = app.post(&format!("{survey}/jobs"), json!({})).await;
    assert_eq!((first, second, &job["id"]), (StatusCode::ACCEPTED, StatusCode::OK, &again["id"]));
    assert_eq!(again["options"]["rows_per_bench"], 2);
}

#[tokio::test]
async fn a_running_job_is_cancelled() {
    let app = App::new(&[Act::Wait, Act::Map(1)]).await;
    let survey = app.complete_survey().await;
    let (_, job) = app.post(&format!("{survey}/jobs"), json!({})).await;
    app.follow_until(&job, |job| job["state"] == "running").await;
    for _ in 0..2 {
        let (status, _) = app.post(&format!("{}/cancel", job_path(&job)), json!(null)).await;
        assert_eq!(status, StatusCode::ACCEPTED);
    }
    assert_eq!(app.follow(&job).await["state"], "cancelled");
    assert_problem(app.get(&format!("{}/models/latest", plant_path(&survey))).await, 404, "model_not_found", "");
    let next = app.map(&survey).await;
    assert_eq!(next["state"], "succeeded");
    assert_problem(
        app.post(&format!("{}/cancel", job_path(&next)), json!(null)).await,
        409,
        "job_finished",
        "succeeded",
    );
    let (_, jobs) = app.get(&format!("{survey}/jobs")).await;
    let states: Vec<_> = jobs["items"].as_array().unwrap().iter().map(|job| job["state"].as_str().unwrap()).collect();
    assert_eq!(states, ["succeeded", "cancelled"]);
}

#[tokio::test]
async fn a_queued_job_is_cancelled_at_once() {
    let app = App::new(&[]).await;
    let survey = app.complete_survey().await;
    let (_, job) = app.post(&format!("{survey}/jobs"), json!({})).await;
    let (_, cancelled) = app.post(&format!("{}/cancel", job_path(&job)), json!(null)).await;
    assert_eq!((&job["state"], &cancelled["state"]), (&json!("queued"), &json!("cancelled")));
}

#[tokio::test]
async fn bad_input_is_not_tried_again() {
    let app = App::new(&[Act::RefuseInput]).await;
    let survey = app.complete_survey().await;
    let job = app.map(&survey).await;
    assert_eq!((&job["state"], &job["attempt"]), (&json!("failed"), &json!(1)));
    assert_eq!(job["error"], json!({"code": "no_modules", "message": "no photo shows a module; fly higher"}));
}

#[tokio::test]
async fn what_may_pass_is_tried_again() {
    let app = App::new(&[Act::FailEnvironment, Act::FailEnvironment, Act::Map(1)]).await;
    let survey = app.complete_survey().await;
    let job = app.map(&survey).await;
    assert_eq!((&job["state"], &job["attempt"], &job["error"]), (&json!("succeeded"), &json!(3), &json!(null)));

    let app = App::new(&[Act::FailEnvironment]).await;
    let survey = app.complete_survey().await;
    let job = app.map(&survey).await;
    assert_eq!((&job["state"], &job["attempt"]), (&json!("failed"), &json!(3)));
    assert_eq!(job["error"]["code"], "environment");
}

#[tokio::test]
async fn a_mapper_that_panics_fails_its_job_and_no_other() {
    let app = App::new(&[Act::Panic, Act::Map(1)]).await;
    let survey = app.complete_survey().await;
    let job = app.map(&survey).await;
    assert_eq!((&job["state"], &job["error"]["code"]), (&json!("failed"), &json!("internal_error")));
    assert_eq!(app.map(&survey).await["state"], "succeeded");
}

#[tokio::test]
async fn a_job_whose_plant_is_deleted_ends() {
    let app = App::new(&[Act::Wait, Act::Map(1)]).await;
    let survey = app.complete_survey().await;
    let (_, job) = app.post(&format!("{survey}/jobs"), json!({})).await;
    app.follow_until(&job, |job| job["state"] == "running").await;
    app.request(reqwest::Method::DELETE, plant_path(&survey)).send().await.unwrap();
    assert_problem(app.get(&job_path(&job)).await, 404, "plant_not_found", "");
    let other = app.complete_survey().await;
    assert_eq!(app.map(&other).await["state"], "succeeded");
    tokio::time::sleep(Duration::from_millis(20)).await;
    assert_eq!(std::fs::read_dir(app.folder.path().join("blobs/plants")).unwrap().count(), 1);
}

#[tokio::test]
async fn options_are_checked() {
    let app = App::new(&[]).await;
    let survey = app.complete_survey().await;
    let jobs = format!("{survey}/jobs");
    assert_problem(app.post(&jobs, json!({"rows": 2})).await, 422, "invalid_fields", "rows");
    assert_problem(app.post(&jobs, json!({"rows_per_bench": 0})).await, 422, "invalid_fields", "rows_per_bench");
    assert_problem(app.post(&jobs, json!({"spacing_m": [1.0]})).await, 422, "invalid_fields", "");
    assert_problem(app.post(&jobs, json!({"max_gsd_m_per_px": -1})).await, 422, "invalid_fields", "max_gsd_m_per_px");
    let empty = app.request(reqwest::Method::POST, &jobs).send().await.unwrap();
    assert_eq!(empty.status(), StatusCode::ACCEPTED);
    assert!(empty.headers()["location"].to_str().unwrap().contains("/jobs/"));
}
