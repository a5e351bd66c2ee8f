//! Messages of the ends of jobs, to a real receiver on loopback.

use crate::app::{Act, App, assert_problem, json_of, plant_path};
use axum::Router;
use axum::body::Bytes;
use axum::extract::State;
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::routing::post;
use heliomap::config::Limits;
use heliomap::store::{Created, Enqueued, JobId, JobRequest, NewWebhook, Quotas, SigningSecret};
use heliomap::telemetry::Metrics;
use heliomap::webhooks::{HEADER, Sender, SenderSettings, Targets, sign};
use jiff::{SignedDuration, Timestamp};
use reqwest::Method;
use serde_json::{Value, json};
use std::sync::{Arc, Mutex};
use std::time::Duration;
use tokio_util::sync::{CancellationToken, DropGuard};

/// What came, and what is answered.
#[derive(Clone, Default)]
struct Receiver {
    came: Arc<Mutex<Vec<(HeaderMap, Bytes)>>>,
    /// Answered one after the other; then 204.
    answers: Arc<Mutex<Vec<u16>>>,
}

impl Receiver {
    /// One that answers these first; its URL.
    async fn new(answers: &[u16]) -> (Self, String) {
        let receiver = Self::default();
        receiver.answers.lock().unwrap().extend(answers.iter().rev());
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let url = format!("http://{}/hook?token=t0ken", listener.local_addr().unwrap());
        let app = Router::new().route("/hook", post(receive)).with_state(receiver.clone());
        tokio::spawn(async move { axum::serve(listener, app).await });
        (receiver, url)
    }

    fn came(&self) -> Vec<(HeaderMap, Bytes)> {
        self.came.lock().unwrap().clone()
    }
}

async fn receive(State(receiver): State<Receiver>, headers: HeaderMap, body: Bytes) -> Response {
    receiver.came.lock().unwrap().push((headers, body));
    let status = receiver.answers.lock().unwrap().pop().unwrap_or(204);
    let mut response = StatusCode::from_u16(status).unwrap().into_response();
    response.headers_mut().insert(header::LOCATION, HeaderValue::from_static("/hook"));
    response
}

/// A sender that does not wait between its tries.
fn sender(app: &App, targets: Targets, metrics: Metrics) -> DropGuard {
    let settings = SenderSettings {
        poll: Duration::from_millis(10),
        timeout: Duration::from_secs(10),
        lease: Duration::from_secs(60),
        backoff: Duration::ZERO,
    };
    let sender = Sender::new(app.store.clone(), targets, settings, metrics).unwrap();
    let stop = CancellationToken::new();
    let stopped = stop.clone();
    tokio::spawn(async move { sender.run(stopped).await });
    stop.drop_guard()
}

async fn register(app: &App, asked: Value) -> (String, SigningSecret) {
    let (status, webhook) = app.post("/api/v1/webhooks", asked).await;
    assert_eq!(status, StatusCode::CREATED, "{webhook}");
    let secret = SigningSecret::given(webhook["secret"].as_str().unwrap()).unwrap();
    (format!("/api/v1/webhooks/{}", webhook["id"].as_str().unwrap()), secret)
}

/// The webhook's newest message, once it is in a state.
async fn delivery_in(app: &App, webhook: &str, state: &str) -> Value {
    let path = format!("{webhook}/deliveries?state={state}");
    for _ in 0..24_000 {
        let (_, list) = app.get(&path).await;
        if let Some(delivery) = list["items"].as_array().unwrap().first() {
            return delivery.clone();
        }
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    panic!("no message gets {state}: {}", app.get(&format!("{webhook}/deliveries")).await.1);
}

#[tokio::test]
async fn the_ends_of_jobs_are_told_signed_and_again_after_a_failure() {
    let app = App::new(&[Act::Map(2), Act::RefuseInput]).await;
    let (receiver, url) = Receiver::new(&[500]).await;
    let survey = app.complete_survey().await;
    let plant = plant_path(&survey);
    let id = plant.rsplit('/').next().unwrap();
    let (webhook, secret) = register(&app, json!({"url": url, "plant": id})).await;
    let (other, _) = {
        let (_, plant) = app.post("/api/v1/plants", json!({"name": "other"})).await;
        register(&app, json!({"url": url, "plant": plant["id"]})).await
    };
    let metrics = Metrics::default();
    let _sending = sender(&app, Targets::Any, metrics.clone());

    let job = app.map(&survey).await;
    let delivered = delivery_in(&app, &webhook, "delivered").await;
    assert_eq!((&delivered["job"], &delivered["attempts"]), (&job["id"], &json!(2)), "{delivered}");
    let came = receiver.came();
    assert_eq!((came.len(), &came[0].1), (2, &came[1].1));
    for (headers, body) in &came {
        let signature = headers[HEADER].to_str().unwrap();
        let seconds = signature.split_once(',').and_then(|(t, _)| t.strip_prefix("t=")?.parse().ok()).unwrap();
        let signed = Timestamp::from_second(seconds).unwrap();
        assert!(Timestamp::now().duration_since(signed).abs() < SignedDuration::from_mins(2), "{signature}");
        assert_eq!(signature, sign(&secret, signed, body));
        assert_ne!(signature, sign(&secret, signed, b"{}"));
        assert_eq!(headers["content-type"], "application/json");
    }
    let message: Value = serde_json::from_slice(&came[0].1).unwrap();
    let told = json!({
        "id": delivered["id"], "event": "job.succeeded", "at": job["finished"], "plant": job["plant"],
        "survey": job["survey"], "job": job["id"], "job_path": format!("{plant}/jobs/{}", job["id"].as_str().unwrap()),
        "model_version": 1, "model_path": job["model"],
    });
    assert_eq!(message, told);

    let failed = app.map(&survey).await;
    for _ in 0..24_000 {
        if receiver.came().len() == 3 {
            break;
        }
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    let message: Value = serde_json::from_slice(&receiver.came()[2].1).unwrap();
    assert_eq!((&message["event"], &message["error"]), (&json!("job.failed"), &failed["error"]), "{message}");
    assert_eq!(app.get(&format!("{other}/deliveries")).await.1["items"], json!([]));
    let text = metrics.render(&*app.store, &app.blobs()).await.unwrap();
    assert!(text.contains("heliomap_webhook_deliveries_total{outcome=\"failed\"} 1\n"), "{text}");
}

#[tokio::test]
async fn what_never_arrives_is_kept_and_sent_again_when_asked() {
    let app = App::new(&[Act::Map(1)]).await;
    // A redirection is not followed.
    let (receiver, url) = Receiver::new(&[302, 500, 500, 500, 500, 500, 500, 503]).await;
    let (webhook, _) = register(&app, json!({"url": url, "secret": "0123456789abcdef"})).await;
    let _sending = sender(&app, Targets::Any, Metrics::default());
    let survey = app.complete_survey().await;
    app.map(&survey).await;
    let dead = delivery_in(&app, &webhook, "dead").await;
    assert_eq!((&dead["attempts"], receiver.came().len()), (&json!(8), 8), "{dead}");
    assert!(dead["error"].as_str().unwrap().contains("503") && dead.get("next_attempt").is_none(), "{dead}");
    let resend = format!("{webhook}/deliveries/{}/resend", dead["id"].as_str().unwrap());
    assert_eq!(app.post(&resend, json!({})).await.0, StatusCode::ACCEPTED);
    let delivered = delivery_in(&app, &webhook, "delivered").await;
    assert_eq!((&delivered["id"], &delivered["attempts"]), (&dead["id"], &json!(9)), "{delivered}");
    let resend = format!("{webhook}/deliveries/00000000-0000-4000-8000-000000000000/resend");
    assert_problem(app.post(&resend, json!({})).await, 404, "delivery_not_found", "lists them");
    let wrong = app.get(&format!("{webhook}/deliveries?state=lost")).await;
    assert_problem(wrong, 400, "invalid_query", "dead");

    let (_, shown) = app.get(&webhook).await;
    assert!(shown.get("secret").is_none() && shown["url"] == url.as_str(), "{shown}");
    let gone = app.request(Method::DELETE, &webhook).send().await.unwrap();
    assert_eq!(gone.status(), StatusCode::NO_CONTENT);
    assert_problem(app.get(&webhook).await, 404, "webhook_not_found", "lists them");
}

#[tokio::test]
async fn messages_go_to_public_addresses_alone() {
    let app = App::new(&[Act::Map(1)]).await;
    let strict = app.beside(Limits::default()).await;
    let ask = async |asked: Value| strict.post("/api/v1/webhooks", asked).await;
    for url in ["http://example.org/", "https://127.0.0.1/", "https://[::1]/", "https://169.254.169.254/latest", "x"] {
        assert_problem(ask(json!({"url": url})).await, 422, "webhook_url", "the URL");
    }
    let short = json!({"url": "https://example.org/", "secret": "short"});
    assert_problem(ask(short).await, 422, "invalid_fields", "16 to 200");
    let nowhere = json!({"url": "https://example.org/", "plant": "00000000-0000-4000-8000-000000000000"});
    assert_problem(ask(nowhere).await, 404, "plant_not_found", "0000");
    let request = strict.request(Method::POST, "/api/v1/webhooks").header("idempotency-key", "once");
    let answer = request.json(&json!({"url": "https://example.org/"})).send().await.unwrap();
    assert_problem(json_of(answer).await, 400, "bad_request", "secret");

    let local = ask(json!({"url": "https://localhost/x"})).await;
    assert_problem(local, 422, "webhook_url", "localhost leads to no public address");

    // One that was registered while any address was taken.
    let (webhook, _) = register(&app, json!({"url": "https://localhost:9/"})).await;
    let _sending = sender(&app, Targets::Public, Metrics::default());
    let survey = app.complete_survey().await;
    app.map(&survey).await;
    let dead = delivery_in(&app, &webhook, "dead").await;
    assert_eq!(dead["error"], "localhost leads to no public address", "{dead}");
}

/// Receivers of one organisation that take connections and answer nothing hold up its own messages alone.
#[tokio::test]
async fn slow_receivers_of_one_organisation_keep_no_other_waiting() {
    let app = App::new(&[]).await;
    let now = Timestamp::now();
    let silent = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let slow = format!("http://{}/", silent.local_addr().unwrap());
    let held = Arc::new(Mutex::new(Vec::new()));
    let holding = held.clone();
    tokio::spawn(async move {
        while let Ok((line, _)) = silent.accept().await {
            holding.lock().unwrap().push(line);
        }
    });
    let (receiver, quick) = Receiver::new(&[]).await;
    for (name, url, webhooks) in [("slow", &slow, 40), ("quick", &quick, 1)] {
        let (Created::New(organisation) | Created::Existing(organisation)) =
            app.store.create_organisation(name, now).await.unwrap();
        let (Created::New(plant) | Created::Existing(plant)) =
            app.store.create_plant(organisation.id, "A", Quotas::default(), now).await.unwrap();
        for _ in 0..webhooks {
            let secret = SigningSecret::random().unwrap();
            let new = NewWebhook { organisation: organisation.id, plant: None, url: url.clone(), secret };
            app.store.create_webhook(&new, now).await.unwrap().unwrap();
        }
        let (Created::New(survey) | Created::Existing(survey)) =
            app.store.create_survey(plant.id, "June", now).await.unwrap();
        let (options, survey) = ("{}".to_owned(), survey.id);
        let request = JobRequest {
            id: JobId(uuid::Uuid::new_v4()),
            plant: plant.id,
            survey,
            options,
            priority: 0,
            max_attempts: 1,
        };
        let (Enqueued::New(job) | Enqueued::Existing(job)) = app.store.enqueue_job(&request, now).await.unwrap();
        app.store.cancel_job(plant.id, job.id, now).await.unwrap();
    }
    let _sending = sender(&app, Targets::Any, Metrics::default());
    let arrives = async {
        while receiver.came().is_empty() {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    };
    // Far less than the sender waits for a slow one.
    tokio::time::timeout(Duration::from_secs(5), arrives).await.expect("it waits for no other's receivers");
    assert!(held.lock().unwrap().len() <= 2);
}
