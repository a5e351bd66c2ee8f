//! A client that sends a file to whichever server a balancer leads it to.

use super::{Program, client, jpeg};
use reqwest::StatusCode;
use reqwest::blocking::{Body, Client};
use serde_json::{Value, json};
use sha2::Digest;
use std::io::Read;
use std::path::Path;
use std::process::{Command, Stdio};

fn put(client: &Client, url: &str, from: usize, bytes: &[u8]) -> StatusCode {
    let request = client.patch(url).header("tus-resumable", "1.0.0").header("upload-offset", from);
    let request = request.header("content-type", "application/offset+octet-stream");
    request.body(bytes.to_vec()).send().unwrap().status()
}

fn offset(client: &Client, url: &str) -> usize {
    let answer = client.head(url).header("tus-resumable", "1.0.0").send().unwrap();
    assert_eq!(answer.status(), StatusCode::OK, "{url}");
    answer.headers()["upload-offset"].to_str().unwrap().parse().unwrap()
}

fn begin(client: &Client, survey: &str, length: usize, concat: Option<&str>) -> String {
    let request = client.post(format!("{survey}/uploads")).header("tus-resumable", "1.0.0");
    let request = match concat {
        Some(concat) => request.header("upload-concat", concat),
        None => request,
    };
    let request = match concat {
        Some("partial") => request.header("upload-length", length),
        Some(_) => request.header("upload-metadata", "filename Yi5qcGc="),
        None => request.header("upload-length", length).header("upload-metadata", "filename YS5qcGc="),
    };
    let answer = request.send().unwrap();
    assert_eq!(answer.status(), StatusCode::CREATED, "{}", answer.text().unwrap());
    answer.headers()["location"].to_str().unwrap().to_owned()
}

/// Bytes that come at once, and others that come later.
struct Line {
    now: Vec<u8>,
    rest: std::sync::mpsc::Receiver<Vec<u8>>,
}

impl Read for Line {
    fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        if self.now.is_empty() {
            self.now = self.rest.recv().unwrap_or_default();
        }
        let count = self.now.len().min(buffer.len());
        buffer[..count].copy_from_slice(&self.now[..count]);
        self.now.drain(..count);
        Ok(count)
    }
}

fn hex(bytes: &[u8]) -> String {
    sha2::Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect()
}

fn digest(client: &Client, survey: &str, path: &str) -> Value {
    let survey: Value = client.get(survey).send().unwrap().json().unwrap();
    let file = survey["files"].as_array().unwrap().iter().find(|file| file["path"] == path);
    file.unwrap_or_else(|| panic!("no {path} in {survey}"))["sha256"].clone()
}

#[test]
#[ignore = "needs Postgres and an S3-compatible server; run `make unit`"]
fn an_upload_goes_on_at_whichever_server_is_there() {
    let [postgres, endpoint] = ["HELIOMAP_TEST_POSTGRES", "HELIOMAP_TEST_S3"].map(|name| std::env::var(name).unwrap());
    let place = tempfile::tempdir().unwrap();
    let name = place.path().file_name().unwrap().to_str().unwrap().trim_start_matches(".tmp").to_lowercase();
    let (database, prefix) = (format!("uploads_{name}"), format!("uploads-{name}"));
    let tools = std::env::var("HELIOMAP_TEST_POSTGRES_BIN").unwrap();
    let created = Command::new(Path::new(&tools).join("createdb"))
        .args(["--maintenance-db", &format!("{postgres}/postgres"), &database])
        .status()
        .unwrap();
    assert!(created.success());
    let serve = |server: &str| -> (Program, String) {
        let mut command = Command::new(env!("CARGO_BIN_EXE_heliomap"));
        command
            .args(["serve", "--insecure", "--no-worker", "--listen", "127.0.0.1:0"])
            .args([
                "--database",
                &format!("{postgres}/{database}"),
                "--blobs",
                &format!("s3://heliomap-tests/{prefix}"),
            ])
            .env("HELIOMAP_DATA_DIR", place.path().join(server))
            .envs(super::bucket_at(&endpoint));
        super::listening(command, Stdio::null())
    };
    let client = client();
    let ((first, here), (_second, there)) = (serve("first"), serve("second"));
    let post = |path: &str, body: Value| -> Value {
        client.post(format!("{here}{path}")).json(&body).send().unwrap().json().unwrap()
    };
    let plant = post("/api/v1/plants", json!({"name": "A"}));
    let surveys = format!("/api/v1/plants/{}/surveys", plant["id"].as_str().unwrap());
    let survey = format!("{surveys}/{}", post(&surveys, json!({"name": "June"}))["id"].as_str().unwrap());

    let mut photo = jpeg();
    photo.extend((0..20_000_000_u32).map(|k| (k.wrapping_mul(2_654_435_761) >> 24) as u8));
    let expected = hex(&photo);
    let upload = begin(&client, &format!("{here}{survey}"), photo.len(), None);
    assert_eq!(put(&client, &format!("{here}{upload}"), 0, &photo[..9_000_000]), StatusCode::NO_CONTENT);
    // The server that took the first bytes is gone, and its disk with it.
    drop(first);
    std::fs::remove_dir_all(place.path().join("first")).unwrap();
    assert_eq!(offset(&client, &format!("{there}{upload}")), 9_000_000);
    assert_eq!(
        put(&client, &format!("{there}{upload}"), 9_000_000, &photo[9_000_000..15_000_000]),
        StatusCode::NO_CONTENT
    );
    // Another one is there, which then is not the only one that goes on.
    let (_third, elsewhere) = serve("third");
    assert_eq!(
        put(&client, &format!("{elsewhere}{upload}"), 15_000_000, &photo[15_000_000..17_000_000]),
        StatusCode::NO_CONTENT
    );
    assert_eq!(
        put(&client, &format!("{there}{upload}"), 15_000_000, &photo[15_000_000..16_000_000]),
        StatusCode::CONFLICT
    );
    assert_eq!(put(&client, &format!("{there}{upload}"), 17_000_000, &photo[17_000_000..]), StatusCode::NO_CONTENT);
    assert_eq!(digest(&client, &format!("{elsewhere}{survey}"), "images/a.jpg"), expected);
    assert_eq!(offset(&client, &format!("{elsewhere}{upload}")), photo.len());

    // A line that nobody uses any more holds bytes that never count, whichever server they came to.
    photo.push(0);
    let upload = begin(&client, &format!("{there}{survey}"), photo.len(), None);
    let (more, rest) = std::sync::mpsc::channel();
    let (line, url, first) = (client.clone(), format!("{there}{upload}"), photo[..9_000_000].to_vec());
    let stale = std::thread::spawn(move || {
        let request = line.patch(url).header("tus-resumable", "1.0.0").header("upload-offset", 0);
        let request = request.header("content-type", "application/offset+octet-stream");
        request.body(Body::new(Line { now: first, rest })).send().unwrap().status()
    });
    while offset(&client, &format!("{elsewhere}{upload}")) == 0 {
        std::thread::sleep(std::time::Duration::from_millis(50));
    }
    let counted = offset(&client, &format!("{elsewhere}{upload}"));
    let end = counted + 1_000_000;
    assert_eq!(put(&client, &format!("{elsewhere}{upload}"), counted, &photo[counted..end]), StatusCode::NO_CONTENT);
    more.send(vec![7; 3_000_000]).unwrap();
    drop(more);
    assert_eq!(stale.join().unwrap(), StatusCode::BAD_REQUEST, "another request went on with the upload");
    assert_eq!(put(&client, &format!("{there}{upload}"), end, &photo[end..]), StatusCode::NO_CONTENT);
    assert_eq!(digest(&client, &format!("{there}{survey}"), "images/a.jpg"), hex(&photo));

    // Parts that went to two servers become one file at either.
    photo.push(0);
    let expected = hex(&photo);
    let (left, right) = photo.split_at(12_000_000);
    let parts = [(&there, left), (&elsewhere, right)].map(|(server, bytes)| {
        let part = begin(&client, &format!("{server}{survey}"), bytes.len(), Some("partial"));
        assert_eq!(put(&client, &format!("{server}{part}"), 0, bytes), StatusCode::NO_CONTENT);
        part
    });
    begin(&client, &format!("{there}{survey}"), 0, Some(&format!("final;{} {}", parts[0], parts[1])));
    assert_eq!(digest(&client, &format!("{there}{survey}"), "images/b.jpg"), expected);

    let list = format!("{endpoint}/heliomap-tests?list-type=2&prefix={prefix}/");
    let left = client.get(list).send().unwrap().text().unwrap();
    assert_eq!(left.matches("<Key>").count(), 3, "the pieces are gone, and three photos are left: {left}");
    assert_eq!(std::fs::read_dir(place.path().join("third/incoming")).unwrap().count(), 0);
}
