//! Files of surveys, and how they come.

use super::{ALL, LEASE, at, claim, enqueue, file, model, plant, put, reserve, survey};
use heliomap::store::{
    Digest, FileDeleted, FileRecord, FileWritten, Heartbeat, Piece, Store, StoreError, SurveyId, SurveyPath, Upload,
    UploadId, Wanted,
};
use heliomap_mapping::reconstruction::PhotoFacts;
use heliomap_model::PlantId;
use uuid::Uuid;

pub async fn files_all_or_none(store: &dyn Store) {
    let survey = survey(store, plant(store, "A").await.id, "June").await;
    let (a, b) = (file("images/a.jpg", "a"), file("reconstruction.json", "b"));
    let written = put(store, &survey, &[a.clone(), b.clone()]).await;
    assert_eq!(written, [FileWritten::Created, FileWritten::Created]);
    let mut changed = file("images/a.jpg", "other");
    changed.size_px = Some([4, 3]);
    let written = put(store, &survey, &[changed, b]).await;
    assert_eq!(written, [FileWritten::Replaced, FileWritten::Unchanged]);
    let files = store.files(survey.id).await.unwrap();
    assert_eq!((files.len(), files[0].size, files[0].size_px), (2, 5, Some([4, 3])));
    assert_eq!(files[0].sha256, Digest::of(b"other"));
    let found = store.file(survey.id, &files[0].path).await.unwrap().unwrap();
    assert_eq!((found.path, found.photo, found.shots), (files[0].path.clone(), None, None));
    let refused = store.put_files(heliomap::store::SurveyId(Uuid::nil()), &[a]).await;
    assert!(matches!(refused, Err(StoreError::Gone { what: "survey" })));
}

pub async fn what_is_deleted_goes_and_models_say_so(store: &dyn Store) {
    let survey = survey(store, plant(store, "A").await.id, "June").await;
    let (a, b) = (file("images/a.jpg", "a"), file("images/b.jpg", "b"));
    put(store, &survey, &[a.clone(), b.clone()]).await;
    enqueue(store, &survey).await;
    let mapped = claim(store, 0).await.unwrap();
    store.complete_job(&mapped, &model(survey.plant, 1, 3), at(1)).await.unwrap();
    let codes = async || {
        let model = store.model(survey.plant, None).await.unwrap().unwrap();
        model.warnings.into_iter().map(|warning| (warning.code, warning.images)).collect::<Vec<_>>()
    };
    let before = codes().await;

    let other = Wanted::OneOf(vec![Digest::of(b"other")]);
    let delete =
        async |file: &FileRecord, wanted| store.delete_file(survey.id, &file.path, wanted, at(2)).await.unwrap();
    assert_eq!(delete(&a, Some(&other)).await, FileDeleted::Other);
    assert_eq!(delete(&a, None).await, FileDeleted::Deleted);
    assert_eq!(delete(&a, None).await, FileDeleted::Absent);
    assert_eq!(store.files(survey.id).await.unwrap().len(), 1);
    let named = ("source_deleted".to_owned(), vec!["a.jpg".to_owned()]);
    assert_eq!(codes().await, [before.clone(), vec![named.clone()]].concat());
    // Nothing names its bytes any more, nor those of the survey's other file later on.
    let unused = async || {
        let taken = store.take_unused_blobs(at(100), LEASE, 9, at(100)).await.unwrap();
        taken.into_iter().map(|unused| unused.blob.sha256).collect::<Vec<_>>()
    };
    assert_eq!(unused().await, [a.sha256]);

    enqueue(store, &survey).await;
    let running = claim(store, 10).await.unwrap();
    assert_eq!(store.delete_survey(survey.id, at(11)).await.unwrap(), Some(Vec::new()));
    assert_eq!(store.delete_survey(survey.id, at(11)).await.unwrap(), None);
    assert!(matches!(store.heartbeat(&running, None, LEASE, at(12)).await.unwrap(), Heartbeat::Lost));
    assert!(store.jobs(survey.plant, None, None, ALL).await.unwrap().is_empty());
    assert_eq!(codes().await, [before, vec![named]].concat());
    assert_eq!(unused().await, [b.sha256]);
    let refused = store.delete_file(survey.id, &b.path, None, at(12)).await;
    assert!(matches!(refused, Err(StoreError::Gone { what: "survey" })));
}

pub async fn names_are_changed_where_they_are_free(store: &dyn Store) {
    let (first, second) = (plant(store, "A").await, plant(store, "B").await);
    let (june, july) = (survey(store, first.id, "June").await, survey(store, first.id, "July").await);
    assert_eq!(store.rename_plant(first.id, "C").await.unwrap().name, "C");
    assert_eq!(store.rename_plant(first.id, "C").await.unwrap().name, "C");
    assert!(matches!(store.rename_plant(first.id, "B").await, Err(StoreError::NameTaken)));
    assert!(matches!(store.rename_plant(PlantId(Uuid::nil()), "D").await, Err(StoreError::Gone { .. })));
    assert_eq!(store.rename_survey(june.id, "May").await.unwrap().name, "May");
    assert!(matches!(store.rename_survey(july.id, "May").await, Err(StoreError::NameTaken)));
    assert!(matches!(store.rename_survey(SurveyId(Uuid::nil()), "D").await, Err(StoreError::Gone { .. })));
    // The same name is free elsewhere, and after all of this the store writes as before.
    survey(store, second.id, "May").await;
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
    put(store, &survey, &plain).await;
    let with_facts = FileRecord { photo: Some(facts.clone()), ..file("images/b.jpg", "1") };
    assert_eq!(put(store, &survey, &[with_facts]).await, [FileWritten::Unchanged]);
    let shots = Some(vec!["a.jpg".to_owned(), "d.jpg".to_owned()]);
    let others = [
        FileRecord { shots: shots.clone(), ..file("reconstruction.json", "1") },
        file("undistorted/images/a.jpg", "1"),
    ];
    put(store, &survey, &others).await;

    let first = store.photos(survey.id, "", "", 2).await.unwrap();
    let names = |photos: &[FileRecord]| photos.iter().map(|p| p.path.file_name().to_owned()).collect::<Vec<_>>();
    assert_eq!(names(&first), ["a.jpg", "b.jpg"]);
    assert_eq!(names(&store.photos(survey.id, "", first[1].path.as_str(), 9).await.unwrap()), ["c.jpg"]);
    assert_eq!(names(&store.photos(survey.id, "b.", "", 9).await.unwrap()), ["b.jpg"]);
    assert!(store.photos(survey.id, "B", "", 9).await.unwrap().is_empty());
    assert!(store.photos(survey.id, "a", first[0].path.as_str(), 9).await.unwrap().is_empty());
    assert_eq!((&first[0].photo, &first[1].photo), (&None, &Some(facts)));
    let reconstruction = store.file(survey.id, &others[0].path).await.unwrap().unwrap();
    assert_eq!(reconstruction.shots, shots);
    let same = store.photos_of_digest(survey.id, Digest::of(b"1"), 9).await.unwrap();
    assert_eq!(same.iter().map(SurveyPath::as_str).collect::<Vec<_>>(), ["images/a.jpg", "images/b.jpg"]);
    assert_eq!(store.photos_of_digest(survey.id, Digest::of(b"1"), 1).await.unwrap().len(), 1);
    let alike = store.photos_alike(survey.id).await.unwrap();
    assert_eq!(alike, same.into_iter().map(|path| (Digest::of(b"1"), path)).collect::<Vec<_>>());
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
        parts: None,
        metadata: "filename YS5qcGc=".to_owned(),
        expires: at(100),
        outcome: None,
        home: None,
    };
    store.create_upload(&upload, None, at(0)).await.unwrap();
    assert_eq!(store.upload(survey.id, id).await.unwrap(), Some(upload.clone()));
    assert_eq!(store.upload(SurveyId(Uuid::nil()), id).await.unwrap(), None);
    let home = Uuid::from_u128(8);
    let piece = |from: u64, to: u64| Piece { from, to, name: Uuid::from_u128(from.into()), home };
    let pieces = [piece(0, 1 << 32), piece(1 << 32, 1 << 33)];
    assert!(store.upload_received(&upload, 1 << 33, Some(home), &pieces, at(200)).await.unwrap());
    // Who does not know of that, on another server, does not count on.
    assert!(!store.upload_received(&upload, 1 << 32, None, &pieces[..1], at(300)).await.unwrap());
    let unknown = Upload { id: UploadId(Uuid::nil()), ..upload.clone() };
    assert!(!store.upload_received(&unknown, 1, None, &[], at(200)).await.unwrap());
    assert_eq!(store.upload_pieces(id).await.unwrap(), pieces);
    assert_eq!(store.uploads_of_plant(survey.plant).await.unwrap(), [id]);
    // One server stores the whole file, unless it falls silent.
    let [one, other] = [1, 2].map(Uuid::from_u128);
    assert!(store.take_upload_end(id, one, LEASE, at(10)).await.unwrap());
    assert!(!store.take_upload_end(id, other, LEASE, at(20)).await.unwrap());
    assert!(store.take_upload_end(id, one, LEASE, at(20)).await.unwrap());
    assert!(!store.take_upload_end(id, other, LEASE, at(45)).await.unwrap());
    assert!(store.take_upload_end(id, other, LEASE, at(51)).await.unwrap());
    store.end_upload(id, one, Some("[]")).await.unwrap();
    assert_eq!(store.upload(survey.id, id).await.unwrap().unwrap().outcome, None);
    store.end_upload(id, other, None).await.unwrap();
    assert!(store.take_upload_end(id, one, LEASE, at(52)).await.unwrap());
    store.end_upload(id, one, Some("{}")).await.unwrap();
    assert!(!store.take_upload_end(id, one, LEASE, at(53)).await.unwrap());
    (upload.received, upload.home, upload.expires, upload.outcome) =
        (1 << 33, Some(home), at(200), Some("{}".to_owned()));
    assert_eq!(store.upload(survey.id, id).await.unwrap(), Some(upload.clone()));
    let ids = (1..=3).map(|number| UploadId(Uuid::from_u128(number << 64))).collect::<Vec<_>>();
    for (id, expires) in ids.iter().zip([150, 150, 100]) {
        let another = Upload { id: *id, received: 0, outcome: None, expires: at(expires), ..upload.clone() };
        store.create_upload(&another, None, at(0)).await.unwrap();
    }
    let listed = async |after: String, limit, now| -> Vec<UploadId> {
        let found = store.uploads_of_survey(survey.id, &after, limit, at(now)).await.unwrap();
        found.iter().map(|upload| upload.id).collect()
    };
    assert_eq!(listed(String::new(), 9, 99).await, [id, ids[0], ids[1], ids[2]]);
    assert_eq!(listed(String::new(), 2, 99).await, [id, ids[0]]);
    assert_eq!(listed(ids[0].to_string(), 9, 100).await, [ids[1]], "the last one's time is over");
    assert!(store.uploads_of_survey(SurveyId(Uuid::nil()), "", 9, at(0)).await.unwrap().is_empty());
    store.delete_expired_uploads(at(199)).await.unwrap();
    assert_eq!(store.uploads().await.unwrap(), [id]);
    store.delete_expired_uploads(at(200)).await.unwrap();
    assert!(store.uploads().await.unwrap().is_empty());
    store.create_upload(&upload, None, at(0)).await.unwrap();
    assert!(!store.delete_upload(SurveyId(Uuid::nil()), id).await.unwrap());
    assert!(store.delete_upload(survey.id, id).await.unwrap());
    upload.parts = Some("final;/a /b".to_owned());
    store.create_upload(&Upload { outcome: None, ..upload.clone() }, None, at(0)).await.unwrap();
    assert_eq!(store.upload(survey.id, id).await.unwrap().unwrap().parts, upload.parts);
    assert!(store.delete_upload(survey.id, id).await.unwrap());
    upload.survey = SurveyId(Uuid::nil());
    assert!(matches!(store.create_upload(&upload, None, at(0)).await, Err(StoreError::Gone { what: "survey" })));
}

pub async fn files_are_replaced_only_if_the_precondition_holds(store: &dyn Store) {
    let survey = survey(store, plant(store, "A").await.id, "June").await;
    let put = async |content: &str, wanted: Wanted| {
        let file = file("images/a.jpg", content);
        reserve(store, survey.plant, std::slice::from_ref(&file)).await.unwrap();
        store.replace_file(survey.id, &file, &wanted).await.unwrap()
    };
    let of = |content: &str| Wanted::OneOf(vec![Digest::of(b"other"), Digest::of(content.as_bytes())]);
    assert_eq!(put("1", Wanted::Anything).await, None);
    assert_eq!(put("1", of("1")).await, None);
    assert_eq!(put("1", Wanted::Nothing).await, Some(FileWritten::Created));
    assert_eq!(put("2", Wanted::Nothing).await, None);
    assert_eq!(put("2", of("3")).await, None);
    assert_eq!(put("2", of("1")).await, Some(FileWritten::Replaced));
    assert_eq!(put("2", of("2")).await, Some(FileWritten::Unchanged));
    let none_of = |content: &str| Wanted::NoneOf(vec![Digest::of(b"other"), Digest::of(content.as_bytes())]);
    assert_eq!(put("3", none_of("2")).await, None);
    assert_eq!(put("4", none_of("3")).await, Some(FileWritten::Replaced));
    assert_eq!(put("3", Wanted::Anything).await, Some(FileWritten::Replaced));
    assert_eq!(store.files(survey.id).await.unwrap()[0].sha256, Digest::of(b"3"));

    // Of many who saw the same and replace it at once, one does.
    let many = (0..8).map(|number| {
        let replaced = file("images/a.jpg", &format!("by {number}"));
        let survey = &survey;
        async move {
            reserve(store, survey.plant, std::slice::from_ref(&replaced)).await.unwrap();
            store.replace_file(survey.id, &replaced, &of("3")).await.unwrap()
        }
    });
    let outcomes = futures::future::join_all(many).await;
    assert_eq!(outcomes.iter().filter(|outcome| outcome.is_some()).count(), 1, "{outcomes:?}");
}

pub async fn referenced_blobs_are_listed(store: &dyn Store) {
    let (a, b) = (plant(store, "A").await.id, plant(store, "B").await.id);
    let (june, july) = (survey(store, a, "June").await, survey(store, a, "July").await);
    let other = survey(store, b, "June").await;
    put(store, &june, &[file("images/a.jpg", "1"), file("images/b.jpg", "22")]).await;
    put(store, &july, &[file("images/c.jpg", "1")]).await;
    put(store, &other, &[file("images/a.jpg", "1")]).await;
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
    put(store, &june, &[file("images/b.jpg", "1")]).await;
    assert_eq!(store.blobs(None, 9).await.unwrap().len(), 3);
}
