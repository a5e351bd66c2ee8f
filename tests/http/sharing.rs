//! The images of one survey, searched by several workers.

use crate::app::{App, job_path, plant_path};
use crate::broken::{Files, Knowing};
use heliomap::jobs::{Mapper, PipelineMapper};
use heliomap::store::{Blobs, TaskClaim};
use heliomap_mapping::detection::{Detection, DetectionError, Detector};
use image::RgbImage;
use jiff::Timestamp;
use reqwest::StatusCode;
use serde_json::{Value, json};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::Duration;

/// The images of the example plant that resolve modules.
const IMAGES: usize = 8;

/// Knows what is in the photos, takes its time, and counts.
struct Slow {
    knowing: Arc<Knowing>,
    takes: Duration,
    version: &'static str,
    searched: AtomicUsize,
    /// While it is raised, no image comes to its end.
    held: AtomicBool,
}

/// Holds a detector until it is dropped.
struct Held(Arc<Slow>);

impl Drop for Held {
    fn drop(&mut self) {
        self.0.held.store(false, Ordering::SeqCst);
    }
}

impl Slow {
    fn new(version: &'static str, takes: Duration) -> Arc<Self> {
        let (knowing, searched) = (Knowing::new(|_| true), AtomicUsize::new(0));
        Arc::new(Self { knowing, takes, version, searched, held: AtomicBool::new(false) })
    }

    fn hold(self: &Arc<Self>) -> Held {
        self.held.store(true, Ordering::SeqCst);
        Held(self.clone())
    }

    fn searched(&self) -> usize {
        self.searched.load(Ordering::SeqCst)
    }
}

impl Detector for Slow {
    fn detect(&self, image: &RgbImage, gsd_m: Option<f64>) -> Result<Vec<Detection>, DetectionError> {
        self.searched.fetch_add(1, Ordering::SeqCst);
        std::thread::sleep(self.takes);
        while self.held.load(Ordering::SeqCst) {
            std::thread::sleep(Duration::from_millis(2));
        }
        self.knowing.detect(image, gsd_m)
    }

    fn describe(&self) -> String {
        self.version.to_owned()
    }
}

fn mapper(detector: &Arc<Slow>) -> Arc<PipelineMapper> {
    let detector = detector.clone();
    Arc::new(PipelineMapper::new(Box::new(move || Ok(detector.clone()))))
}

async fn start(app: &App) -> (String, Value) {
    let survey = Files::new().upload(app).await;
    let (status, job) = app.post(&format!("{survey}/jobs"), json!({})).await;
    assert_eq!(status, StatusCode::ACCEPTED, "{job}");
    (survey, job)
}

/// All modules of the plant's model, without identifiers, which differ by plant.
async fn modules(app: &App, survey: &str) -> Vec<Value> {
    let (_, modules) = app.get(&format!("{}/models/1/modules", plant_path(survey))).await;
    let features = modules["features"].as_array().unwrap().iter();
    features.map(|feature| json!([feature["properties"]["label"], feature["geometry"]])).collect()
}

/// Takes an image of a running job, as a worker with this mapper would.
async fn take(app: &App, mapper: &PipelineMapper, lease: Duration) -> TaskClaim {
    let identity = mapper.identity();
    loop {
        if let Some(claim) = app.store.take_task(&identity, lease, Timestamp::now()).await.unwrap() {
            return claim;
        }
        tokio::time::sleep(Duration::from_millis(2)).await;
    }
}

async fn nothing_is_left(app: &App) {
    assert_eq!(app.store.waiting_tasks(Timestamp::now()).await.unwrap(), 0);
    assert_eq!(std::fs::read_dir(app.folder.path().join("incoming")).unwrap().count(), 0);
}

#[tokio::test]
async fn two_workers_find_together_what_one_finds_alone() {
    let app = App::new(&[]).await;
    let alone = Slow::new("same", Duration::ZERO);
    let first = app.work(mapper(&alone));
    let (survey, job) = start(&app).await;
    assert_eq!(app.follow(&job).await["state"], "succeeded");
    let expected = modules(&app, &survey).await;
    assert_eq!((alone.searched(), expected.len() > 400), (IMAGES, true));
    first.cancel();

    let pair = [(); 2].map(|()| Slow::new("same", Duration::from_millis(300)));
    for detector in &pair {
        app.work(mapper(detector));
    }
    let (survey, job) = start(&app).await;
    let job = app.follow(&job).await;
    assert_eq!((&job["state"], &job["attempt"]), (&json!("succeeded"), &json!(1)), "{job}");
    let searched = [pair[0].searched(), pair[1].searched()];
    assert_eq!(searched.iter().sum::<usize>(), IMAGES, "{searched:?}");
    assert!(searched.iter().all(|count| *count > 0), "{searched:?}");
    assert!(modules(&app, &survey).await == expected, "the model is another one");
    nothing_is_left(&app).await;
}

#[tokio::test]
async fn a_worker_of_another_version_is_left_out() {
    let app = App::new(&[]).await;
    let detectors = ["one", "other"].map(|version| Slow::new(version, Duration::from_millis(50)));
    for detector in &detectors {
        app.work(mapper(detector));
    }
    let (_, job) = start(&app).await;
    assert_eq!(app.follow(&job).await["state"], "succeeded");
    let mut searched = detectors.map(|detector| detector.searched());
    searched.sort_unstable();
    assert_eq!(searched, [0, IMAGES]);
}

#[tokio::test]
async fn what_a_silent_worker_holds_is_taken_back() {
    let app = App::new(&[]).await;
    let detector = Slow::new("same", Duration::from_millis(20));
    let mapper = mapper(&detector);
    app.work(mapper.clone());
    let (survey, job) = start(&app).await;
    let claim = take(&app, &mapper, Duration::from_millis(400)).await;
    // Progress is honest: the image that somebody holds is not done.
    let waiting = app.follow_until(&job, |job| job["progress"]["done"] == json!(IMAGES - 1)).await;
    assert_eq!((&waiting["state"], &waiting["progress"]["stage"]), (&json!("running"), &json!("detect")));
    assert_eq!(app.follow(&job).await["state"], "succeeded");
    assert_eq!((detector.searched(), modules(&app, &survey).await.len() > 400), (IMAGES, true));
    assert!(!app.store.finish_task(&claim, b"late").await.unwrap());
}

#[tokio::test]
async fn what_cannot_be_read_is_searched_again() {
    let app = App::new(&[]).await;
    let detector = Slow::new("same", Duration::from_millis(20));
    let mapper = mapper(&detector);
    app.work(mapper.clone());
    let (_, job) = start(&app).await;
    let claim = take(&app, &mapper, Duration::from_secs(60)).await;
    assert!(app.store.finish_task(&claim, b"no document").await.unwrap());
    assert_eq!(app.follow(&job).await["state"], "succeeded");
    assert_eq!(detector.searched(), IMAGES);
}

#[tokio::test]
async fn a_helper_without_the_photos_leaves_them_to_the_job() {
    let app = App::new(&[]).await;
    let [owner, helper] = [(); 2].map(|()| Slow::new("same", Duration::from_millis(100)));
    app.work(mapper(&owner));
    let (_, job) = start(&app).await;
    app.follow_until(&job, |job| job["state"] == "running").await;
    let elsewhere = tempfile::tempdir().unwrap();
    app.work_with(Blobs::in_folder(elsewhere.path()).unwrap(), mapper(&helper));
    let job = app.follow(&job).await;
    assert_eq!((&job["state"], owner.searched(), helper.searched()), (&json!("succeeded"), IMAGES, 0), "{job}");
}

#[tokio::test]
async fn a_shared_job_is_cancelled_whatever_its_workers_do() {
    let app = App::new(&[]).await;
    let pair = [(); 2].map(|()| Slow::new("same", Duration::ZERO));
    let held = pair.each_ref().map(Slow::hold);
    for detector in &pair {
        app.work(mapper(detector));
    }
    let (_, job) = start(&app).await;
    while pair.iter().any(|detector| detector.searched() == 0) {
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    let (status, _) = app.post(&format!("{}/cancel", job_path(&job)), json!(null)).await;
    assert_eq!(status, StatusCode::ACCEPTED);
    // It ends while both are in the middle of an image; within which time is a matter of the worker's settings alone.
    assert_eq!(app.follow(&job).await["state"], "cancelled");
    assert_eq!(app.store.waiting_tasks(Timestamp::now()).await.unwrap(), 0);
    // Both are free for the next.
    drop(held);
    let (_, job) = start(&app).await;
    assert_eq!(app.follow(&job).await["state"], "succeeded");
}

#[tokio::test]
async fn a_helper_that_stops_gives_back_what_it_held() {
    let app = App::new(&[]).await;
    let [owner, helper] = [20, 400].map(|ms| Slow::new("same", Duration::from_millis(ms)));
    let (_, job) = start(&app).await;
    app.work(mapper(&owner));
    let helping = app.work(mapper(&helper));
    while helper.searched() == 0 && app.get(&job_path(&job)).await.1["state"] != "succeeded" {
        tokio::time::sleep(Duration::from_millis(2)).await;
    }
    helping.cancel();
    // The leases are of an hour, for which nobody waits.
    assert_eq!(app.follow(&job).await["state"], "succeeded");
}
