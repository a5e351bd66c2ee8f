//! Models and their features.

use super::{ALL, at, claim, enqueue, model, plant, state, survey};
use heliomap::store::{Completed, Digest, FeatureQuery, GeoBox, JobState, Store};
use heliomap_model::{Layer, ModuleId};

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

/// More features than one statement takes: all are there, once, in their order.
pub async fn large_models(store: &dyn Store) {
    let survey = survey(store, plant(store, "A").await.id, "June").await;
    for (version, columns) in [(1, 1000), (2, 1234)] {
        enqueue(store, &survey).await;
        let claim = claim(store, 0).await.unwrap();
        let stored = store.complete_job(&claim, &model(survey.plant, version, columns), at(1)).await.unwrap();
        let Completed::Done(stored) = stored else { panic!("the claim holds") };
        let layer = store.layer(&stored, Layer::Modules).await.unwrap().unwrap();
        let all = store.features(&layer, FeatureQuery { after: None, limit: 5000, within: None }).await.unwrap();
        let found: Vec<(i64, String)> = all.into_iter().map(|feature| (feature.seq, feature.json)).collect();
        let expected = (0..columns).map(|c| (c as i64 + 1, format!("{{\"column\":{c},\"version\":{version}}}")));
        assert_eq!(found, expected.collect::<Vec<_>>());
        let last = store.module(&stored, ModuleId::from_serial(survey.plant, columns - 1)).await.unwrap();
        assert!(last.is_some());
    }
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
