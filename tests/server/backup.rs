//! A backup is taken while the service runs, and taken back in a new place: everything answers the same.

use super::{Program, client, jpeg, serve, start};
use reqwest::StatusCode;
use reqwest::blocking::Client;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};

/// Runs the program to its end; whether it succeeded, and what it said.
fn run(arguments: &[&str]) -> (bool, String) {
    let output = Command::new(env!("CARGO_BIN_EXE_heliomap")).args(arguments).output().unwrap();
    let said = [output.stdout, output.stderr].concat();
    (output.status.success(), String::from_utf8(said).unwrap())
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

fn post(client: &Client, url: &str, body: &Value) -> Value {
    let answer = client.post(url).json(body).send().unwrap();
    assert!(answer.status().is_success(), "{url}: {}", answer.text().unwrap());
    answer.json().unwrap()
}

fn get(client: &Client, url: &str) -> Value {
    let answer = client.get(url).send().unwrap();
    assert_eq!(answer.status(), StatusCode::OK, "{url}");
    answer.json().unwrap()
}

/// A plant with a mapped survey of the example, whose boxes come with it; its path.
fn mapped_plant(client: &Client, base: &str) -> String {
    let plant = post(client, &format!("{base}/api/v1/plants"), &json!({"name": "Mapped"}));
    let plant = format!("/api/v1/plants/{}", plant["id"].as_str().unwrap());
    let survey = post(client, &format!("{base}{plant}/surveys"), &json!({"name": "June"}));
    let survey = format!("{plant}/surveys/{}", survey["id"].as_str().unwrap());
    let example = Path::new(crate::boxes::EXAMPLE);
    let mut files: Vec<(String, Vec<u8>)> = std::fs::read_dir(example.join("images"))
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .map(|path| (format!("images/{}", path.file_name().unwrap().to_str().unwrap()), std::fs::read(path).unwrap()))
        .collect();
    for name in ["reconstruction.json", "reference_lla.json"] {
        files.push((format!("reconstruction/{name}"), std::fs::read(example.join(name)).unwrap()));
    }
    files.push(("reconstruction/boxes.json".to_owned(), crate::boxes::true_boxes(|_| true).to_string().into_bytes()));
    for (place, bytes) in files {
        let answer = client.put(format!("{base}{survey}/{place}")).body(bytes).send().unwrap();
        assert_eq!(answer.status(), StatusCode::CREATED, "{place}");
    }
    let job = post(client, &format!("{base}{survey}/jobs"), &json!({}));
    let job = super::follow(client, base, &job);
    assert_eq!(job["state"], "succeeded", "{job}");
    plant
}

/// Everything that the service tells of a plant.
fn told(client: &Client, base: &str, plant: &str) -> Vec<Value> {
    let mut told = vec![get(client, &format!("{base}{plant}"))];
    let surveys = get(client, &format!("{base}{plant}/surveys"));
    for survey in surveys["items"].as_array().unwrap() {
        let survey = format!("{base}{plant}/surveys/{}", survey["id"].as_str().unwrap());
        told.extend([get(client, &survey), get(client, &format!("{survey}/jobs"))]);
    }
    let models = get(client, &format!("{base}{plant}/models"));
    for model in models["items"].as_array().unwrap() {
        for layer in ["modules", "sectors", "benches", "lines"] {
            told.push(get(client, &format!("{base}{plant}/models/{}/{layer}", model["version"])));
        }
    }
    told.extend([surveys, models]);
    told
}

/// All blobs below a folder that is laid out like a data folder.
fn blobs(folder: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    let mut folders = vec![folder.join("blobs")];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() { folders.push(path) } else { found.push(path) }
        }
    }
    found.sort();
    found
}

#[test]
fn what_is_restored_answers_the_same() {
    if !Path::new(&std::env::var("ORT_DYLIB_PATH").unwrap_or_default()).is_file() {
        println!("skipped: no ONNX Runtime; `make setup` fetches it");
        return;
    }
    let place = tempfile::tempdir().unwrap();
    let [data, backup, back] = ["data", "backup", "back"].map(|name| place.path().join(name));
    let client = client();
    let (program, base) = serve(&data, &[]);
    let mapped = mapped_plant(&client, &base);
    let (survey, job) = super::broken_survey_with_job(&client, &base);
    super::follow(&client, &base, &job);
    let broken = survey.split_once("/surveys/").unwrap().0;

    // More comes while the backup is made, and an upload stands half-way.
    let upload = client
        .post(format!("{base}{survey}/uploads"))
        .header("tus-resumable", "1.0.0")
        .header("upload-length", "100")
        .header("upload-metadata", "filename YS5qcGc=")
        .send()
        .unwrap();
    assert_eq!(upload.status(), StatusCode::CREATED);
    let busy = post(&client, &format!("{base}/api/v1/plants"), &json!({"name": "Busy"}));
    let busy = format!("/api/v1/plants/{}", busy["id"].as_str().unwrap());
    let flight = post(&client, &format!("{base}{busy}/surveys"), &json!({"name": "June"}));
    let flight = format!("{base}{busy}/surveys/{}", flight["id"].as_str().unwrap());
    let first = client.put(format!("{flight}/images/first.jpg")).body(jpeg()).send().unwrap();
    assert_eq!(first.status(), StatusCode::CREATED);
    let done = AtomicBool::new(false);
    std::thread::scope(|scope| {
        let sending = scope.spawn(|| {
            let mut sent = 0;
            while !done.load(Ordering::Relaxed) {
                let mut photo = jpeg();
                photo.extend_from_slice(&u32::to_le_bytes(sent));
                let answer = client.put(format!("{flight}/images/{sent}.jpg")).body(photo).send().unwrap();
                assert_eq!(answer.status(), StatusCode::CREATED);
                sent += 1;
            }
            sent
        });
        let (ok, said) = run(&["backup", text(&backup), "--data-dir", text(&data)]);
        done.store(true, Ordering::Relaxed);
        assert!(ok, "{said}");
        assert!(sending.join().unwrap() > 0);
    });
    let before = [told(&client, &base, &mapped), told(&client, &base, broken)];
    assert!(program.terminate().success());

    let (ok, said) = run(&["restore", text(&backup), "--data-dir", text(&back)]);
    assert!(ok && said.contains("restored "), "{said}");
    let (ok, said) = run(&["verify", "--content", "--data-dir", text(&back)]);
    assert!(ok && said.contains("blobs are there"), "{said}");
    let (_program, base) = serve(&back, &["--no-worker"]);
    let after = [told(&client, &base, &mapped), told(&client, &base, broken)];
    assert_eq!(before, after);
    let flight = flight.split_once("/api/").unwrap().1;
    let files = get(&client, &format!("{base}/api/{flight}"));
    let count = files["files"].as_array().unwrap().len();
    assert!(count > 0, "what was there when the backup began is in it");
    // Uploads that were not whole are begun anew.
    let location = upload.headers()["location"].to_str().unwrap();
    let head = client.head(format!("{base}{location}")).header("tus-resumable", "1.0.0").send().unwrap();
    assert_eq!(head.status(), StatusCode::NOT_FOUND);
    let next = client.put(format!("{base}{survey}/images/c.jpg")).body(jpeg()).send().unwrap();
    assert_eq!(next.status(), StatusCode::CREATED);
    assert_eq!(std::fs::read_dir(back.join("incoming")).unwrap().count(), 0);
}

#[test]
fn a_backup_that_is_not_whole_is_not_restored() {
    let place = tempfile::tempdir().unwrap();
    let [data, backup, back] = ["data", "backup", "back"].map(|name| place.path().join(name));
    let client = client();
    let (_program, base) = serve(&data, &["--no-worker"]);
    super::broken_survey_with_job(&client, &base);
    let (ok, said) = run(&["backup", text(&backup), "--data-dir", text(&data)]);
    assert!(ok && said.contains("3 blobs"), "{said}");
    // Into a folder of its own, and back into one that has none.
    let (ok, said) = run(&["backup", text(&backup), "--data-dir", text(&data)]);
    assert!(!ok && said.contains("is not empty"), "{said}");
    let (ok, said) = run(&["restore", text(&backup), "--data-dir", text(&data)]);
    assert!(!ok && said.contains("--data-dir"), "{said}");
    let (ok, said) = run(&["backup", text(&back), "--data-dir", text(&place.path().join("nowhere"))]);
    assert!(!ok && said.contains("--data-dir"), "{said}");
    let (ok, said) = run(&["backup", text(&back), "--database", "postgres://127.0.0.1/x"]);
    assert!(!ok && said.contains("pg_dump"), "{said}");
    std::fs::remove_dir_all(&back).ok();

    let blob = blobs(&backup).pop().unwrap();
    let bytes = std::fs::read(&blob).unwrap();
    let refused = |what: &str| {
        let (ok, said) = run(&["restore", text(&backup), "--data-dir", text(&back)]);
        assert!(!ok && said.contains(what), "{said}");
        assert!(!back.join("heliomap.db").exists());
    };
    std::fs::write(&blob, [&bytes[1..], b"x"].concat()).unwrap();
    refused("is damaged");
    std::fs::remove_file(&blob).unwrap();
    refused("the backup lacks");
    std::fs::write(&blob, &bytes).unwrap();
    std::fs::rename(backup.join("backup.json"), backup.join("later")).unwrap();
    refused("is not a complete backup");
    std::fs::rename(backup.join("later"), backup.join("backup.json")).unwrap();
    let (ok, said) = run(&["restore", text(&backup), "--data-dir", text(&back)]);
    assert!(ok, "{said}");

    // What is lost afterwards is told.
    std::fs::remove_file(blobs(&back).pop().unwrap()).unwrap();
    let (ok, said) = run(&["verify", "--data-dir", text(&back)]);
    assert!(!ok && said.contains("it is missing") && said.contains("1 of 3 blobs"), "{said}");
}

/// What a killed service leaves beside its database is none of the one that takes its place, nor does what became of the
/// blobs matter.
#[test]
fn a_backup_is_restored_where_a_killed_service_was() {
    let place = tempfile::tempdir().unwrap();
    let [data, backup] = ["data", "backup"].map(|name| place.path().join(name));
    let client = client();
    let (program, base) = serve(&data, &["--no-worker"]);
    let (survey, _) = super::broken_survey_with_job(&client, &base);
    let plant = survey.split_once("/surveys/").unwrap().0;
    let before = told(&client, &base, plant);
    let (ok, said) = run(&["backup", text(&backup), "--data-dir", text(&data)]);
    assert!(ok, "{said}");
    for number in 0..300 {
        post(&client, &format!("{base}/api/v1/plants"), &json!({"name": format!("Later {number}")}));
    }
    drop(program);
    assert!(std::fs::metadata(data.join("heliomap.db-wal")).unwrap().len() > 0);
    std::fs::remove_file(data.join("heliomap.db")).unwrap();
    std::fs::write(data.join("heliomap.restoring-wal"), b"of a restore that was killed").unwrap();
    let [damaged, short, lost] = blobs(&data).try_into().unwrap();
    let bytes = std::fs::read(&damaged).unwrap();
    for (file, bytes) in [(&damaged, [&bytes[1..], b"x"].concat()), (&short, Vec::new())] {
        std::fs::remove_file(file).unwrap();
        std::fs::write(file, bytes).unwrap();
    }
    std::fs::remove_file(lost).unwrap();

    let (ok, said) = run(&["restore", text(&backup), "--data-dir", text(&data)]);
    assert!(ok, "{said}");
    let (ok, said) = run(&["verify", "--content", "--data-dir", text(&data)]);
    assert!(ok && said.contains("all 3 blobs"), "{said}");
    let (_program, base) = serve(&data, &["--no-worker"]);
    assert_eq!(told(&client, &base, plant), before);
    let plants = get(&client, &format!("{base}/api/v1/plants"));
    assert_eq!(plants["items"].as_array().unwrap().len(), 1, "what came after the backup is gone");
}

/// A command of another version changes nothing of a service's database.
#[tokio::test]
async fn a_database_of_an_older_version_is_left_as_it_is() {
    let place = tempfile::tempdir().unwrap();
    let [data, backup] = ["data", "backup"].map(|name| place.path().join(name));
    std::fs::create_dir(&data).unwrap();
    let rows = data.join("heliomap.db");
    let options = sqlx::sqlite::SqliteConnectOptions::new().filename(&rows).create_if_missing(true);
    let pool = sqlx::SqlitePool::connect_with(options).await.unwrap();
    let mut migrator = sqlx::migrate!("migrations/sqlite");
    let all = migrator.migrations.len();
    migrator.migrations.to_mut().truncate(all - 1);
    migrator.run(&pool).await.unwrap();
    let in_folder = |arguments: &[&str]| run(&[arguments, &["--data-dir", text(&data)]].concat());
    for command in [&["verify"][..], &["keys", "list"], &["keys", "create", "--name", "k", "--scope", "admin"]] {
        let (ok, said) = in_folder(command);
        assert!(!ok && said.contains("of an older version"), "{command:?}: {said}");
    }
    let (ok, said) = in_folder(&["backup", text(&backup)]);
    assert!(ok, "{said}");
    let made = "SELECT COUNT(*) FROM _sqlx_migrations";
    assert_eq!(sqlx::query_scalar::<_, i64>(made).fetch_one(&pool).await.unwrap(), all as i64 - 1);

    let later = "INSERT INTO _sqlx_migrations (version, description, success, checksum, execution_time) \
                 VALUES (99999999999999, 'later', TRUE, X'00', 0)";
    sqlx::query(later).execute(&pool).await.unwrap();
    for command in [&["backup", text(&place.path().join("second"))][..], &["verify"]] {
        let (ok, said) = in_folder(command);
        assert!(!ok && said.contains("of a newer version"), "{command:?}: {said}");
    }
}

/// Rows by Postgres' own tools, blobs by the bucket's: as docs/OPERATION.md says.
#[test]
#[ignore = "needs Postgres and an S3-compatible server; run `make unit`"]
fn postgres_and_a_bucket_are_restored_by_their_own_tools() {
    let [server, endpoint] = ["HELIOMAP_TEST_POSTGRES", "HELIOMAP_TEST_S3"].map(|name| std::env::var(name).unwrap());
    let tools = PathBuf::from(std::env::var("HELIOMAP_TEST_POSTGRES_BIN").unwrap());
    let tool = |name: &str, arguments: &[&str]| {
        let output = Command::new(tools.join(name)).args(arguments).output().unwrap();
        assert!(output.status.success(), "{name}: {}", String::from_utf8_lossy(&output.stderr));
    };
    let place = tempfile::tempdir().unwrap();
    let name = place.path().file_name().unwrap().to_str().unwrap().trim_start_matches(".tmp").to_lowercase();
    let [first, second] = ["a", "b"].map(|which| format!("backup_{which}_{name}"));
    for database in [&first, &second] {
        tool("createdb", &["--maintenance-db", &format!("{server}/postgres"), database]);
    }
    let env = super::bucket_at(&endpoint);
    let store = |database: &str| {
        [
            "--database".to_owned(),
            format!("{server}/{database}"),
            "--blobs".to_owned(),
            format!("s3://heliomap-tests/{database}"),
        ]
    };
    let command = |arguments: &[&str], database: &str| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_heliomap"));
        command.args(arguments).args(store(database)).envs(env).env("HELIOMAP_DATA_DIR", place.path().join(database));
        command
    };
    let client = client();
    let serve = |database: &str| -> (Program, String) {
        super::listening(command(&["serve", "--insecure", "--listen", "127.0.0.1:0"], database), Stdio::null())
    };
    let (program, base) = serve(&first);
    let (survey, job) = super::broken_survey_with_job(&client, &base);
    super::follow(&client, &base, &job);
    let plant = survey.split_once("/surveys/").unwrap().0;
    let before = told(&client, &base, plant);

    let dump = place.path().join("rows.dump");
    tool("pg_dump", &["--format", "custom", "--file", text(&dump), &format!("{server}/{first}")]);
    assert!(program.terminate().success());
    tool("pg_restore", &["--no-owner", "--dbname", &format!("{server}/{second}"), text(&dump)]);
    let verify = || {
        let output = command(&["verify", "--content"], &second).output().unwrap();
        (output.status.success(), String::from_utf8([output.stdout, output.stderr].concat()).unwrap())
    };
    let (ok, said) = verify();
    assert!(!ok && said.contains("3 of 3 blobs"), "{said}");
    // What `aws s3 sync` does: every object is copied under its key.
    let list =
        client.get(format!("{endpoint}/heliomap-tests?list-type=2&prefix={first}/")).send().unwrap().text().unwrap();
    for key in list.split("<Key>").skip(1).map(|rest| rest.split_once("</Key>").unwrap().0) {
        let copy = format!("{endpoint}/heliomap-tests/{}", key.replacen(&first, &second, 1));
        let copying = client.put(copy).header("x-amz-copy-source", format!("/heliomap-tests/{key}"));
        let answer = copying.send().unwrap();
        assert!(answer.status().is_success());
    }
    let (ok, said) = verify();
    assert!(ok && said.contains("all 3 blobs"), "{said}");
    let (_program, base) = serve(&second);
    assert_eq!(told(&client, &base, plant), before);
}

#[test]
fn the_backup_is_itself_a_data_folder() {
    let place = tempfile::tempdir().unwrap();
    let [data, backup] = ["data", "backup"].map(|name| place.path().join(name));
    let client = client();
    let (_program, base) = serve(&data, &["--no-worker"]);
    let (survey, _) = super::broken_survey_with_job(&client, &base);
    let (ok, said) = run(&["backup", text(&backup), "--data-dir", text(&data)]);
    assert!(ok, "{said}");
    let plant = survey.split_once("/surveys/").unwrap().0;
    let before = told(&client, &base, plant);
    let (_other, line) = start(&backup, &["serve", "--insecure", "--no-worker", "--listen", "127.0.0.1:0"]);
    let other = line.trim().strip_prefix("heliomap is listening on ").unwrap();
    assert_eq!(told(&client, other, plant), before);
}
