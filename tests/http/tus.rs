//! Uploads that may be resumed.

use crate::app::{App, assert_problem, jpeg, json_of};
use crate::stub::RECONSTRUCTION;
use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use futures::StreamExt;
use heliomap::store::{Digest, UploadId};
use reqwest::{Method, RequestBuilder, Response, StatusCode};
use serde_json::{Value, json};
use std::time::Duration;

fn tus(app: &App, method: Method, path: &str) -> RequestBuilder {
    app.request(method, path).header("tus-resumable", "1.0.0")
}

/// `Upload-Metadata` of one name.
fn metadata(name: &str, value: &str) -> String {
    format!("{name} {}", BASE64_STANDARD.encode(value))
}

async fn begin(app: &App, survey: &str, length: usize, metadata: &str) -> String {
    let request = tus(app, Method::POST, &format!("{survey}/uploads")).header("upload-length", length);
    let answer = request.header("upload-metadata", metadata).send().await.unwrap();
    assert_eq!((answer.status(), &answer.headers()["tus-resumable"] == "1.0.0"), (StatusCode::CREATED, true));
    assert!(answer.headers()["upload-expires"].to_str().unwrap().ends_with("GMT"));
    answer.headers()["location"].to_str().unwrap().to_owned()
}

fn more(app: &App, upload: &str, offset: usize, bytes: &[u8]) -> RequestBuilder {
    let request = tus(app, Method::PATCH, upload).header("upload-offset", offset);
    request.header("content-type", "application/offset+octet-stream").body(bytes.to_vec())
}

async fn offset(app: &App, upload: &str) -> String {
    let answer = tus(app, Method::HEAD, upload).send().await.unwrap();
    assert_eq!(answer.status(), StatusCode::OK);
    assert_eq!(answer.headers()["cache-control"], "no-store");
    answer.headers()["upload-offset"].to_str().unwrap().to_owned()
}

async fn problem(answer: Response) -> (StatusCode, Value) {
    json_of(answer).await
}

#[tokio::test]
async fn a_photo_comes_in_pieces() {
    let app = App::new(&[]).await;
    let survey = app.survey().await;
    let photo = jpeg(64, 48);
    let upload = begin(&app, &survey, photo.len(), &metadata("filename", "a.jpg")).await;
    let (first, rest) = photo.split_at(100);
    let answer = more(&app, &upload, 0, first).send().await.unwrap();
    assert_eq!(
        (answer.status(), &answer.headers()["upload-offset"]),
        (StatusCode::NO_CONTENT, &"100".parse().unwrap())
    );
    assert_eq!(offset(&app, &upload).await, "100");
    let again = more(&app, &upload, 0, first).send().await.unwrap();
    assert_problem(problem(again).await, 409, "upload_offset", "100 bytes are safe");
    assert_eq!(more(&app, &upload, 100, rest).send().await.unwrap().status(), StatusCode::NO_CONTENT);
    let (_, view) = app.get(&upload).await;
    assert_eq!(view["outcome"]["files"][0]["path"], "images/a.jpg");
    assert_eq!(view["outcome"]["files"][0]["sha256"], Digest::of(&photo).to_string());
    assert_eq!(offset(&app, &upload).await, photo.len().to_string());
    let (_, survey) = app.get(&survey).await;
    assert_eq!(survey["files"][0]["width_px"], 64);
    assert_eq!(std::fs::read_dir(app.folder.path().join("uploads")).unwrap().count(), 0);
}

#[tokio::test]
async fn what_came_before_the_line_broke_counts() {
    let app = App::new(&[]).await;
    let survey = app.survey().await;
    let photo = jpeg(64, 48);
    let upload = begin(&app, &survey, photo.len(), &metadata("filename", "a.jpg")).await;
    let pieces = [Ok(photo[..200].to_vec()), Err(std::io::Error::other("the line breaks"))];
    let body = reqwest::Body::wrap_stream(futures::stream::iter(pieces).then(|piece| async {
        tokio::time::sleep(std::time::Duration::from_millis(100)).await;
        piece
    }));
    let broken = tus(&app, Method::PATCH, &upload).header("upload-offset", 0);
    broken.header("content-type", "application/offset+octet-stream").body(body).send().await.unwrap_err();
    // Asking how far it is takes the upload from the broken request.
    let begun = std::time::Instant::now();
    while offset(&app, &upload).await != "200" {
        assert!(begun.elapsed().as_secs() < 20, "what came does not count");
        tokio::time::sleep(std::time::Duration::from_millis(10)).await;
    }
    assert_eq!(more(&app, &upload, 200, &photo[200..]).send().await.unwrap().status(), StatusCode::NO_CONTENT);
    assert_eq!(app.get(&survey).await.1["files"][0]["sha256"], Digest::of(&photo).to_string());
}

#[tokio::test]
async fn a_whole_upload_may_be_ended_again() {
    let app = App::new(&[]).await;
    let survey = app.survey().await;
    let photo = jpeg(64, 48);
    let upload = begin(&app, &survey, photo.len(), &metadata("filename", "a.jpg")).await;
    assert_eq!(more(&app, &upload, 0, &photo).send().await.unwrap().status(), StatusCode::NO_CONTENT);
    let end = photo.len();
    let again = more(&app, &upload, end, b"").send().await.unwrap();
    let told = again.headers()["upload-offset"].to_str().unwrap().to_owned();
    assert_eq!((again.status(), told), (StatusCode::NO_CONTENT, end.to_string()));
    // The request whose answer was lost, and one whose length is not told.
    let repeated = more(&app, &upload, 0, &photo).send().await.unwrap();
    assert_problem(problem(repeated).await, 409, "upload_offset", "ask with HEAD");
    assert_problem(
        problem(more(&app, &upload, end, b"x").send().await.unwrap()).await,
        400,
        "bad_request",
        "more than",
    );
    let unmeasured = tus(&app, Method::PATCH, &upload).header("upload-offset", end);
    let unmeasured = unmeasured.header("content-type", "application/offset+octet-stream");
    let surplus = reqwest::Body::wrap_stream(futures::stream::iter([Ok::<_, std::io::Error>("x")]));
    assert_problem(problem(unmeasured.body(surplus).send().await.unwrap()).await, 400, "bad_request", "more than");
    assert_eq!(app.get(&survey).await.1["files"][0]["sha256"], Digest::of(&photo).to_string());
}

/// A request that brings `first`, and `rest` once it is told to; nothing more where it never is.
fn brings_more_later(
    app: &App,
    upload: &str,
    [first, rest]: [Vec<u8>; 2],
    headers: Vec<(&'static str, String)>,
) -> (tokio::sync::oneshot::Sender<()>, tokio::task::JoinHandle<Response>) {
    let (go_on, told) = tokio::sync::oneshot::channel::<()>();
    let rest = async move { if told.await.is_ok() { Ok(rest) } else { std::future::pending().await } };
    let pieces = futures::stream::once(async { Ok::<_, std::io::Error>(first) }).chain(futures::stream::once(rest));
    let request = tus(app, Method::PATCH, upload).header("upload-offset", 0);
    let request = request.header("content-type", "application/offset+octet-stream");
    let request = headers.into_iter().fold(request, |request, (name, value)| request.header(name, value));
    let request = request.body(reqwest::Body::wrap_stream(pieces));
    (go_on, tokio::spawn(async move { request.send().await.unwrap() }))
}

/// Waits until some of an upload's bytes are on disk.
async fn some_came(app: &App, upload: &str) {
    let file = app.folder.path().join("uploads").join(upload.rsplit('/').next().unwrap());
    for _ in 0..24_000 {
        if std::fs::metadata(&file).unwrap().len() > 0 {
            return;
        }
        tokio::time::sleep(std::time::Duration::from_millis(5)).await;
    }
    panic!("nothing comes");
}

/// A reconstruction of a megabyte, in two pieces.
fn large() -> [Vec<u8>; 2] {
    let document = format!("{RECONSTRUCTION}{}", " ".repeat(1 << 20)).into_bytes();
    let (first, rest) = document.split_at(600_000);
    [first.to_vec(), rest.to_vec()]
}

#[tokio::test]
async fn a_request_with_wrong_headers_leaves_a_running_one_alone() {
    let app = App::new(&[]).await;
    let survey = app.survey().await;
    let pieces = large();
    let length = pieces[0].len() + pieces[1].len();
    let upload = begin(&app, &survey, length, &metadata("path", "reconstruction.json")).await;
    let (go_on, running) = brings_more_later(&app, &upload, pieces, Vec::new());
    some_came(&app, &upload).await;

    let more = |offset: &'static str| {
        let request = app.request(Method::PATCH, &upload).header("upload-offset", offset).body("abc");
        request.header("content-type", "application/offset+octet-stream")
    };
    let with = |request: RequestBuilder| request.header("tus-resumable", "1.0.0").send();
    let typeless = tus(&app, Method::PATCH, &upload).header("upload-offset", "0").body("abc").send();
    assert_problem(problem(typeless.await.unwrap()).await, 415, "unsupported_media_type", "offset+octet-stream");
    assert_problem(problem(more("0").send().await.unwrap()).await, 412, "tus_version", "");
    for (offset, status, code) in [("5", 409, "upload_offset"), ("-1", 400, "bad_request")] {
        assert_problem(problem(with(more(offset)).await.unwrap()).await, status, code, "");
    }
    for checksum in ["md5 AAAA", "sha256 AAAA", "sha1"] {
        let wrong = more("0").header("upload-checksum", checksum);
        assert_problem(problem(with(wrong).await.unwrap()).await, 400, "bad_request", "Upload-Checksum");
    }
    let too_much = with(more("0").body(vec![b' '; length + 1])).await.unwrap();
    assert_problem(problem(too_much).await, 400, "bad_request", "were announced");
    let post = app.request(Method::POST, &upload).header("x-http-method-override", "PATCH").body("abc");
    assert_problem(problem(with(post).await.unwrap()).await, 415, "unsupported_media_type", "");

    assert!(!running.is_finished());
    go_on.send(()).unwrap();
    assert_eq!(running.await.unwrap().status(), StatusCode::NO_CONTENT);
    assert_eq!(app.get(&survey).await.1["files"][0]["size"], json!(length));
}

#[tokio::test]
async fn a_request_with_the_right_headers_takes_the_upload_over() {
    let app = App::new(&[]).await;
    let survey = app.survey().await;
    let pieces = large();
    let whole = pieces.concat();
    let upload = begin(&app, &survey, whole.len(), &metadata("path", "reconstruction.json")).await;
    // Its old connection is still open, and what it brought counts only as a whole.
    let sum = format!("sha256 {}", BASE64_STANDARD.encode(Digest::of(&whole).0));
    let (go_on, running) = brings_more_later(&app, &upload, pieces, vec![("upload-checksum", sum)]);
    some_came(&app, &upload).await;
    assert_eq!(more(&app, &upload, 0, &whole).send().await.unwrap().status(), StatusCode::NO_CONTENT);
    assert_problem(problem(running.await.unwrap()).await, 400, "upload_interrupted", "newer request");
    drop(go_on);
    assert_eq!(app.get(&survey).await.1["files"][0]["sha256"], Digest::of(&whole).to_string());
}

#[tokio::test]
async fn checksums_are_checked() {
    let app = App::new(&[]).await;
    let survey = app.survey().await;
    let photo = jpeg(64, 48);
    let upload = begin(&app, &survey, photo.len(), &metadata("filename", "a.jpg")).await;
    let sum = |bytes: &[u8]| format!("sha256 {}", BASE64_STANDARD.encode(Digest::of(bytes).0));
    let changed = more(&app, &upload, 0, &photo[..50]).header("upload-checksum", sum(b"other")).send().await.unwrap();
    assert_problem(problem(changed).await, 460, "checksum_mismatch", "send them again");
    assert_eq!(offset(&app, &upload).await, "0");
    let unknown = more(&app, &upload, 0, &photo[..50]).header("upload-checksum", "md5 AAAA").send().await.unwrap();
    assert_problem(problem(unknown).await, 400, "bad_request", "sha1,sha256");
    // `printf abc | sha1sum`
    let part = begin(&app, &survey, 9, &metadata("filename", "b.jpg")).await;
    let sha1 = "sha1 qZk+NkcGgWq6PiVxeFDCbJzQ2J0=";
    let abc = more(&app, &part, 0, b"abc").header("upload-checksum", sha1).send().await.unwrap();
    assert_eq!(abc.status(), StatusCode::NO_CONTENT);
    let good = more(&app, &upload, 0, &photo).header("upload-checksum", sum(&photo)).send().await.unwrap();
    assert_eq!(good.status(), StatusCode::NO_CONTENT);

    let put =
        |digest: String| app.request(Method::PUT, &format!("{survey}/images/c.jpg")).header("repr-digest", digest);
    let told = |bytes: &[u8]| format!("sha-512=:AA==:, sha-256=:{}:", BASE64_STANDARD.encode(Digest::of(bytes).0));
    let changed = put(told(b"other")).body(photo.clone()).send().await.unwrap();
    assert_problem(problem(changed).await, 422, "checksum_mismatch", "repr-digest");
    assert_eq!(put(told(&photo)).body(photo.clone()).send().await.unwrap().status(), StatusCode::CREATED);
}

#[tokio::test]
async fn a_file_is_put_together_from_its_parts() {
    let app = App::new(&[]).await;
    let survey = app.survey().await;
    let photo = jpeg(64, 48);
    let mut parts = Vec::new();
    for bytes in [&photo[..300], &photo[300..]] {
        let request = tus(&app, Method::POST, &format!("{survey}/uploads")).header("upload-concat", "partial");
        let answer = request.header("upload-length", bytes.len()).send().await.unwrap();
        let part = answer.headers()["location"].to_str().unwrap().to_owned();
        more(&app, &part, 0, bytes).send().await.unwrap();
        parts.push(part);
    }
    let join = async |urls: String| {
        let request = tus(&app, Method::POST, &format!("{survey}/uploads")).header("upload-concat", urls);
        json_of(request.header("upload-metadata", metadata("filename", "a.jpg")).send().await.unwrap()).await
    };
    let lonely = begin(&app, &survey, 5, &metadata("filename", "b.jpg")).await;
    assert_problem(join(format!("final;{lonely}")).await, 400, "bad_request", "no part that is whole");
    let twice = format!("final;{} {}", parts.join(" "), parts[0]);
    assert_problem(join(twice).await, 400, "bad_request", "named twice");
    let concat = format!("final;{}", parts.join(" "));
    let request = tus(&app, Method::POST, &format!("{survey}/uploads")).header("upload-concat", &concat);
    let whole = request.header("upload-metadata", metadata("filename", "a.jpg")).send().await.unwrap();
    assert_eq!(whole.status(), StatusCode::CREATED);
    let whole = whole.headers()["location"].to_str().unwrap().to_owned();
    let told = tus(&app, Method::HEAD, &whole).send().await.unwrap();
    assert_eq!((told.status(), told.headers()["upload-concat"].to_str().unwrap()), (StatusCode::OK, concat.as_str()));
    assert_eq!(app.get(&survey).await.1["files"][0]["sha256"], Digest::of(&photo).to_string());
    assert_problem(app.get(&parts[0]).await, 404, "upload_not_found", "begin a new one");
}

#[tokio::test]
async fn an_archive_may_be_resumed_too() {
    let app = App::new(&[]).await;
    let survey = app.survey().await;
    let mut archive = tar::Builder::new(Vec::new());
    let document = RECONSTRUCTION.as_bytes();
    let mut header = tar::Header::new_ustar();
    header.set_size(document.len() as u64);
    archive.append_data(&mut header, "reconstruction.json", document).unwrap();
    let archive = archive.into_inner().unwrap();
    let upload = begin(&app, &survey, archive.len(), &metadata("path", "reconstruction")).await;
    assert_eq!(more(&app, &upload, 0, &archive).send().await.unwrap().status(), StatusCode::NO_CONTENT);
    assert_eq!(app.get(&survey).await.1["files"][0]["path"], "reconstruction.json");
}

#[tokio::test]
async fn a_file_that_is_refused_says_why() {
    let app = App::new(&[]).await;
    let survey = app.survey().await;
    let upload = begin(&app, &survey, 7, &metadata("filename", "a.jpg")).await;
    let refused = more(&app, &upload, 0, b"no jpeg").send().await.unwrap();
    assert_problem(problem(refused).await, 422, "image_unreadable", "images/a.jpg");
    assert_eq!(app.get(&upload).await.1["outcome"]["problem"]["code"], "image_unreadable");
    let again = more(&app, &upload, 7, b"").send().await.unwrap();
    assert_problem(problem(again).await, 422, "image_unreadable", "images/a.jpg");
    assert_eq!(app.get(&survey).await.1["files"], json!([]));
    let ended = json_of(tus(&app, Method::DELETE, &upload).send().await.unwrap()).await;
    assert_eq!(ended.0, StatusCode::NO_CONTENT);
    assert_problem(app.get(&upload).await, 404, "upload_not_found", "");
}

#[tokio::test]
async fn a_ground_station_finds_again_what_it_began() {
    let app = App::new(&[]).await;
    let survey = app.survey().await;
    let uploads = format!("{survey}/uploads");
    assert_eq!(app.get(&uploads).await.1, json!({"items": []}));
    let photo = jpeg(64, 48);
    let half = begin(&app, &survey, photo.len(), &metadata("filename", "half.jpg")).await;
    more(&app, &half, 0, &photo[..100]).send().await.unwrap();
    let whole = begin(&app, &survey, photo.len(), &metadata("filename", "whole.jpg")).await;
    more(&app, &whole, 0, &photo).send().await.unwrap();
    let broken = begin(&app, &survey, 7, &metadata("path", "reconstruction")).await;
    more(&app, &broken, 0, b"no file").send().await.unwrap();
    let part = tus(&app, Method::POST, &uploads).header("upload-concat", "partial").header("upload-length", 5);
    let part = part.send().await.unwrap().headers()["location"].to_str().unwrap().to_owned();

    let listed = async |query: &str| -> Vec<(String, Value)> {
        let (mut next, mut seen) = (format!("{uploads}?limit=1&{query}"), Vec::new());
        loop {
            let (status, list) = app.get(&next).await;
            assert_eq!((status, list["items"].as_array().unwrap().len() <= 1), (StatusCode::OK, true), "{list}");
            let items = list["items"].as_array().unwrap().iter();
            seen.extend(items.map(|item| (item["location"].as_str().unwrap().to_owned(), item.clone())));
            match list["next"].as_str() {
                Some(link) => next = link.to_owned(),
                None => break,
            }
        }
        seen.sort_by(|a, b| a.0.cmp(&b.0));
        seen
    };
    let places = |list: &[(String, Value)]| list.iter().map(|(place, _)| place.clone()).collect::<Vec<_>>();
    let sorted = |mut places: Vec<&String>| {
        places.sort();
        places.into_iter().cloned().collect::<Vec<_>>()
    };
    assert_eq!(places(&listed("").await), sorted(vec![&half, &whole, &broken, &part]));
    let unfinished = listed("state=unfinished").await;
    assert_eq!(places(&unfinished), sorted(vec![&half, &part]));
    let (_, told) = unfinished.iter().find(|(place, _)| *place == half).unwrap();
    assert_eq!((&told["path"], &told["offset"]), (&json!("images/half.jpg"), &json!(100)));
    assert!(unfinished.iter().any(|(place, told)| *place == part && told.get("path").is_none()));
    let refused = listed("state=refused").await;
    assert_eq!((places(&refused), &refused[0].1["path"]), (vec![broken], &json!("reconstruction")));
    assert_eq!(refused[0].1["outcome"]["problem"]["code"], "unsupported_archive");
    let stored = listed("state=stored").await;
    assert_eq!(
        (places(&stored), &stored[0].1["outcome"]["files"][0]["path"]),
        (vec![whole], &json!("images/whole.jpg"))
    );
    // And it goes on with what it found.
    assert_eq!(more(&app, &half, 100, &photo[100..]).send().await.unwrap().status(), StatusCode::NO_CONTENT);
    assert_eq!(places(&listed("state=unfinished").await), [part]);
    for query in ["state=lost", "cursor=x", "limit=0", "unknown=1"] {
        assert_problem(app.get(&format!("{uploads}?{query}")).await, 400, "invalid_query", "");
    }
}

#[tokio::test]
async fn an_upload_whose_bytes_are_elsewhere_begins_anew() {
    let app = App::new(&[]).await;
    let survey = app.survey().await;
    let photo = jpeg(64, 48);
    let upload = begin(&app, &survey, photo.len(), &metadata("filename", "a.jpg")).await;
    more(&app, &upload, 0, &photo[..100]).send().await.unwrap();
    // As where another machine took the first bytes.
    std::fs::remove_file(app.folder.path().join("uploads").join(upload.rsplit('/').next().unwrap())).unwrap();
    let head = tus(&app, Method::HEAD, &upload).send().await.unwrap();
    assert_eq!(head.status(), StatusCode::NOT_FOUND);
    let goes_on = more(&app, &upload, 100, &photo[100..]).send().await.unwrap();
    assert_problem(problem(goes_on).await, 404, "upload_not_found", "begin a new one");
    let request = tus(&app, Method::POST, &format!("{survey}/uploads")).header("upload-concat", "partial");
    let answer = request.header("upload-length", 3).send().await.unwrap();
    let part = answer.headers()["location"].to_str().unwrap().to_owned();
    more(&app, &part, 0, b"abc").send().await.unwrap();
    std::fs::remove_file(app.folder.path().join("uploads").join(part.rsplit('/').next().unwrap())).unwrap();
    let request =
        tus(&app, Method::POST, &format!("{survey}/uploads")).header("upload-concat", format!("final;{part}"));
    let joined = request.header("upload-metadata", metadata("filename", "a.jpg")).send().await.unwrap();
    assert_problem(problem(joined).await, 404, "upload_not_found", "begin a new one");
    assert_eq!(tus(&app, Method::DELETE, &upload).send().await.unwrap().status(), StatusCode::NO_CONTENT);
}

#[tokio::test]
async fn wrong_requests_are_refused() {
    let app = App::new(&[]).await;
    let survey = app.survey().await;
    let uploads = format!("{survey}/uploads");
    let options = app.request(Method::OPTIONS, &uploads).send().await.unwrap();
    assert_eq!(options.status(), StatusCode::NO_CONTENT);
    assert_eq!(options.headers()["tus-extension"], "creation,expiration,checksum,termination,concatenation");
    let old = app.request(Method::POST, &uploads).send().await.unwrap();
    assert_eq!(old.headers()["tus-version"], "1.0.0");
    assert_problem(problem(old).await, 412, "tus_version", "1.0.0");
    let create = async |length: &str, metadata: &str| {
        let request = tus(&app, Method::POST, &uploads).header("upload-length", length);
        problem(request.header("upload-metadata", metadata).send().await.unwrap()).await
    };
    assert_problem(create("5", "").await, 400, "bad_request", "filename");
    assert_problem(create("5", "filename ???").await, 400, "bad_request", "base64");
    assert_problem(create("-5", &metadata("filename", "a.jpg")).await, 400, "bad_request", "upload-length");
    assert_problem(create("5", &metadata("filename", "../a.jpg")).await, 422, "invalid_name", "../a.jpg");
    assert_problem(create("5", &metadata("path", "etc/passwd")).await, 422, "unknown_file", "etc/passwd");
    let huge = create("99999999999999", &metadata("filename", "a.jpg")).await;
    assert_problem(huge, 413, "too_large", "limit");
    let upload = begin(&app, &survey, 3, &metadata("filename", "a.jpg")).await;
    let typeless = tus(&app, Method::PATCH, &upload).header("upload-offset", 0).body("abc").send().await.unwrap();
    assert_problem(problem(typeless).await, 415, "unsupported_media_type", "offset+octet-stream");
    let long = more(&app, &upload, 0, b"abcdef").send().await.unwrap();
    assert_problem(problem(long).await, 400, "bad_request", "3 bytes");
    // Clients that cannot send PATCH.
    let begun = begin(&app, &survey, 9, &metadata("filename", "a.jpg")).await;
    let post = tus(&app, Method::POST, &begun).header("x-http-method-override", "PATCH").header("upload-offset", 0);
    let post = post.header("content-type", "application/offset+octet-stream").body("abc").send().await.unwrap();
    assert_eq!(post.status(), StatusCode::NO_CONTENT);
}

#[tokio::test]
async fn a_whole_file_that_another_server_is_storing_is_busy() {
    let app = App::new(&[]).await;
    let survey = app.survey().await;
    let photo = jpeg(64, 48);
    let upload = begin(&app, &survey, photo.len(), &metadata("filename", "a.jpg")).await;
    let id = UploadId(upload.rsplit('/').next().unwrap().parse().unwrap());
    let (other, lease) = (uuid::Uuid::from_u128(7), Duration::from_secs(60));
    assert!(app.store.take_upload_end(id, other, lease, jiff::Timestamp::now()).await.unwrap());
    let last = more(&app, &upload, 0, &photo).send().await.unwrap();
    assert!(last.headers()["retry-after"].to_str().unwrap().parse::<u64>().unwrap() > 0);
    assert_problem(problem(last).await, 423, "upload_busy", "just being stored");
    let head = tus(&app, Method::HEAD, &upload).send().await.unwrap();
    assert_eq!(head.status(), StatusCode::LOCKED);
    // It could not store it: whoever is asked next does.
    app.store.end_upload(id, other, None).await.unwrap();
    assert_eq!(offset(&app, &upload).await, photo.len().to_string());
    let (_, view) = app.get(&upload).await;
    assert_eq!(view["state"], "stored", "{view}");
}
