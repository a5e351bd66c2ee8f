use crate::app::{App, assert_problem, json_of, plant_path};
use heliomap::store::Scope;
use reqwest::{Method, StatusCode};
use serde_json::{Value, json};
use std::time::Duration;
use tokio::io::AsyncWriteExt;
use tokio::net::TcpStream;

async fn keyed() -> App {
    let mut app = App::with_keys().await;
    app.secret = Some(app.key("owner", &[Scope::Admin], None).await);
    app
}

async fn secret_of(app: &App, asked: Value) -> (String, String) {
    let (status, key) = app.post("/api/v1/keys", asked).await;
    assert_eq!(status, StatusCode::CREATED, "{key}");
    let text = |name: &str| key[name].as_str().unwrap().to_owned();
    (text("secret"), format!("/api/v1/keys/{}", text("id")))
}

async fn delete(app: &App, path: &str) -> (StatusCode, Value) {
    json_of(app.request(Method::DELETE, path).send().await.unwrap()).await
}

#[tokio::test]
async fn scopes_open_what_they_say() {
    let mut app = keyed().await;
    let survey = app.complete_survey().await;
    app.map(&survey).await;
    let plant = plant_path(&survey).to_owned();
    for (scope, uploads, sees, reads, administers) in [
        ("upload", true, true, false, false),
        ("read", false, true, true, false),
        ("review", false, true, true, false),
        ("admin", true, true, true, true),
    ] {
        let admin = app.secret.clone();
        let (secret, _) = secret_of(&app, json!({"name": scope, "scopes": [scope]})).await;
        app.secret = Some(secret);
        let photo = app.put(&format!("{survey}/images/a.jpg"), crate::app::jpeg(32, 24)).await;
        let opens = [
            photo,
            app.get(&survey).await,
            app.get(&format!("{plant}/models/latest/modules")).await,
            app.get("/api/v1/keys").await,
        ];
        for ((status, answer), expected) in opens.iter().zip([uploads, sees, reads, administers]) {
            let expected = if expected { StatusCode::OK } else { StatusCode::FORBIDDEN };
            assert_eq!(*status, expected, "{scope}: {answer}");
        }
        if !administers {
            assert_problem(delete(&app, &plant).await, 403, "forbidden", "admin");
        }
        app.secret = admin;
    }
}

#[tokio::test]
async fn keys_end_are_revoked_and_rotated() {
    let mut app = keyed().await;
    let admin = app.secret.clone();
    let soon = jiff::Timestamp::now() + jiff::SignedDuration::from_millis(300);
    let (short, _) = secret_of(&app, json!({"name": "short", "scopes": ["read"], "expires": soon.to_string()})).await;
    let (first, path) = secret_of(&app, json!({"name": "long", "scopes": ["read"]})).await;
    let plants = async |app: &mut App, secret: &str| {
        app.secret = Some(secret.to_owned());
        let status = app.get("/api/v1/plants").await.0;
        app.secret = admin.clone();
        status
    };
    assert_eq!(plants(&mut app, &first).await, StatusCode::OK);
    let (_, rotated) = app.post(&format!("{path}/rotate"), json!({"grace_s": 3600})).await;
    let second = rotated["secret"].as_str().unwrap().to_owned();
    assert_eq!((plants(&mut app, &first).await, plants(&mut app, &second).await), (StatusCode::OK, StatusCode::OK));
    let (_, rotated) = app.post(&format!("{path}/rotate"), json!({})).await;
    let third = rotated["secret"].as_str().unwrap().to_owned();
    let good = [plants(&mut app, &first).await, plants(&mut app, &second).await, plants(&mut app, &third).await];
    assert_eq!(good, [StatusCode::UNAUTHORIZED, StatusCode::UNAUTHORIZED, StatusCode::OK]);

    let (_, key) = app.get(&path).await;
    assert!(key["last_used"].is_string() && key.get("secret").is_none(), "{key}");
    let (status, revoked) = delete(&app, &path).await;
    assert_eq!((status, revoked["revoked"].is_string()), (StatusCode::OK, true));
    assert_eq!(delete(&app, &path).await.1, revoked);
    assert_eq!(plants(&mut app, &third).await, StatusCode::UNAUTHORIZED);
    assert_problem(app.post(&format!("{path}/rotate"), json!({})).await, 409, "key_revoked", "make another");

    tokio::time::sleep(std::time::Duration::from_millis(350)).await;
    assert_eq!(plants(&mut app, &short).await, StatusCode::UNAUTHORIZED);
}

#[tokio::test]
async fn wrong_wishes_for_keys_are_refused() {
    let app = keyed().await;
    let ask = async |asked: Value| app.post("/api/v1/keys", asked).await;
    assert_problem(ask(json!({"name": "x", "scopes": []})).await, 422, "invalid_fields", "upload, read");
    assert_problem(ask(json!({"name": "x", "scopes": ["all"]})).await, 422, "invalid_fields", "all");
    assert_problem(ask(json!({"name": "", "scopes": ["read"]})).await, 422, "invalid_name", "1 to 200");
    let past = json!({"name": "x", "scopes": ["read"], "expires": "2020-01-01T00:00:00Z"});
    assert_problem(ask(past).await, 422, "invalid_fields", "ahead");
    let nowhere = json!({"name": "x", "scopes": ["read"], "plants": ["00000000-0000-4000-8000-000000000000"]});
    assert_problem(ask(nowhere).await, 404, "plant_not_found", "0000");
    let none = json!({"name": "x", "scopes": ["read"], "plants": []});
    assert_problem(ask(none).await, 422, "invalid_fields", "leave it out");
}

#[tokio::test]
async fn the_audit_log_tells_who_did_what() {
    let mut app = keyed().await;
    let admin = app.secret.clone();
    let plant = app.plant().await;
    let (secret, _) = secret_of(&app, json!({"name": "dashboard", "scopes": ["read"]})).await;
    app.secret = Some(secret);
    app.get(&plant).await;
    assert_eq!(delete(&app, &plant).await.0, StatusCode::FORBIDDEN);
    app.secret = admin;
    let request = app.request(Method::DELETE, &plant).header("x-request-id", "call-7");
    assert_eq!(request.send().await.unwrap().status(), StatusCode::NO_CONTENT);
    let (_, log) = app.get("/api/v1/audit").await;
    let lines: Vec<String> = log["items"]
        .as_array()
        .unwrap()
        .iter()
        .map(|entry| format!("{} {} {} {}", entry["key_name"], entry["method"], entry["path"], entry["status"]))
        .collect();
    assert_eq!(
        lines,
        [
            format!("\"test\" \"DELETE\" \"{plant}\" 204"),
            format!("\"dashboard\" \"DELETE\" \"{plant}\" 403"),
            "\"test\" \"POST\" \"/api/v1/keys\" 201".to_owned(),
            "\"test\" \"POST\" \"/api/v1/plants\" 201".to_owned(),
        ]
    );
    assert_eq!(log["items"][0]["request_id"], "call-7");
}

/// Sends a request and hangs up after a while, without waiting for the answer.
async fn hang_up(app: &App, request: String, after: Duration) {
    let mut socket = TcpStream::connect(app.base.trim_start_matches("http://")).await.unwrap();
    socket.write_all(request.as_bytes()).await.unwrap();
    tokio::time::sleep(after).await;
}

#[tokio::test]
async fn what_is_done_is_noted_though_the_client_hung_up() {
    let app = keyed().await;
    let secret = app.secret.clone().unwrap();
    let mut plants = Vec::new();
    for number in 0..16 {
        let (_, plant) = app.post("/api/v1/plants", json!({"name": format!("plant {number}")})).await;
        plants.push(format!("/api/v1/plants/{}", plant["id"].as_str().unwrap()));
    }
    for (number, plant) in (0..).zip(&plants) {
        let request = format!("DELETE {plant} HTTP/1.1\r\nhost: x\r\nauthorization: Bearer {secret}\r\n\r\n");
        hang_up(&app, request, Duration::from_micros(400 * number)).await;
    }
    // What has begun comes to its end: the log is whole once no plant goes any more.
    let mut seen = (usize::MAX, usize::MAX);
    for _ in 0..100 {
        let (_, log) = app.get("/api/v1/audit").await;
        let noted = log["items"].as_array().unwrap().iter().filter(|entry| entry["method"] == "DELETE").count();
        let (_, left) = app.get("/api/v1/plants").await;
        let now = (noted, plants.len() - left["items"].as_array().unwrap().len());
        let settled = now == seen && now.0 == now.1;
        seen = now;
        if settled {
            break;
        }
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
    assert_eq!(seen.0, seen.1, "entries, and plants that are gone");
    assert!(seen.0 > 0, "some were deleted");
}

#[tokio::test]
async fn a_retry_after_a_lost_answer_is_answered_the_same() {
    let app = keyed().await;
    let secret = app.secret.clone().unwrap();
    for number in 0..16 {
        let body = format!("{{\"name\": \"plant {number}\"}}");
        let request = format!(
            "POST /api/v1/plants HTTP/1.1\r\nhost: x\r\nauthorization: Bearer {secret}\r\nidempotency-key: {number}\r\n\
             content-type: application/json\r\ncontent-length: {}\r\n\r\n{body}",
            body.len()
        );
        hang_up(&app, request, Duration::from_micros(400 * number)).await;
        let status = loop {
            let retry = app.request(Method::POST, "/api/v1/plants").header("idempotency-key", number.to_string());
            let retry = retry.header("content-type", "application/json").body(body.clone()).send().await.unwrap();
            if retry.status() != StatusCode::CONFLICT {
                break retry.status();
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        };
        // Without the answer that was kept it would be 200: the plant is there.
        assert_eq!(status, StatusCode::CREATED, "{number}");
    }
}

#[tokio::test]
async fn refusals_without_end_do_not_fill_the_disk() {
    let mut app = keyed().await;
    let admin = app.secret.clone();
    let (secret, _) = secret_of(&app, json!({"name": "dashboard", "scopes": ["read"]})).await;
    app.secret = Some(secret);
    let long = format!("/api/v1/plants/{}/modules/{}", uuid::Uuid::nil(), "x".repeat(60_000));
    for _ in 0..100 {
        assert_eq!(app.get(&long).await.0, StatusCode::NOT_FOUND);
    }
    app.secret = admin;
    let (_, log) = app.get("/api/v1/audit?limit=1000").await;
    let paths: Vec<&str> =
        log["items"].as_array().unwrap().iter().map(|entry| entry["path"].as_str().unwrap()).collect();
    let refused: Vec<&&str> = paths.iter().filter(|path| path.contains("/modules/")).collect();
    assert!((60..70).contains(&refused.len()), "{}", refused.len());
    assert!(refused.iter().all(|path| path.chars().count() == 501 && path.ends_with('…')));
}

#[tokio::test]
async fn a_key_for_some_plants_finds_them_by_name_and_creates_none() {
    let mut app = keyed().await;
    let (_, field) = app.post("/api/v1/plants", json!({"name": "Field"})).await;
    for name in ["Field 2", "Fiel"] {
        app.post("/api/v1/plants", json!({"name": name})).await;
    }
    let asked = json!({"name": "x", "scopes": ["upload"], "plants": [field["id"]]});
    let (secret, _) = secret_of(&app, asked).await;
    app.secret = Some(secret);
    assert_eq!(app.post("/api/v1/plants", json!({"name": "Field"})).await, (StatusCode::OK, field));
    for name in ["Field 2", "Fiel", "New"] {
        assert_problem(app.post("/api/v1/plants", json!({"name": name})).await, 403, "forbidden", "plants");
    }
}
