//! The suite. Times are given, so nothing waits.

use heliomap::plant::{Layer, ModuleId, PlantId, Warning};
use heliomap::reconstruction::PhotoFacts;
use heliomap::store::requests::{Begun, KeptAnswer};
use heliomap::store::usage::UNLIMITED;
use heliomap::store::{
    AuditEntry, Cancelled, Checkpoint, Claim, Completed, Created, DeliveryState, Digest, Ending, Enqueued,
    FeatureQuery, FileRecord, FileWritten, GeoBox, GivenBack, Heartbeat, ImageTask, Job, JobId, JobRequest, JobState,
    KeyId, NewFeature, NewKey, NewLayer, NewModel, NewWebhook, OrganisationId, OwnTask, Page, Plant, Progress, Quotas,
    Scope, SecretRecord, Sent, SigningSecret, Store, StoreError, Survey, SurveyId, SurveyPath, TimeSpan, Upload,
    UploadId, Usage, Wanted, Webhook, WebhookId,
};
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
    let request =
        JobRequest { plant: survey.plant, survey: survey.id, options: "{}".to_owned(), priority: 0, max_attempts: 2 };
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

pub async fn plants_and_surveys(store: &dyn Store) {
    store.ping().await.unwrap();
    let a = plant(store, "A").await;
    let b = plant(store, "B").await;
    assert!(
        matches!(store.create_plant(ORGANISATION, "A", Quotas::default(), at(9)).await.unwrap(), Created::Existing(found) if found.id == a.id)
    );
    assert_eq!(store.plant(b.id).await.unwrap().unwrap().name, "B");
    assert!(store.plant(PlantId(Uuid::nil())).await.unwrap().is_none());
    let names = async |page| {
        store.plants(ORGANISATION, None, "", page).await.unwrap().into_iter().map(|p| p.name).collect::<Vec<_>>()
    };
    assert_eq!(names(Page { after: None, limit: 1 }).await, ["A"]);
    assert_eq!(names(Page { after: Some(a.seq), limit: 9 }).await, ["B"]);

    let june = survey(store, a.id, "June").await;
    let july = survey(store, a.id, "July").await;
    assert_ne!(survey(store, b.id, "June").await.id, june.id);
    assert_eq!(survey(store, a.id, "June").await.id, june.id);
    assert!(store.survey(b.id, july.id).await.unwrap().is_none());
    assert_eq!(store.surveys(a.id, "", ALL).await.unwrap().len(), 2);
    let nobody = store.create_survey(PlantId(Uuid::nil()), "June", at(0)).await;
    assert!(matches!(nobody, Err(StoreError::Gone { what: "plant" })));
}

pub async fn files_all_or_none(store: &dyn Store) {
    let survey = survey(store, plant(store, "A").await.id, "June").await;
    let (a, b) = (file("images/a.jpg", "a"), file("reconstruction.json", "b"));
    let written = store.put_files(survey.id, &[a.clone(), b.clone()]).await.unwrap();
    assert_eq!(written, [FileWritten::Created, FileWritten::Created]);
    let mut changed = file("images/a.jpg", "other");
    changed.size_px = Some([4, 3]);
    let written = store.put_files(survey.id, &[changed, b]).await.unwrap();
    assert_eq!(written, [FileWritten::Replaced, FileWritten::Unchanged]);
    let files = store.files(survey.id).await.unwrap();
    assert_eq!((files.len(), files[0].size, files[0].size_px), (2, 5, Some([4, 3])));
    assert_eq!(files[0].sha256, Digest::of(b"other"));
    let found = store.file(survey.id, &files[0].path).await.unwrap().unwrap();
    assert_eq!((found.path, found.photo, found.shots), (files[0].path.clone(), None, None));
    let nobody = store.put_files(heliomap::store::SurveyId(Uuid::nil()), &[a]).await;
    assert!(matches!(nobody, Err(StoreError::Gone { what: "survey" })));
}

pub async fn photos_and_what_was_found_in_them(store: &dyn Store) {
    let survey = survey(store, plant(store, "A").await.id, "June").await;
    let facts: PhotoFacts = serde_json::from_value(serde_json::json!({
        "camera": "DJI FC6310", "taken": null,
        "position": {"latitude_deg": 50.0, "longitude_deg": 8.0, "height_m": null},
        "quality": {"fine": 0.5, "coarse": 1.0, "dark_share": 0.0, "bright_share": 0.25},
    }))
    .unwrap();
    let plain = [file("images/b.jpg", "1"), file("images/a.jpg", "1"), file("images/c.jpg", "2")];
    store.put_files(survey.id, &plain).await.unwrap();
    let told = FileRecord { photo: Some(facts.clone()), ..file("images/b.jpg", "1") };
    assert_eq!(store.put_files(survey.id, &[told]).await.unwrap(), [FileWritten::Unchanged]);
    let shots = Some(vec!["a.jpg".to_owned(), "d.jpg".to_owned()]);
    let others = [
        FileRecord { shots: shots.clone(), ..file("reconstruction.json", "1") },
        file("undistorted/images/a.jpg", "1"),
    ];
    store.put_files(survey.id, &others).await.unwrap();

    let first = store.photos(survey.id, "", 2).await.unwrap();
    let names = |photos: &[FileRecord]| photos.iter().map(|p| p.path.file_name().to_owned()).collect::<Vec<_>>();
    assert_eq!(names(&first), ["a.jpg", "b.jpg"]);
    assert_eq!(names(&store.photos(survey.id, first[1].path.as_str(), 9).await.unwrap()), ["c.jpg"]);
    assert_eq!((&first[0].photo, &first[1].photo), (&None, &Some(facts)));
    let reconstruction = store.file(survey.id, &others[0].path).await.unwrap().unwrap();
    assert_eq!(reconstruction.shots, shots);
    let same = store.photos_of_digest(survey.id, Digest::of(b"1"), 9).await.unwrap();
    assert_eq!(same.iter().map(SurveyPath::as_str).collect::<Vec<_>>(), ["images/a.jpg", "images/b.jpg"]);
    assert_eq!(store.photos_of_digest(survey.id, Digest::of(b"1"), 1).await.unwrap().len(), 1);
    let alike = store.photos_alike(survey.id).await.unwrap();
    assert_eq!(alike, same.into_iter().map(|path| (Digest::of(b"1"), path)).collect::<Vec<_>>());
}

pub async fn one_unfinished_job_per_survey(store: &dyn Store) {
    let survey = survey(store, plant(store, "A").await.id, "June").await;
    let job = enqueue(store, &survey).await;
    let request =
        JobRequest { plant: survey.plant, survey: survey.id, options: "[]".to_owned(), priority: 0, max_attempts: 2 };
    let again = store.enqueue_job(&request, at(1)).await.unwrap();
    assert!(matches!(again, Enqueued::Existing(found) if found.id == job.id && found.options == "{}"));
    let claim = claim(store, 0).await.unwrap();
    let again = store.enqueue_job(&request, at(1)).await.unwrap();
    assert!(matches!(again, Enqueued::Existing(found) if found.state == JobState::Running));
    let failed = Ending::Failed { code: "code".to_owned(), message: "message".to_owned() };
    assert!(store.end_job(&claim, &failed, at(2)).await.unwrap());
    assert!(matches!(store.enqueue_job(&request, at(3)).await.unwrap(), Enqueued::New(new) if new.id != job.id));
    let jobs = store.jobs(survey.plant, None, None, ALL).await.unwrap();
    assert_eq!((jobs.len(), jobs[1].id), (2, job.id));
    assert_eq!(jobs[1].error, Some(("code".to_owned(), "message".to_owned())));
    assert_eq!(
        store
            .jobs(survey.plant, Some(survey.id), None, Page { after: Some(jobs[0].seq), limit: 9 })
            .await
            .unwrap()
            .len(),
        1
    );
}

pub async fn jobs_of_one_plant_run_one_after_the_other(store: &dyn Store) {
    let a = plant(store, "A").await.id;
    let june = enqueue(store, &survey(store, a, "June").await).await;
    let july = enqueue(store, &survey(store, a, "July").await).await;
    let other = enqueue(store, &survey(store, plant(store, "B").await.id, "June").await).await;
    let first = claim(store, 0).await.unwrap();
    assert_eq!(first.job.id, june.id);
    assert_eq!(claim(store, 0).await.unwrap().job.id, other.id);
    assert!(claim(store, 0).await.is_none());
    assert!(store.end_job(&first, &Ending::Cancelled, at(1)).await.unwrap());
    assert_eq!(claim(store, 1).await.unwrap().job.id, july.id);
}

pub async fn an_abandoned_job_is_taken_up_and_its_first_worker_is_fenced_out(store: &dyn Store) {
    let survey = survey(store, plant(store, "A").await.id, "June").await;
    enqueue(store, &survey).await;
    let first = claim(store, 0).await.unwrap();
    let progress = Progress { stage: "detect".to_owned(), done: 3, total: 9, remaining_ms: Some(7) };
    assert_eq!(store.heartbeat(&first, Some(progress.clone()), LEASE, at(20)).await.unwrap(), Heartbeat::Continue);
    assert_eq!(store.job(survey.plant, first.job.id).await.unwrap().unwrap().progress, Some(progress));
    assert!(claim(store, 49).await.is_none());
    let second = claim(store, 51).await.unwrap();
    assert_eq!((second.job.id, second.job.attempt, second.job.progress.clone()), (first.job.id, 2, None));
    assert_eq!(store.heartbeat(&first, None, LEASE, at(52)).await.unwrap(), Heartbeat::Lost);
    assert!(matches!(store.complete_job(&first, &model(survey.plant, 1, 1), at(52)).await.unwrap(), Completed::Fenced));
    assert!(!store.end_job(&first, &Ending::Cancelled, at(52)).await.unwrap());
    assert!(store.model(survey.plant, None).await.unwrap().is_none());
    let done = store.complete_job(&second, &model(survey.plant, 1, 1), at(53)).await.unwrap();
    assert!(matches!(done, Completed::Done(_)));
}

pub async fn a_job_that_kills_its_workers_ends(store: &dyn Store) {
    let survey = survey(store, plant(store, "A").await.id, "June").await;
    let job = enqueue(store, &survey).await;
    assert!(claim(store, 0).await.is_some());
    assert!(claim(store, 100).await.is_some());
    assert!(claim(store, 200).await.is_none());
    let job = store.job(job.plant, job.id).await.unwrap().unwrap();
    assert_eq!((job.state, job.error.unwrap().0.as_str()), (JobState::Failed, "worker_lost"));
}

pub async fn a_released_job_has_its_attempt_back(store: &dyn Store) {
    let survey = survey(store, plant(store, "A").await.id, "June").await;
    enqueue(store, &survey).await;
    for now in 0..5 {
        let claim = claim(store, now).await.unwrap();
        assert_eq!(claim.job.attempt, 1);
        assert!(store.end_job(&claim, &Ending::Released, at(now)).await.unwrap());
        assert!(!store.end_job(&claim, &Ending::Released, at(now)).await.unwrap());
    }
}

pub async fn retry_waits_and_ends(store: &dyn Store) {
    let survey = survey(store, plant(store, "A").await.id, "June").await;
    let job = enqueue(store, &survey).await;
    let retry = |seconds| Ending::Retry { code: "environment".to_owned(), message: "m".to_owned(), at: at(seconds) };
    let first = claim(store, 0).await.unwrap();
    assert!(store.end_job(&first, &retry(10), at(1)).await.unwrap());
    assert_eq!(state(store, &job).await, JobState::Queued);
    assert!(claim(store, 9).await.is_none());
    let second = claim(store, 10).await.unwrap();
    assert!(store.end_job(&second, &retry(20), at(11)).await.unwrap());
    assert_eq!(state(store, &job).await, JobState::Failed);
    assert!(claim(store, 30).await.is_none());
}

pub async fn cancel(store: &dyn Store) {
    let survey = survey(store, plant(store, "A").await.id, "June").await;
    let queued = enqueue(store, &survey).await;
    let outcome = store.cancel_job(queued.plant, queued.id, at(1)).await.unwrap();
    assert!(
        matches!(outcome, Some(Cancelled::Accepted(job)) if job.state == JobState::Cancelled && job.finished.is_some())
    );
    assert!(claim(store, 2).await.is_none());

    let running = enqueue(store, &survey).await;
    let first = claim(store, 2).await.unwrap();
    let outcome = store.cancel_job(running.plant, running.id, at(3)).await.unwrap();
    assert!(
        matches!(outcome, Some(Cancelled::Accepted(job)) if job.state == JobState::Running && job.cancel_requested)
    );
    assert_eq!(store.heartbeat(&first, None, LEASE, at(4)).await.unwrap(), Heartbeat::Cancel);
    assert!(store.end_job(&first, &Ending::Cancelled, at(5)).await.unwrap());
    let outcome = store.cancel_job(running.plant, running.id, at(6)).await.unwrap();
    assert!(matches!(outcome, Some(Cancelled::TooLate(job)) if job.state == JobState::Cancelled));
    assert!(store.cancel_job(PlantId(Uuid::nil()), running.id, at(6)).await.unwrap().is_none());

    // A cancelled job whose worker fell silent is not taken up again.
    let silent = enqueue(store, &survey).await;
    claim(store, 7).await.unwrap();
    store.cancel_job(silent.plant, silent.id, at(8)).await.unwrap();
    assert!(claim(store, 100).await.is_none());
    assert_eq!(state(store, &silent).await, JobState::Cancelled);
}

pub async fn models_and_features(store: &dyn Store) {
    let survey = survey(store, plant(store, "A").await.id, "June").await;
    for version in 1..=2 {
        enqueue(store, &survey).await;
        let claim = claim(store, 0).await.unwrap();
        let new = model(survey.plant, version, 3 - u64::from(version - 1));
        let Completed::Done(stored) = store.complete_job(&claim, &new, at(1)).await.unwrap() else {
            panic!("the claim holds");
        };
        assert_eq!((stored.version, stored.survey, stored.size), (version, survey.id, 5));
        let job = store.job(survey.plant, claim.job.id).await.unwrap().unwrap();
        assert_eq!((job.state, job.model_version, job.warnings), (JobState::Succeeded, Some(version), new.warnings));
    }
    let versions: Vec<u32> = store.models(survey.plant, ALL).await.unwrap().iter().map(|m| m.version).collect();
    assert_eq!(versions, [2, 1]);
    let newest = store.model(survey.plant, None).await.unwrap().unwrap();
    let first = store.model(survey.plant, Some(1)).await.unwrap().unwrap();
    assert_eq!((newest.version, newest.sha256), (2, Digest::of(b"model")));
    assert!(store.model(survey.plant, Some(3)).await.unwrap().is_none());

    let layer = store.layer(&first, Layer::Modules).await.unwrap().unwrap();
    assert_eq!((layer.features, layer.properties.as_str()), (3, "{\"name\":\"x\"}"));
    let query = FeatureQuery { after: None, limit: 2, within: None };
    let part = store.features(&layer, query).await.unwrap();
    let rest = store.features(&layer, FeatureQuery { after: Some(part[1].seq), ..query }).await.unwrap();
    let json: Vec<&str> = part.iter().chain(&rest).map(|feature| feature.json.as_str()).collect();
    assert_eq!(json, [0, 1, 2].map(|column| format!("{{\"column\":{column},\"version\":1}}")));
    let empty = store.layer(&first, Layer::Lines).await.unwrap().unwrap();
    assert_eq!((empty.features, empty.extent), (0, None));
    assert!(store.layer(&first, Layer::Benches).await.unwrap().is_none());

    let id = |serial| ModuleId::from_serial(survey.plant, serial);
    assert_eq!(store.module(&newest, id(0)).await.unwrap().unwrap(), "{\"column\":0,\"version\":2}");
    assert_eq!(store.module(&newest, id(2)).await.unwrap(), None);
    assert_eq!(store.module_last_seen(survey.plant, id(2)).await.unwrap(), Some(1));
    assert_eq!(store.module_last_seen(survey.plant, id(9)).await.unwrap(), None);
}

pub async fn two_models_of_one_version_are_not_written(store: &dyn Store) {
    let survey = survey(store, plant(store, "A").await.id, "June").await;
    enqueue(store, &survey).await;
    let first = claim(store, 0).await.unwrap();
    store.complete_job(&first, &model(survey.plant, 1, 1), at(1)).await.unwrap();
    let job = enqueue(store, &survey).await;
    let second = claim(store, 2).await.unwrap();
    let outdated = store.complete_job(&second, &model(survey.plant, 1, 9), at(3)).await.unwrap();
    assert!(matches!(outdated, Completed::Outdated));
    assert_eq!(state(store, &job).await, JobState::Running);
    let kept = store.model(survey.plant, None).await.unwrap().unwrap();
    assert_eq!(store.layer(&kept, Layer::Modules).await.unwrap().unwrap().features, 1);
}

pub async fn a_deleted_plant_takes_everything_with_it(store: &dyn Store) {
    let survey = survey(store, plant(store, "A").await.id, "June").await;
    store.put_files(survey.id, &[file("images/a.jpg", "a")]).await.unwrap();
    enqueue(store, &survey).await;
    let first = claim(store, 0).await.unwrap();
    store.complete_job(&first, &model(survey.plant, 1, 3), at(1)).await.unwrap();
    let stored = store.model(survey.plant, None).await.unwrap().unwrap();
    enqueue(store, &survey).await;
    let running = claim(store, 2).await.unwrap();
    assert!(store.delete_plant(survey.plant, at(9)).await.unwrap());
    assert!(!store.delete_plant(survey.plant, at(9)).await.unwrap());
    assert_eq!(store.heartbeat(&running, None, LEASE, at(3)).await.unwrap(), Heartbeat::Lost);
    assert!(store.files(survey.id).await.unwrap().is_empty());
    assert!(store.model(survey.plant, None).await.unwrap().is_none());
    assert!(store.layer(&stored, Layer::Modules).await.unwrap().is_none());
    assert!(store.module(&stored, ModuleId::from_serial(survey.plant, 0)).await.unwrap().is_none());
}

/// Small boxes are looked up by place, large ones by order: both find the same, in order, part by part.
pub async fn boxes_find_what_touches_them(store: &dyn Store) {
    let survey = survey(store, plant(store, "A").await.id, "June").await;
    enqueue(store, &survey).await;
    let first = claim(store, 0).await.unwrap();
    store.complete_job(&first, &model(survey.plant, 1, 200), at(1)).await.unwrap();
    let stored = store.model(survey.plant, None).await.unwrap().unwrap();
    let layer = store.layer(&stored, Layer::Modules).await.unwrap().unwrap();
    for (from, to) in [(10, 12), (0, 199), (50, 150), (7, 7)] {
        for (south, north) in [(49.0, 51.0), (50.0009, 50.002), (49.0, 50.0)] {
            let within = GeoBox {
                min_lon: from as f64 * 1e-3 + 1e-4,
                max_lon: to as f64 * 1e-3 + 1e-4,
                min_lat: south,
                max_lat: north,
            };
            let mut query = FeatureQuery { after: None, limit: 7, within: Some(within) };
            let mut columns = Vec::new();
            loop {
                let part = store.features(&layer, query).await.unwrap();
                let Some(last) = part.last() else { break };
                query.after = Some(last.seq);
                columns.extend(part.iter().map(|feature| feature.json.clone()));
            }
            let expected: Vec<String> = (from..=to).map(|c| format!("{{\"column\":{c},\"version\":1}}")).collect();
            assert_eq!(columns, expected, "{within:?}");
        }
    }
    let elsewhere = GeoBox { min_lon: 0.0, min_lat: 50.002, max_lon: 1.0, max_lat: 51.0 };
    let query = FeatureQuery { after: None, limit: 9, within: Some(elsewhere) };
    assert!(store.features(&layer, query).await.unwrap().is_empty());
}

async fn organisation(store: &dyn Store, name: &str) -> OrganisationId {
    match store.create_organisation(name, at(0)).await.unwrap() {
        Created::New(organisation) | Created::Existing(organisation) => organisation.id,
    }
}

fn secret(text: &str) -> SecretRecord {
    SecretRecord { sha256: Digest::of(text.as_bytes()), prefix: text.to_owned() }
}

pub async fn organisations_and_their_plants(store: &dyn Store) {
    assert_eq!(organisation(store, "default").await, ORGANISATION);
    let (a, b) = (organisation(store, "A").await, organisation(store, "B").await);
    assert_eq!(organisation(store, "A").await, a);
    let Created::New(one) = store.create_plant(a, "Sunfield", Quotas::default(), at(1)).await.unwrap() else {
        panic!("it is new")
    };
    let Created::New(two) = store.create_plant(b, "Sunfield", Quotas::default(), at(1)).await.unwrap() else {
        panic!("names are its own")
    };
    let Created::New(more) = store.create_plant(a, "Hill", Quotas::default(), at(2)).await.unwrap() else {
        panic!("it is new")
    };
    let ids = async |organisation, only: Option<&[PlantId]>| -> Vec<PlantId> {
        store.plants(organisation, only, "", ALL).await.unwrap().iter().map(|plant| plant.id).collect()
    };
    assert_eq!(ids(a, None).await, [one.id, more.id]);
    assert_eq!(ids(b, None).await, [two.id]);
    assert_eq!(ids(a, Some(&[more.id, two.id])).await, [more.id]);
    assert!(ids(a, Some(&[])).await.is_empty());
    assert_eq!(store.plant(two.id).await.unwrap().unwrap().organisation, b);
    let nobody = store.create_plant(OrganisationId(Uuid::max()), "x", Quotas::default(), at(3)).await;
    assert!(matches!(nobody, Err(StoreError::Gone { what: "organisation" })));
}

pub async fn keys(store: &dyn Store) {
    let (a, b) = (organisation(store, "A").await, organisation(store, "B").await);
    let plants = Some(vec![PlantId(Uuid::from_u128(1)), PlantId(Uuid::from_u128(2))]);
    let new = NewKey {
        organisation: a,
        name: "station".to_owned(),
        secret: secret("one"),
        scopes: [Scope::Read, Scope::Upload].into(),
        plants: plants.clone(),
        expires: Some(at(100)),
    };
    let key = store.create_key(&new, at(1)).await.unwrap();
    assert_eq!((key.organisation, key.prefix.as_str(), &key.scopes, &key.plants), (a, "one", &new.scopes, &plants));
    let everything =
        NewKey { secret: secret("all"), plants: None, expires: None, scopes: [Scope::Admin].into(), ..new.clone() };
    let endless = store.create_key(&everything, at(1)).await.unwrap();
    assert_eq!((endless.plants, endless.expires), (None, None));
    assert!(store.create_key(&everything, at(1)).await.is_err(), "no two keys have one secret");

    let found = async |text: &str, now| {
        store.key_of_secret(Digest::of(text.as_bytes()), at(now)).await.unwrap().map(|key| key.id)
    };
    assert_eq!((found("one", 99).await, found("one", 100).await, found("two", 99).await), (Some(key.id), None, None));
    store.key_used(key.id, at(5)).await.unwrap();
    assert_eq!(store.key(a, key.id).await.unwrap().unwrap().last_used, Some(at(5)));
    assert!(store.key(b, key.id).await.unwrap().is_none());
    assert_eq!(store.keys(Some(a), TimeSpan::default(), ALL).await.unwrap().len(), 2);
    assert_eq!(store.keys(None, TimeSpan::default(), Page { after: Some(key.seq), limit: 9 }).await.unwrap().len(), 1);
    assert!(store.keys(Some(b), TimeSpan::default(), ALL).await.unwrap().is_empty());

    assert!(store.rotate_key(b, key.id, &secret("two"), at(20)).await.unwrap().is_none());
    let rotated = store.rotate_key(a, key.id, &secret("two"), at(20)).await.unwrap().unwrap();
    assert_eq!(rotated.prefix, "two");
    assert_eq!((found("one", 19).await, found("one", 20).await), (Some(key.id), None));
    assert_eq!(found("two", 50).await, Some(key.id));
    assert!(store.revoke_key(b, key.id, at(30)).await.unwrap().is_none());
    assert_eq!(store.revoke_key(a, key.id, at(30)).await.unwrap().unwrap().revoked, Some(at(30)));
    assert_eq!(store.revoke_key(a, key.id, at(40)).await.unwrap().unwrap().revoked, Some(at(30)));
    assert_eq!((found("one", 10).await, found("two", 10).await), (None, None));
    assert!(store.rotate_key(a, key.id, &secret("three"), at(50)).await.unwrap().is_none());
    assert!(store.revoke_key(a, KeyId(Uuid::nil()), at(30)).await.unwrap().is_none());
}

pub async fn audit_log(store: &dyn Store) {
    let (a, b) = (organisation(store, "A").await, organisation(store, "B").await);
    let entry = |organisation, second, key| AuditEntry {
        organisation,
        at: at(second),
        key,
        subject: (second == 1).then(|| "pilot-7".to_owned()),
        method: "DELETE".to_owned(),
        path: format!("/{second}"),
        status: 204,
        request_id: "r".to_owned(),
    };
    let key = (KeyId(Uuid::from_u128(7)), "station".to_owned());
    for entry in [entry(a, 1, None), entry(b, 2, None), entry(a, 3, Some(key.clone()))] {
        store.record(&entry).await.unwrap();
    }
    let log = store.audit(a, TimeSpan::default(), ALL).await.unwrap();
    let seen: Vec<(&str, u16)> = log.iter().map(|(_, entry)| (entry.path.as_str(), entry.status)).collect();
    assert_eq!(seen, [("/3", 204), ("/1", 204)]);
    assert_eq!((&log[0].1.key, &log[1].1.key, log[0].1.at), (&Some(key), &None, at(3)));
    assert_eq!((&log[0].1.subject, log[1].1.subject.as_deref()), (&None, Some("pilot-7")));
    let rest = store.audit(a, TimeSpan::default(), Page { after: Some(log[0].0), limit: 9 }).await.unwrap();
    assert_eq!(rest.len(), 1);
}

pub async fn checkpoints_live_as_long_as_their_job(store: &dyn Store) {
    let survey = survey(store, plant(store, "A").await.id, "June").await;
    let job = enqueue(store, &survey).await;
    let kept = |name: &str| Checkpoint { name: name.to_owned(), document: name.as_bytes().to_vec() };
    let first = claim(store, 0).await.unwrap();
    assert!(store.checkpoint(&first, "f", &[kept("a"), kept("b")]).await.unwrap());
    assert_eq!(store.checkpoints(job.id, "f").await.unwrap(), [kept("a"), kept("b")]);
    assert!(store.checkpoints(job.id, "g").await.unwrap().is_empty());
    let second = claim(store, 31).await.unwrap();
    assert!(!store.checkpoint(&first, "f", &[kept("c")]).await.unwrap());
    // The second attempt gets somewhere: the next two may fail before the job does.
    assert!(store.checkpoint(&second, "g", &[kept("a")]).await.unwrap());
    assert_eq!(store.checkpoints(job.id, "f").await.unwrap(), [kept("b")]);
    let third = claim(store, 62).await.unwrap();
    assert_eq!(third.job.attempt, 3);
    let retry = Ending::Retry { code: "environment".to_owned(), message: "m".to_owned(), at: at(63) };
    assert!(store.end_job(&third, &retry, at(63)).await.unwrap());
    assert_eq!(state(store, &job).await, JobState::Failed);
    assert!(store.checkpoints(job.id, "g").await.unwrap().is_empty());

    // Two attempts that got nowhere, counted from the last that did.
    let job = enqueue(store, &survey).await;
    let claimed = claim(store, 100).await.unwrap();
    assert!(store.checkpoint(&claimed, "f", &[kept("a")]).await.unwrap());
    assert!(claim(store, 200).await.is_some());
    assert!(claim(store, 300).await.is_none());
    assert_eq!(state(store, &job).await, JobState::Failed);
    assert!(store.checkpoints(job.id, "f").await.unwrap().is_empty());
}

pub async fn jobs_by_priority(store: &dyn Store) {
    let mut jobs = Vec::new();
    for (name, priority) in [("A", 0), ("B", 5), ("C", 5), ("D", -5)] {
        let survey = survey(store, plant(store, name).await.id, "June").await;
        let options = "{}".to_owned();
        let request = JobRequest { plant: survey.plant, survey: survey.id, options, priority, max_attempts: 2 };
        let Enqueued::New(job) = store.enqueue_job(&request, at(0)).await.unwrap() else { panic!("it is new") };
        assert_eq!(job.priority, priority);
        jobs.push(job.id);
    }
    for expected in [1, 2, 0, 3] {
        assert_eq!(claim(store, 0).await.unwrap().job.id, jobs[expected]);
    }
}

pub async fn the_last_jobs_pace_is_known(store: &dyn Store) {
    assert_eq!(store.last_stage_ms().await.unwrap(), None);
    let survey = survey(store, plant(store, "A").await.id, "June").await;
    enqueue(store, &survey).await;
    let first = claim(store, 0).await.unwrap();
    store.complete_job(&first, &model(survey.plant, 1, 1), at(1)).await.unwrap();
    assert_eq!(store.last_stage_ms().await.unwrap().as_deref(), Some("{}"));
}

pub async fn deleted_plants_are_remembered(store: &dyn Store) {
    let plant = plant(store, "A").await.id;
    assert!(store.deleted_plants().await.unwrap().is_empty());
    assert!(store.delete_plant(plant, at(5)).await.unwrap());
    assert_eq!(store.deleted_plants().await.unwrap(), [plant]);
    store.forget_deleted_plants(at(5)).await.unwrap();
    assert_eq!(store.deleted_plants().await.unwrap(), [plant]);
    store.forget_deleted_plants(at(6)).await.unwrap();
    assert!(store.deleted_plants().await.unwrap().is_empty());
}

pub async fn uploads(store: &dyn Store) {
    let survey = survey(store, plant(store, "A").await.id, "June").await;
    let id = UploadId(Uuid::from_u128(7));
    let mut upload = Upload {
        id,
        survey: survey.id,
        length: 1 << 40,
        received: 0,
        partial: true,
        metadata: "filename YS5qcGc=".to_owned(),
        expires: at(100),
        outcome: None,
    };
    store.create_upload(&upload).await.unwrap();
    assert_eq!(store.upload(survey.id, id).await.unwrap(), Some(upload.clone()));
    assert_eq!(store.upload(SurveyId(Uuid::nil()), id).await.unwrap(), None);
    assert!(store.upload_received(id, 1 << 33, at(200)).await.unwrap());
    assert!(!store.upload_received(UploadId(Uuid::nil()), 1, at(200)).await.unwrap());
    store.end_upload(id, "{}").await.unwrap();
    (upload.received, upload.expires, upload.outcome) = (1 << 33, at(200), Some("{}".to_owned()));
    assert_eq!(store.upload(survey.id, id).await.unwrap(), Some(upload.clone()));
    store.delete_expired_uploads(at(199)).await.unwrap();
    assert_eq!(store.uploads().await.unwrap(), [id]);
    store.delete_expired_uploads(at(200)).await.unwrap();
    assert!(store.uploads().await.unwrap().is_empty());
    store.create_upload(&upload).await.unwrap();
    assert!(!store.delete_upload(SurveyId(Uuid::nil()), id).await.unwrap());
    assert!(store.delete_upload(survey.id, id).await.unwrap());
    upload.survey = SurveyId(Uuid::nil());
    assert!(matches!(store.create_upload(&upload).await, Err(StoreError::Gone { what: "survey" })));
}

pub async fn named_requests(store: &dyn Store) {
    let (a, b) = (organisation(store, "A").await, organisation(store, "B").await);
    let begin =
        async |organisation, now| store.begin_request(organisation, "one", at(now), at(now + 60)).await.unwrap();
    assert_eq!(begin(a, 0).await, Begun::New);
    assert_eq!(begin(a, 59).await, Begun::Running);
    assert_eq!(begin(b, 0).await, Begun::New, "names are each organisation's own");
    // Whoever had it died over it.
    assert_eq!(begin(a, 60).await, Begun::New);
    let answer =
        KeptAnswer { fingerprint: Digest::of(b"x"), status: 201, headers: "{}".to_owned(), body: vec![0, 159, 255] };
    store.keep_answer(a, "one", &answer, at(1000)).await.unwrap();
    assert_eq!(begin(a, 200).await, Begun::Answered(Box::new(answer.clone())));
    store.forget_request(a, "one").await.unwrap();
    assert_eq!(begin(a, 200).await, Begun::Answered(Box::new(answer)), "what was answered stays");
    store.forget_request(b, "one").await.unwrap();
    assert_eq!(begin(b, 1).await, Begun::New);
    store.forget_old_requests(at(1000)).await.unwrap();
    assert_eq!(begin(a, 999).await, Begun::New);
}

async fn webhook(store: &dyn Store, organisation: OrganisationId, plant: Option<PlantId>) -> Webhook {
    let secret = SigningSecret::given("0123456789abcdef").unwrap();
    let new = NewWebhook { organisation, plant, url: "https://example.org/".to_owned(), secret };
    store.create_webhook(&new, at(0)).await.unwrap().unwrap()
}

async fn messages(store: &dyn Store, webhook: &Webhook) -> Vec<(JobId, DeliveryState)> {
    let found = store.deliveries(webhook.id, None, ALL).await.unwrap();
    found.into_iter().map(|delivery| (delivery.job, delivery.state)).collect()
}

pub async fn webhooks(store: &dyn Store) {
    let Created::New(other) = store.create_organisation("other", at(0)).await.unwrap() else {
        panic!("there is no such organisation yet");
    };
    let (a, b) = (plant(store, "A").await, plant(store, "B").await);
    let all = webhook(store, ORGANISATION, None).await;
    let of_a = webhook(store, ORGANISATION, Some(a.id)).await;
    let strange = webhook(store, other.id, None).await;
    let of_nothing = NewWebhook {
        organisation: ORGANISATION,
        plant: Some(PlantId(Uuid::nil())),
        url: String::new(),
        secret: SigningSecret::random().unwrap(),
    };
    let nowhere = store.create_webhook(&of_nothing, at(0)).await;
    assert!(matches!(nowhere, Err(StoreError::Gone { what: "plant" })));
    let listed = store.webhooks(ORGANISATION, ALL).await.unwrap();
    assert_eq!(listed.iter().map(|webhook| webhook.id).collect::<Vec<_>>(), [all.id, of_a.id]);
    assert_eq!(listed[1].plant, Some(a.id));
    assert!(store.webhook(other.id, all.id).await.unwrap().is_none());
    assert!(!store.delete_webhook(other.id, all.id).await.unwrap());

    // Every end is told once, whatever it is; what goes back to the queue is none.
    let (june, july) = (survey(store, a.id, "June").await, survey(store, b.id, "July").await);
    let mut ended = Vec::new();
    for ending in 0..5 {
        let job = enqueue(store, &june).await;
        if ending == 0 {
            store.cancel_job(a.id, job.id, at(1)).await.unwrap();
        } else {
            let claimed = claim(store, 1).await.unwrap();
            let failed = Ending::Failed { code: "code".to_owned(), message: "message".to_owned() };
            match ending {
                1 => assert!(store.end_job(&claimed, &failed, at(1)).await.unwrap()),
                2 => assert!(store.end_job(&claimed, &Ending::Cancelled, at(1)).await.unwrap()),
                3 => {
                    let done = store.complete_job(&claimed, &model(a.id, 1, 1), at(1)).await.unwrap();
                    assert!(matches!(done, Completed::Done(_)));
                }
                _ => {
                    let retry = Ending::Retry { code: "code".to_owned(), message: "message".to_owned(), at: at(2) };
                    assert!(store.end_job(&claimed, &retry, at(1)).await.unwrap());
                    assert_eq!(messages(store, &of_a).await.len(), ended.len());
                    // Its last attempt, whose worker falls silent.
                    claim(store, 2).await.unwrap();
                    assert!(claim(store, 100).await.is_none());
                }
            }
        }
        ended.insert(0, (job.id, DeliveryState::Waiting));
        assert_eq!(messages(store, &of_a).await, ended, "after {ending}");
    }
    let of_b = enqueue(store, &july).await;
    store.cancel_job(b.id, of_b.id, at(100)).await.unwrap();
    assert_eq!(messages(store, &of_a).await, ended);
    assert_eq!(messages(store, &all).await.len(), 6);
    assert!(messages(store, &strange).await.is_empty());

    assert!(store.delete_plant(a.id, at(101)).await.unwrap());
    assert_eq!(messages(store, &all).await, [(of_b.id, DeliveryState::Waiting)]);
    assert!(store.webhook(ORGANISATION, of_a.id).await.unwrap().is_none());
    assert!(store.delete_webhook(ORGANISATION, all.id).await.unwrap());
    assert!(messages(store, &all).await.is_empty());

    for _ in 0..100 {
        webhook(store, ORGANISATION, None).await;
    }
    let secret = SigningSecret::random().unwrap();
    let more = NewWebhook { organisation: ORGANISATION, plant: None, url: String::new(), secret };
    assert!(store.create_webhook(&more, at(0)).await.unwrap().is_none());
}

pub async fn messages_are_sent_by_one_at_a_time_and_not_for_ever(store: &dyn Store) {
    let survey = survey(store, plant(store, "A").await.id, "June").await;
    let webhook = webhook(store, ORGANISATION, None).await;
    let job = enqueue(store, &survey).await;
    assert!(store.claim_delivery(LEASE, at(1)).await.unwrap().is_none());
    store.cancel_job(survey.plant, job.id, at(1)).await.unwrap();
    let take = async |now| store.claim_delivery(LEASE, at(now)).await.unwrap();
    let first = take(1).await.unwrap();
    assert_eq!(
        (first.job.id, first.url.as_str(), first.secret.reveal()),
        (job.id, "https://example.org/", "0123456789abcdef")
    );
    assert!(take(30).await.is_none());
    // Whoever had it is taken for dead.
    let mut taken = take(31).await.unwrap();
    assert!(!store.end_delivery(&first, &Sent::Arrived, at(31)).await.unwrap());
    let failed = |seconds| Sent::Failed { error: "refused".to_owned(), at: at(seconds) };
    let mut now = 31;
    for attempts in 2..=8 {
        assert_eq!((taken.delivery.attempts, taken.delivery.attempts_left), (attempts, 8 - attempts));
        assert!(store.end_delivery(&taken, &failed(now + 10), at(now)).await.unwrap());
        now += 10;
        if attempts < 8 {
            assert!(take(now - 1).await.is_none());
            taken = take(now).await.unwrap();
        }
    }
    assert!(take(100_000).await.is_none());
    let dead = store.deliveries(webhook.id, Some(DeliveryState::Dead), ALL).await.unwrap();
    assert_eq!((dead.len(), dead[0].attempts, dead[0].error.as_deref()), (1, 8, Some("refused")));
    assert!(store.deliveries(webhook.id, Some(DeliveryState::Waiting), ALL).await.unwrap().is_empty());

    let nobody = WebhookId(Uuid::nil());
    assert!(store.resend_delivery(nobody, dead[0].id, at(200)).await.unwrap().is_none());
    let waiting = store.resend_delivery(webhook.id, dead[0].id, at(200)).await.unwrap().unwrap();
    assert_eq!((waiting.state, waiting.finished), (DeliveryState::Waiting, None));
    let again = take(200).await.unwrap();
    assert_eq!(again.delivery.attempts, 9);
    assert!(store.end_delivery(&again, &Sent::Arrived, at(201)).await.unwrap());
    assert!(!store.end_delivery(&again, &failed(300), at(202)).await.unwrap());
    let arrived = store.deliveries(webhook.id, Some(DeliveryState::Delivered), ALL).await.unwrap();
    assert_eq!((arrived[0].finished, &arrived[0].error), (Some(at(201)), &None));
    store.forget_old_deliveries(at(201)).await.unwrap();
    assert_eq!(messages(store, &webhook).await.len(), 1);
    store.forget_old_deliveries(at(202)).await.unwrap();
    assert!(messages(store, &webhook).await.is_empty());
}

pub async fn quotas(store: &dyn Store) {
    let a = plant(store, "A").await;
    let usage = async || store.usage(ORGANISATION, at(5)).await.unwrap().unwrap();
    let kept = Usage { bytes: 0, announced_bytes: 0, plants: 1, own: Quotas::default() };
    assert_eq!(usage().await, kept);
    assert!(store.usage(OrganisationId(Uuid::max()), at(5)).await.unwrap().is_none());

    // The same bytes count once in a plant, whoever says so again.
    let (one, two) = ((Digest::of(b"1"), 60), (Digest::of(b"2"), 50));
    let none = Quotas::default();
    store.reserve_bytes(a.id, &[one, one], none).await.unwrap();
    store.reserve_bytes(a.id, &[one], none).await.unwrap();
    assert_eq!(usage().await.bytes, 60);
    let tight = Quotas { bytes: Some(100), plants: Some(1) };
    let refused = store.reserve_bytes(a.id, &[two], tight).await;
    assert!(matches!(refused, Err(StoreError::OverQuota { what: "bytes", used: 60, quota: 100 })), "{refused:?}");
    assert_eq!(usage().await.bytes, 60);
    store.reserve_bytes(a.id, &[one], Quotas { bytes: Some(10), plants: None }).await.unwrap();
    let nowhere = store.reserve_bytes(PlantId(Uuid::nil()), &[one], none).await;
    assert!(matches!(nowhere, Err(StoreError::Gone { what: "plant" })));

    // What is said of one organisation goes before what holds for all.
    let refused = store.create_plant(ORGANISATION, "B", tight, at(1)).await;
    assert!(matches!(refused, Err(StoreError::OverQuota { what: "plants", used: 1, quota: 1 })), "{refused:?}");
    assert!(matches!(store.create_plant(ORGANISATION, "A", tight, at(1)).await.unwrap(), Created::Existing(_)));
    let own = Quotas { bytes: Some(UNLIMITED), plants: Some(2) };
    store.set_quotas(ORGANISATION, own).await.unwrap();
    let Created::New(b) = store.create_plant(ORGANISATION, "B", tight, at(1)).await.unwrap() else {
        panic!("there is room for two")
    };
    store.reserve_bytes(b.id, &[two], tight).await.unwrap();
    let june = survey(store, a.id, "June").await;
    let upload = |id: u128, length, outcome: bool, expires| Upload {
        id: UploadId(Uuid::from_u128(id)),
        survey: june.id,
        length,
        received: 0,
        partial: false,
        metadata: String::new(),
        expires: at(expires),
        outcome: outcome.then(|| "{}".to_owned()),
    };
    for upload in [upload(1, 7, false, 9), upload(2, 70, true, 9), upload(3, 700, false, 4)] {
        store.create_upload(&upload).await.unwrap();
        if let Some(outcome) = &upload.outcome {
            store.end_upload(upload.id, outcome).await.unwrap();
        }
    }
    assert_eq!(usage().await, Usage { bytes: 110, announced_bytes: 7, plants: 2, own });

    // A model counts, and what is deleted does not.
    enqueue(store, &june).await;
    let claimed = claim(store, 0).await.unwrap();
    store.complete_job(&claimed, &model(a.id, 1, 1), at(1)).await.unwrap();
    assert_eq!(usage().await.bytes, 115);
    store.delete_plant(a.id, at(2)).await.unwrap();
    assert_eq!(usage().await, Usage { bytes: 50, announced_bytes: 0, plants: 1, own });
    let Created::New(other) = store.create_organisation("another", at(0)).await.unwrap() else {
        panic!("there is no such organisation yet")
    };
    let all = store.organisations(at(5)).await.unwrap();
    let names: Vec<_> = all.iter().map(|(organisation, usage)| (organisation.id, usage.bytes)).collect();
    assert_eq!(names, [(other.id, 0), (ORGANISATION, 50)]);
}

pub async fn blobs_that_rows_name(store: &dyn Store) {
    let (a, b) = (plant(store, "A").await.id, plant(store, "B").await.id);
    let (june, july) = (survey(store, a, "June").await, survey(store, a, "July").await);
    let other = survey(store, b, "June").await;
    store.put_files(june.id, &[file("images/a.jpg", "1"), file("images/b.jpg", "22")]).await.unwrap();
    store.put_files(july.id, &[file("images/c.jpg", "1")]).await.unwrap();
    store.put_files(other.id, &[file("images/a.jpg", "1")]).await.unwrap();
    enqueue(store, &june).await;
    let running = claim(store, 0).await.unwrap();
    store.complete_job(&running, &model(a, 1, 1), at(1)).await.unwrap();
    let mut found = Vec::new();
    let mut after = None;
    loop {
        let page = store.blobs(after, 2).await.unwrap();
        let Some(last) = page.last() else { break };
        after = Some((last.plant, last.sha256));
        found.extend(page.into_iter().map(|blob| (blob.plant, blob.sha256, blob.size)));
    }
    let mut expected = vec![
        (a, Digest::of(b"1"), 1),
        (a, Digest::of(b"22"), 2),
        (a, Digest::of(b"model"), 5),
        (b, Digest::of(b"1"), 1),
    ];
    expected.sort();
    assert_eq!(found, expected);
    // What is replaced is named no more.
    store.put_files(june.id, &[file("images/b.jpg", "1")]).await.unwrap();
    assert_eq!(store.blobs(None, 9).await.unwrap().len(), 3);
}

fn tasks(images: &[&str]) -> Vec<ImageTask> {
    let task = |image: &&str| ImageTask { image: (*image).to_owned(), document: format!("about {image}") };
    images.iter().map(task).collect()
}

pub async fn images_of_a_job_are_shared(store: &dyn Store) {
    let survey = survey(store, plant(store, "A").await.id, "June").await;
    enqueue(store, &survey).await;
    let owner = claim(store, 0).await.unwrap();
    assert_eq!(store.take_own_task(&owner, at(0)).await.unwrap(), OwnTask::None);
    assert!(store.offer_tasks(&owner, "f", "this version", &tasks(&["a", "b", "c", "d"])).await.unwrap());
    assert_eq!(store.waiting_tasks(at(0)).await.unwrap(), 4);
    assert_eq!(store.queue(at(0)).await.unwrap().images, 4);
    // A worker of another version finds something else in the same images.
    assert!(store.take_task("another version", LEASE, at(0)).await.unwrap().is_none());
    let helper = store.take_task("this version", LEASE, at(0)).await.unwrap().unwrap();
    assert_eq!((helper.plant, helper.job, &helper.task), (survey.plant, owner.job.id, &tasks(&["a"])[0]));
    assert_eq!(store.take_own_task(&owner, at(1)).await.unwrap(), OwnTask::Image("b".to_owned()));
    assert!(store.gather_tasks(&owner).await.unwrap().is_empty());

    assert!(store.finish_task(&helper, b"in a").await.unwrap());
    assert!(!store.finish_task(&helper, b"in a, again").await.unwrap());
    let found = Checkpoint { name: "a".to_owned(), document: b"in a".to_vec() };
    assert_eq!(store.checkpoints(owner.job.id, "f").await.unwrap(), std::slice::from_ref(&found));
    assert_eq!(store.gather_tasks(&owner).await.unwrap(), [found]);
    assert!(store.gather_tasks(&owner).await.unwrap().is_empty());

    // What could not be done is for the job's own worker alone.
    let helper = store.take_task("this version", LEASE, at(1)).await.unwrap().unwrap();
    assert_eq!(helper.task.image, "c");
    store.give_back_task(&helper, GivenBack::ToOwner).await.unwrap();
    let last = store.take_task("this version", LEASE, at(1)).await.unwrap().unwrap();
    assert_eq!(last.task.image, "d");
    assert!(store.take_task("this version", LEASE, at(1)).await.unwrap().is_none());
    assert_eq!(store.waiting_tasks(at(1)).await.unwrap(), 0);
    assert_eq!(store.take_own_task(&owner, at(1)).await.unwrap(), OwnTask::Image("c".to_owned()));
    assert_eq!(store.take_own_task(&owner, at(1)).await.unwrap(), OwnTask::InOtherHands);
    store.give_back_task(&last, GivenBack::ToAll).await.unwrap();
    assert_eq!(store.take_own_task(&owner, at(1)).await.unwrap(), OwnTask::Image("d".to_owned()));
    assert_eq!(store.take_own_task(&owner, at(1)).await.unwrap(), OwnTask::None);
    let own: Vec<_> = ["b", "c", "d"].map(|name| Checkpoint { name: name.to_owned(), document: vec![1] }).into();
    assert!(store.checkpoint(&owner, "f", &own).await.unwrap());
    assert_eq!(store.checkpoints(owner.job.id, "f").await.unwrap().len(), 4);
}

pub async fn images_in_silent_hands_come_back(store: &dyn Store) {
    let survey = survey(store, plant(store, "A").await.id, "June").await;
    enqueue(store, &survey).await;
    assert!(claim(store, 0).await.is_some());
    let owner = claim(store, 100).await.unwrap();
    store.offer_tasks(&owner, "f", "v", &tasks(&["a", "b"])).await.unwrap();
    let silent = store.take_task("v", LEASE, at(100)).await.unwrap().unwrap();
    let alive = store.take_task("v", LEASE, at(100)).await.unwrap().unwrap();
    assert_eq!(store.extend_tasks(&[alive.token], LEASE, at(120)).await.unwrap(), [alive.token]);
    assert_eq!(store.take_own_task(&owner, at(130)).await.unwrap(), OwnTask::InOtherHands);
    assert!(store.take_task("v", LEASE, at(130)).await.unwrap().is_none());
    let second = store.take_task("v", LEASE, at(131)).await.unwrap().unwrap();
    assert_eq!((second.task.image.as_str(), second.token != silent.token), ("a", true));
    // Who was silent has lost it, and changes nothing any more.
    assert!(store.extend_tasks(&[silent.token], LEASE, at(132)).await.unwrap().is_empty());
    assert!(!store.finish_task(&silent, b"late").await.unwrap());
    store.give_back_task(&silent, GivenBack::ToOwner).await.unwrap();
    assert_eq!(store.take_own_task(&owner, at(151)).await.unwrap(), OwnTask::Image("b".to_owned()));
    assert!(!store.finish_task(&alive, b"late").await.unwrap());
    assert!(store.finish_task(&second, b"in a").await.unwrap());
    // Others' work counts as the job's: this was its last attempt, and it has another.
    assert_eq!(claim(store, 200).await.unwrap().job.attempt, 3);
}

pub async fn images_go_with_their_job(store: &dyn Store) {
    let survey = survey(store, plant(store, "A").await.id, "June").await;
    let job = enqueue(store, &survey).await;
    let first = claim(store, 0).await.unwrap();
    store.offer_tasks(&first, "f", "v", &tasks(&["a", "b"])).await.unwrap();
    let held = store.take_task("v", LEASE, at(0)).await.unwrap().unwrap();
    // The next worker offers anew; what was held before is lost.
    let second = claim(store, 40).await.unwrap();
    assert!(!store.offer_tasks(&first, "f", "v", &tasks(&["a"])).await.unwrap());
    assert_eq!(store.take_own_task(&first, at(40)).await.unwrap(), OwnTask::InOtherHands);
    assert!(store.offer_tasks(&second, "g", "v", &tasks(&["a", "b"])).await.unwrap());
    assert!(!store.finish_task(&held, b"late").await.unwrap());
    assert!(store.checkpoints(job.id, "g").await.unwrap().is_empty());

    let held = store.take_task("v", LEASE, at(41)).await.unwrap().unwrap();
    store.cancel_job(job.plant, job.id, at(42)).await.unwrap();
    assert!(store.take_task("v", LEASE, at(42)).await.unwrap().is_none());
    assert!(store.extend_tasks(&[held.token], LEASE, at(42)).await.unwrap().is_empty());
    assert_eq!(store.waiting_tasks(at(42)).await.unwrap(), 0);
    assert!(store.end_job(&second, &Ending::Cancelled, at(43)).await.unwrap());
    assert!(!store.finish_task(&held, b"late").await.unwrap());
    assert_eq!(store.take_own_task(&second, at(43)).await.unwrap(), OwnTask::None);

    // A plant that is deleted takes them along.
    enqueue(store, &survey).await;
    let third = claim(store, 50).await.unwrap();
    store.offer_tasks(&third, "f", "v", &tasks(&["a"])).await.unwrap();
    store.delete_plant(survey.plant, at(51)).await.unwrap();
    assert_eq!(store.waiting_tasks(at(51)).await.unwrap(), 0);
}

pub async fn a_file_is_replaced_only_where_it_is_as_wanted(store: &dyn Store) {
    let survey = survey(store, plant(store, "A").await.id, "June").await;
    let put = async |content: &str, wanted: Wanted| {
        store.replace_file(survey.id, &file("images/a.jpg", content), &wanted).await.unwrap()
    };
    let of = |content: &str| Wanted::OneOf(vec![Digest::of(b"other"), Digest::of(content.as_bytes())]);
    assert_eq!(put("1", Wanted::Anything).await, None);
    assert_eq!(put("1", of("1")).await, None);
    assert_eq!(put("1", Wanted::Nothing).await, Some(FileWritten::Created));
    assert_eq!(put("2", Wanted::Nothing).await, None);
    assert_eq!(put("2", of("3")).await, None);
    assert_eq!(put("2", of("1")).await, Some(FileWritten::Replaced));
    assert_eq!(put("2", of("2")).await, Some(FileWritten::Unchanged));
    assert_eq!(put("3", Wanted::Anything).await, Some(FileWritten::Replaced));
    assert_eq!(store.files(survey.id).await.unwrap()[0].sha256, Digest::of(b"3"));

    // Of many who saw the same and replace it at once, one does.
    let many = (0..8).map(|number| {
        let replaced = file("images/a.jpg", &format!("by {number}"));
        async move { store.replace_file(survey.id, &replaced, &of("3")).await.unwrap() }
    });
    let outcomes = futures::future::join_all(many).await;
    assert_eq!(outcomes.iter().filter(|outcome| outcome.is_some()).count(), 1, "{outcomes:?}");
}

pub async fn lists_are_filtered(store: &dyn Store) {
    let (a, _, c) = (plant(store, "Sun 1").await, plant(store, "Hill").await, plant(store, "Sun 2").await);
    let plants = async |prefix: &str| {
        let found = store.plants(ORGANISATION, None, prefix, ALL).await.unwrap();
        found.into_iter().map(|plant| plant.id).collect::<Vec<_>>()
    };
    assert_eq!((plants("Sun").await, plants("sun").await, plants("%").await), (vec![a.id, c.id], vec![], vec![]));
    let (june, july) = (survey(store, a.id, "June").await, survey(store, a.id, "July").await);
    let surveys = async |prefix: &str| store.surveys(a.id, prefix, ALL).await.unwrap().len();
    assert_eq!((surveys("Ju").await, surveys("Jun").await, surveys("X").await), (2, 1, 0));

    let cancelled = enqueue(store, &june).await;
    store.cancel_job(a.id, cancelled.id, at(1)).await.unwrap();
    let queued = enqueue(store, &july).await;
    let jobs = async |survey: Option<SurveyId>, state: Option<JobState>| {
        let found = store.jobs(a.id, survey, state, ALL).await.unwrap();
        found.into_iter().map(|job| job.id).collect::<Vec<_>>()
    };
    assert_eq!(jobs(None, None).await, [queued.id, cancelled.id]);
    assert_eq!(jobs(None, Some(JobState::Cancelled)).await, [cancelled.id]);
    assert_eq!(jobs(Some(june.id), Some(JobState::Queued)).await, []);
    assert_eq!(jobs(Some(july.id), Some(JobState::Queued)).await, [queued.id]);

    let entry = |second| AuditEntry {
        organisation: ORGANISATION,
        at: at(second),
        key: None,
        subject: None,
        method: "DELETE".to_owned(),
        path: format!("/{second}"),
        status: 204,
        request_id: "r".to_owned(),
    };
    for second in 1..=4 {
        store.record(&entry(second)).await.unwrap();
    }
    let audit = async |since: Option<i64>, until: Option<i64>| {
        let within = TimeSpan { since: since.map(at), until: until.map(at) };
        let found = store.audit(ORGANISATION, within, ALL).await.unwrap();
        found.into_iter().map(|(_, entry)| entry.path).collect::<Vec<_>>()
    };
    assert_eq!(audit(Some(2), Some(4)).await, ["/3", "/2"]);
    assert_eq!((audit(Some(5), None).await.len(), audit(None, Some(2)).await.len()), (0, 1));
    for second in [10, 20] {
        let new = NewKey {
            organisation: ORGANISATION,
            name: second.to_string(),
            secret: SecretRecord { sha256: Digest::of(&[second as u8]), prefix: "hm_".to_owned() },
            scopes: [Scope::Read].into(),
            plants: None,
            expires: None,
        };
        store.create_key(&new, at(second)).await.unwrap();
    }
    let within = TimeSpan { since: Some(at(10)), until: Some(at(20)) };
    let keys = store.keys(Some(ORGANISATION), within, ALL).await.unwrap();
    assert_eq!(keys.iter().map(|key| key.name.as_str()).collect::<Vec<_>>(), ["10"]);
}
