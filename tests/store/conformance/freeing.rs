//! What becomes of bytes that nothing names any more.

use super::{LEASE, ORGANISATION, at, claim, enqueue, file, model, plant, put, reserve, survey};
use heliomap::store::{Digest, Ending, FileRecord, Quotas, Store, StoreError, UnusedBlob};
use heliomap_model::PlantId;

/// `images/NAME` with this content, stored at a time.
fn photo(name: &str, content: &str, stored: i64) -> FileRecord {
    FileRecord { stored: at(stored), ..file(&format!("images/{name}.jpg"), content) }
}

async fn take(store: &dyn Store, before: i64, now: i64) -> Vec<UnusedBlob> {
    store.take_unused_blobs(at(before), LEASE, 1000, at(now)).await.unwrap()
}

fn contents(unused: &[UnusedBlob]) -> Vec<(PlantId, Digest)> {
    unused.iter().map(|unused| (unused.blob.plant, unused.blob.sha256)).collect()
}

async fn bytes(store: &dyn Store) -> u64 {
    store.usage(ORGANISATION, at(0)).await.unwrap().unwrap().bytes
}

pub async fn unreferenced_blobs_are_freed(store: &dyn Store) {
    let (a, b) = (plant(store, "A").await.id, plant(store, "B").await.id);
    let (june, july) = (survey(store, a, "June").await, survey(store, a, "July").await);
    let other = survey(store, b, "June").await;
    let old = Digest::of(b"old");
    for (survey, name) in [(&june, "1"), (&june, "2"), (&july, "1"), (&other, "1")] {
        put(store, survey, &[photo(name, "old", 1)]).await;
    }
    // Its plant's last one that holds these bytes counts, of whichever survey.
    put(store, &june, &[photo("1", "new", 10), photo("2", "new", 10)]).await;
    assert!(take(store, 100, 100).await.is_empty());
    put(store, &july, &[photo("1", "newer", 20)]).await;
    assert_eq!(bytes(store).await, 3 + 3 + 3 + 5);
    assert!(take(store, 20, 100).await.is_empty(), "it is unused since 20");
    let taken = take(store, 21, 100).await;
    assert_eq!((contents(&taken), taken[0].blob.size), (vec![(a, old)], 3));
    // Until they are gone, the blobs can be neither claimed nor reserved.
    assert!(take(store, 21, 101).await.is_empty());
    let again = photo("3", "old", 102);
    let refused = reserve(store, a, std::slice::from_ref(&again)).await;
    assert!(matches!(refused, Err(StoreError::BeingFreed { sha256 }) if sha256 == old), "{refused:?}");
    let refused = store.put_files(june.id, std::slice::from_ref(&again)).await;
    assert!(matches!(refused, Err(StoreError::BeingFreed { .. })), "{refused:?}");
    assert_eq!(bytes(store).await, 14);
    // Whoever took them died: another one does it, and the first is heard no more.
    let retaken = take(store, 21, 131).await;
    assert_eq!(contents(&retaken), [(a, old)]);
    assert!(!store.blob_is_gone(&taken[0]).await.unwrap());
    assert!(store.blob_is_gone(&retaken[0]).await.unwrap());
    assert!(!store.blob_is_gone(&retaken[0]).await.unwrap());
    assert_eq!(bytes(store).await, 11);
    put(store, &june, &[again]).await;
    assert_eq!(bytes(store).await, 14);
    assert!(take(store, 1000, 1000).await.is_empty(), "all are named, in the other plant, too");
    store.delete_plant(a, at(1)).await.unwrap();
    assert!(!store.blob_is_gone(&retaken[0]).await.unwrap());
    assert_eq!(bytes(store).await, 3);
}

pub async fn blobs_that_are_uploaded_again_are_kept(store: &dyn Store) {
    let june = survey(store, plant(store, "A").await.id, "June").await;
    put(store, &june, &[photo("1", "old", 1)]).await;
    put(store, &june, &[photo("1", "new", 10)]).await;
    // An upload has reserved them: they are unused only from then on.
    let again = photo("2", "old", 50);
    reserve(store, june.plant, std::slice::from_ref(&again)).await.unwrap();
    assert!(take(store, 50, 60).await.is_empty());
    store.put_files(june.id, std::slice::from_ref(&again)).await.unwrap();
    assert!(take(store, 1000, 1000).await.is_empty());
    // One that was never ended leaves nothing behind for ever.
    reserve(store, june.plant, &[photo("3", "lost", 70)]).await.unwrap();
    assert!(take(store, 70, 100).await.is_empty());
    assert_eq!(contents(&take(store, 71, 100).await), [(june.plant, Digest::of(b"lost"))]);
    // One that took longer than bytes without a name are kept must bring them anew.
    let late = store.put_files(june.id, &[photo("3", "lost", 110)]).await;
    assert!(matches!(late, Err(StoreError::BeingFreed { .. })), "{late:?}");
    assert_eq!(store.files(june.id).await.unwrap().len(), 2);
}

pub async fn unreferenced_models_are_freed(store: &dyn Store) {
    let june = survey(store, plant(store, "A").await.id, "June").await;
    let lost = (Digest::of(b"lost"), 4);
    let quota = Quotas { bytes: Some(1), plants: None };
    store.set_quotas(ORGANISATION, quota).await.unwrap();
    store.reserve_model(june.plant, lost, at(1)).await.unwrap();
    store.reserve_model(june.plant, (Digest::of(b"model"), 5), at(1)).await.unwrap();
    assert_eq!(bytes(store).await, 9, "no quota forbids it");
    enqueue(store, &june).await;
    let running = claim(store, 2).await.unwrap();
    store.complete_job(&running, &model(june.plant, 1, 1), at(3)).await.unwrap();
    assert_eq!(bytes(store).await, 9, "it counts once");
    assert_eq!(contents(&take(store, 100, 100).await), [(june.plant, lost.0)]);
    let nowhere = store.reserve_model(PlantId(uuid::Uuid::nil()), lost, at(1)).await;
    assert!(matches!(nowhere, Err(StoreError::Gone { what: "plant" })), "{nowhere:?}");
}

pub async fn blobs_that_a_running_job_may_read_are_kept(store: &dyn Store) {
    let june = survey(store, plant(store, "A").await.id, "June").await;
    let elsewhere = survey(store, plant(store, "B").await.id, "June").await;
    for survey in [&june, &elsewhere] {
        put(store, survey, &[photo("1", "old", 1)]).await;
    }
    enqueue(store, &june).await;
    let running = claim(store, 5).await.unwrap();
    for survey in [&june, &elsewhere] {
        put(store, survey, &[photo("1", "new", 10)]).await;
    }
    assert_eq!(contents(&take(store, 100, 100).await), [(elsewhere.plant, Digest::of(b"old"))]);
    // A job that goes back to the queue looks at the survey anew; one whose worker fell silent is not over.
    assert!(take(store, 1000, 101).await.is_empty());
    assert!(store.end_job(&running, &Ending::Released, at(101)).await.unwrap());
    let taken = take(store, 1000, 102).await;
    assert_eq!(contents(&taken), [(june.plant, Digest::of(b"old"))]);
    // A deletion that had begun is finished, even if a job began since then.
    let running = claim(store, 200).await.unwrap();
    let retaken = take(store, 1000, 300).await;
    let retaken = retaken.iter().find(|unused| unused.blob.plant == june.plant).unwrap();
    assert!(store.blob_is_gone(retaken).await.unwrap());
    // What a model holds is named by it.
    store.complete_job(&running, &model(june.plant, 1, 1), at(201)).await.unwrap();
    put(store, &june, &[photo("2", "model", 210)]).await;
    put(store, &june, &[photo("2", "other", 220)]).await;
    assert!(take(store, 1000, 1000).await.iter().all(|unused| unused.blob.plant != june.plant));
}

/// Files that hold the same bytes are replaced at once: whichever is last, the bytes are unused after it.
pub async fn blobs_are_kept_until_the_last_reference_is_gone(store: &dyn Store) {
    let plant = plant(store, "A").await.id;
    let names: Vec<String> = (0..6).map(|number| number.to_string()).collect();
    let mut surveys = Vec::new();
    for name in &names {
        surveys.push(survey(store, plant, name).await);
    }
    for round in 0..4 {
        let old = format!("old {round}");
        for survey in &surveys {
            put(store, survey, &[photo("1", &old, 10 * round)]).await;
        }
        let replaced = surveys.iter().map(|survey| async move {
            let new = photo("1", &format!("{round} of {}", survey.name), 10 * round + 5);
            put(store, survey, &[new]).await;
        });
        futures::future::join_all(replaced).await;
        let taken = take(store, 10 * round + 6, 1000).await;
        let taken: Vec<_> = taken.iter().filter(|unused| unused.blob.sha256 == Digest::of(old.as_bytes())).collect();
        assert_eq!(taken.len(), 1, "in round {round}");
    }
    // And an upload of the same bytes at that moment keeps them or hears that they go.
    for round in 0..20 {
        let (old, new) = (format!("again {round}"), format!("other {round}"));
        put(store, &surveys[0], &[photo("2", &old, 2000)]).await;
        let again = [photo("2", &old, 2020)];
        let upload = async {
            reserve(store, plant, &again).await.is_ok() && store.put_files(surveys[1].id, &again).await.is_ok()
        };
        let replace = async {
            put(store, &surveys[0], &[photo("2", &new, 2010)]).await;
            take(store, 2011, 2030).await
        };
        let (kept, taken) = futures::future::join(upload, replace).await;
        let freed = taken.iter().any(|unused| unused.blob.sha256 == Digest::of(old.as_bytes()));
        assert_ne!(kept, freed, "in round {round}");
    }
}
