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

/// A response where it is described: in place, or among the shared ones.
fn resolved<'a>(description: &'a Value, response: &'a Value) -> &'a Value {
    match response["$ref"].as_str() {
        Some(reference) => description.pointer(&reference[1..]).unwrap_or_else(|| panic!("{reference}")),
        None => response,
    }
}

/// Whether a path is one of a template's.
fn matches(template: &str, path: &str) -> bool {
    let pairs = template.split('/').zip(path.split('/'));
    template.split('/').count() == path.split('/').count()
        && pairs
            .into_iter()
            .all(|(wanted, found)| wanted == found || (wanted.starts_with('{') && !found.starts_with('{')))
}

#[test]
fn shared_responses_are_used_more_than_once() {
    let text = serde_json::to_string(&openapi()).unwrap();
    let description = serde_json::to_value(openapi()).unwrap();
    let shared = description["components"]["responses"].as_object().unwrap();
    assert!(shared.len() > 10);
    for name in shared.keys() {
        assert!(text.matches(&format!("#/components/responses/{name}\"")).count() > 1, "{name}");
    }
}

#[test]
fn operations_list_problems_by_status() {
    let description = serde_json::to_value(openapi()).unwrap();
    for (path, operations) in description["paths"].as_object().unwrap() {
        for (method, operation) in operations.as_object().unwrap().iter().filter(|(method, _)| *method != "options") {
            let responses = operation["responses"].as_object().unwrap();
            assert!(responses.keys().all(|status| status.parse::<u16>().is_ok()), "{method} {path}");
            let text = resolved(&description, &responses["500"])["description"].as_str().unwrap();
            assert!(text.contains("`internal_error`"), "{method} {path}: {text}");
            if let Some(limited) = responses.get("429") {
                assert!(resolved(&description, limited)["headers"]["retry-after"].is_object(), "{method} {path}");
            }
        }
    }
}

#[test]
fn every_answer_has_an_example_that_is_as_described() {
    let description = serde_json::to_value(openapi()).unwrap();
    let mut problems = std::collections::BTreeSet::new();
    for (path, operations) in description["paths"].as_object().unwrap() {
        for (method, operation) in operations.as_object().unwrap().iter().filter(|(method, _)| *method != "options") {
            for (status, response) in operation["responses"].as_object().unwrap() {
                let response = resolved(&description, response);
                for (media_type, content) in response["content"].as_object().into_iter().flatten() {
                    let about = format!("{method} {path} {status}");
                    let component = content["schema"]["$ref"].as_str().and_then(|schema| schema.rsplit('/').next());
                    match (media_type.as_str(), component) {
                        ("application/json" | "application/geo+json", Some(component)) => {
                            assert!(content["example"].is_object(), "{about}");
                            if let Some(next) = content["example"]["next"].as_str() {
                                assert!(matches(path, next.split('?').next().unwrap()), "{about}: {next}");
                            }
                            validate(&description, component, &content["example"]);
                        }
                        ("application/problem+json", Some(component)) => {
                            let named = content["examples"].as_object().unwrap_or_else(|| panic!("{about}"));
                            for (code, example) in named {
                                let example = match example["$ref"].as_str() {
                                    Some(reference) => &description.pointer(&reference[1..]).unwrap()["value"],
                                    None => &example["value"],
                                };
                                assert_eq!(
                                    (&example["code"], &example["status"].to_string()),
                                    (&json!(code), status),
                                    "{about}"
                                );
                                validate(&description, component, example);
                                problems.insert(code.clone());
                            }
                        }
                        _ => {}
                    }
                }
            }
        }
    }
    let unheard: Vec<_> = description["components"]["examples"].as_object().unwrap().keys().collect();
    let unheard: Vec<_> = unheard.into_iter().filter(|code| !problems.contains(*code)).collect();
    assert!(unheard.is_empty(), "no operation names {unheard:?}");
}

#[tokio::test]
async fn real_problems_are_as_described() {
    let description = serde_json::to_value(openapi()).unwrap();
    let app = App::new(&[Act::Map(2)]).await;
    let survey = app.complete_survey().await;
    let job = app.map(&survey).await;
    let plant = plant_path(&survey).to_owned();
    let job = format!("{plant}/jobs/{}", job["id"].as_str().unwrap());
    let nowhere = format!("{plant}/surveys/{}", uuid::Uuid::nil());
    let (plants, one, surveys) =
        ("/api/v1/plants", "/api/v1/plants/{plant}", "/api/v1/plants/{plant}/surveys/{survey}");
    let of = |path: &str, rest: &str| format!("{path}{rest}");
    for (method, template, path, body, code) in [
        ("get", of(plants, ""), format!("{plants}?limit=0"), "", "invalid_query"),
        ("post", of(plants, ""), plants.to_owned(), "{", "invalid_json"),
        ("post", of(plants, ""), plants.to_owned(), "{\"name\": \"\"}", "invalid_name"),
        ("get", of(one, ""), format!("{plants}/{}", uuid::Uuid::nil()), "", "plant_not_found"),
        ("get", of(surveys, ""), nowhere.clone(), "", "survey_not_found"),
        ("post", of(surveys, "/jobs"), format!("{nowhere}/jobs"), "{}", "survey_not_found"),
        ("post", of(one, "/jobs/{job}/cancel"), format!("{job}/cancel"), "", "job_finished"),
        ("put", of(surveys, "/images/{name}"), format!("{survey}/images/x.jpg"), "no photo", "image_unreadable"),
        ("put", of(surveys, "/images/{name}"), format!("{survey}/images/x.exe"), "x", "invalid_name"),
        ("put", of(surveys, "/reconstruction"), format!("{survey}/reconstruction"), "x", "unsupported_archive"),
        ("post", of(surveys, "/reconstruction"), format!("{survey}/reconstruction"), "x", "unsupported_archive"),
        ("put", of(surveys, "/reconstruction/{path}"), format!("{survey}/reconstruction/x"), "x", "unknown_file"),
        ("post", of(surveys, "/uploads"), format!("{survey}/uploads"), "", "tus_version"),
        ("get", of(one, "/models/{version}/{layer}"), format!("{plant}/models/9/modules"), "", "model_not_found"),
        ("get", of(one, "/modules/{module}"), format!("{plant}/modules/{}", uuid::Uuid::nil()), "", "module_not_found"),
        ("get", of(one, "/modules/{module}"), format!("{plant}/modules/x"), "", "not_found"),
    ] {
        let request = app.request(Method::from_bytes(method.to_uppercase().as_bytes()).unwrap(), &path);
        let request = request.header("content-type", "application/json").body(body);
        let (status, problem) = crate::app::json_of(request.send().await.unwrap()).await;
        assert_eq!(problem["code"], code, "{method} {path}: {problem}");
        validate(&description, "Problem", &problem);
        let responses = &description["paths"][&template][method]["responses"];
        let text = &resolved(&description, &responses[status.as_str()])["description"];
        assert!(text.as_str().is_some_and(|text| text.contains(&format!("`{code}`"))), "{method} {template}: {text}");
    }
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
