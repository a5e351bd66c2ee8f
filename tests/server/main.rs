//! The real program.

mod backup;
#[path = "../common/boxes.rs"]
mod boxes;

mod configuration;
mod doctor;
#[path = "../common/stub.rs"]
mod stub;
mod traces;
mod upgrade;
mod uploads;

use heliomap::store::{Digest, SqliteStore, SurveyId, Upload, UploadId, UploadStore};
use jiff::SignedDuration;
use reqwest::StatusCode;
use reqwest::blocking::Client;
use serde_json::{Value, json};
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};
use uuid::Uuid;

/// Sends requests.
fn client() -> Client {
    heliomap::tls::provide();
    Client::new()
}

/// A running program that is killed when dropped.
struct Program(Child);

impl Drop for Program {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

impl Program {
    /// Asks it to stop as a service manager would; how it ended.
    fn terminate(mut self) -> std::process::ExitStatus {
        let kill = Command::new("kill").arg(self.0.id().to_string()).status().unwrap();
        assert!(kill.success());
        let begun = Instant::now();
        loop {
            if let Some(status) = self.0.try_wait().unwrap() {
                return status;
            }
            assert!(begun.elapsed() < Duration::from_secs(20), "it does not stop");
            std::thread::sleep(Duration::from_millis(10));
        }
    }
}

/// Starts the program; its first line of output.
fn start(data: &Path, arguments: &[&str]) -> (Program, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_heliomap"));
    command.args(arguments).env("HELIOMAP_DATA_DIR", data);
    spawn(command, Stdio::null())
}

/// Starts a program that logs to `log`; its first line of output.
fn spawn(mut command: Command, log: impl Into<Stdio>) -> (Program, String) {
    let mut child = command.stdout(Stdio::piped()).stderr(log).spawn().unwrap();
    let mut line = String::new();
    BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
    (Program(child), line)
}

fn serve(data: &Path, more: &[&str]) -> (Program, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_heliomap"));
    command.args(["serve", "--insecure", "--listen", "127.0.0.1:0"]).args(more).env("HELIOMAP_DATA_DIR", data);
    listening(command, Stdio::null())
}

/// Starts a service that logs into the file `log` of its data folder.
fn serve_logged(data: &Path, command: Command) -> (Program, String) {
    listening(command, std::fs::File::create(data.join("log")).unwrap())
}

/// Starts a service that logs to `log`; its address.
fn listening(command: Command, log: impl Into<Stdio>) -> (Program, String) {
    let (program, line) = spawn(command, log);
    let base = line.trim().strip_prefix("heliomap is listening on ").expect("the address is printed");
    (program, base.to_owned())
}

/// How the program reaches the tests' S3-compatible server.
fn bucket_at(endpoint: &str) -> [(&str, &str); 4] {
    [
        ("AWS_ENDPOINT_URL", endpoint),
        ("AWS_REGION", "eu-central-1"),
        ("AWS_ACCESS_KEY_ID", "heliomap"),
        ("AWS_SECRET_ACCESS_KEY", "heliomap"),
    ]
}

fn jpeg() -> Vec<u8> {
    jpeg_of(16)
}

fn jpeg_of(width: u32) -> Vec<u8> {
    let mut bytes = std::io::Cursor::new(Vec::new());
    image::RgbImage::new(width, 12).write_to(&mut bytes, image::ImageFormat::Jpeg).unwrap();
    bytes.into_inner()
}

/// A survey that looks complete but whose reconstruction has no points; its path and its job.
fn broken_survey_with_job(client: &Client, base: &str) -> (String, Value) {
    let post = |path: &str, body: Value| -> Value {
        client.post(format!("{base}{path}")).json(&body).send().unwrap().json().unwrap()
    };
    let plant = post("/api/v1/plants", json!({"name": "Sunfield"}));
    let surveys = format!("/api/v1/plants/{}/surveys", plant["id"].as_str().unwrap());
    let survey = format!("{surveys}/{}", post(&surveys, json!({"name": "June"}))["id"].as_str().unwrap());
    for (path, body) in [
        ("images/a.jpg", jpeg()),
        ("images/b.jpg", jpeg()),
        ("reconstruction/reconstruction.json", stub::RECONSTRUCTION.as_bytes().to_vec()),
        ("reconstruction/reference_lla.json", stub::REFERENCE.as_bytes().to_vec()),
    ] {
        let answer = client.put(format!("{base}{survey}/{path}")).body(body).send().unwrap();
        assert_eq!(answer.status(), StatusCode::CREATED);
    }
    let job = post(&format!("{survey}/jobs"), json!({}));
    (survey, job)
}

fn follow(client: &Client, base: &str, job: &Value) -> Value {
    let path = format!("/api/v1/plants/{}/jobs/{}", job["plant"].as_str().unwrap(), job["id"].as_str().unwrap());
    let begun = Instant::now();
    loop {
        let job: Value = client.get(format!("{base}{path}")).send().unwrap().json().unwrap();
        if !["queued", "running"].contains(&job["state"].as_str().unwrap()) {
            return job;
        }
        assert!(begun.elapsed() < Duration::from_secs(30), "{job}");
        std::thread::sleep(Duration::from_millis(50));
    }
}

#[test]
fn what_was_acknowledged_survives_a_kill_and_the_program_stops_when_told() {
    let data = tempfile::tempdir().unwrap();
    let client = client();
    let (program, base) = serve(data.path(), &["--no-worker"]);
    let (survey, job) = broken_survey_with_job(&client, &base);
    drop(program);

    let (program, base) = serve(data.path(), &["--no-worker"]);
    let found: Value = client.get(format!("{base}{survey}")).send().unwrap().json().unwrap();
    assert_eq!((found["files"].as_array().unwrap().len(), &found["complete"]), (4, &json!(true)));
    let jobs: Value = client.get(format!("{base}{survey}/jobs")).send().unwrap().json().unwrap();
    assert_eq!((&jobs["items"][0]["id"], &jobs["items"][0]["state"]), (&job["id"], &json!("queued")));
    assert!(program.terminate().success());
}

#[test]
fn the_bytes_of_replaced_files_go_after_their_time() {
    let data = tempfile::tempdir().unwrap();
    let client = client();
    let (_server, base) = serve(data.path(), &["--no-worker", "--keep-replaced", "0.5"]);
    let (survey, job) = broken_survey_with_job(&client, &base);
    let kept_bytes = || {
        let usage: Value = client.get(format!("{base}/api/v1/usage")).send().unwrap().json().unwrap();
        usage["bytes"].as_u64().unwrap()
    };
    let (before, old, new) = (kept_bytes(), jpeg(), jpeg_of(80));
    for name in ["a.jpg", "b.jpg"] {
        let answer = client.put(format!("{base}{survey}/images/{name}")).body(new.clone()).send().unwrap();
        assert_eq!(answer.status(), StatusCode::OK);
    }
    let digest = Digest::of(&old).to_string();
    let plant = job["plant"].as_str().unwrap();
    let blob = data.path().join(format!("blobs/plants/{plant}/{}/{digest}", &digest[..2]));
    let begun = Instant::now();
    while blob.exists() || kept_bytes() != before - old.len() as u64 + new.len() as u64 {
        assert!(begun.elapsed() < Duration::from_secs(60), "they stay");
        std::thread::sleep(Duration::from_millis(50));
    }
}

/// Not only when the service starts.
#[test]
fn uploads_whose_time_is_over_are_forgotten_while_the_service_runs() {
    let data = tempfile::tempdir().unwrap();
    let client = client();
    let (_server, base) = serve(data.path(), &["--no-worker", "--keep-replaced", "0.5"]);
    let (survey, _) = broken_survey_with_job(&client, &base);
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let store = runtime.block_on(SqliteStore::open(&data.path().join("heliomap.db"))).unwrap();
    let upload = |id: u128, expires: SignedDuration| Upload {
        id: UploadId(Uuid::from_u128(id)),
        survey: SurveyId(survey.rsplit('/').next().unwrap().parse().unwrap()),
        length: 9,
        received: 0,
        partial: false,
        parts: None,
        metadata: "filename YS5qcGc=".to_owned(),
        expires: jiff::Timestamp::now() + expires,
        outcome: None,
        home: None,
    };
    let over = upload(1, SignedDuration::from_secs(-1));
    let goes_on = upload(2, SignedDuration::from_hours(1));
    let file = |upload: &Upload| data.path().join("uploads").join(upload.id.to_string());
    for upload in [&over, &goes_on] {
        runtime.block_on(store.create_upload(upload, None, jiff::Timestamp::now())).unwrap();
        let made = std::fs::File::create(file(upload)).unwrap();
        made.set_modified(std::time::SystemTime::now() - Duration::from_secs(90_000)).unwrap();
    }
    let begun = Instant::now();
    while file(&over).exists() || runtime.block_on(store.uploads()).unwrap() != [goes_on.id] {
        assert!(begun.elapsed() < Duration::from_secs(60), "it stays");
        std::thread::sleep(Duration::from_millis(50));
    }
    assert!(file(&goes_on).exists());
}

#[test]
fn a_worker_of_its_own_takes_the_jobs_of_a_server_without_one() {
    let data = tempfile::tempdir().unwrap();
    let client = client();
    let (_server, base) = serve(data.path(), &["--no-worker"]);
    let (_, job) = broken_survey_with_job(&client, &base);
    let (worker, line) = start(data.path(), &["worker"]);
    assert!(line.contains("works on jobs"), "{line}");
    let job = follow(&client, &base, &job);
    assert_eq!(job["state"], "failed", "{job}");
    assert!(job["error"]["code"].is_string(), "{job}");
    assert!(worker.terminate().success());
}

#[test]
fn a_detector_that_is_named_must_be_there() {
    let data = tempfile::tempdir().unwrap();
    for command in [&["serve", "--insecure", "--listen", "127.0.0.1:0"][..], &["worker"]] {
        let mut program = Command::new(env!("CARGO_BIN_EXE_heliomap"));
        program.args(command).args(["--detector", "/no/such.onnx"]).env("HELIOMAP_DATA_DIR", data.path());
        let output = program.output().unwrap();
        let text = String::from_utf8(output.stderr).unwrap();
        assert!(output.status.code() == Some(1) && text.contains("/no/such.onnx cannot be read"), "{text}");
    }
    let _no_worker_needs_none = serve(data.path(), &["--no-worker", "--detector", "/no/such.onnx"]);
}

#[test]
fn without_the_shipped_detector_the_service_runs_and_says_so() {
    let folder = tempfile::tempdir().unwrap();
    let alone = folder.path().join("heliomap");
    std::fs::copy(env!("CARGO_BIN_EXE_heliomap"), &alone).unwrap();
    let mut command = Command::new(alone);
    command.args(["serve", "--insecure", "--listen", "127.0.0.1:0", "--data-dir", "data"]);
    command.current_dir(folder.path()).env_remove("ORT_DYLIB_PATH");
    let (_program, base) = listening(command, Stdio::null());
    let ready: Value = client().get(format!("{base}/ready")).send().unwrap().json().unwrap();
    assert_eq!(ready["status"], "ok");
    assert!(ready["warnings"][0].as_str().unwrap().contains("heliomap doctor"), "{ready}");
}

#[test]
fn a_broken_reconstruction_fails_its_job() {
    let data = tempfile::tempdir().unwrap();
    let client = client();
    let (_program, base) = serve(data.path(), &[]);
    let (_, job) = broken_survey_with_job(&client, &base);
    let job = follow(&client, &base, &job);
    assert_eq!((&job["state"], &job["attempt"]), (&json!("failed"), &json!(1)), "{job}");
    assert_eq!(job["error"]["code"], "points_missing", "{job}");
    let message = job["error"]["message"].as_str().unwrap();
    assert!(message.contains("reconstruction.json: neither dense nor sparse points"), "{message}");
    assert!(message.ends_with("run the reconstruction again"), "{message}");
}

#[test]
fn without_a_key_nobody_gets_in() {
    let data = tempfile::tempdir().unwrap();
    let keys = |arguments: &[&str]| {
        let arguments = [&["keys", "--data-dir", data.path().to_str().unwrap()], arguments].concat();
        let output = Command::new(env!("CARGO_BIN_EXE_heliomap")).args(arguments).output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        String::from_utf8(output.stdout).unwrap().trim().to_owned()
    };
    let secret = keys(&["create", "--name", "first", "--scope", "admin"]);
    let (_program, line) = start(data.path(), &["serve", "--no-worker", "--listen", "127.0.0.1:0"]);
    let plants = format!("{}/api/v1/plants", line.trim().strip_prefix("heliomap is listening on ").unwrap());
    let client = client();
    let status = |secret: &str| client.get(&plants).bearer_auth(secret).send().unwrap().status();
    assert_eq!(client.get(&plants).send().unwrap().status(), StatusCode::UNAUTHORIZED);
    assert_eq!((status("hm_wrong"), status(&secret)), (StatusCode::UNAUTHORIZED, StatusCode::OK));
    let listed = keys(&["list"]);
    assert!(!listed.contains(&secret) && listed.contains(&secret[..11]), "{listed}");
    let id = listed.split(' ').next().unwrap();
    let rotated = keys(&["rotate", id]);
    assert_eq!((status(&secret), status(&rotated)), (StatusCode::UNAUTHORIZED, StatusCode::OK));
    keys(&["revoke", id]);
    assert_eq!(status(&rotated), StatusCode::UNAUTHORIZED);
}

#[test]
fn mistakes_on_the_command_line_say_what_to_do() {
    let run = |arguments: &[&str]| {
        let output = Command::new(env!("CARGO_BIN_EXE_heliomap")).args(arguments).output().unwrap();
        (output.status.success(), String::from_utf8(output.stderr).unwrap())
    };
    let (ok, text) = run(&["serve", "--listen", "nowhere"]);
    assert!(!ok && text.contains("--listen"), "{text}");
    let (ok, text) = run(&["serve", "--max-image-size", "12X"]);
    assert!(!ok && text.contains("256M"), "{text}");
    let (ok, text) = run(&["serve", "--data-dir", "/dev/null/x"]);
    assert!(!ok && text.contains("--data-dir"), "{text}");
    let (ok, text) = run(&["detect", "/no/such/photo.jpg"]);
    assert!(
        !ok && text.trim_end().ends_with("/no/such/photo.jpg cannot be read: No such file or directory (os error 2)"),
        "{text}"
    );
    let create = ["keys", "create", "--scope", "read", "--data-dir", "/no/such"];
    for wrong in [&["--name", ""][..], &["--name", "a", "--organisation", " "], &["--name", "a", "--days", "0"]] {
        let (ok, text) = run(&[&create[..], wrong].concat());
        assert!(!ok && text.contains("invalid value"), "{wrong:?}: {text}");
    }
}

#[test]
fn commands_that_read_make_no_data_folder() {
    let folder = tempfile::tempdir().unwrap();
    let data = folder.path().join("typo");
    for arguments in [&["verify"][..], &["keys", "list"], &["organisations", "list"]] {
        let mut command = Command::new(env!("CARGO_BIN_EXE_heliomap"));
        let output = command.args(arguments).arg("--data-dir").arg(&data).output().unwrap();
        let text = String::from_utf8(output.stderr).unwrap();
        assert!(output.status.code() == Some(1) && text.contains("--data-dir"), "{arguments:?}: {text}");
        assert!(!data.exists(), "{arguments:?}");
    }
}

/// What a command leaves behind whose reader has gone before it prints.
fn unread(arguments: &[&str], data: &Path) -> std::process::Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_heliomap"));
    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    command.args(arguments).env("HELIOMAP_DATA_DIR", data).stdout(writer).output().unwrap()
}

#[test]
fn a_reader_who_goes_is_no_fault_but_no_secret_is_lost() {
    let data = tempfile::tempdir().unwrap();
    let organisation = unread(&["organisations", "create", "Sun"], data.path());
    assert_eq!((organisation.status.code(), organisation.stderr.len()), (Some(0), 0), "{organisation:?}");
    assert_eq!(unread(&["openapi"], data.path()).status.code(), Some(0));
    let lost = unread(&["keys", "create", "--name", "lost", "--scope", "read"], data.path());
    let text = String::from_utf8(lost.stderr).unwrap();
    assert!(lost.status.code() == Some(1) && text.contains("the key is revoked"), "{text}");
    let mut command = Command::new(env!("CARGO_BIN_EXE_heliomap"));
    let listed = command.args(["keys", "list", "--data-dir"]).arg(data.path()).output().unwrap();
    let listed = String::from_utf8(listed.stdout).unwrap();
    assert!(listed.contains("revoked") && listed.contains("lost"), "{listed}");
}

#[test]
fn the_description_is_printed() {
    let output = Command::new(env!("CARGO_BIN_EXE_heliomap")).arg("openapi").output().unwrap();
    assert_eq!(String::from_utf8(output.stdout).unwrap(), include_str!("../../openapi.yaml"));
}

/// Everything that a program logs at its most talkative, in JSON, while a request with a secret comes and is refused, another
/// is answered, and a job runs.
#[test]
fn logs_name_requests_and_jobs_and_hold_no_secret() {
    let data = tempfile::tempdir().unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_heliomap"));
    command
        .args(["serve", "--insecure", "--listen", "127.0.0.1:0", "--log", "trace", "--log-format", "json"])
        .env("HELIOMAP_DATA_DIR", data.path())
        .env("HELIOMAP_WEBHOOK_PRIVATE_TARGETS", "true");
    let (program, base) = serve_logged(data.path(), command);
    let client = client();
    let (secret, password) = ("hm_5ec2e75ec2e75ec2e7", "pa55w0rd");
    let request = client.get(format!("{base}/api/v1/plants")).header("x-request-id", "call-7").bearer_auth(secret);
    assert_eq!(request.header("cookie", password).send().unwrap().status(), StatusCode::OK);
    let key = json!({"name": "first", "scopes": ["read"]});
    let key: Value = client.post(format!("{base}/api/v1/keys")).json(&key).send().unwrap().json().unwrap();
    let hook = json!({"url": "http://127.0.0.1:9/pa55w0rd?token=pa55w0rd"});
    let hook: Value = client.post(format!("{base}/api/v1/webhooks")).json(&hook).send().unwrap().json().unwrap();
    let (_, job) = broken_survey_with_job(&client, &base);
    follow(&client, &base, &job);
    let deliveries = format!("{base}/api/v1/webhooks/{}/deliveries", hook["id"].as_str().unwrap());
    let begun = Instant::now();
    while client.get(&deliveries).send().unwrap().json::<Value>().unwrap()["items"][0]["error"].is_null() {
        assert!(begun.elapsed() < Duration::from_secs(30), "no message is tried");
        std::thread::sleep(Duration::from_millis(50));
    }
    assert!(program.terminate().success());
    let log = std::fs::read_to_string(data.path().join("log")).unwrap();
    let lines: Vec<Value> = log.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert!(lines.iter().any(|line| line["span"]["id"] == "call-7" && line["status"] == 200), "{log}");
    assert!(lines.iter().any(|line| line["span"]["job"] == job["id"]), "{log}");
    let made = [&key["secret"].as_str().unwrap()[11..], hook["secret"].as_str().unwrap()];
    for secret in [secret, password].into_iter().chain(made) {
        assert!(!log.contains(secret), "the log holds {secret}");
    }

    // A database whose URL is wrong.
    let output = Command::new(env!("CARGO_BIN_EXE_heliomap"))
        .args(["serve", "--log", "trace", "--data-dir", data.path().to_str().unwrap()])
        .env("HELIOMAP_DATABASE", format!("postgres://heliomap:{password}@127.0.0.1:port/heliomap"))
        .output()
        .unwrap();
    let text = String::from_utf8_lossy(&output.stderr);
    assert!(!output.status.success() && text.contains("--database") && !text.contains(password), "{text}");
}

/// Files go to a bucket and come from it, everything of a plant goes with it, and the bucket's secret is in no log.
#[test]
#[ignore = "needs an S3-compatible server; run `make unit`"]
fn blobs_lie_in_a_bucket() {
    let endpoint = std::env::var("HELIOMAP_TEST_S3").unwrap();
    let data = tempfile::tempdir().unwrap();
    let prefix = data.path().file_name().unwrap().to_str().unwrap().trim_start_matches('.').to_owned();
    let secret = "5ec2e7-0f-the-bucket";
    let command = |blobs: String| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_heliomap"));
        command
            .args(["serve", "--insecure", "--listen", "127.0.0.1:0", "--log", "trace", "--blobs", &blobs])
            .env("HELIOMAP_DATA_DIR", data.path())
            .envs([("AWS_ENDPOINT_URL", endpoint.as_str()), ("AWS_REGION", "eu-central-1")])
            .envs([("AWS_ACCESS_KEY_ID", "heliomap"), ("AWS_SECRET_ACCESS_KEY", secret)]);
        command
    };
    let output = command("s3://no-such-bucket".to_owned()).output().unwrap();
    let text = String::from_utf8_lossy(&output.stderr);
    assert!(!output.status.success() && text.contains("--blobs") && !text.contains(secret), "{text}");

    let (program, base) = serve_logged(data.path(), command(format!("s3://heliomap-tests/{prefix}")));
    let client = client();
    let (_, job) = broken_survey_with_job(&client, &base);
    let job = follow(&client, &base, &job);
    assert_eq!(job["error"]["code"], "points_missing", "{job}");
    assert!(!data.path().join("blobs").exists());
    let list = format!("{endpoint}/heliomap-tests?list-type=2&prefix={prefix}/");
    let list = || client.get(&list).send().unwrap().text().unwrap();
    assert_eq!(list().matches("<Key>").count(), 3, "two photos of the same bytes, and two files: {}", list());
    let plant = format!("{base}/api/v1/plants/{}", job["plant"].as_str().unwrap());
    assert_eq!(client.delete(plant).send().unwrap().status(), StatusCode::NO_CONTENT);
    assert_eq!(list().matches("<Key>").count(), 0, "{}", list());
    assert!(program.terminate().success());
    let log = std::fs::read_to_string(data.path().join("log")).unwrap();
    assert!(log.len() > 1000 && !log.contains(secret), "the log holds the bucket's secret");
}

#[test]
fn metrics_are_told_on_a_listener_of_their_own() {
    let data = tempfile::tempdir().unwrap();
    let mut child = Command::new(env!("CARGO_BIN_EXE_heliomap"))
        .args(["worker", "--metrics-listen", "127.0.0.1:0"])
        .env("HELIOMAP_DATA_DIR", data.path())
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
    let _program = Program(child);
    let address = lines.find_map(|line| line.unwrap().strip_prefix("metrics are on ").map(str::to_owned)).unwrap();
    let health = client().get(address.replace("/metrics", "/health")).send().unwrap();
    assert_eq!(health.status(), 204);
    let answer = client().get(address).send().unwrap();
    assert!(answer.headers()["content-type"].to_str().unwrap().starts_with("application/openmetrics-text"));
    assert!(answer.text().unwrap().contains("heliomap_queue_depth 0"));
}

#[cfg(unix)]
#[test]
fn data_is_for_its_user_alone() {
    use std::os::unix::fs::PermissionsExt;
    let data = tempfile::tempdir().unwrap();
    // As an earlier version left it.
    std::fs::set_permissions(data.path(), std::fs::Permissions::from_mode(0o755)).unwrap();
    let client = client();
    let (_program, base) = serve(data.path(), &["--no-worker"]);
    broken_survey_with_job(&client, &base);
    let mut folders = vec![data.path().to_owned()];
    let mut files = 0;
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(&folder).unwrap() {
            let entry = entry.unwrap();
            if entry.file_type().unwrap().is_dir() {
                folders.push(entry.path());
            } else {
                files += 1;
                let mode = entry.metadata().unwrap().permissions().mode();
                assert_eq!(mode & 0o077, 0, "{}", entry.path().display());
            }
        }
        let mode = std::fs::metadata(&folder).unwrap().permissions().mode();
        assert_eq!(mode & 0o077, 0, "{}", folder.display());
    }
    assert!(files >= 4, "{files}");
}
