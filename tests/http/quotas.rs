//! What an organisation may keep, and no more.

use crate::app::{Act, App, assert_problem, jpeg, json_of, plant_path};
use crate::stub::{RECONSTRUCTION, REFERENCE, cloud};
use heliomap::config::Limits;
use heliomap::store::{OrganisationId, Quotas};
use reqwest::{Method, StatusCode};
use serde_json::json;

/// So much that what a survey needs fits, and little more.
const QUOTA: u64 = 8_000;

fn limits() -> Limits {
    Limits { quota_bytes: Some(QUOTA), quota_plants: Some(2), ..Limits::default() }
}

#[tokio::test]
async fn uploads_beyond_the_quota_are_refused_and_what_is_kept_is_told() {
    let app = App::with_limits(&[Act::Map(2)], limits()).await;
    let survey = app.complete_survey().await;
    let (_, usage) = app.get("/api/v1/usage").await;
    let bytes = usage["bytes"].as_u64().unwrap();
    // Two photos of the same bytes count once.
    let files = [jpeg(32, 24).len(), RECONSTRUCTION.len(), REFERENCE.len()];
    assert_eq!(bytes, files.iter().sum::<usize>() as u64);
    assert_eq!(usage, json!({"bytes": bytes, "announced_bytes": 0, "max_bytes": QUOTA, "plants": 1, "max_plants": 2}));

    let photo = jpeg(200, 150);
    assert!(photo.len() as u64 > QUOTA - bytes, "{}", photo.len());
    let put = || app.request(Method::PUT, &format!("{survey}/images/large.jpg"));
    let known = put().body(photo.clone()).send().await.unwrap();
    assert_problem(json_of(known).await, 507, "quota_exceeded", "higher quota");
    // Without a length it is told on the way.
    let pieces: Vec<_> = photo.chunks(512).map(|piece| Ok::<_, std::io::Error>(piece.to_vec())).collect();
    let body = reqwest::Body::wrap_stream(futures::stream::iter(pieces));
    let unknown = put().body(body).send().await.unwrap();
    assert_problem(json_of(unknown).await, 507, "quota_exceeded", "larger than");
    let begin = |length: u64| {
        let request = app.request(Method::POST, &format!("{survey}/uploads")).header("tus-resumable", "1.0.0");
        request.header("upload-length", length).header("upload-metadata", "filename Yi5qcGc=").send()
    };
    assert_problem(json_of(begin(QUOTA).await.unwrap()).await, 507, "quota_exceeded", "higher quota");
    // What was announced counts until it is stored or ended.
    let begun = begin(QUOTA - bytes).await.unwrap();
    assert_eq!(begun.status(), StatusCode::CREATED);
    assert_problem(json_of(begin(1).await.unwrap()).await, 507, "quota_exceeded", "keeps 8000 of the 8000 bytes");
    let upload = begun.headers()["location"].to_str().unwrap().to_owned();
    let end = app.request(Method::DELETE, &upload).header("tus-resumable", "1.0.0").send().await.unwrap();
    assert_eq!(end.status(), StatusCode::NO_CONTENT);

    // An archive that unpacks to more than fits.
    let mut archive = tar::Builder::new(flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::best()));
    let cloud = cloud(QUOTA as usize);
    let mut header = tar::Header::new_gnu();
    header.set_size(cloud.len() as u64);
    header.set_mode(0o644);
    archive.append_data(&mut header, "undistorted/depthmaps/merged.ply", cloud.as_slice()).unwrap();
    let archive = archive.into_inner().unwrap().finish().unwrap();
    assert!((archive.len() as u64) < QUOTA - bytes);
    let unpacked = app.put(&format!("{survey}/reconstruction"), archive).await;
    assert_problem(unpacked, 507, "quota_exceeded", "8000 bytes");

    let (_, found) = app.get(&survey).await;
    assert_eq!(found["files"].as_array().unwrap().len(), 4, "{found}");
    assert_eq!(app.get("/api/v1/usage").await.1, usage);
    // Jobs and their models are never refused.
    assert_eq!(app.map(&survey).await["state"], "succeeded");
    assert!(app.get("/api/v1/usage").await.1["bytes"].as_u64().unwrap() > bytes);
    let gone = app.request(Method::DELETE, plant_path(&survey)).send().await.unwrap();
    assert_eq!(gone.status(), StatusCode::NO_CONTENT);
    assert_eq!(app.get("/api/v1/usage").await.1["bytes"], 0);
}

#[tokio::test]
async fn an_organisation_has_as_many_plants_as_it_may() {
    let app = App::with_limits(&[], limits()).await;
    let create = async |name: &str| app.post("/api/v1/plants", json!({"name": name})).await;
    assert_eq!((create("one").await.0, create("two").await.0), (StatusCode::CREATED, StatusCode::CREATED));
    assert_problem(create("three").await, 507, "quota_exceeded", "2 of the 2 plants");
    assert_eq!(create("two").await.0, StatusCode::OK);
    app.store.set_quotas(OrganisationId::DEFAULT, Quotas { bytes: None, plants: Some(3) }).await.unwrap();
    assert_eq!(create("three").await.0, StatusCode::CREATED);
    assert_eq!(app.get("/api/v1/usage").await.1["max_plants"], 3);
}

#[tokio::test]
async fn what_is_kept_may_be_sent_again_whatever_room_there_is() {
    let app = App::with_limits(&[], limits()).await;
    let survey = app.complete_survey().await;
    let used = app.get("/api/v1/usage").await.1["bytes"].as_u64().unwrap();
    // Fills the quota but for a byte.
    let cloud = cloud((QUOTA - used - 1) as usize);
    let place = format!("{survey}/reconstruction/undistorted/depthmaps/merged.ply");
    assert_eq!(app.put(&place, cloud.clone()).await.0, StatusCode::CREATED);
    let full = app.get("/api/v1/usage").await.1;

    let (status, again) = app.put(&place, cloud.clone()).await;
    assert_eq!((status, &again["result"]), (StatusCode::OK, &json!("unchanged")), "{again}");
    let pieces: Vec<_> = cloud.chunks(512).map(|piece| Ok::<_, std::io::Error>(piece.to_vec())).collect();
    let (status, again) = app.put(&place, reqwest::Body::wrap_stream(futures::stream::iter(pieces))).await;
    assert_eq!((status, &again["result"]), (StatusCode::OK, &json!("unchanged")), "{again}");
    let part = reqwest::multipart::Part::bytes(jpeg(32, 24)).file_name("a.jpg");
    let form = reqwest::multipart::Form::new().part("file", part);
    let form = app.request(Method::POST, &format!("{survey}/images")).multipart(form).send().await.unwrap();
    let (status, again) = json_of(form).await;
    assert_eq!((status, &again["files"][0]["result"]), (StatusCode::OK, &json!("unchanged")), "{again}");
    let document = RECONSTRUCTION.as_bytes();
    let mut archive = tar::Builder::new(Vec::new());
    let mut header = tar::Header::new_gnu();
    header.set_size(document.len() as u64);
    header.set_mode(0o644);
    archive.append_data(&mut header, "reconstruction.json", document).unwrap();
    let (status, again) = app.put(&format!("{survey}/reconstruction"), archive.into_inner().unwrap()).await;
    assert_eq!((status, &again["files"][0]["result"]), (StatusCode::OK, &json!("unchanged")), "{again}");
    let photo = jpeg(32, 24);
    let begin = app.request(Method::POST, &format!("{survey}/uploads")).header("tus-resumable", "1.0.0");
    let begin = begin.header("upload-length", photo.len()).header("upload-metadata", "filename YS5qcGc=");
    let begun = begin.send().await.unwrap();
    assert_eq!(begun.status(), StatusCode::CREATED);
    let upload = begun.headers()["location"].to_str().unwrap().to_owned();
    let more = app.request(Method::PATCH, &upload).header("tus-resumable", "1.0.0").header("upload-offset", 0);
    let more = more.header("content-type", "application/offset+octet-stream").body(photo);
    assert_eq!(more.send().await.unwrap().status(), StatusCode::NO_CONTENT);
    assert_eq!(app.get("/api/v1/usage").await.1, full);

    // Others of the same size are others.
    let other = [&cloud[..cloud.len() - 1], b"\n"].concat();
    assert_problem(app.put(&place, other).await, 507, "quota_exceeded", "bytes");
    assert_problem(app.put(&format!("{survey}/images/c.jpg"), jpeg(33, 24)).await, 507, "quota_exceeded", "bytes");
}

#[tokio::test]
async fn uploads_that_begin_at_once_share_the_quota_and_are_as_many_as_there_may_be() {
    let begin = |app: &App, survey: &str, length: u64| {
        let request = app.request(Method::POST, &format!("{survey}/uploads")).header("tus-resumable", "1.0.0");
        let request = request.header("upload-length", length).header("upload-metadata", "filename Yi5qcGc=");
        async move { json_of(request.send().await.unwrap()).await }
    };
    let of_status = |answers: &[(StatusCode, serde_json::Value)], status| {
        answers.iter().filter(|answer| answer.0.as_u16() == status).count()
    };
    let app = App::with_limits(&[], limits()).await;
    let survey = app.survey().await;
    let answers = futures::future::join_all((0..8).map(|_| begin(&app, &survey, QUOTA * 2 / 5))).await;
    assert_eq!((of_status(&answers, 201), of_status(&answers, 507)), (2, 6), "{answers:?}");
    assert_eq!(std::fs::read_dir(app.folder.path().join("uploads")).unwrap().count(), 2);

    let app = App::with_limits(&[], Limits { max_uploads: 3, ..Limits::default() }).await;
    let survey = app.survey().await;
    let answers = futures::future::join_all((0..8).map(|_| begin(&app, &survey, 1_000))).await;
    assert_eq!((of_status(&answers, 201), of_status(&answers, 429)), (3, 5), "{answers:?}");
    assert_problem(begin(&app, &survey, 1_000).await, 429, "too_many_uploads", "3 unfinished uploads of the 3");
}
