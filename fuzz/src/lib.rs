//! What the fuzz targets share: files in memory, what an input may cost, and the service in this process.

pub mod memory;

use axum::Router;
use axum::body::{Body, to_bytes};
use axum::http::response::Parts;
use axum::http::{HeaderValue, Request, StatusCode, header};
use heliomap::config::Limits;
use heliomap::http::{AppState, router};
use heliomap_model::{Layer, ModuleId, PlantId};
use heliomap::store::{
    Blobs, Completed, Created, Digest, Enqueued, GeoBox, JobId, JobRequest, NewFeature, NewLayer, NewModel, OrganisationId,
    Quotas, SqliteStore, Store,
};
use std::path::PathBuf;
use std::sync::{Arc, LazyLock};
use std::time::Duration;
use tempfile::TempDir;
use tokio::runtime::Runtime;
use tower::ServiceExt;

/// A folder in memory where there is such a place: files are written many times a second.
pub fn folder() -> TempDir {
    let memory = std::path::Path::new("/dev/shm");
    let place = if memory.is_dir() { memory.to_owned() } else { std::env::temp_dir() };
    tempfile::Builder::new().prefix("heliomap-fuzz-").tempdir_in(place).expect("a folder can be made")
}

/// The file that a target writes its input to.
pub fn file(name: &str) -> PathBuf {
    static FOLDER: LazyLock<TempDir> = LazyLock::new(folder);
    FOLDER.path().join(name)
}

/// The service over a store of its own, with a plant, a survey and a model of a few modules.
pub struct Service {
    runtime: Runtime,
    app: Router,
    blobs: Blobs,
    _folder: TempDir,
    plant_id: PlantId,
    pub plant: String,
    pub survey: String,
}

/// Limits that bound what one input may cost, as a service's own bound what an upload may.
fn limits() -> Limits {
    Limits {
        max_image_size: 1 << 20,
        max_image_megapixels: 1.0,
        max_file_size: 1 << 20,
        max_archive_size: 1 << 20,
        max_unpacked_size: 8 << 20,
        max_entries: 200,
        request_timeout: Duration::from_secs(5),
        disk_reserve: 0,
        max_requests_per_second: 1_000_000,
        ..Limits::default()
    }
}

impl Service {
    pub fn start() -> Self {
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build();
        let runtime = runtime.expect("threads can be started");
        let folder = folder();
        let data = folder.path();
        let (app, blobs, plant, survey) = runtime.block_on(async {
            let store = SqliteStore::open(&data.join("heliomap.db")).await.expect("a database can be made");
            let blobs = Blobs::in_folder(data).expect("blobs can be stored");
            let (plant, survey) = fill(&store).await;
            let state = AppState { insecure: true, ..AppState::new(Arc::new(store), blobs.clone(), limits()) };
            (router(state), blobs, plant, survey)
        });
        let plant_id = plant;
        let plant = format!("/api/v1/plants/{plant}");
        let survey = format!("{plant}/surveys/{survey}");
        Self { runtime, app, blobs, _folder: folder, plant_id, plant, survey }
    }

    /// Sends a request; the answer, which no input may make an internal error.
    pub fn send(&self, mut request: Request<Body>) -> (Parts, Vec<u8>) {
        request.headers_mut().insert(header::HOST, HeaderValue::from_static("localhost"));
        let about = format!("{} {}", request.method(), request.uri());
        let answer = self.runtime.block_on(async {
            let response = self.app.clone().oneshot(request).await.expect("the router answers");
            let (parts, body) = response.into_parts();
            (parts, to_bytes(body, 64 << 20).await.expect("an answer ends"))
        });
        let (parts, body) = answer;
        assert!(
            parts.status != StatusCode::INTERNAL_SERVER_ERROR && parts.status != StatusCode::SERVICE_UNAVAILABLE,
            "{about}: {} {}",
            parts.status,
            String::from_utf8_lossy(&body)
        );
        (parts, body.to_vec())
    }

    /// Drops what was stored, which would fill the memory in the end.
    pub fn empty(&self) {
        self.runtime.block_on(self.blobs.delete_plant(self.plant_id)).expect("blobs can be deleted");
    }

    /// Fails where something that came in was left lying.
    pub fn assert_tidy(&self) {
        let left = std::fs::read_dir(self.blobs.staging()).expect("the folder is there").count();
        assert!(left == 0, "{left} files were left in the folder of what comes in");
    }
}

async fn fill(store: &dyn Store) -> (PlantId, heliomap::store::SurveyId) {
    let now = "2026-01-01T00:00:00Z".parse().expect("a time");
    let Ok(Created::New(plant)) = store.create_plant(OrganisationId::DEFAULT, "Plant", Quotas::default(), now).await
    else {
        panic!("a plant can be made")
    };
    let Ok(Created::New(survey)) = store.create_survey(plant.id, "Survey", now).await else {
        panic!("a survey can be made")
    };
    let request = JobRequest {
        id: JobId(survey.id.0),
        plant: plant.id,
        survey: survey.id,
        options: "{}".to_owned(),
        priority: 0,
        max_attempts: 1,
    };
    let Ok(Enqueued::New(_)) = store.enqueue_job(&request, now).await else { panic!("a job can be queued") };
    let claim = store.claim_job("fuzz", Duration::from_secs(60), now).await;
    let claim = claim.expect("a job can be claimed").expect("there is one");
    let features = (0..20_u32).map(|number| {
        let lon = 8.0 + f64::from(number) * 1e-5;
        let id = ModuleId::from_serial(plant.id, number.into()).to_string();
        let extent = GeoBox { min_lon: lon, min_lat: 50.0, max_lon: lon + 1e-5, max_lat: 50.00001 };
        let json = serde_json::json!({"type": "Feature", "id": id, "geometry": null, "properties": {"number": number}});
        NewFeature { id, label: number.to_string(), json: json.to_string(), extent: Some(extent) }
    });
    let modules = NewLayer { layer: Layer::Modules, properties: "{}".to_owned(), features: features.collect() };
    let model = NewModel {
        version: 1,
        sha256: Digest::of(b""),
        size: 0,
        warnings: Vec::new(),
        stage_ms: None,
        layers: vec![modules],
    };
    let done = store.complete_job(&claim, &model, now).await;
    assert!(matches!(done, Ok(Completed::Done(_))));
    (plant.id, survey.id)
}
