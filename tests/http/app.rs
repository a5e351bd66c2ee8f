//! A service of its own for each test.

use crate::stub::{RECONSTRUCTION, REFERENCE};
use axum::http::HeaderValue;
use heliomap::config::{Limits, NetworkArgs};
use heliomap::http::{AppState, router, serve};
use heliomap::jobs::{FoundInTask, Mapper, NextTask, PipelineMapper, Stopped, Worker, WorkerSettings};
use heliomap::oidc::Oidc;
use heliomap::store::{Blobs, Created, NewKey, Scope, Secret, SqliteStore, Store};
use heliomap::telemetry::Metrics;
use heliomap::webhooks::Targets;
use heliomap_mapping::detection::{Detector, ImageDetections};
use heliomap_mapping::geometry::Camera;
use heliomap_mapping::pipeline::{Found, MapError, MapOptions, Observer, Stage, Subject};
use heliomap_mapping::reconstruction::{Photo, ProjectFolder};
use heliomap_model::{
    Bench, BenchId, Line, LineId, Module, ModuleId, ModuleStatus, PlantId, PlantModel, Sector, SectorId, Warning,
};
use heliomap_model::{GeodeticReference, Lla};
use nalgebra::Vector3;
use reqwest::{Client, Method, RequestBuilder, Response, StatusCode};
use serde_json::{Value, json};
use std::collections::VecDeque;
use std::ops::Deref;
use std::path::Path;
use std::sync::{Arc, Mutex};
use std::time::Duration;
use tempfile::TempDir;
use tokio::sync::Notify;
use tokio_util::sync::{CancellationToken, DropGuard};

/// Sends requests.
fn client() -> Client {
    heliomap::tls::provide();
    Client::new()
}

/// What the mapper does when it is called.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Act {
    /// Maps a plant of so many columns.
    Map(u32),
    /// As [`Self::Map`], across the line of 180 degrees.
    MapAcross(u32),
    RefuseInput,
    FailEnvironment,
    Panic,
    /// Waits to be cancelled.
    Wait,
    /// Hears nothing for a second.
    Deaf,
    /// Finds something in one more image that it had not looked at, then fails.
    FindOneAndFail,
}

/// Does as it is told, then as it was told last.
pub struct ScriptedMapper {
    acts: Mutex<VecDeque<Act>>,
    /// The files of the folders it was given, and the photos that it could load.
    pub seen: Mutex<Vec<Vec<String>>>,
    /// The end of the test, which waits for no mapper.
    closing: CancellationToken,
}

impl Mapper for ScriptedMapper {
    fn run(
        &self,
        folder: &dyn ProjectFolder,
        options: &MapOptions,
        subject: &Subject,
        observer: &dyn Observer,
    ) -> Result<PlantModel, MapError> {
        let mut files = Vec::new();
        list(folder.path(), folder.path(), &mut files);
        for place in folder.images() {
            let name = place.file_name().unwrap().to_str().unwrap().to_owned();
            let header = folder.inspect(&place, u64::MAX).unwrap().unwrap();
            let camera = Camera::pinhole(header.width_px, header.height_px, 0.8);
            let photo = Photo { shot: name, path: folder.path().join(&place), header, camera };
            let picture = folder.load(&photo)?;
            assert_eq!(picture.dimensions(), (header.width_px, header.height_px));
            assert!(!photo.path.exists());
            files.push(place.to_str().unwrap().to_owned());
        }
        files.sort();
        self.seen.lock().unwrap().push(files);
        let act = {
            let mut acts = self.acts.lock().unwrap();
            if acts.len() > 1 { acts.pop_front().unwrap() } else { acts[0] }
        };
        observer.progress(Stage::Detect, 1, 2);
        match act {
            Act::Map(columns) => Ok(model(subject, options, columns)),
            Act::MapAcross(columns) => {
                let mut model = model(subject, options, columns);
                // 7 cm west of the line, which is in the first module.
                model.reference.origin.longitude_deg = 179.999_999;
                Ok(model)
            }
            Act::RefuseInput => {
                Err(MapError::Input { code: "no_modules", message: "no photo shows a module; fly higher".to_owned() })
            }
            Act::FailEnvironment => Err(MapError::Environment { message: "the detector cannot be loaded".to_owned() }),
            Act::Panic => panic!("as it was told"),
            Act::Deaf => {
                std::thread::sleep(Duration::from_secs(1));
                Ok(model(subject, options, 1))
            }
            Act::FindOneAndFail => {
                let next = (0..).find(|image| match observer.load_checkpoint(&image.to_string()) {
                    Some(found) => {
                        assert_eq!(found.detections.image, image.to_string());
                        false
                    }
                    None => true,
                });
                let found = nothing_in(&next.unwrap().to_string());
                observer.save_checkpoint(&found);
                Err(MapError::Environment { message: format!("image {} was found", found.detections.image) })
            }
            Act::Wait => {
                while !observer.cancelled() && !self.closing.is_cancelled() {
                    std::thread::sleep(Duration::from_millis(2));
                }
                Err(MapError::Cancelled)
            }
        }
    }

    fn search(&self, next: &mut NextTask<'_>, found: &mut FoundInTask<'_>, _: &Stopped<'_>) -> Result<(), MapError> {
        while let Some(image) = next() {
            let image = image?;
            found(image.key, nothing_in(&image.image));
        }
        Ok(())
    }

    fn identity(&self) -> String {
        "scripted".to_owned()
    }
}

/// An image that shows no module.
fn nothing_in(image: &str) -> Found {
    let image = image.to_owned();
    let detections = ImageDetections { image, width_px: 32, height_px: 24, detections: Vec::new() };
    let layout = heliomap_mapping::layout::infer(&detections, None, &Default::default());
    Found { detections, layout }
}

fn list(root: &Path, folder: &Path, files: &mut Vec<String>) {
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        match path.is_dir() {
            true => list(root, &path, files),
            false => files.push(path.strip_prefix(root).unwrap().to_str().unwrap().to_owned()),
        }
    }
}

/// One bench of one row, `columns` modules of 1 m with 1 m between their centres; identifiers persist.
fn model(subject: &Subject, options: &MapOptions, columns: u32) -> PlantModel {
    let plant = subject.plant;
    let (line, bench, sector) =
        (LineId::from_serial(plant, 1), BenchId::from_serial(plant, 1), SectorId::from_serial(plant, 1));
    let known = subject.previous.as_ref().map_or(0, |previous| previous.serials[3]);
    let modules = (1..=columns).map(|number| {
        let west = f64::from(number - 1);
        Module {
            id: ModuleId::from_serial(plant, u64::from(number)),
            label: format!("L01-B01-R1-{number:03}"),
            line,
            bench,
            sector,
            row: 1,
            number,
            corners_enu_m: [[0.0, 0.0], [0.9, 0.0], [0.9, 1.6], [0.0, 1.6]]
                .map(|[x, y]| Vector3::new(west + x, y, 2.0)),
            center_enu_m: Vector3::new(west + 0.45, 0.8, 2.0),
            normal_enu: Vector3::z(),
            width_m: 0.9,
            height_m: 1.6,
            sigma_enu_m: None,
            images: vec!["a.jpg".to_owned(), "b.jpg".to_owned()],
            status: ModuleStatus::Detected,
        }
    });
    PlantModel {
        plant,
        plant_name: subject.plant_name.clone(),
        version: subject.previous.as_ref().map_or(1, |previous| previous.version + 1),
        survey: subject.survey.clone(),
        reference: GeodeticReference::new(Lla { latitude_deg: 50.0, longitude_deg: 8.0, height_m: 100.0 }),
        vertical_datum: "as the drone wrote it".to_owned(),
        alignment: None,
        parameters: None,
        lines: vec![Line { id: line, label: "L01".to_owned(), index: 1 }],
        benches: vec![Bench {
            id: bench,
            label: "L01-B01".to_owned(),
            line,
            index: 1,
            rows: options.rows_per_bench.unwrap_or(1),
            columns,
            open_ended: [false; 2],
            confidence: 1.0,
        }],
        sectors: vec![Sector { id: sector, label: "L01-B01-R1".to_owned(), line, bench, row: 1 }],
        modules: modules.collect(),
        warnings: vec![Warning::new("high_image", "b.jpg does not resolve modules", ["b.jpg".to_owned()])],
        serials: [1, 1, 1, known.max(u64::from(columns))],
    }
}

/// A service that runs until it is dropped.
pub struct App {
    pub base: String,
    pub client: Client,
    pub mapper: Arc<ScriptedMapper>,
    pub folder: TempDir,
    pub store: Arc<dyn Store>,
    /// The secret that requests show.
    pub secret: Option<String>,
    metrics: Metrics,
    blobs: Blobs,
    cancelled: CancellationToken,
    _stop: DropGuard,
}

/// A worker in a hurry.
fn worker(store: Arc<dyn Store>, blobs: Blobs, mapper: Arc<dyn Mapper>) -> Worker {
    let settings = WorkerSettings {
        lease: Duration::from_secs(3600),
        heartbeat: Duration::from_millis(10),
        poll: Duration::from_millis(20),
        backoff: Duration::from_millis(10),
    };
    let (name, metrics, work_notify) = ("test".to_owned(), Metrics::default(), Arc::default());
    Worker { name, store, blobs, mapper, settings, metrics, work_notify }
}

/// A service over what another one has stored, which lives at least as long.
pub struct Beside<'a> {
    app: App,
    _of: &'a App,
}

impl Deref for Beside<'_> {
    type Target = App;

    fn deref(&self) -> &App {
        &self.app
    }
}

impl App {
    /// With a worker whose mapper acts so.
    pub async fn new(acts: &[Act]) -> Self {
        Self::with_limits(acts, Limits::default()).await
    }

    /// With limits of its own.
    pub async fn with_limits(acts: &[Act], limits: Limits) -> Self {
        let stop = CancellationToken::new();
        let mapper = Arc::new(ScriptedMapper {
            acts: Mutex::new(acts.iter().copied().collect()),
            seen: Mutex::default(),
            closing: stop.clone(),
        });
        let working = (!acts.is_empty()).then(|| mapper.clone() as Arc<dyn Mapper>);
        Self::start(working, mapper, limits, stop, true).await
    }

    /// That asks for keys, with a worker whose mapper makes models of two modules.
    pub async fn with_keys() -> Self {
        let stop = CancellationToken::new();
        let acts = Mutex::new(VecDeque::from([Act::Map(2)]));
        let mapper = Arc::new(ScriptedMapper { acts, seen: Mutex::default(), closing: stop.clone() });
        Self::start(Some(mapper.clone()), mapper, Limits::default(), stop, false).await
    }

    /// That asks for keys, with limits of its own.
    pub async fn with_keys_and_limits(limits: Limits) -> Self {
        let stop = CancellationToken::new();
        let mapper = Arc::new(ScriptedMapper { acts: Mutex::default(), seen: Mutex::default(), closing: stop.clone() });
        Self::start(None, mapper, limits, stop, false).await
    }

    /// That lets scripts of an origin's pages in.
    pub async fn for_pages_of(origin: &'static str) -> Self {
        let mut app = Self::new(&[]).await;
        let network = NetworkArgs { cors_origin: vec![HeaderValue::from_static(origin)], behind_proxy: false };
        app.base = app.again(Limits::default(), Arc::new(network), app.cancelled.clone()).await;
        app
    }

    /// Without a worker, over a database that may grow by so many pages and no more, as on a disk that gets full.
    pub async fn with_pages(more: u32) -> Self {
        let mut app = Self::new(&[]).await;
        let file = app.folder.path().join("bounded.db");
        SqliteStore::open(&file).await.unwrap().close().await;
        let pages = std::fs::metadata(&file).unwrap().len() / 4096;
        app.store = Arc::new(SqliteStore::open_bounded(&file, Some(pages as u32 + more)).await.unwrap());
        app.base = app.again(Limits::default(), Arc::default(), app.cancelled.clone()).await;
        app
    }

    /// Another service, without a worker, over what this one has stored.
    pub async fn beside(&self, limits: Limits) -> Beside<'_> {
        let stop = CancellationToken::new();
        let base = self.again(limits, Arc::default(), stop.clone()).await;
        let mapper = self.mapper.clone();
        let (client, metrics, blobs) = (client(), Metrics::default(), self.blobs.clone());
        let (folder, store, secret) = (tempfile::tempdir().unwrap(), self.store.clone(), self.secret.clone());
        let cancelled = stop.clone();
        let app =
            Self { base, client, mapper, metrics, blobs, folder, store, secret, cancelled, _stop: stop.drop_guard() };
        Beside { app, _of: self }
    }

    async fn again(&self, limits: Limits, network: Arc<NetworkArgs>, stop: CancellationToken) -> String {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let base = format!("http://{}", listener.local_addr().unwrap());
        let state = AppState::new(self.store.clone(), self.blobs.clone(), limits.clone());
        let state = AppState { network, insecure: true, stop: stop.clone(), ..state };
        tokio::spawn(async move { serve(listener, router(state), &limits, stop).await });
        base
    }

    /// Where it keeps bytes.
    pub fn blobs(&self) -> Blobs {
        self.blobs.clone()
    }

    /// Starts another worker, which works until the service stops or the answer is cancelled.
    pub fn work(&self, mapper: Arc<dyn Mapper>) -> CancellationToken {
        self.work_with(self.blobs.clone(), mapper)
    }

    /// Starts another worker with blobs of its own.
    pub fn work_with(&self, blobs: Blobs, mapper: Arc<dyn Mapper>) -> CancellationToken {
        let (worker, stop) = (worker(self.store.clone(), blobs, mapper), self.cancelled.child_token());
        let told = stop.clone();
        tokio::spawn(async move { worker.run(told).await });
        stop
    }

    /// Tells the service to stop.
    pub fn stop(&self) {
        self.cancelled.cancel();
    }

    /// What the service counts.
    pub async fn metrics(&self) -> String {
        self.metrics.render(&*self.store, &self.blobs).await.unwrap()
    }

    /// Waits until what the service counts is as wanted.
    pub async fn metrics_until(&self, wanted: impl Fn(&str) -> bool) {
        for _ in 0..24_000 {
            if wanted(&self.metrics().await) {
                return;
            }
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
        panic!("the service does not get there: {}", self.metrics().await);
    }

    /// The secret of a new key.
    pub async fn key(&self, organisation: &str, scopes: &[Scope], plants: Option<Vec<PlantId>>) -> String {
        let now = jiff::Timestamp::now();
        let organisation = match self.store.create_organisation(organisation, now).await.unwrap() {
            Created::New(organisation) | Created::Existing(organisation) => organisation.id,
        };
        let secret = Secret::random().unwrap();
        let scopes = scopes.iter().copied().collect();
        let name = "test".to_owned();
        let new = NewKey { organisation, name, secret: secret.record(), scopes, plants, expires: None };
        self.store.create_key(&new, now).await.unwrap();
        secret.reveal().to_owned()
    }

    /// That takes tokens of an identity provider beside keys.
    pub async fn with_oidc(oidc: Oidc) -> Self {
        let mut app = Self::with_keys_and_limits(Limits::default()).await;
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        app.base = format!("http://{}", listener.local_addr().unwrap());
        let limits = Limits::default();
        let state = AppState::new(app.store.clone(), app.blobs.clone(), limits.clone());
        let state = AppState { oidc: Some(Arc::new(oidc)), stop: app.cancelled.clone(), ..state };
        let stop = app.cancelled.clone();
        tokio::spawn(async move { serve(listener, router(state), &limits, stop).await });
        app
    }

    /// With a worker that maps in earnest, by this detector.
    pub async fn with_detector(detector: Arc<dyn Detector>) -> Self {
        let stop = CancellationToken::new();
        let unused = Arc::new(ScriptedMapper { acts: Mutex::default(), seen: Mutex::default(), closing: stop.clone() });
        let mapper = PipelineMapper::new(Box::new(move || Ok(detector.clone())));
        Self::start(Some(Arc::new(mapper)), unused, Limits::default(), stop, true).await
    }

    async fn start(
        working: Option<Arc<dyn Mapper>>,
        mapper: Arc<ScriptedMapper>,
        limits: Limits,
        stop: CancellationToken,
        insecure: bool,
    ) -> Self {
        // The mapper hears of the test's end alone, the service may stop before.
        let cancelled = stop.child_token();
        let folder = tempfile::tempdir().unwrap();
        let store: Arc<dyn Store> = Arc::new(SqliteStore::open(&folder.path().join("heliomap.db")).await.unwrap());
        let blobs = Blobs::in_folder(folder.path()).unwrap();
        let (work_notify, metrics) = (Arc::new(Notify::new()), Metrics::default());
        if let Some(mapper) = working {
            let worker = worker(store.clone(), blobs.clone(), mapper);
            let (worker, stop) =
                (Worker { metrics: metrics.clone(), work_notify: work_notify.clone(), ..worker }, cancelled.clone());
            tokio::spawn(async move { worker.run(stop).await });
        }
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let base = format!("http://{}", listener.local_addr().unwrap());
        let served = limits.clone();
        let state = AppState {
            bell: work_notify,
            metrics: metrics.clone(),
            insecure,
            stop: cancelled.clone(),
            targets: Targets::Any,
            ..AppState::new(store.clone(), blobs.clone(), limits)
        };
        let (app, closing) = (router(state), cancelled.clone());
        tokio::spawn(async move { serve(listener, app, &served, closing).await });
        let (client, secret) = (client(), None);
        Self { base, client, mapper, folder, store, secret, metrics, blobs, cancelled, _stop: stop.drop_guard() }
    }

    pub fn request(&self, method: Method, path: &str) -> RequestBuilder {
        let request = self.client.request(method, format!("{}{path}", self.base));
        match &self.secret {
            Some(secret) => request.bearer_auth(secret),
            None => request,
        }
    }

    pub async fn get(&self, path: &str) -> (StatusCode, Value) {
        json_of(self.request(Method::GET, path).send().await.unwrap()).await
    }

    pub async fn post(&self, path: &str, body: Value) -> (StatusCode, Value) {
        json_of(self.request(Method::POST, path).json(&body).send().await.unwrap()).await
    }

    pub async fn put(&self, path: &str, body: impl Into<reqwest::Body>) -> (StatusCode, Value) {
        json_of(self.request(Method::PUT, path).body(body).send().await.unwrap()).await
    }

    /// The path of a new plant.
    pub async fn plant(&self) -> String {
        let (status, plant) = self.post("/api/v1/plants", json!({"name": "Sunfield"})).await;
        assert_eq!(status, StatusCode::CREATED, "{plant}");
        format!("/api/v1/plants/{}", plant["id"].as_str().unwrap())
    }

    /// The path of a new survey of a new plant.
    pub async fn survey(&self) -> String {
        let plant = self.plant().await;
        let (status, survey) = self.post(&format!("{plant}/surveys"), json!({"name": "June"})).await;
        assert_eq!(status, StatusCode::CREATED, "{survey}");
        format!("{plant}/surveys/{}", survey["id"].as_str().unwrap())
    }

    /// The path of a survey that can be mapped.
    pub async fn complete_survey(&self) -> String {
        let survey = self.survey().await;
        self.fill(&survey).await;
        survey
    }

    /// Uploads what a survey needs.
    pub async fn fill(&self, survey: &str) {
        for name in ["a.jpg", "b.jpg"] {
            let (status, answer) = self.put(&format!("{survey}/images/{name}"), jpeg(32, 24)).await;
            assert_eq!(status, StatusCode::CREATED, "{answer}");
        }
        for (path, body) in [("reconstruction.json", RECONSTRUCTION), ("reference_lla.json", REFERENCE)] {
            let (status, answer) = self.put(&format!("{survey}/reconstruction/{path}"), body).await;
            assert_eq!(status, StatusCode::CREATED, "{answer}");
        }
    }

    /// Starts a job and follows it to its end.
    pub async fn map(&self, survey: &str) -> Value {
        let (status, job) = self.post(&format!("{survey}/jobs"), json!({})).await;
        assert_eq!(status, StatusCode::ACCEPTED, "{job}");
        self.follow(&job).await
    }

    /// Follows a job to its end.
    pub async fn follow(&self, job: &Value) -> Value {
        self.follow_until(job, |job| {
            ["succeeded", "failed", "cancelled"].contains(&job["state"].as_str().unwrap_or_default())
        })
        .await
    }

    /// Follows a job until it is as wanted.
    pub async fn follow_until(&self, job: &Value, wanted: impl Fn(&Value) -> bool) -> Value {
        let path = job_path(job);
        // Two minutes at the most: a busy machine is no failure.
        for _ in 0..24_000 {
            let (_, job) = self.get(&path).await;
            if wanted(&job) {
                return job;
            }
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
        panic!("the job does not get there: {}", self.get(&path).await.1);
    }
}

pub fn job_path(job: &Value) -> String {
    format!("/api/v1/plants/{}/jobs/{}", job["plant"].as_str().unwrap(), job["id"].as_str().unwrap())
}

/// The plant's path from one of its surveys.
pub fn plant_path(survey: &str) -> &str {
    survey.split_once("/surveys/").unwrap().0
}

pub async fn json_of(response: Response) -> (StatusCode, Value) {
    let status = response.status();
    let kind = response.headers().get("content-type").map(|kind| kind.to_str().unwrap().to_owned());
    let text = response.text().await.unwrap();
    if status.is_client_error() || status.is_server_error() {
        assert_eq!(kind.as_deref(), Some("application/problem+json"), "{status}: {text}");
    }
    let value = if text.is_empty() { Value::Null } else { serde_json::from_str(&text).unwrap_or(Value::String(text)) };
    (status, value)
}

/// Asserts that an answer is the problem wanted and that its detail names what it is about.
#[track_caller]
pub fn assert_problem((status, problem): (StatusCode, Value), expected: u16, code: &str, names: &str) {
    assert_eq!(status.as_u16(), expected, "{problem}");
    assert_eq!(problem["code"], code, "{problem}");
    assert_eq!(problem["status"], expected, "{problem}");
    let detail = problem["detail"].as_str().unwrap();
    assert!(detail.contains(names), "`{names}` is not in `{detail}`");
}

/// A photo.
pub fn jpeg(width: u32, height: u32) -> Vec<u8> {
    encoded(width, height, image::ImageFormat::Jpeg)
}

/// A photo in some format.
pub fn encoded(width: u32, height: u32, format: image::ImageFormat) -> Vec<u8> {
    let photo =
        image::RgbImage::from_fn(width, height, |x, y| image::Rgb([(x * 9) as u8, (y * 7) as u8, (x ^ y) as u8]));
    let mut bytes = std::io::Cursor::new(Vec::new());
    photo.write_to(&mut bytes, format).unwrap();
    bytes.into_inner()
}
