//! The bytes of files that other files replaced.

use crate::app::{Act, App, jpeg, plant_path};
use heliomap::store::Digest;
use heliomap::store::freeing::free_unused;
use jiff::{SignedDuration, Timestamp};
use reqwest::StatusCode;
use serde_json::json;
use std::time::Duration;

/// Whether a plant keeps these bytes.
fn keeps(app: &App, survey: &str, bytes: &[u8]) -> bool {
    let (plant, digest) = (plant_path(survey).rsplit('/').next().unwrap(), Digest::of(bytes).to_string());
    app.folder.path().join(format!("blobs/plants/{plant}/{}/{digest}", &digest[..2])).is_file()
}

/// Deletes what is unused now; how many blobs that were.
async fn free(app: &App) -> usize {
    free_unused(&*app.store, &app.blobs(), Timestamp::now() + SignedDuration::from_secs(1)).await.unwrap()
}

async fn put(app: &App, survey: &str, name: &str, bytes: &[u8]) {
    let (status, answer) = app.put(&format!("{survey}/images/{name}"), bytes.to_vec()).await;
    assert!(status.is_success(), "{answer}");
}

async fn kept_bytes(app: &App) -> usize {
    app.get("/api/v1/usage").await.1["bytes"].as_u64().unwrap() as usize
}

#[tokio::test]
async fn go_once_nothing_needs_them() {
    let app = App::new(&[]).await;
    let june = app.survey().await;
    let (_, july) = app.post(&format!("{}/surveys", plant_path(&june)), json!({"name": "July"})).await;
    let july = format!("{}/surveys/{}", plant_path(&june), july["id"].as_str().unwrap());
    let [old, new] = [8, 9].map(|width| jpeg(width, 8));
    put(&app, &june, "a.jpg", &old).await;
    put(&app, &july, "b.jpg", &old).await;
    put(&app, &june, "a.jpg", &new).await;
    assert_eq!((free(&app).await, keeps(&app, &june, &old)), (0, true), "the other survey has them");
    put(&app, &july, "b.jpg", &new).await;
    // Not at once: a backup may have read the rows of before.
    let long_ago = Timestamp::now() - SignedDuration::from_hours(24);
    assert_eq!(free_unused(&*app.store, &app.blobs(), long_ago).await.unwrap(), 0);
    assert_eq!((keeps(&app, &june, &old), kept_bytes(&app).await), (true, old.len() + new.len()));
    assert_eq!((free(&app).await, keeps(&app, &june, &old), keeps(&app, &june, &new)), (1, false, true));
    assert_eq!(kept_bytes(&app).await, new.len());
    // They may come again.
    put(&app, &june, "c.jpg", &old).await;
    assert_eq!((free(&app).await, keeps(&app, &june, &old)), (0, true));
}

#[tokio::test]
async fn stay_while_a_job_of_the_plant_runs() {
    let app = App::new(&[Act::Wait]).await;
    let survey = app.complete_survey().await;
    let (_, job) = app.post(&format!("{survey}/jobs"), json!({})).await;
    app.follow_until(&job, |job| job["state"] == "running").await;
    // Both photos of the survey are of the same bytes.
    let (old, new) = (jpeg(32, 24), jpeg(16, 24));
    put(&app, &survey, "a.jpg", &new).await;
    put(&app, &survey, "b.jpg", &new).await;
    assert_eq!((free(&app).await, keeps(&app, &survey, &old)), (0, true));
    app.post(&format!("{}/cancel", crate::app::job_path(&job)), json!(null)).await;
    app.follow(&job).await;
    assert_eq!((free(&app).await, keeps(&app, &survey, &old)), (1, false));
}

#[tokio::test]
async fn that_are_just_being_deleted_come_anew() {
    let app = App::new(&[]).await;
    let survey = app.survey().await;
    let [old, new] = [8, 9].map(|width| jpeg(width, 8));
    put(&app, &survey, "a.jpg", &old).await;
    put(&app, &survey, "a.jpg", &new).await;
    let now = Timestamp::now() + SignedDuration::from_secs(1);
    let taken = app.store.take_unused_blobs(now, Duration::from_secs(60), 10, now).await.unwrap();
    assert_eq!(taken.len(), 1);
    // Somebody has taken them, and their bytes are still there: the upload must not rely on these.
    let path = format!("{survey}/images/b.jpg");
    let upload = app.put(&path, old.clone());
    let delete = async {
        tokio::time::sleep(Duration::from_millis(100)).await;
        app.blobs().delete(taken[0].blob.plant, taken[0].blob.sha256).await.unwrap();
        assert!(app.store.blob_is_gone(&taken[0]).await.unwrap());
    };
    let ((status, answer), ()) = futures::future::join(upload, delete).await;
    assert_eq!(status, StatusCode::CREATED, "{answer}");
    assert_eq!((keeps(&app, &survey, &old), kept_bytes(&app).await), (true, old.len() + new.len()));
}
