//! Plants, surveys, and lists of them.

use super::{ALL, LEASE, ORGANISATION, at, claim, enqueue, file, model, plant, put, survey};
use heliomap::store::{
    AuditEntry, Created, Digest, Heartbeat, JobState, NewKey, Page, Quotas, Scope, SecretRecord, Store, StoreError,
    SurveyId, TimeSpan,
};
use heliomap_model::{Layer, ModuleId, PlantId};
use uuid::Uuid;

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
    let refused = store.create_survey(PlantId(Uuid::nil()), "June", at(0)).await;
    assert!(matches!(refused, Err(StoreError::Gone { what: "plant" })));
}

pub async fn a_deleted_plant_takes_everything_with_it(store: &dyn Store) {
    let survey = survey(store, plant(store, "A").await.id, "June").await;
    put(store, &survey, &[file("images/a.jpg", "a")]).await;
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
