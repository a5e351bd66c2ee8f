//! Whoever asks too much, too slowly or without room for it is told so, and the others do not notice.

use crate::app::{Act, App, assert_problem, job_path, jpeg, json_of};
use futures::StreamExt;
use heliomap::config::Limits;
use heliomap::store::Scope;
use reqwest::{Method, StatusCode};
use serde_json::json;
use std::time::Duration;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

#[tokio::test]
async fn a_key_that_asks_too_often_is_told_to_wait() {
    let limits = Limits { max_requests_per_second: 1, ..Limits::default() };
    let mut app = App::with_keys_and_limits(limits).await;
    let (busy, other) = (app.key("owner", &[Scope::Read], None).await, app.key("owner", &[Scope::Read], None).await);
    app.secret = Some(busy);
    let mut answers = Vec::new();
    for _ in 0..20 {
        answers.push(app.request(Method::GET, "/api/v1/plants").send().await.unwrap());
    }
    let refused: Vec<_> = answers.into_iter().filter(|answer| answer.status() != StatusCode::OK).collect();
    // Twenty requests take well below the 18 s in which they would all be let through.
    assert!(!refused.is_empty());
    for answer in refused {
        let wait: u64 = answer.headers()["retry-after"].to_str().unwrap().parse().unwrap();
        assert!((1..=2).contains(&wait), "{wait}");
        assert_problem(json_of(answer).await, 429, "too_many_requests", "too often");
    }
    app.secret = Some(other);
    assert_eq!(app.get("/api/v1/plants").await.0, StatusCode::OK);
}

#[tokio::test]
async fn an_address_that_fails_too_often_is_told_to_wait_and_good_keys_go_on() {
    let limits = Limits { max_failed_logins_per_minute: 3, ..Limits::default() };
    let mut app = App::with_keys_and_limits(limits).await;
    let good = app.key("owner", &[Scope::Read], None).await;
    app.secret = Some("hm_guessed".to_owned());
    let mut statuses = Vec::new();
    for _ in 0..5 {
        let answer = app.request(Method::GET, "/api/v1/plants").send().await.unwrap();
        let told = answer.headers().contains_key("retry-after");
        assert_eq!(told, answer.status() == StatusCode::TOO_MANY_REQUESTS);
        statuses.push(answer.status().as_u16());
    }
    assert_eq!(statuses, [401, 401, 401, 429, 429]);
    app.secret = Some(good);
    assert_eq!(app.get("/api/v1/plants").await.0, StatusCode::OK);
}

#[tokio::test]
async fn a_full_disk_refuses_uploads_and_breaks_no_job() {
    let (limits, lavish) = (Limits { disk_reserve: u64::MAX, ..Limits::default() }, Limits::default());
    let app = App::with_limits(&[Act::Map(2)], lavish).await;
    let survey = app.complete_survey().await;
    // The same store, seen by a service for which the disk is full.
    let full = app.beside(limits).await;
    let answer = full.request(Method::PUT, &format!("{survey}/images/c.jpg")).body(jpeg(8, 8)).send().await.unwrap();
    assert_eq!(answer.headers()["retry-after"], "60");
    assert_problem(json_of(answer).await, 507, "storage_full", "nothing of it was stored");
    let begun = full.request(Method::POST, &format!("{survey}/uploads")).header("tus-resumable", "1.0.0");
    let begun = begun.header("upload-length", 9).header("upload-metadata", "filename Yi5qcGc=").send().await.unwrap();
    assert_eq!(begun.status(), StatusCode::INSUFFICIENT_STORAGE);
    let (status, job) = full.post(&format!("{survey}/jobs"), json!({})).await;
    assert_eq!(status, StatusCode::ACCEPTED, "{job}");
    assert_eq!(app.follow(&job).await["state"], "succeeded");
    assert_eq!(full.get(&survey).await.1["files"].as_array().unwrap().len(), 4);
}

#[tokio::test]
async fn who_sends_no_request_is_let_go() {
    let limits = Limits { request_timeout: Duration::from_millis(200), ..Limits::default() };
    let app = App::with_limits(&[], limits).await;
    let address = app.base.strip_prefix("http://").unwrap().to_owned();
    for sent in ["", "GET /health HTTP/1.1\r\nhost: localhost\r\n"] {
        let mut stream = TcpStream::connect(&address).await.unwrap();
        stream.write_all(sent.as_bytes()).await.unwrap();
        let mut answer = Vec::new();
        let ended = tokio::time::timeout(Duration::from_secs(60), stream.read_to_end(&mut answer)).await;
        assert!(ended.is_ok(), "the service waits for ever after {sent:?}");
    }
}

#[tokio::test]
async fn a_form_goes_on_after_a_refused_photo_that_comes_slowly_and_tells_what_is_stored_where_it_stops() {
    let limits = Limits { request_timeout: Duration::from_secs(1), ..Limits::default() };
    let app = App::with_limits(&[], limits).await;
    let survey = app.survey().await;
    let part = |name: &str, bytes: Vec<u8>| {
        let head = format!("--x\r\ncontent-disposition: form-data; name=\"f\"; filename=\"{name}\"\r\n\r\n");
        [head.into_bytes(), bytes, b"\r\n".to_vec()].concat()
    };
    let send = |pieces: Vec<(u64, Vec<u8>)>| {
        let pieces = futures::stream::iter(pieces).then(|(wait_ms, piece)| async move {
            tokio::time::sleep(Duration::from_millis(wait_ms)).await;
            Ok::<_, std::io::Error>(piece)
        });
        let request = app.request(Method::POST, &format!("{survey}/images"));
        let request = request.header("content-type", "multipart/form-data; boundary=x");
        let request = request.body(reqwest::Body::wrap_stream(pieces));
        async move { json_of(request.send().await.unwrap()).await }
    };
    let names = |told: &serde_json::Value| {
        let files = told["files"].as_array().unwrap().iter();
        files.map(|file| file["path"].as_str().unwrap().to_owned()).collect::<Vec<_>>()
    };
    let mut pieces = vec![(0, part("a.jpg", jpeg(8, 8))), (0, part("clip.MP4", vec![0; 1 << 10]))];
    // The end of its part is held back.
    pieces[1].1.truncate((1 << 10) + 50);
    pieces.extend((0..6).map(|_| (400, vec![0; 10 << 10])));
    pieces.push((400, [b"\r\n".to_vec(), part("b.jpg", jpeg(9, 8)), b"--x--\r\n".to_vec()].concat()));
    let (status, told) = send(pieces).await;
    assert_eq!((status, &told["code"]), (StatusCode::UNPROCESSABLE_ENTITY, &json!("files_refused")), "{told}");
    assert_eq!(names(&told), ["images/a.jpg", "images/b.jpg"]);

    let half = part("c.jpg", jpeg(64, 48))[..200].to_vec();
    let pieces =
        vec![(0, part("a.jpg", jpeg(8, 8))), (0, part("clip.MP4", vec![0; 9])), (0, half), (60_000, Vec::new())];
    let (status, told) = send(pieces).await;
    assert_eq!((status, &told["code"]), (StatusCode::REQUEST_TIMEOUT, &json!("upload_stalled")), "{told}");
    assert_eq!((names(&told), told["refused"].as_array().unwrap().len()), (vec!["images/a.jpg".to_owned()], 1));
    assert_eq!(told["refused"][0]["name"], "clip.MP4");
}

#[tokio::test]
async fn an_upload_of_a_byte_now_and_then_is_ended() {
    let limits = Limits { request_timeout: Duration::from_millis(600), ..Limits::default() };
    let app = App::with_limits(&[], limits).await;
    let survey = app.survey().await;
    let bytes = futures::stream::iter(0..3_000).then(|_| async {
        tokio::time::sleep(Duration::from_millis(200)).await;
        Ok::<_, std::io::Error>(vec![b' '])
    });
    let put = app.request(Method::PUT, &format!("{survey}/reconstruction/reconstruction.json"));
    let put = put.body(reqwest::Body::wrap_stream(bytes)).send();
    let answer = tokio::time::timeout(Duration::from_secs(60), put).await.expect("it goes on for ever").unwrap();
    assert_problem(json_of(answer).await, 408, "upload_stalled", "too slow");
}

#[tokio::test]
async fn one_address_holds_so_many_connections() {
    let app = App::with_limits(&[], Limits { max_connections_per_address: 2, ..Limits::default() }).await;
    let address = app.base.strip_prefix("http://").unwrap().to_owned();
    let ask = async |stream: &mut TcpStream| {
        let request = b"GET /health HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n\r\n";
        let mut answer = String::new();
        let _ = stream.write_all(request).await;
        let _ = stream.read_to_string(&mut answer).await;
        answer
    };
    let mut held = [TcpStream::connect(&address).await.unwrap(), TcpStream::connect(&address).await.unwrap()];
    let mut third = TcpStream::connect(&address).await.unwrap();
    assert_eq!(ask(&mut third).await, "", "the third connection is served");
    for stream in &mut held {
        assert!(ask(stream).await.contains("\"ok\""));
    }
    let answer = ask(&mut TcpStream::connect(&address).await.unwrap()).await;
    assert!(answer.contains("\"ok\""), "{answer}");
}

/// A connection from an address of this machine that has asked and is held open; what came of it.
async fn held(to: &str, from: &str) -> (TcpStream, usize) {
    let socket = tokio::net::TcpSocket::new_v4().unwrap();
    socket.bind(format!("{from}:0").parse().unwrap()).unwrap();
    let mut stream = socket.connect(to.parse().unwrap()).await.unwrap();
    let _ = stream.write_all(b"GET /health HTTP/1.1\r\nhost: localhost\r\n\r\n").await;
    let mut answer = [0; 4096];
    let count = stream.read(&mut answer).await.unwrap_or(0);
    (stream, count)
}

#[tokio::test]
async fn few_addresses_do_not_take_all_connections() {
    let limits = Limits { max_connections: 12, max_connections_per_address: 11, ..Limits::default() };
    let app = App::with_limits(&[], limits).await;
    let address = app.base.strip_prefix("http://").unwrap().to_owned();
    let mut greedy = Vec::new();
    for _ in 0..11 {
        greedy.push(held(&address, "127.0.0.1").await);
    }
    let served = greedy.iter().filter(|(_, count)| *count > 0).count();
    assert_eq!(served, 4);
    for other in ["127.0.0.2", "127.0.0.3"] {
        assert!(held(&address, other).await.1 > 0, "{other}");
    }
}

#[tokio::test]
async fn connections_beyond_the_limit_wait_and_are_served_then() {
    let app = App::with_limits(&[], Limits { max_connections: 1, ..Limits::default() }).await;
    let address = app.base.strip_prefix("http://").unwrap().to_owned();
    let first = TcpStream::connect(&address).await.unwrap();
    let mut second = TcpStream::connect(&address).await.unwrap();
    second.write_all(b"GET /health HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n\r\n").await.unwrap();
    let mut byte = [0];
    let early = tokio::time::timeout(Duration::from_millis(200), second.read_exact(&mut byte)).await;
    assert!(early.is_err(), "the second connection is served beside the first");
    drop(first);
    let mut answer = String::new();
    second.read_to_string(&mut answer).await.unwrap();
    assert!(answer.contains("\"ok\""), "{answer}");
}

#[tokio::test]
async fn scripts_of_other_pages_get_in_where_that_is_configured() {
    let origin = "https://dashboard.example.org";
    let app = App::for_pages_of(origin).await;
    let preflight = |from: &str| {
        let request = app.request(Method::OPTIONS, "/api/v1/plants").header("origin", from);
        let request = request.header("access-control-request-method", "GET");
        request.header("access-control-request-headers", "authorization").send()
    };
    let answer = preflight(origin).await.unwrap();
    assert!(answer.status().is_success(), "{}", answer.status());
    assert_eq!(answer.headers()["access-control-allow-origin"], origin);
    assert!(answer.headers()["access-control-allow-headers"].to_str().unwrap().contains("authorization"));
    assert!(
        !preflight("https://evil.example.org").await.unwrap().headers().contains_key("access-control-allow-origin")
    );
    let answer = app.request(Method::GET, "/api/v1/plants").header("origin", origin).send().await.unwrap();
    assert_eq!(answer.headers()["access-control-allow-origin"], origin);
    assert!(answer.headers()["access-control-expose-headers"].to_str().unwrap().contains("upload-offset"));

    // What a resumable upload is asked for reaches scripts, and its options are its own.
    let survey = app.survey().await;
    let uploads = format!("{survey}/uploads");
    for from in [None, Some(origin)] {
        let request = app.request(Method::OPTIONS, &uploads);
        let request = from.into_iter().fold(request, |request, from| request.header("origin", from));
        let options = request.send().await.unwrap();
        assert_eq!(
            (options.status(), &options.headers()["tus-version"]),
            (StatusCode::NO_CONTENT, &"1.0.0".parse().unwrap())
        );
        assert_eq!(options.headers().get("access-control-allow-origin").is_some(), from.is_some());
    }
    let exposed = answer.headers()["access-control-expose-headers"].to_str().unwrap().to_owned();
    for name in ["upload-length", "upload-metadata", "upload-concat", "tus-checksum-algorithm", "idempotency-replayed"]
    {
        assert!(exposed.split(',').any(|known| known == name), "{name} is not in {exposed}");
    }

    let closed = App::new(&[]).await;
    let answer = closed.request(Method::GET, "/api/v1/plants").header("origin", origin).send().await.unwrap();
    assert!(!answer.headers().contains_key("access-control-allow-origin"));
}

#[tokio::test]
async fn without_keys_pages_of_other_sites_get_nothing_done() {
    let origin = "https://dashboard.example.org";
    let app = App::for_pages_of(origin).await;
    let survey = app.survey().await;
    // A name that was made to lead here.
    for path in ["/api/v1/plants", "/openapi.yaml", "/"] {
        let rebound = app.request(Method::GET, path).header("host", "evil.example").send().await.unwrap();
        assert_problem(json_of(rebound).await, 403, "forbidden", "localhost");
    }
    let start = |from: &[(&'static str, &str)]| {
        let request = app.request(Method::POST, &format!("{survey}/jobs")).header("content-type", "text/plain");
        let request = from.iter().fold(request, |request, (name, value)| request.header(*name, *value));
        request.header("sec-fetch-site", "cross-site").body("{}").send()
    };
    let old = app.request(Method::POST, &format!("{survey}/jobs")).header("origin", "https://evil.example").body("{}");
    assert_problem(json_of(old.send().await.unwrap()).await, 403, "forbidden", "other sites");
    for from in [&[][..], &[("origin", "https://evil.example")]] {
        assert_problem(json_of(start(from).await.unwrap()).await, 403, "forbidden", "other sites");
    }
    let let_in = json_of(start(&[("origin", origin)]).await.unwrap()).await;
    assert_ne!(let_in.0, StatusCode::FORBIDDEN, "{let_in:?}");
    let read = app.request(Method::GET, "/api/v1/plants").header("sec-fetch-site", "cross-site").send().await.unwrap();
    assert_eq!(read.status(), StatusCode::OK);

    let mut guarded = App::with_keys().await;
    guarded.secret = Some(guarded.key("owner", &[Scope::Read], None).await);
    let named = guarded.request(Method::GET, "/api/v1/plants").header("host", "heliomap.example.org").send().await;
    assert_eq!(named.unwrap().status(), StatusCode::OK);
}

#[tokio::test]
async fn a_service_that_stops_ends_its_requests_and_puts_its_job_back() {
    let app = App::new(&[Act::Wait]).await;
    let survey = app.complete_survey().await;
    let (_, job) = app.post(&format!("{survey}/jobs"), json!({})).await;
    app.follow_until(&job, |job| job["state"] == "running").await;
    // A photo of which half has come when the service is told to stop.
    let photo = jpeg(64, 48);
    let (first, second) = photo.split_at(photo.len() / 2);
    let (send, body) = tokio::sync::mpsc::channel::<Result<Vec<u8>, std::io::Error>>(1);
    send.send(Ok(first.to_vec())).await.unwrap();
    let body = reqwest::Body::wrap_stream(tokio_stream::wrappers::ReceiverStream::new(body));
    let request = app.request(Method::PUT, &format!("{survey}/images/late.jpg")).body(body);
    let upload = tokio::spawn(request.send());
    app.metrics_until(|text| text.contains("heliomap_upload_bytes_total") && in_flight(text) == 1).await;
    app.stop();
    send.send(Ok(second.to_vec())).await.unwrap();
    drop(send);
    assert_eq!(upload.await.unwrap().unwrap().status(), StatusCode::CREATED);
    let again = app.beside(Limits::default()).await;
    let waiting = again.follow_until(&job, |job| job["state"] == "queued").await;
    assert_eq!(waiting["attempt"], 0, "{}: {waiting}", job_path(&job));
}

fn in_flight(metrics: &str) -> u64 {
    let line = metrics.lines().find_map(|line| line.strip_prefix("heliomap_requests_in_flight "));
    line.unwrap().parse().unwrap()
}

#[tokio::test]
async fn metrics_tell_what_happened() {
    let app = App::new(&[Act::Map(2), Act::RefuseInput]).await;
    let survey = app.complete_survey().await;
    app.map(&survey).await;
    app.map(&survey).await;
    app.get("/api/v1/plants/x").await;
    let metrics = app.metrics().await;
    let uploads = "heliomap_requests_total{method=\"PUT\",\
        route=\"/api/v1/plants/{plant}/surveys/{survey}/images/{name}\",status=\"201\"} 2";
    for line in [
        uploads,
        "heliomap_requests_total{method=\"GET\",route=\"/api/v1/plants/{plant}\",status=\"404\"} 1",
        "heliomap_requests_in_flight 0",
        "heliomap_job_attempts_total{outcome=\"succeeded\"} 1",
        "heliomap_job_attempts_total{outcome=\"failed\"} 1",
        "heliomap_jobs{state=\"succeeded\"} 1",
        "heliomap_jobs{state=\"queued\"} 0",
        "heliomap_queue_depth 0",
        "heliomap_queue_age_seconds 0.0",
    ] {
        assert!(metrics.lines().any(|told| told == line), "{line}\n{metrics}");
    }
    for begin in ["heliomap_request_seconds_bucket{le=\"0.1\",method=\"PUT\"", "heliomap_disk_free_bytes "] {
        assert!(metrics.lines().any(|told| told.starts_with(begin)), "{begin}\n{metrics}");
    }
    // The idle worker looks for jobs all the time: the one connection that writes is used or not.
    let writing = "heliomap_database_connections{pool=\"write\"";
    let writing =
        metrics.lines().filter_map(|line| line.strip_prefix(writing)?.rsplit(' ').next()?.parse::<u64>().ok());
    assert_eq!(writing.sum::<u64>(), 1, "{metrics}");
    let bytes = metrics.lines().find_map(|line| line.strip_prefix("heliomap_upload_bytes_total ")).unwrap();
    assert!(bytes.parse::<u64>().unwrap() > 2 * jpeg(32, 24).len() as u64, "{bytes}");
    assert!(metrics.ends_with("# EOF\n"));
}

/// What the service sends first to a head that it is sent raw.
async fn first_answer(app: &App, head: &str) -> String {
    let mut stream = TcpStream::connect(app.base.trim_start_matches("http://")).await.unwrap();
    stream.write_all(head.as_bytes()).await.unwrap();
    let mut answer = vec![0; 8192];
    let count = stream.read(&mut answer).await.unwrap();
    String::from_utf8_lossy(&answer[..count]).into_owned()
}

#[tokio::test]
async fn a_body_that_is_refused_already_is_not_asked_for() {
    let app = App::with_limits(&[], Limits { max_image_size: 1000, ..Limits::default() }).await;
    let survey = app.survey().await;
    let expect = "host: localhost\r\nexpect: 100-continue\r\n";
    let other = format!("{}0000", &survey[..survey.len() - 4]);
    for (head, status) in [
        (format!("PUT {survey}/images/a.jpg HTTP/1.1\r\n{expect}content-length: 2000\r\n\r\n"), "413"),
        (format!("PUT {survey}/images/a.exe HTTP/1.1\r\n{expect}content-length: 10\r\n\r\n"), "422"),
        (format!("PUT {other}/images/a.jpg HTTP/1.1\r\n{expect}content-length: 10\r\n\r\n"), "404"),
        (format!("PUT {survey}/images/a.jpg HTTP/1.1\r\n{expect}if-match: *\r\ncontent-length: 10\r\n\r\n"), "412"),
        (format!("PUT {survey}/reconstruction HTTP/1.1\r\n{expect}if-match: *\r\ncontent-length: 10\r\n\r\n"), "400"),
        (
            format!(
                "POST /api/v1/plants HTTP/1.1\r\n{expect}content-type: application/json\r\ncontent-length: 9000000\r\n\r\n"
            ),
            "413",
        ),
        (format!("POST /api/v1/plants HTTP/1.1\r\n{expect}content-length: 10\r\n\r\n"), "415"),
        // What may come is asked for.
        (format!("PUT {survey}/images/a.jpg HTTP/1.1\r\n{expect}content-length: 10\r\n\r\n"), "100"),
    ] {
        let answer = first_answer(&app, &head).await;
        assert!(answer.starts_with(&format!("HTTP/1.1 {status} ")), "{head}{answer}");
    }
}

#[tokio::test]
async fn heads_that_can_be_read_in_two_ways_are_refused() {
    let app = App::new(&[]).await;
    for (head, status) in [
        ("GET /health HTTP/1.1\r\n\r\n", "400"),
        ("GET /health HTTP/1.1\r\nhost: localhost\r\nhost: localhost\r\n\r\n", "400"),
        ("POST /api/v1/plants HTTP/1.1\r\nhost: localhost\r\ntransfer-encoding: gzip, chunked\r\n\r\n0\r\n\r\n", "400"),
        ("GET /health HTTP/1.1\r\nhost: localhost\r\n\r\n", "200"),
        ("GET /health HTTP/1.0\r\n\r\n", "200"),
    ] {
        let answer = first_answer(&app, head).await;
        let code = answer.split(' ').nth(1).unwrap_or_default();
        assert_eq!(code, status, "{head}{answer}");
    }
}
