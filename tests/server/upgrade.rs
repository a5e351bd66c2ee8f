//! What earlier versions left behind is taken over: a data folder, a backup and a Postgres database of each of them, with
//! models, queued jobs and a job whose worker was killed. `upgrade/make.py` makes such a fixture with the program of a version.

use flate2::read::GzDecoder;
use reqwest::blocking::Client;
use serde_json::{Value, json};
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// The versions with a fixture.
const VERSIONS: [&str; 1] = ["0.1.0"];
/// Members that change whenever a service runs: the use of keys and the attempts to send messages.
const VOLATILE: [&str; 4] = ["last_used", "attempts", "next_attempt", "error"];
/// Of numbers: builds whose JSON parser rounds to the nearest number, and others, differ in the last digit.
const MAX_RELATIVE_DIFFERENCE: f64 = 1e-15;
/// Statements by which a worker and a server of version 0.1.0 take, keep, complete, end and queue jobs and check keys.
const STATEMENTS_OF_0_1_0: [&str; 6] = [
    "UPDATE jobs SET state = 'running', worker = 'w', attempt = attempt + 1, fence = fence + 1, lease_until_ms = 1 \
     WHERE state = 'queued'",
    "UPDATE jobs SET lease_until_ms = 1 WHERE state = 'running'",
    "UPDATE jobs SET state = 'succeeded', finished_ms = 1, lease_until_ms = NULL WHERE state = 'running'",
    "UPDATE jobs SET state = 'failed', lease_until_ms = NULL WHERE state = 'running'",
    "INSERT INTO jobs (id, plant_id, survey_id, state, options, max_attempts, run_after_ms, created_ms, priority) \
     SELECT 'x', plant_id, id, 'queued', '{}', 1, 1, 1, 0 FROM surveys WHERE name = 'Mapped'",
    "SELECT seq, id, organisation_id, name, prefix, scopes, plants, created_ms FROM api_keys",
];

/// An unpacked fixture.
struct Fixture {
    folder: tempfile::TempDir,
    expected: Value,
}

impl Fixture {
    fn unpack(version: &str, database: &str) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let packed = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("tests/server/upgrade/{version}.tar.gz"));
        let packed = std::fs::File::open(packed).unwrap();
        tar::Archive::new(GzDecoder::new(packed)).unpack(folder.path()).unwrap();
        let expected = std::fs::read(folder.path().join("expected.json")).unwrap();
        let mut expected: Value = serde_json::from_slice(&expected).unwrap();
        Self { folder, expected: expected[database].take() }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn key(&self, name: &str) -> &str {
        self.expected["keys"][name].as_str().unwrap()
    }

    fn survey(&self, name: &str) -> &str {
        self.expected["surveys"][name].as_str().unwrap()
    }
}

/// A running service, killed when dropped.
struct Service {
    process: Child,
    base: String,
    client: Client,
}

impl Drop for Service {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

impl Service {
    fn start(data: &Path, more: &[&str]) -> Self {
        let mut command = Command::new(env!("CARGO_BIN_EXE_heliomap"));
        command.args(["serve", "--listen", "127.0.0.1:0", "--data-dir"]).arg(data).args(more);
        let mut process = command.stdout(Stdio::piped()).stderr(Stdio::null()).spawn().unwrap();
        let mut line = String::new();
        BufReader::new(process.stdout.take().unwrap()).read_line(&mut line).unwrap();
        let base = line.split_whitespace().last().expect("the address is printed").trim_end_matches('/').to_owned();
        heliomap::tls::provide();
        Self { process, base: base + "/api/v1", client: Client::new() }
    }

    fn get(&self, key: &str, path: &str) -> (u16, Value) {
        let answer = self.client.get(format!("{}{path}", self.base)).bearer_auth(key).send().unwrap();
        (answer.status().as_u16(), answer.json().unwrap_or_default())
    }
}

/// Fails unless `new` has all that `old` has; new members are allowed.
fn assert_holds(old: &Value, new: &Value, place: &str) {
    match (old, new) {
        (Value::Object(old), Value::Object(new)) => {
            for (name, value) in old.iter().filter(|(name, _)| !VOLATILE.contains(&name.as_str())) {
                let place = format!("{place}.{name}");
                assert_holds(value, new.get(name).unwrap_or_else(|| panic!("{place} is missing")), &place);
            }
        }
        (Value::Array(old), Value::Array(new)) => {
            assert_eq!(old.len(), new.len(), "{place}");
            old.iter()
                .zip(new)
                .enumerate()
                .for_each(|(k, (old, new))| assert_holds(old, new, &format!("{place}[{k}]")));
        }
        (Value::Number(old), Value::Number(new)) => {
            let (old, new) = (old.as_f64().unwrap(), new.as_f64().unwrap());
            assert!((old - new).abs() <= MAX_RELATIVE_DIFFERENCE * old.abs(), "{place}: {old} and {new}");
        }
        _ => assert_eq!(old, new, "{place}"),
    }
}

/// The service answers as the old version did, for the same keys.
fn assert_serves_the_same(fixture: &Fixture, service: &Service) {
    for (path, old) in fixture.expected["answers"].as_object().unwrap() {
        let (status, new) = service.get(fixture.key("admin"), path);
        assert_eq!(status, 200, "{path}: {new}");
        assert_holds(old, &new, path);
    }
    let plant = format!("/plants/{}", fixture.expected["plant"].as_str().unwrap());
    let other = format!("/plants/{}", fixture.expected["plant_of_other_organisation"].as_str().unwrap());
    for (key, path, status) in [
        ("read", plant.as_str(), 200),
        ("review", &plant, 200),
        ("revoked", &plant, 401),
        ("other organisation", &other, 200),
        ("other organisation", &plant, 404),
        ("read", "/keys", 403),
    ] {
        assert_eq!(service.get(fixture.key(key), path).0, status, "{key}: {path}");
    }
}

/// The queued job and the one whose worker was killed are run to their end by this version. Boxes are uploaded before, so that
/// no detector is needed.
fn assert_runs_the_jobs(fixture: &Fixture, data: &Path, more: &[&str]) {
    let boxes = boxes_of(&data.join("blobs"));
    let service = Service::start(data, &[&["--no-worker"], more].concat());
    for survey in ["interrupted", "queued"] {
        let url = format!("{}{}/reconstruction/boxes.json", service.base, fixture.survey(survey));
        let put = service.client.put(url).bearer_auth(fixture.key("upload")).body(boxes.clone()).send().unwrap();
        assert_eq!(put.status().as_u16(), 201, "{}", put.text().unwrap_or_default());
    }
    drop(service);
    let service = Service::start(data, more);
    let plant = fixture.expected["plant"].as_str().unwrap();
    let mut versions = Vec::new();
    for job in ["interrupted", "queued"] {
        let path = format!("/plants/{plant}/jobs/{}", fixture.expected["jobs"][job].as_str().unwrap());
        let begun = Instant::now();
        let ended = loop {
            let (status, state) = service.get(fixture.key("read"), &path);
            assert_eq!(status, 200, "{state}");
            if !["queued", "running"].contains(&state["state"].as_str().unwrap()) {
                break state;
            }
            assert!(begun.elapsed() < Duration::from_secs(300), "{state}");
            std::thread::sleep(Duration::from_millis(200));
        };
        assert_eq!(ended["state"], "succeeded", "{ended}");
        versions.push(ended["model_version"].as_u64().unwrap());
    }
    versions.sort_unstable();
    // The model of the old version is the first, and still there.
    assert_eq!(versions, [2, 3]);
    assert_eq!(service.get(fixture.key("read"), &format!("/plants/{plant}/models/1")).0, 200);
}

/// The file of boxes among blobs.
fn boxes_of(folder: &Path) -> Vec<u8> {
    let mut folders = vec![folder.to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
                continue;
            }
            let bytes = std::fs::read(&path).unwrap();
            if bytes.starts_with(br#"{"images":"#) {
                return bytes;
            }
        }
    }
    panic!("the fixture has no boxes");
}

fn run(arguments: &[&str]) {
    let ran = Command::new(env!("CARGO_BIN_EXE_heliomap")).args(arguments).output().unwrap();
    assert!(ran.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&ran.stderr));
}

#[test]
fn data_folders() {
    for version in VERSIONS {
        let fixture = Fixture::unpack(version, "sqlite");
        let data = fixture.path("sqlite/data");
        assert_serves_the_same(&fixture, &Service::start(&data, &["--no-worker"]));
        run(&["verify", "--content", "--data-dir", data.to_str().unwrap()]);
        assert_runs_the_jobs(&fixture, &data, &[]);
    }
}

#[test]
fn backups() {
    for version in VERSIONS {
        let fixture = Fixture::unpack(version, "sqlite");
        let data = fixture.path("restored");
        run(&["restore", fixture.path("sqlite/backup").to_str().unwrap(), "--data-dir", data.to_str().unwrap()]);
        assert_serves_the_same(&fixture, &Service::start(&data, &["--no-worker"]));
        run(&["verify", "--content", "--data-dir", data.to_str().unwrap()]);
    }
}

/// A process of an old version that still runs can do nothing to an upgraded data folder.
#[tokio::test]
async fn old_processes_are_refused() {
    let fixture = Fixture::unpack("0.1.0", "sqlite");
    let file = fixture.path("sqlite/data/heliomap.db");
    let pool = sqlx::SqlitePool::connect(&format!("sqlite://{}", file.display())).await.unwrap();
    for statement in STATEMENTS_OF_0_1_0 {
        // They work before, so that they fail for the upgrade alone.
        let mut tx = pool.begin().await.unwrap();
        sqlx::query(statement).execute(&mut *tx).await.unwrap_or_else(|error| panic!("{statement}: {error}"));
        tx.rollback().await.unwrap();
    }
    heliomap::store::SqliteStore::open(&file).await.unwrap().close().await;
    for statement in STATEMENTS_OF_0_1_0 {
        assert!(sqlx::query(statement).execute(&pool).await.is_err(), "{statement}");
    }
}

/// A database in the server that `tests/with-postgres.sh` started, filled from a fixture; its URL.
fn restored_database(fixture: &Fixture, version: &str) -> String {
    let server = std::env::var("HELIOMAP_TEST_POSTGRES")
        .expect("this test needs a Postgres server: run tests/with-postgres.sh before cargo test");
    let programs = PathBuf::from(std::env::var("HELIOMAP_TEST_POSTGRES_BIN").unwrap());
    let url = format!("{server}/upgrade_{}_{}", version.replace('.', "_"), uuid::Uuid::new_v4().simple());
    let name = url.rsplit('/').next().unwrap();
    let psql = |database: &str, more: &[&str]| {
        let mut command = Command::new(programs.join("psql"));
        command.args(["--quiet", "--no-psqlrc", "--set", "ON_ERROR_STOP=1", "--dbname", database]).args(more);
        let ran = command.output().unwrap();
        assert!(ran.status.success(), "{}", String::from_utf8_lossy(&ran.stderr));
    };
    psql(&format!("{server}/postgres"), &["--command", &format!("CREATE DATABASE {name}")]);
    psql(&url, &["--file", fixture.path("postgres/dump.sql").to_str().unwrap()]);
    url
}

#[test]
#[ignore = "needs Postgres; run `make unit`"]
fn postgres_databases() {
    for version in VERSIONS {
        let fixture = Fixture::unpack(version, "postgres");
        let data = fixture.path("postgres/data");
        let database = restored_database(&fixture, version);
        assert_serves_the_same(&fixture, &Service::start(&data, &["--no-worker", "--database", &database]));
        let runtime = tokio::runtime::Runtime::new().unwrap();
        runtime.block_on(async {
            let pool = sqlx::PgPool::connect(&database).await.unwrap();
            for statement in STATEMENTS_OF_0_1_0 {
                assert!(sqlx::query(statement).execute(&pool).await.is_err(), "{statement}");
            }
        });
        assert_runs_the_jobs(&fixture, &data, &["--database", &database]);
    }
}

#[test]
fn members_that_are_missing_are_found() {
    let old = json!({"a": [{"b": 1, "last_used": 2}]});
    assert_holds(&old, &json!({"a": [{"b": 1, "c": 3}], "d": 4}), "");
    for new in [json!({}), json!({"a": []}), json!({"a": [{"b": 2}]}), json!({"a": [{}]})] {
        assert!(std::panic::catch_unwind(|| assert_holds(&old, &new, "")).is_err(), "{new}");
    }
}
