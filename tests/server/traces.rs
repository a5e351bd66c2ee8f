//! Traces to a real receiver: what is sent is protobuf, and tells of the service, of requests and of a job's stages.

use crate::{broken_survey_with_job, client, follow, serve_logged};
use reqwest::StatusCode;
use serde_json::Value;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpListener;
use std::process::Command;
use std::sync::{Arc, Mutex};

/// What was posted: path, content type and body of each request.
type Posted = Arc<Mutex<Vec<(String, String, Vec<u8>)>>>;

/// A collector that takes everything.
fn collector() -> (String, Posted) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let base = format!("http://{}", listener.local_addr().unwrap());
    let posted = Posted::default();
    let kept = posted.clone();
    std::thread::spawn(move || {
        for stream in listener.incoming() {
            let mut reader = BufReader::new(stream.unwrap());
            let kept = kept.clone();
            std::thread::spawn(move || {
                loop {
                    let mut head = Vec::new();
                    loop {
                        let mut line = String::new();
                        if reader.read_line(&mut line).unwrap_or(0) == 0 {
                            return;
                        }
                        if line.trim().is_empty() {
                            break;
                        }
                        head.push(line.trim().to_owned());
                    }
                    let header = |name: &str| {
                        let value = head.iter().find_map(|line| {
                            let (found, value) = line.split_once(": ")?;
                            found.eq_ignore_ascii_case(name).then(|| value.to_owned())
                        });
                        value.unwrap_or_default()
                    };
                    let mut body = vec![0; header("content-length").parse().unwrap()];
                    reader.read_exact(&mut body).unwrap();
                    kept.lock().unwrap().push((head[0].clone(), header("content-type"), body));
                    reader.get_mut().write_all(b"HTTP/1.1 200 OK\r\ncontent-length: 0\r\n\r\n").unwrap();
                }
            });
        }
    });
    (base, posted)
}

fn holds(body: &[u8], part: &[u8]) -> bool {
    body.windows(part.len()).any(|window| window == part)
}

#[test]
fn requests_and_the_stages_of_jobs_are_traced() {
    let (endpoint, posted) = collector();
    let data = tempfile::tempdir().unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_heliomap"));
    command
        .args(["serve", "--insecure", "--listen", "127.0.0.1:0", "--log", "error", "--otlp-endpoint", &endpoint])
        .env("HELIOMAP_DATA_DIR", data.path());
    let (program, base) = serve_logged(data.path(), command);
    let client = client();
    let trace = "0af7651916cd43dd8448eb211c80319c";
    let request =
        client.get(format!("{base}/api/v1/plants")).header("traceparent", format!("00-{trace}-b7ad6b7169203331-01"));
    assert_eq!(request.send().unwrap().status(), StatusCode::OK);
    let (_, job) = broken_survey_with_job(&client, &base);
    let ended: Value = follow(&client, &base, &job);
    assert_eq!(ended["state"], "failed");
    // The last of them are sent when the process stops.
    assert!(program.terminate().success());
    let posted = posted.lock().unwrap();
    let all: Vec<u8> = posted.iter().flat_map(|(_, _, body)| body.clone()).collect();
    for (line, kind, _) in posted.iter() {
        assert_eq!((line.as_str(), kind.as_str()), ("POST /v1/traces HTTP/1.1", "application/x-protobuf"));
    }
    let id: Vec<u8> = trace
        .as_bytes()
        .chunks(2)
        .map(|pair| u8::from_str_radix(std::str::from_utf8(pair).unwrap(), 16).unwrap())
        .collect();
    for part in [
        b"service.name".as_slice(),
        b"heliomap",
        env!("CARGO_PKG_VERSION").as_bytes(),
        b"GET /api/v1/plants",
        b"PUT /api/v1/plants/{plant}/surveys/{survey}/images/{name}",
        b"job",
        b"stage read",
        job["id"].as_str().unwrap().as_bytes(),
        &id,
    ] {
        assert!(holds(&all, part), "no trace holds {}", String::from_utf8_lossy(part));
    }
    let log = std::fs::read_to_string(data.path().join("log")).unwrap();
    assert!(!log.contains("GET"), "what is traced is logged: {log}");
}

#[test]
fn a_collector_whose_address_is_none_is_named() {
    let output = Command::new(env!("CARGO_BIN_EXE_heliomap"))
        .args(["openapi", "--otlp-endpoint", "not a url"])
        .output()
        .unwrap();
    let text = String::from_utf8(output.stderr).unwrap();
    assert!(!output.status.success() && text.contains("--otlp-endpoint"), "{text}");
}
