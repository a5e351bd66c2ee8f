//! Organisations, keys, the audit log, and requests that may be sent again.

use super::{ALL, ORGANISATION, at};
use heliomap::store::requests::{Begun, KeptAnswer};
use heliomap::store::{
    AuditEntry, Created, Digest, KeyId, NewKey, OrganisationId, Page, Quotas, Scope, SecretRecord, Store, StoreError,
    TimeSpan,
};
use heliomap_model::PlantId;
use uuid::Uuid;

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
    let refused = store.create_plant(OrganisationId(Uuid::max()), "x", Quotas::default(), at(3)).await;
    assert!(matches!(refused, Err(StoreError::Gone { what: "organisation" })));
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

    assert!(store.rotate_key(b, key.id, None, &secret("two"), at(20)).await.unwrap().is_none());
    let rotated = store.rotate_key(a, key.id, None, &secret("two"), at(20)).await.unwrap().unwrap();
    assert_eq!(rotated.prefix, "two");
    // Whoever knows it by the secret of before neither rotates nor revokes it.
    assert!(store.rotate_key(a, key.id, Some("one"), &secret("four"), at(20)).await.unwrap().is_none());
    assert!(store.revoke_key(a, key.id, Some("one"), at(20)).await.unwrap().is_none());
    assert_eq!((found("one", 19).await, found("one", 20).await), (Some(key.id), None));
    assert_eq!(found("two", 50).await, Some(key.id));
    assert!(store.revoke_key(b, key.id, None, at(30)).await.unwrap().is_none());
    assert_eq!(store.revoke_key(a, key.id, Some("two"), at(30)).await.unwrap().unwrap().revoked, Some(at(30)));
    assert_eq!(store.revoke_key(a, key.id, None, at(40)).await.unwrap().unwrap().revoked, Some(at(30)));
    assert_eq!((found("one", 10).await, found("two", 10).await), (None, None));
    assert!(store.rotate_key(a, key.id, None, &secret("three"), at(50)).await.unwrap().is_none());
    assert!(store.revoke_key(a, KeyId(Uuid::nil()), None, at(30)).await.unwrap().is_none());
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
    store.forget_audit(at(3)).await.unwrap();
    assert_eq!(store.audit(a, TimeSpan::default(), ALL).await.unwrap().len(), 1);
    assert!(store.audit(b, TimeSpan::default(), ALL).await.unwrap().is_empty());
}

pub async fn named_requests(store: &dyn Store) {
    let (a, b) = (organisation(store, "A").await, organisation(store, "B").await);
    let [first, second] = [Uuid::from_u128(1), Uuid::from_u128(2)];
    let begin = async |organisation, token, now| {
        store.begin_request(organisation, "one", token, at(now), at(now + 60)).await.unwrap()
    };
    assert_eq!(begin(a, first, 0).await, Begun::New);
    assert_eq!(begin(a, second, 59).await, Begun::Running);
    assert_eq!(begin(b, second, 0).await, Begun::New, "names are each organisation's own");
    // It takes its time.
    store.renew_request(a, "one", first, at(100)).await.unwrap();
    assert_eq!(begin(a, second, 99).await, Begun::Running);
    // Whoever had it died over it, or slept: it is another's now.
    assert_eq!(begin(a, second, 100).await, Begun::New);
    let answer =
        KeptAnswer { fingerprint: Digest::of(b"x"), status: 201, headers: "{}".to_owned(), body: vec![0, 159, 255] };
    store.renew_request(a, "one", first, at(1000)).await.unwrap();
    store.keep_answer(a, "one", first, &answer, at(1000)).await.unwrap();
    store.forget_request(a, "one", first).await.unwrap();
    assert_eq!(begin(a, first, 101).await, Begun::Running);
    store.keep_answer(a, "one", second, &answer, at(1000)).await.unwrap();
    assert_eq!(begin(a, first, 200).await, Begun::Answered(Box::new(answer.clone())));
    store.forget_request(a, "one", second).await.unwrap();
    assert_eq!(begin(a, first, 200).await, Begun::Answered(Box::new(answer)), "what was answered stays");
    store.forget_request(b, "one", second).await.unwrap();
    assert_eq!(begin(b, first, 1).await, Begun::New);
    store.forget_old_requests(at(1000)).await.unwrap();
    assert_eq!(begin(a, first, 999).await, Begun::New);
}
