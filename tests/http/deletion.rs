//! What was uploaded or named by mistake is deleted or renamed; what was made from it stays and says so.

use crate::app::{Act, App, assert_problem, job_path, jpeg, json_of, plant_path};
use reqwest::{Method, StatusCode};
use serde_json::{Value, json};

async fn delete(app: &App, path: &str, tag: Option<&str>) -> (StatusCode, Value) {
    let request = app.request(Method::DELETE, path);
    let request = tag.into_iter().fold(request, |request, tag| request.header("if-match", tag));
    json_of(request.send().await.unwrap()).await
}

async fn rename(app: &App, path: &str, name: &str, tag: Option<&str>) -> (StatusCode, Value) {
    let request = app.request(Method::PATCH, path).json(&json!({"name": name}));
    let request = tag.into_iter().fold(request, |request, tag| request.header("if-match", tag));
    json_of(request.send().await.unwrap()).await
}

async fn tag(app: &App, path: &str) -> String {
    let answer = app.request(Method::GET, path).send().await.unwrap();
    answer.headers()["etag"].to_str().unwrap().to_owned()
}

async fn warnings(app: &App, survey: &str) -> Vec<(String, String)> {
    let (_, model) = app.get(&format!("{}/models/latest", plant_path(survey))).await;
    let text = |warning: &Value, member: &str| warning[member].as_str().unwrap().to_owned();
    let warnings = model["warnings"].as_array().unwrap();
    warnings.iter().map(|warning| (text(warning, "code"), text(warning, "message"))).collect()
}

#[tokio::test]
async fn a_photo_is_deleted_and_the_model_made_from_it_says_so() {
    let app = App::new(&[Act::Map(2)]).await;
    let survey = app.complete_survey().await;
    app.map(&survey).await;
    let photo = format!("{survey}/images/a.jpg");
    assert_problem(delete(&app, &photo, Some("\"00\"")).await, 412, "precondition_failed", "decide anew");
    let digest = app.get(&survey).await.1["files"][0]["sha256"].as_str().unwrap().to_owned();
    assert_eq!(delete(&app, &photo, Some(&format!("\"{digest}\""))).await.0, StatusCode::NO_CONTENT);
    assert_problem(delete(&app, &photo, None).await, 404, "file_not_found", "no such file");
    assert_problem(delete(&app, &format!("{survey}/images/a%3Ab.exe"), None).await, 404, "file_not_found", "");
    let (_, told) = app.get(&survey).await;
    assert_eq!((&told["complete"], told["files"].as_array().unwrap().len()), (&json!(false), 3));
    assert_eq!(told["images"]["not_uploaded"], json!(["a.jpg"]));
    assert_eq!(delete(&app, &format!("{survey}/reconstruction/reference_lla.json"), None).await.0.as_u16(), 204);
    let found = warnings(&app, &survey).await;
    let deleted: Vec<&str> =
        found.iter().filter(|(code, _)| code == "source_deleted").map(|(_, message)| message.as_str()).collect();
    assert_eq!(deleted, ["files that it was made from were deleted since: a.jpg, reference_lla.json"]);
    // It may come again.
    assert_eq!(app.put(&photo, jpeg(32, 24)).await.0, StatusCode::CREATED);
}

#[tokio::test]
async fn a_survey_goes_with_its_files_and_jobs_and_its_model_stays() {
    let app = App::new(&[Act::Map(2), Act::Wait]).await;
    let survey = app.complete_survey().await;
    app.map(&survey).await;
    let begun = app.request(Method::POST, &format!("{survey}/uploads")).header("tus-resumable", "1.0.0");
    let begun = begun.header("upload-length", 9).header("upload-metadata", "filename Yi5qcGc=").send().await.unwrap();
    assert_eq!(begun.status(), StatusCode::CREATED);
    let (_, job) = app.post(&format!("{survey}/jobs"), json!({})).await;
    app.follow_until(&job, |job| job["state"] == "running").await;
    assert_problem(delete(&app, &survey, Some("W/\"other\"")).await, 412, "precondition_failed", "");
    let tag = tag(&app, &survey).await;
    assert_eq!(delete(&app, &survey, Some(&tag)).await.0, StatusCode::NO_CONTENT);
    assert_problem(app.get(&survey).await, 404, "survey_not_found", "");
    assert_problem(delete(&app, &survey, None).await, 404, "survey_not_found", "");
    assert_problem(app.get(&job_path(&job)).await, 404, "job_not_found", "");
    assert_eq!(std::fs::read_dir(app.folder.path().join("uploads")).unwrap().count(), 0);
    let found = warnings(&app, &survey).await;
    assert!(found.iter().any(|(code, message)| code == "source_deleted" && message.contains("survey")), "{found:?}");
    let plant = plant_path(&survey);
    let (status, modules) = app.get(&format!("{plant}/models/latest/modules")).await;
    assert_eq!((status, modules["features"].as_array().unwrap().len()), (StatusCode::OK, 2));
    // Its bytes are no longer needed by anything: they go once they are old enough.
    let unused = app.store.blobs(None, 100).await.unwrap();
    assert_eq!(unused.len(), 1, "the model's alone: {unused:?}");
    // The name is free again, for another survey.
    let (status, again) = app.post(&format!("{plant}/surveys"), json!({"name": "June"})).await;
    assert_eq!(status, StatusCode::CREATED, "{again}");
}

#[tokio::test]
async fn plants_and_surveys_are_renamed() {
    let app = App::new(&[]).await;
    let survey = app.survey().await;
    let plant = plant_path(&survey);
    for path in [plant, &survey] {
        let before = tag(&app, path).await;
        let (status, renamed) = rename(&app, path, " Ho\u{308}he ", Some(&before)).await;
        assert_eq!((status, &renamed["name"]), (StatusCode::OK, &json!("H\u{f6}he")), "{renamed}");
        assert_eq!(app.get(path).await.1["name"], "H\u{f6}he");
        assert_problem(rename(&app, path, "late", Some(&before)).await, 412, "precondition_failed", "");
        assert_problem(rename(&app, path, "", None).await, 422, "invalid_name", "1 to 200");
    }
    app.post("/api/v1/plants", json!({"name": "Other"})).await;
    assert_problem(rename(&app, plant, "Other", None).await, 409, "name_taken", "another name");
    app.post(&format!("{plant}/surveys"), json!({"name": "Other"})).await;
    assert_problem(rename(&app, &survey, "Other", None).await, 409, "name_taken", "another name");
    // A name that is taken leaves the store as it was.
    assert_eq!(rename(&app, plant, "North", None).await.0, StatusCode::OK);
    let nowhere = format!("{plant}/surveys/00000000-0000-4000-8000-000000000000");
    assert_problem(rename(&app, &nowhere, "x", None).await, 404, "survey_not_found", "");
}
