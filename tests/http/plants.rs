use crate::app::{App, assert_problem, json_of};
use reqwest::{Method, StatusCode};
use serde_json::json;

#[tokio::test]
async fn creating_the_same_plant_again_finds_it() {
    let app = App::new(&[]).await;
    let (status, first) = app.post("/api/v1/plants", json!({"name": " Sunfield "})).await;
    assert_eq!((status, &first["name"]), (StatusCode::CREATED, &json!("Sunfield")));
    let (status, again) = app.post("/api/v1/plants", json!({"name": "Sunfield"})).await;
    assert_eq!((status, &again), (StatusCode::OK, &first));
    let path = format!("/api/v1/plants/{}", first["id"].as_str().unwrap());
    assert_eq!(app.get(&path).await.1, first);
    let surveys = format!("{path}/surveys");
    let (created, survey) = app.post(&surveys, json!({"name": "June"})).await;
    let (found, again) = app.post(&surveys, json!({"name": "June"})).await;
    assert_eq!((created, found, &survey), (StatusCode::CREATED, StatusCode::OK, &again));
}

#[tokio::test]
async fn lists_come_in_parts() {
    let app = App::new(&[]).await;
    for name in ["A", "B", "C"] {
        app.post("/api/v1/plants", json!({"name": name})).await;
    }
    let mut next = Some("/api/v1/plants?limit=2".to_owned());
    let mut names = Vec::new();
    let mut parts = 0;
    while let Some(path) = next {
        let (_, list) = app.get(&path).await;
        names.extend(list["items"].as_array().unwrap().iter().map(|plant| plant["name"].as_str().unwrap().to_owned()));
        next = list["next"].as_str().map(str::to_owned);
        parts += 1;
    }
    assert_eq!((names, parts), (vec!["A".to_owned(), "B".to_owned(), "C".to_owned()], 2));
    assert_problem(app.get("/api/v1/plants?limit=0").await, 400, "invalid_query", "limit");
    assert_problem(app.get("/api/v1/plants?cursor=x").await, 400, "invalid_query", "cursor");
    assert_problem(app.get("/api/v1/plants?lmit=1").await, 400, "invalid_query", "lmit");
}

#[tokio::test]
async fn deleting_a_plant_deletes_everything_of_it() {
    let app = App::new(&[crate::app::Act::Map(2)]).await;
    let survey = app.complete_survey().await;
    app.map(&survey).await;
    let plant = crate::app::plant_path(&survey);
    let blobs = app.folder.path().join("blobs/plants");
    assert_eq!(std::fs::read_dir(&blobs).unwrap().count(), 1);
    let delete = async || json_of(app.request(Method::DELETE, plant).send().await.unwrap()).await;
    assert_eq!(delete().await.0, StatusCode::NO_CONTENT);
    assert_problem(delete().await, 404, "plant_not_found", "");
    assert_eq!(std::fs::read_dir(&blobs).unwrap().count(), 0);
    assert_problem(app.get(plant).await, 404, "plant_not_found", "");
    assert_problem(app.get(&survey).await, 404, "plant_not_found", "");
    assert_problem(app.get(&format!("{plant}/models/latest/modules")).await, 404, "plant_not_found", "");
    assert_problem(
        app.put(&format!("{survey}/images/a.jpg"), crate::app::jpeg(8, 8)).await,
        404,
        "plant_not_found",
        "",
    );
    assert_eq!(std::fs::read_dir(&blobs).unwrap().count(), 0);
}

#[tokio::test]
async fn every_wrong_request_is_a_problem() {
    let app = App::new(&[]).await;
    let plant = app.plant().await;
    assert_problem(app.get("/api/v1/nothing").await, 404, "not_found", "/api/v1/nothing");
    assert_problem(app.get("/api/v1/plants/x").await, 404, "not_found", "UUID");
    let missing = "/api/v1/plants/00000000-0000-4000-8000-000000000000";
    assert_problem(app.get(missing).await, 404, "plant_not_found", "00000000");
    assert_problem(app.get(&format!("{plant}/surveys/{}", &missing[15..])).await, 404, "survey_not_found", "00000000");
    assert_problem(app.get(&format!("{plant}/jobs/{}", &missing[15..])).await, 404, "job_not_found", "00000000");
    assert_problem(app.get(&format!("{plant}/models/latest")).await, 404, "model_not_found", "map");

    let patch = app.request(Method::PATCH, "/api/v1/plants").send().await.unwrap();
    assert_eq!(patch.headers()["allow"], "POST,GET,HEAD");
    assert_problem(json_of(patch).await, 405, "method_not_allowed", "allow");
    let form = app.request(Method::POST, "/api/v1/plants").body("{}").send().await.unwrap();
    assert_problem(json_of(form).await, 415, "unsupported_media_type", "application/json");
    let broken = app.request(Method::POST, "/api/v1/plants").header("content-type", "application/json").body("{");
    assert_problem(json_of(broken.send().await.unwrap()).await, 400, "invalid_json", "");
    assert_problem(app.post("/api/v1/plants", json!({"nam": "x"})).await, 422, "invalid_fields", "nam");
    assert_problem(app.post("/api/v1/plants", json!(["x"])).await, 422, "invalid_fields", "an object");
    assert_problem(app.post("/api/v1/plants", json!({"name": ""})).await, 422, "invalid_name", "1 to 200");
    let turned = json!({"name": "Sunfield\u{202e}htroN"});
    assert_problem(app.post("/api/v1/plants", turned).await, 422, "invalid_name", "steer how text is shown");
    let large = json!({"name": "x".repeat(2 << 20)});
    assert_problem(app.post("/api/v1/plants", large).await, 413, "too_large", "");
}

#[tokio::test]
async fn the_service_tells_how_it_is() {
    let app = App::new(&[]).await;
    for path in ["/health", "/ready"] {
        let response = app.request(Method::GET, path).header("x-request-id", "abc-1").send().await.unwrap();
        assert_eq!(response.headers()["x-request-id"], "abc-1");
        let (status, health) = json_of(response).await;
        assert_eq!((status, &health["status"]), (StatusCode::OK, &json!("ok")));
    }
    let odd = app.request(Method::GET, "/health").header("x-request-id", "a b").send().await.unwrap();
    assert_ne!(odd.headers()["x-request-id"], "a b");
    let (status, page) = app.get("/").await;
    assert_eq!(status, StatusCode::OK);
    assert!(page.as_str().unwrap().contains("heliomap"));
    let page = app.request(Method::GET, "/").send().await.unwrap();
    let policy = page.headers()["content-security-policy"].to_str().unwrap();
    assert!(policy.contains("default-src 'none'") && policy.contains("frame-ancestors 'none'"), "{policy}");
    assert_eq!(
        (&page.headers()["x-frame-options"], &page.headers()["x-content-type-options"]),
        (&"DENY".parse().unwrap(), &"nosniff".parse().unwrap())
    );
    std::fs::remove_dir_all(app.folder.path().join("blobs")).unwrap();
    assert_problem(app.get("/ready").await, 503, "unavailable", "storage");
}

/// Waits until `/ready` answers with this status.
async fn ready_as(app: &App, wanted: StatusCode) -> serde_json::Value {
    for _ in 0..600 {
        let (status, answer) = app.get("/ready").await;
        if status == wanted {
            return answer;
        }
        tokio::time::sleep(std::time::Duration::from_millis(50)).await;
    }
    panic!("`/ready` does not answer {wanted}: {:?}", app.get("/ready").await);
}

#[tokio::test]
async fn a_full_disk_is_said_by_ready_and_all_works_again_once_there_is_room() {
    let app = App::with_pages(60).await;
    assert_eq!(app.get("/ready").await.0, StatusCode::OK);
    let plant = app.plant().await;
    let surveys = format!("{plant}/surveys");
    for index in 0.. {
        let (status, answer) = app.post(&surveys, json!({"name": format!("{index} {}", "long".repeat(45))})).await;
        if status != StatusCode::CREATED {
            assert_problem((status, answer), 507, "storage_full", "make room");
            break;
        }
    }
    let problem = ready_as(&app, StatusCode::SERVICE_UNAVAILABLE).await;
    assert_problem((StatusCode::SERVICE_UNAVAILABLE, problem), 503, "unavailable", "the database cannot be written");
    assert_eq!(app.get(&plant).await.0, StatusCode::OK);
    assert_eq!(app.request(Method::DELETE, &plant).send().await.unwrap().status(), StatusCode::NO_CONTENT);
    ready_as(&app, StatusCode::OK).await;
    app.plant().await;
}

#[tokio::test]
async fn answers_are_gzip_or_plain_by_accept_encoding() {
    let app = App::new(&[]).await;
    let ask = async |codings: &'static str| {
        app.request(Method::GET, "/openapi.yaml").header("accept-encoding", codings).send().await.unwrap()
    };
    for (codings, sent) in [
        ("gzip", "gzip"),
        ("identity;q=0", "gzip"),
        ("br, gzip;q=0.5", "gzip"),
        ("identity", ""),
        ("br", ""),
        ("*;q=0", ""),
    ] {
        let answer = ask(codings).await;
        let coding = answer.headers().get("content-encoding").map_or("", |coding| coding.to_str().unwrap());
        assert_eq!((answer.status(), coding), (StatusCode::OK, sent), "{codings}");
    }
}
