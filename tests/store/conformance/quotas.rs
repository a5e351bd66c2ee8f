//! What organisations keep, and may keep.

use super::{LEASE, ORGANISATION, at, claim, enqueue, model, plant, survey};
use heliomap::store::usage::UNLIMITED;
use heliomap::store::{
    Created, Digest, OrganisationId, Quotas, Store, StoreError, Upload, UploadBounds, UploadId, Usage,
};
use heliomap_model::PlantId;
use uuid::Uuid;

pub async fn quotas(store: &dyn Store) {
    let a = plant(store, "A").await;
    let usage = async || store.usage(ORGANISATION, at(5)).await.unwrap().unwrap();
    let kept = Usage { bytes: 0, announced_bytes: 0, plants: 1, own: Quotas::default() };
    assert_eq!(usage().await, kept);
    assert!(store.usage(OrganisationId(Uuid::max()), at(5)).await.unwrap().is_none());

    // The same bytes count once in a plant.
    let (one, two) = ((Digest::of(b"1"), 60), (Digest::of(b"2"), 50));
    let none = Quotas::default();
    store.reserve_bytes(a.id, &[one, one], none, at(1)).await.unwrap();
    store.reserve_bytes(a.id, &[one], none, at(1)).await.unwrap();
    assert_eq!(usage().await.bytes, 60);
    let tight = Quotas { bytes: Some(100), plants: Some(1) };
    let refused = store.reserve_bytes(a.id, &[two], tight, at(1)).await;
    assert!(matches!(refused, Err(StoreError::OverQuota { what: "bytes", used: 60, quota: 100 })), "{refused:?}");
    assert_eq!(usage().await.bytes, 60);
    store.reserve_bytes(a.id, &[one], Quotas { bytes: Some(10), plants: None }, at(1)).await.unwrap();
    let nowhere = store.reserve_bytes(PlantId(Uuid::nil()), &[one], none, at(1)).await;
    assert!(matches!(nowhere, Err(StoreError::Gone { what: "plant" })));

    // Quotas of one organisation override the defaults.
    let refused = store.create_plant(ORGANISATION, "B", tight, at(1)).await;
    assert!(matches!(refused, Err(StoreError::OverQuota { what: "plants", used: 1, quota: 1 })), "{refused:?}");
    assert!(matches!(store.create_plant(ORGANISATION, "A", tight, at(1)).await.unwrap(), Created::Existing(_)));
    let own = Quotas { bytes: Some(UNLIMITED), plants: Some(2) };
    store.set_quotas(ORGANISATION, own).await.unwrap();
    let Created::New(b) = store.create_plant(ORGANISATION, "B", tight, at(1)).await.unwrap() else {
        panic!("there is room for two")
    };
    store.reserve_bytes(b.id, &[two], tight, at(1)).await.unwrap();
    let june = survey(store, a.id, "June").await;
    let upload = |id: u128, length, outcome: bool, expires| Upload {
        id: UploadId(Uuid::from_u128(id)),
        survey: june.id,
        length,
        received: 0,
        partial: false,
        parts: None,
        metadata: String::new(),
        expires: at(expires),
        outcome: outcome.then(|| "{}".to_owned()),
        home: None,
    };
    for upload in [upload(1, 7, false, 9), upload(2, 70, true, 9), upload(3, 700, false, 4)] {
        store.create_upload(&upload, None, at(0)).await.unwrap();
        if let Some(outcome) = &upload.outcome {
            assert!(store.take_upload_end(upload.id, upload.id.0, LEASE, at(0)).await.unwrap());
            store.end_upload(upload.id, upload.id.0, Some(outcome)).await.unwrap();
        }
    }
    assert_eq!(usage().await, Usage { bytes: 110, announced_bytes: 7, plants: 2, own });
    // What begins fits beside what is kept and announced, or, where it may be there already, beside what is announced.
    store.set_quotas(ORGANISATION, Quotas { bytes: Some(120), plants: Some(2) }).await.unwrap();
    let bounds = |open, may_be_there| UploadBounds { quotas: none, open, may_be_there };
    let begin = async |length, bounds: UploadBounds| {
        let begun = store.create_upload(&upload(4, length, false, 9), Some(&bounds), at(5)).await;
        store.delete_upload(june.id, UploadId(Uuid::from_u128(4))).await.unwrap();
        begun
    };
    begin(3, bounds(2, false)).await.unwrap();
    let refused = begin(4, bounds(2, false)).await;
    assert!(matches!(refused, Err(StoreError::OverQuota { what: "bytes", used: 117, quota: 120 })), "{refused:?}");
    begin(113, bounds(2, true)).await.unwrap();
    assert!(matches!(begin(114, bounds(2, true)).await, Err(StoreError::OverQuota { .. })));
    let refused = begin(1, bounds(1, true)).await;
    assert!(matches!(refused, Err(StoreError::TooManyUploads { open: 1, max: 1 })), "{refused:?}");
    store.set_quotas(ORGANISATION, own).await.unwrap();

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
