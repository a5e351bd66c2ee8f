//! The bytes of files that other files replaced.

use crate::app::{Act, App, jpeg, plant_path};
use heliomap::store::Digest;
use heliomap::store::freeing::free_unused;
use jiff::{SignedDuration, Timestamp};
use reqwest::StatusCode;
use serde_json::json;
use std::cell::Cell;
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

/// Whoever was to delete them died: the next upload of the same bytes does not wait for anybody else to notice.
#[tokio::test]
async fn whose_deletion_was_abandoned_come_anew() {
    let app = App::new(&[]).await;
    let survey = app.survey().await;
    let [old, new] = [8, 9].map(|width| jpeg(width, 8));
    put(&app, &survey, "a.jpg", &old).await;
    put(&app, &survey, "a.jpg", &new).await;
    let (begun, lease) = (Timestamp::now() - SignedDuration::from_secs(90), Duration::from_secs(60));
    let before = Timestamp::now() + SignedDuration::from_secs(1);
    assert_eq!(app.store.take_unused_blobs(before, lease, 10, begun).await.unwrap().len(), 1);
    put(&app, &survey, "b.jpg", &old).await;
    assert_eq!((keeps(&app, &survey, &old), kept_bytes(&app).await), (true, old.len() + new.len()));
}

/// Clients send the same few photos over each other while whatever nothing names is deleted at once: what the surveys name is
/// there, and nothing else.
#[tokio::test]
async fn never_go_while_something_names_them() {
    let app = App::new(&[]).await;
    let june = app.survey().await;
    let (_, july) = app.post(&format!("{}/surveys", plant_path(&june)), json!({"name": "July"})).await;
    let surveys = [june.clone(), format!("{}/surveys/{}", plant_path(&june), july["id"].as_str().unwrap())];
    let photos: Vec<Vec<u8>> = (8..13).map(|width| jpeg(width, 8)).collect();
    let mut most = 0;
    for round in 0..20 {
        let uploads = (0..8).map(|client| {
            let turn = client * 7 + round * 17;
            let (path, photo) = (format!("{}/images/{}.jpg", surveys[turn % 2], turn % 3), photos[turn % 5].clone());
            let app = &app;
            async move {
                let (status, answer) = app.put(&path, photo).await;
                // Where nothing is kept for any time, the bytes of an upload may go before they have a name.
                assert!(status.is_success() || answer["code"] == "unavailable", "{answer}");
            }
        });
        let done = Cell::new(false);
        let uploads = async {
            futures::future::join_all(uploads).await;
            done.set(true);
        };
        let freeing = async {
            while !done.get() {
                free(&app).await;
                tokio::task::yield_now().await;
            }
            free(&app).await;
        };
        futures::future::join(uploads, freeing).await;
        most = most.max(what_is_named_is_there(&app, &surveys, &photos).await);
    }
    assert!(most > 1, "{most}");
}

/// And nothing else; how many photos that are.
async fn what_is_named_is_there(app: &App, surveys: &[String; 2], photos: &[Vec<u8>]) -> usize {
    let mut named = std::collections::BTreeSet::new();
    for survey in surveys {
        for file in app.get(survey).await.1["files"].as_array().unwrap() {
            named.insert(file["sha256"].as_str().unwrap().to_owned());
        }
    }
    for photo in photos {
        assert_eq!(keeps(app, &surveys[0], photo), named.contains(&Digest::of(photo).to_string()));
    }
    let sizes = photos.iter().filter(|photo| named.contains(&Digest::of(photo).to_string())).map(Vec::len);
    assert_eq!(kept_bytes(app).await, sizes.sum::<usize>());
    named.len()
}
