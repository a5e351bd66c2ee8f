//! The suite. Times are parameters, so that nothing waits.

mod access;
pub mod cancelled;
pub mod contention;
mod files;
mod freeing;
mod jobs;
mod models;
mod plants;
mod quotas;
mod tasks;
mod webhooks;

pub use access::*;
pub use files::*;
pub use freeing::*;
pub use jobs::*;
pub use models::*;
pub use plants::*;
pub use quotas::*;
pub use tasks::*;
pub use webhooks::*;

use heliomap::store::{
    Claim, Created, Digest, Enqueued, FileRecord, FileWritten, GeoBox, Job, JobId, JobRequest, JobState, NewFeature,
    NewLayer, NewModel, OrganisationId, Page, Plant, Quotas, Store, StoreError, Survey, SurveyPath,
};
use heliomap_model::{Layer, ModuleId, PlantId, Warning};
use jiff::Timestamp;
use std::time::Duration;
use uuid::Uuid;

const ORGANISATION: OrganisationId = OrganisationId::DEFAULT;
const LEASE: Duration = Duration::from_secs(30);
const ALL: Page = Page { after: None, limit: 1000 };

fn at(seconds: i64) -> Timestamp {
    Timestamp::from_second(1_000_000 + seconds).unwrap()
}

async fn plant(store: &dyn Store, name: &str) -> Plant {
    match store.create_plant(ORGANISATION, name, Quotas::default(), at(0)).await.unwrap() {
        Created::New(plant) | Created::Existing(plant) => plant,
    }
}

async fn survey(store: &dyn Store, plant: PlantId, name: &str) -> Survey {
    match store.create_survey(plant, name, at(0)).await.unwrap() {
        Created::New(survey) | Created::Existing(survey) => survey,
    }
}

async fn enqueue(store: &dyn Store, survey: &Survey) -> Job {
    let request = JobRequest {
        id: JobId(Uuid::new_v4()),
        plant: survey.plant,
        survey: survey.id,
        options: "{}".to_owned(),
        priority: 0,
        max_attempts: 2,
    };
    match store.enqueue_job(&request, at(0)).await.unwrap() {
        Enqueued::New(job) => job,
        Enqueued::Existing(job) => panic!("there is an unfinished job: {job:?}"),
    }
}

async fn claim(store: &dyn Store, now: i64) -> Option<Claim> {
    store.claim_job("worker", LEASE, at(now)).await.unwrap()
}

async fn state(store: &dyn Store, job: &Job) -> JobState {
    store.job(job.plant, job.id).await.unwrap().unwrap().state
}

fn file(path: &str, content: &str) -> FileRecord {
    FileRecord {
        path: SurveyPath::parse(path).unwrap(),
        size: content.len() as u64,
        sha256: Digest::of(content.as_bytes()),
        size_px: None,
        photo: None,
        shots: None,
        stored: at(0),
    }
}

/// Puts files whose bytes are reserved, as an upload does.
async fn put(store: &dyn Store, survey: &Survey, files: &[FileRecord]) -> Vec<FileWritten> {
    reserve(store, survey.plant, files).await.unwrap();
    store.put_files(survey.id, files).await.unwrap()
}

async fn reserve(store: &dyn Store, plant: PlantId, files: &[FileRecord]) -> Result<(), StoreError> {
    let blobs: Vec<_> = files.iter().map(|file| (file.sha256, file.size)).collect();
    store.reserve_bytes(plant, &blobs, Quotas::default(), files[0].stored).await
}

/// A model of `columns` modules in a row along a parallel, a thousandth of a degree apart.
fn model(plant: PlantId, version: u32, columns: u64) -> NewModel {
    let features = (0..columns).map(|column| {
        let lon = column as f64 * 1e-3;
        NewFeature {
            id: ModuleId::from_serial(plant, column).to_string(),
            label: format!("{column}"),
            json: format!("{{\"column\":{column},\"version\":{version}}}"),
            extent: Some(GeoBox { min_lon: lon, min_lat: 50.0, max_lon: lon + 5e-4, max_lat: 50.001 }),
        }
    });
    let layers = vec![
        NewLayer { layer: Layer::Modules, properties: "{\"name\":\"x\"}".to_owned(), features: features.collect() },
        NewLayer { layer: Layer::Lines, properties: "{}".to_owned(), features: Vec::new() },
    ];
    let warnings = vec![Warning::new("code", "message", ["a.jpg".to_owned()])];
    NewModel { version, sha256: Digest::of(b"model"), size: 5, warnings, stage_ms: Some("{}".to_owned()), layers }
}
