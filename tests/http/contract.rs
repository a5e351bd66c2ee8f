//! The description of the API against the reviewed copy, and real answers against the description.

use crate::app::{Act, App, plant_path};
use heliomap::http::openapi;
use reqwest::{Method, StatusCode};
use serde_json::{Value, json};

/// To accept a change: `cargo run -- openapi > openapi.yaml`.
#[test]
fn the_description_is_the_reviewed_one() {
    let reviewed = include_str!("../../openapi.yaml");
    let generated = openapi().to_yaml().unwrap();
    assert!(generated == reviewed, "run `cargo run -- openapi > openapi.yaml` and review the difference");
}

/// Validates an answer against the schema of a component.
#[track_caller]
fn validate(description: &Value, component: &str, answer: &Value) {
    let schema = json!({
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$ref": format!("#/components/schemas/{component}"),
        "components": description["components"],
    });
    let validator = jsonschema::validator_for(&schema).unwrap();
    let errors: Vec<String> =
        validator.iter_errors(answer).map(|error| format!("{}: {error}", error.instance_path())).collect();
    assert!(errors.is_empty(), "{component}: {errors:?}\n{answer}");
}

#[tokio::test]
async fn real_answers_are_as_described() {
    let description = serde_json::to_value(openapi()).unwrap();
    let app = App::new(&[Act::Map(2), Act::RefuseInput]).await;
    let survey = app.complete_survey().await;
    let done = app.map(&survey).await;
    let failed = app.map(&survey).await;
    let plant = plant_path(&survey);
    validate(&description, "JobView", &done);
    validate(&description, "JobView", &failed);
    for (path, component) in [
        ("/health".to_owned(), "Health"),
        ("/api/v1/plants".to_owned(), "List_PlantView"),
        (plant.to_owned(), "PlantView"),
        (format!("{plant}/surveys"), "List_SurveyView"),
        (survey.clone(), "SurveyDetail"),
        (format!("{survey}/jobs?limit=1"), "List_JobView"),
        (format!("{plant}/jobs"), "List_JobView"),
        (format!("{plant}/models"), "List_ModelView"),
        (format!("{plant}/models/latest"), "ModelDetail"),
        (format!("{plant}/models/1/modules?limit=1"), "FeatureCollection"),
        (format!("{plant}/models/1/lines"), "FeatureCollection"),
        (format!("{survey}/uploads"), "List_UploadView"),
        (format!("{survey}?limit=1"), "SurveyDetail"),
        ("/api/v1/plants/x".to_owned(), "Problem"),
    ] {
        let (_, answer) = app.get(&path).await;
        validate(&description, component, &answer);
    }
    let (_, modules) = app.get(&format!("{plant}/models/1/modules")).await;
    validate(&description, "GeoFeature", &modules["features"][0]);
    validate(&description, "UploadedFile", &app.put(&format!("{survey}/images/a.jpg"), crate::app::jpeg(8, 8)).await.1);
}

#[tokio::test]
async fn the_service_describes_itself() {
    let app = App::new(&[]).await;
    let (_, yaml) = app.get("/openapi.yaml").await;
    assert!(yaml.as_str().unwrap().starts_with("openapi: 3.1"));
    let (_, document) = app.get("/openapi.json").await;
    assert!(document["paths"]["/api/v1/plants"]["post"].is_object());
}

#[tokio::test]
async fn what_a_client_has_is_not_sent_again() {
    let app = App::new(&[Act::Map(2)]).await;
    let survey = app.complete_survey().await;
    app.map(&survey).await;
    let plant = plant_path(&survey);
    let mut tags = Vec::new();
    for path in [
        plant.to_owned(),
        survey.clone(),
        format!("{survey}/images"),
        format!("{plant}/models/latest/modules"),
        format!("{plant}/models/1/modules?limit=1"),
        format!("{plant}/models/1/lines"),
    ] {
        let answer = app.request(Method::GET, &path).send().await.unwrap();
        let tag = answer.headers()["etag"].clone();
        let known = format!("\"other\", {}", tag.to_str().unwrap());
        let again = app.request(Method::GET, &path).header("if-none-match", known).send().await.unwrap();
        assert_eq!((again.status(), &again.headers()["etag"]), (StatusCode::NOT_MODIFIED, &tag), "{path}");
        assert!(again.bytes().await.unwrap().is_empty());
        let other = app.request(Method::GET, &path).header("if-none-match", "\"other\"").send().await.unwrap();
        assert_eq!(other.status(), StatusCode::OK);
        tags.push(tag);
    }
    // `latest` is 1, whole and in part are two things.
    assert_eq!(tags.iter().collect::<std::collections::BTreeSet<_>>().len(), tags.len());
    app.put(&format!("{survey}/images/c.jpg"), crate::app::jpeg(8, 8)).await;
    let changed = app.request(Method::GET, &survey).header("if-none-match", tags[1].clone()).send().await.unwrap();
    assert_eq!(changed.status(), StatusCode::OK);
}
