//! Nobody changes what someone else changed meanwhile, unless that is wanted; and lists are filtered.

use crate::app::{Act, App, assert_problem, jpeg, json_of, plant_path};
use reqwest::{Method, StatusCode};
use serde_json::{Value, json};

#[tokio::test]
async fn a_file_is_replaced_as_it_was_seen() {
    let app = App::new(&[]).await;
    let survey = app.survey().await;
    let path = format!("{survey}/images/a.jpg");
    let put = |width: u32, name: &'static str, value: String| {
        app.request(Method::PUT, &path).header(name, value).body(jpeg(width, 8)).send()
    };
    let absent = put(8, "if-match", "*".to_owned()).await.unwrap();
    assert_problem(json_of(absent).await, 412, "precondition_failed", "decide anew");
    let created = put(8, "if-none-match", "*".to_owned()).await.unwrap();
    assert_eq!(created.status(), StatusCode::CREATED);
    let first = created.headers()["etag"].to_str().unwrap().to_owned();
    let (_, file) = json_of(created).await;
    assert_eq!(first, format!("\"{}\"", file["sha256"].as_str().unwrap()));
    let again = put(9, "if-none-match", "*".to_owned()).await.unwrap();
    assert_eq!(again.status(), StatusCode::PRECONDITION_FAILED);
    let replaced = put(9, "if-match", format!("\"other\", {first}")).await.unwrap();
    assert_eq!(replaced.status(), StatusCode::OK);
    let second = replaced.headers()["etag"].to_str().unwrap().to_owned();
    // Whoever saw the first one does not know of the second.
    let late = put(10, "if-match", first).await.unwrap();
    assert_problem(json_of(late).await, 412, "precondition_failed", "decide anew");
    assert_eq!(put(10, "if-match", second).await.unwrap().status(), StatusCode::OK);
    let other = put(10, "if-none-match", "\"x\"".to_owned()).await.unwrap();
    assert_eq!(other.status(), StatusCode::OK);
    let same = put(11, "if-none-match", other.headers()["etag"].to_str().unwrap().to_owned()).await.unwrap();
    assert_eq!(same.status(), StatusCode::PRECONDITION_FAILED);
    let reconstruction = format!("{survey}/reconstruction/reconstruction.json");
    let absent = app.request(Method::PUT, &reconstruction).header("if-match", "*").body("[]").send().await.unwrap();
    assert_eq!(absent.status(), StatusCode::PRECONDITION_FAILED);
    let (_, found) = app.get(&survey).await;
    assert_eq!((found["files"].as_array().unwrap().len(), &found["files"][0]["width_px"]), (1, &json!(10)));
}

#[tokio::test]
async fn what_brings_many_files_speaks_of_no_state() {
    let app = App::new(&[]).await;
    let survey = app.complete_survey().await;
    for (name, value) in [("if-match", "\"0000\""), ("if-none-match", "*")] {
        for method in [Method::PUT, Method::POST] {
            let archive = app.request(method, &format!("{survey}/reconstruction")).header(name, value).body("PK");
            assert_problem(json_of(archive.send().await.unwrap()).await, 400, "bad_request", name);
        }
        let form = reqwest::multipart::Form::new()
            .part("f", reqwest::multipart::Part::bytes(b"x".to_vec()).file_name("c.jpg"));
        let form = app.request(Method::POST, &format!("{survey}/images")).header(name, value).multipart(form);
        assert_problem(json_of(form.send().await.unwrap()).await, 400, "bad_request", name);
    }
}

#[tokio::test]
async fn what_is_asked_with_head_has_the_tag_of_what_is_read() {
    let app = App::new(&[]).await;
    let plant = app.plant().await;
    let get = app.request(Method::GET, &plant).send().await.unwrap();
    let head = app.request(Method::HEAD, &plant).send().await.unwrap();
    for name in ["etag", "content-length", "content-type"] {
        assert_eq!(head.headers()[name], get.headers()[name], "{name}");
    }
    let tag = head.headers()["etag"].clone();
    let unchanged = app.request(Method::HEAD, &plant).header("if-none-match", tag).send().await.unwrap();
    assert_eq!(unchanged.status(), StatusCode::NOT_MODIFIED);
}

#[tokio::test]
async fn a_plant_is_deleted_as_it_was_seen() {
    let app = App::new(&[]).await;
    let plant = app.plant().await;
    let seen = app.request(Method::GET, &plant).send().await.unwrap().headers()["etag"].clone();
    let delete = |tag: &str| app.request(Method::DELETE, &plant).header("if-match", tag.to_owned()).send();
    let other = delete("\"other\"").await.unwrap();
    assert_problem(json_of(other).await, 412, "precondition_failed", "decide anew");
    assert_eq!(app.get(&plant).await.0, StatusCode::OK);
    assert_eq!(delete(seen.to_str().unwrap()).await.unwrap().status(), StatusCode::NO_CONTENT);
    assert_eq!(app.get(&plant).await.0, StatusCode::NOT_FOUND);
}

#[tokio::test]
async fn keys_and_webhooks_are_changed_as_they_were_seen() {
    let app = App::new(&[]).await;
    let tag = async |path: &str| {
        let answer = app.request(Method::GET, path).send().await.unwrap();
        answer.headers()["etag"].to_str().unwrap().to_owned()
    };
    let send = async |method: Method, path: &str, tag: &str| {
        let request = app.request(method, path).header("if-match", tag);
        json_of(request.json(&json!({})).send().await.unwrap()).await
    };
    let (_, key) = app.post("/api/v1/keys", json!({"name": "station", "scopes": ["upload"]})).await;
    let key = format!("/api/v1/keys/{}", key["id"].as_str().unwrap());
    let rotate = format!("{key}/rotate");
    assert_problem(send(Method::POST, &rotate, "\"other\"").await, 412, "precondition_failed", "decide anew");
    // Of two administrators who saw the same key, one gives it a new secret, and the other hears of it.
    let first = tag(&key).await;
    assert_eq!(send(Method::POST, &rotate, &first).await.0, StatusCode::OK);
    let before = app.get(&key).await.1;
    for (method, path) in [(Method::POST, &rotate), (Method::DELETE, &key)] {
        assert_problem(send(method, path, &first).await, 412, "precondition_failed", "decide anew");
    }
    assert_eq!(app.get(&key).await.1, before);
    let second = tag(&key).await;
    let (status, revoked) = send(Method::DELETE, &key, &format!("\"other\", {second}")).await;
    assert_eq!((status, revoked["revoked"].is_string()), (StatusCode::OK, true), "{revoked}");
    assert_problem(send(Method::DELETE, &key, &second).await, 412, "precondition_failed", "decide anew");
    assert_eq!(send(Method::DELETE, &key, "*").await.0, StatusCode::OK);
    let absent = "/api/v1/keys/00000000-0000-4000-8000-000000000000";
    assert_problem(send(Method::DELETE, absent, "*").await, 404, "key_not_found", "");

    let (_, hook) = app.post("/api/v1/webhooks", json!({"url": "https://example.org/"})).await;
    let hook = format!("/api/v1/webhooks/{}", hook["id"].as_str().unwrap());
    assert_problem(send(Method::DELETE, &hook, "\"other\"").await, 412, "precondition_failed", "decide anew");
    assert_eq!(app.get(&hook).await.0, StatusCode::OK);
    assert_eq!(send(Method::DELETE, &hook, &tag(&hook).await).await.0, StatusCode::NO_CONTENT);
    assert_problem(send(Method::DELETE, &hook, "*").await, 404, "webhook_not_found", "");
}

#[tokio::test]
async fn lists_are_filtered_and_go_on_so() {
    let app = App::new(&[Act::Map(1), Act::RefuseInput]).await;
    let survey = app.complete_survey().await;
    let plant = plant_path(&survey);
    for name in ["Sun & Moon 1", "Sun & Moon 2", "Hill"] {
        app.post("/api/v1/plants", json!({"name": name})).await;
    }
    let names = |list: &Value| -> Vec<String> {
        list["items"].as_array().unwrap().iter().map(|item| item["name"].as_str().unwrap().to_owned()).collect()
    };
    let (_, first) = app.get("/api/v1/plants?name=Sun%20%26&limit=1").await;
    assert_eq!(names(&first), ["Sun & Moon 1"]);
    let (_, second) = app.get(first["next"].as_str().unwrap()).await;
    assert_eq!((names(&second), second.get("next")), (vec!["Sun & Moon 2".to_owned()], None));
    let endless = app.get(&format!("/api/v1/plants?name={}", "x".repeat(201))).await;
    assert_problem(endless, 400, "invalid_query", "200 characters");
    assert_eq!(names(&app.get("/api/v1/plants?name=%00").await.1), [""; 0]);
    app.post(&format!("{plant}/surveys"), json!({"name": "July"})).await;
    assert_eq!(names(&app.get(&format!("{plant}/surveys?name=Jul")).await.1), ["July"]);

    app.map(&survey).await;
    app.map(&survey).await;
    let id = survey.rsplit('/').next().unwrap();
    let states = async |path: String| {
        let (status, list) = app.get(&path).await;
        assert_eq!(status, StatusCode::OK, "{list}");
        list["items"]
            .as_array()
            .unwrap()
            .iter()
            .map(|job| job["state"].as_str().unwrap().to_owned())
            .collect::<Vec<_>>()
    };
    assert_eq!(states(format!("{plant}/jobs?survey={id}")).await, ["failed", "succeeded"]);
    assert_eq!(states(format!("{plant}/jobs?state=failed")).await, ["failed"]);
    assert_eq!(states(format!("{survey}/jobs?state=succeeded")).await, ["succeeded"]);
    let nobody = "00000000-0000-4000-8000-000000000000";
    assert!(states(format!("{plant}/jobs?survey={nobody}")).await.is_empty());
    assert_problem(app.get(&format!("{plant}/jobs?state=done")).await, 400, "invalid_query", "cancelled");

    let (_, images) = app.get(&format!("{survey}?kind=image")).await;
    assert_eq!((images["files"].as_array().unwrap().len(), &images["complete"]), (2, &json!(true)), "{images}");
    assert_problem(app.get(&format!("{survey}?kind=photo")).await, 400, "invalid_query", "image or reconstruction");

    let (_, log) = app.get("/api/v1/audit").await;
    let at = |entry: &Value| entry["at"].as_str().unwrap().parse::<jiff::Timestamp>().unwrap();
    let third = at(&log["items"][2]);
    let (_, later) = app.get(&format!("/api/v1/audit?since={third}&limit=1000")).await;
    let later: Vec<_> = later["items"].as_array().unwrap().iter().map(at).collect();
    assert!(later.len() >= 3 && later.iter().all(|at| *at >= third), "{later:?}");
    let (_, earlier) = app.get(&format!("/api/v1/audit?until={third}&limit=1000")).await;
    let earlier: Vec<_> = earlier["items"].as_array().unwrap().iter().map(at).collect();
    assert!(!earlier.is_empty() && earlier.iter().all(|at| *at < third), "{earlier:?}");
    assert_eq!(app.get("/api/v1/keys?since=2030-01-01T00:00:00Z").await.1["items"], json!([]));
    assert_problem(app.get("/api/v1/keys?since=yesterday").await, 400, "invalid_query", "since");
}
