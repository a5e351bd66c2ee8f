use crate::app::{Act, App, assert_problem, job_path, jpeg, plant_path};
use heliomap::store::{Digest, Enqueued, JobId, JobRequest, SurveyId};
use heliomap_model::PlantId;
use jiff::Timestamp;
use reqwest::StatusCode;
use serde_json::json;
use std::time::Duration;

#[tokio::test]
async fn from_upload_to_model() {
    let app = App::new(&[Act::Map(3)]).await;
    let survey = app.complete_survey().await;
    let job = app.map(&survey).await;
    assert_eq!((&job["state"], &job["model_version"], &job["attempt"]), (&json!("succeeded"), &json!(1), &json!(1)));
    assert_eq!(job["warnings"][0]["code"], "high_image");
    assert_eq!((&job["progress"]["stage"], &job["progress"]["done"]), (&json!("detect"), &json!(1)));
    assert_eq!(
        app.mapper.seen.lock().unwrap()[0],
        ["images/a.jpg", "images/b.jpg", "reconstruction.json", "reference_lla.json"]
    );
    let (status, model) = app.get(job["model"].as_str().unwrap()).await;
    assert_eq!((status, &model["layers"][0]["features"]), (StatusCode::OK, &json!(3)));
    assert_eq!(std::fs::read_dir(app.folder.path().join("incoming")).unwrap().count(), 0);
}

#[tokio::test]
async fn a_photo_that_the_storage_does_not_give_is_asked_for_again() {
    let app = App::new(&[Act::Map(3)]).await;
    let survey = app.complete_survey().await;
    let digest = Digest::of(&jpeg(32, 24)).to_string();
    let plant = plant_path(&survey).rsplit('/').next().unwrap();
    let blob = app.folder.path().join("blobs/plants").join(plant).join(&digest[..2]).join(&digest);
    std::fs::remove_file(&blob).unwrap();
    let job = app.map(&survey).await;
    assert_eq!(
        (&job["state"], &job["attempt"], &job["error"]["code"]),
        (&json!("failed"), &json!(3), &json!("environment"))
    );
    assert_eq!(
        job["error"]["message"],
        "a.jpg cannot be fetched: the service's storage failed; see the log of the service"
    );
    std::fs::write(&blob, jpeg(32, 24)).unwrap();
    assert_eq!(app.map(&survey).await["state"], "succeeded");
}

#[tokio::test]
async fn a_survey_is_never_mapped_twice_at_once() {
    let app = App::new(&[Act::Wait]).await;
    let survey = app.complete_survey().await;
    let (first, job) = app.post(&format!("{survey}/jobs"), json!({"rows_per_bench": 2})).await;
    let (second, again) = app.post(&format!("{survey}/jobs"), json!({})).await;
    assert_eq!((first, second, &job["id"]), (StatusCode::ACCEPTED, StatusCode::OK, &again["id"]));
    assert_eq!(again["options"]["rows_per_bench"], 2);
}

#[tokio::test]
async fn a_running_job_is_cancelled() {
    let app = App::new(&[Act::Wait, Act::Map(1)]).await;
    let survey = app.complete_survey().await;
    let (_, job) = app.post(&format!("{survey}/jobs"), json!({})).await;
    app.follow_until(&job, |job| job["state"] == "running").await;
    for _ in 0..2 {
        let (status, _) = app.post(&format!("{}/cancel", job_path(&job)), json!(null)).await;
        assert_eq!(status, StatusCode::ACCEPTED);
    }
    assert_eq!(app.follow(&job).await["state"], "cancelled");
    assert_problem(app.get(&format!("{}/models/latest", plant_path(&survey))).await, 404, "model_not_found", "");
    let next = app.map(&survey).await;
    assert_eq!(next["state"], "succeeded");
    assert_problem(
        app.post(&format!("{}/cancel", job_path(&next)), json!(null)).await,
        409,
        "job_finished",
        "succeeded",
    );
    let (_, jobs) = app.get(&format!("{survey}/jobs")).await;
    let states: Vec<_> = jobs["items"].as_array().unwrap().iter().map(|job| job["state"].as_str().unwrap()).collect();
    assert_eq!(states, ["succeeded", "cancelled"]);
}

#[tokio::test]
async fn a_queued_job_is_cancelled_at_once() {
    let app = App::new(&[]).await;
    let survey = app.complete_survey().await;
    let (_, job) = app.post(&format!("{survey}/jobs"), json!({})).await;
    let (_, cancelled) = app.post(&format!("{}/cancel", job_path(&job)), json!(null)).await;
    assert_eq!((&job["state"], &cancelled["state"]), (&json!("queued"), &json!("cancelled")));
}

#[tokio::test]
async fn bad_input_is_not_tried_again() {
    let app = App::new(&[Act::RefuseInput]).await;
    let survey = app.complete_survey().await;
    let job = app.map(&survey).await;
    assert_eq!((&job["state"], &job["attempt"]), (&json!("failed"), &json!(1)));
    assert_eq!(job["error"], json!({"code": "no_modules", "message": "no photo shows a module; fly higher"}));
}

#[tokio::test]
async fn what_may_pass_is_tried_again() {
    let app = App::new(&[Act::FailEnvironment, Act::FailEnvironment, Act::Map(1)]).await;
    let survey = app.complete_survey().await;
    let job = app.map(&survey).await;
    assert_eq!((&job["state"], &job["attempt"], &job["error"]), (&json!("succeeded"), &json!(3), &json!(null)));

    let app = App::new(&[Act::FailEnvironment]).await;
    let survey = app.complete_survey().await;
    let job = app.map(&survey).await;
    assert_eq!((&job["state"], &job["attempt"]), (&json!("failed"), &json!(3)));
    assert_eq!(job["error"]["code"], "environment");
}

#[tokio::test]
async fn a_mapper_that_panics_fails_its_job_and_no_other() {
    let app = App::new(&[Act::Panic, Act::Map(1)]).await;
    let survey = app.complete_survey().await;
    let job = app.map(&survey).await;
    assert_eq!((&job["state"], &job["error"]["code"]), (&json!("failed"), &json!("internal_error")));
    assert_eq!(app.map(&survey).await["state"], "succeeded");
}

#[tokio::test]
async fn a_job_whose_plant_is_deleted_ends() {
    let app = App::new(&[Act::Wait, Act::Map(1)]).await;
    let survey = app.complete_survey().await;
    let (_, job) = app.post(&format!("{survey}/jobs"), json!({})).await;
    // It is in the mapper's hands.
    app.follow_until(&job, |job| job["progress"]["stage"] == "detect").await;
    app.request(reqwest::Method::DELETE, plant_path(&survey)).send().await.unwrap();
    assert_problem(app.get(&job_path(&job)).await, 404, "plant_not_found", "");
    let other = app.complete_survey().await;
    assert_eq!(app.map(&other).await["state"], "succeeded");
    tokio::time::sleep(Duration::from_millis(20)).await;
    assert_eq!(std::fs::read_dir(app.folder.path().join("blobs/plants")).unwrap().count(), 1);
}

#[tokio::test]
async fn options_are_checked() {
    let app = App::new(&[]).await;
    let survey = app.complete_survey().await;
    let jobs = format!("{survey}/jobs");
    assert_problem(app.post(&jobs, json!({"rows": 2})).await, 422, "invalid_fields", "rows");
    assert_problem(app.post(&jobs, json!({"rows_per_bench": 0})).await, 422, "invalid_fields", "rows_per_bench");
    assert_problem(app.post(&jobs, json!({"spacing_m": [1.0]})).await, 422, "invalid_fields", "spacing_m");
    assert_problem(
        app.post(&jobs, json!({"seed": -1})).await,
        422,
        "invalid_fields",
        "seed: invalid value: integer `-1`",
    );
    assert_problem(app.post(&jobs, json!({"max_gsd_m_per_px": -1})).await, 422, "invalid_fields", "max_gsd_m_per_px");
    assert_problem(app.post(&jobs, json!([])).await, 422, "invalid_fields", "an object");
    let empty = app.request(reqwest::Method::POST, &jobs).send().await.unwrap();
    assert_eq!(empty.status(), StatusCode::ACCEPTED);
    assert!(empty.headers()["location"].to_str().unwrap().contains("/jobs/"));
}

#[tokio::test]
async fn a_job_goes_on_where_it_was_and_getting_somewhere_gives_its_attempts_back() {
    let app =
        App::new(&[Act::FindOneAndFail, Act::FindOneAndFail, Act::FindOneAndFail, Act::FindOneAndFail, Act::Map(1)])
            .await;
    let survey = app.complete_survey().await;
    let job = app.map(&survey).await;
    assert_eq!((&job["state"], &job["attempt"], &job["max_attempts"]), (&json!("succeeded"), &json!(5), &json!(3)));

    // Other files: what was found in the ones before counts for nothing.
    let app = App::new(&[Act::FindOneAndFail, Act::Wait, Act::FindOneAndFail, Act::FailEnvironment]).await;
    let survey = app.complete_survey().await;
    let (_, job) = app.post(&format!("{survey}/jobs"), json!({})).await;
    app.follow_until(&job, |job| job["state"] == "running" && job["attempt"] == 2).await;
    app.put(&format!("{survey}/images/a.jpg"), jpeg(64, 48)).await;
    app.post(&format!("{}/cancel", job_path(&job)), json!(null)).await;
    assert_eq!(app.follow(&job).await["state"], "cancelled");
    let (_, job) = app.post(&format!("{survey}/jobs"), json!({})).await;
    let job = app.follow_until(&job, |job| job["error"].is_object()).await;
    assert_eq!(job["error"]["message"], "image 0 was found");
}

#[tokio::test]
async fn a_job_whose_mapper_hears_nothing_is_cancelled_all_the_same() {
    let app = App::new(&[Act::Deaf, Act::Map(2)]).await;
    let survey = app.complete_survey().await;
    let (_, job) = app.post(&format!("{survey}/jobs"), json!({})).await;
    app.follow_until(&job, |job| job["state"] == "running").await;
    app.post(&format!("{}/cancel", job_path(&job)), json!(null)).await;
    assert_eq!(app.follow(&job).await["state"], "cancelled");
    assert_eq!(app.mapper.seen.lock().unwrap().len(), 1);
    let next = app.map(&survey).await;
    assert_eq!((&next["state"], &next["model_version"]), (&json!("succeeded"), &json!(1)));
}

#[tokio::test]
async fn the_highest_priority_goes_first() {
    let app = App::new(&[]).await;
    let survey = app.complete_survey().await;
    let plant = plant_path(&survey).to_owned();
    let (_, other) = app.post(&format!("{plant}/surveys"), json!({"name": "urgent"})).await;
    let urgent = format!("{plant}/surveys/{}", other["id"].as_str().unwrap());
    app.fill(&urgent).await;
    app.post(&format!("{survey}/jobs"), json!({})).await;
    let (_, job) = app.post(&format!("{urgent}/jobs"), json!({"priority": 7})).await;
    assert_eq!(job["priority"], 7);
    let now = jiff::Timestamp::now();
    let claim = app.store.claim_job("test", Duration::from_secs(9), now).await.unwrap().unwrap();
    assert_eq!(claim.job.id.to_string(), job["id"].as_str().unwrap());
    assert_problem(
        app.post(&format!("{survey}/jobs"), json!({"priority": 101})).await,
        422,
        "invalid_fields",
        "priority",
    );
}

#[tokio::test]
async fn progress_comes_as_events() {
    let app = App::new(&[Act::Wait]).await;
    let survey = app.complete_survey().await;
    let (_, job) = app.post(&format!("{survey}/jobs"), json!({})).await;
    let path = format!("{}/events", job_path(&job));
    let mut stream = app.request(reqwest::Method::GET, &path).send().await.unwrap();
    assert_eq!(stream.headers()["content-type"], "text/event-stream");
    app.follow_until(&job, |job| job["state"] == "running").await;
    app.post(&format!("{}/cancel", job_path(&job)), json!(null)).await;
    let mut text = String::new();
    while let Some(chunk) = stream.chunk().await.unwrap() {
        text.push_str(std::str::from_utf8(&chunk).unwrap());
    }
    let events: Vec<serde_json::Value> = text
        .split("\n\n")
        .filter_map(|event| serde_json::from_str(event.strip_prefix("event: job\ndata: ")?).ok())
        .collect();
    let (first, last) = (events.first().unwrap(), events.last().unwrap());
    assert_eq!((&first["id"], &last["state"]), (&job["id"], &json!("cancelled")));
    assert!(events.windows(2).all(|pair| pair[0] != pair[1]), "{events:?}");
    assert_problem(
        app.get(&path.replace(job["id"].as_str().unwrap(), "00000000-0000-4000-8000-000000000000")).await,
        404,
        "job_not_found",
        "",
    );
}

#[tokio::test]
async fn options_of_a_newer_version_wait_for_a_worker_that_knows_them() {
    let app = App::new(&[Act::Map(1)]).await;
    let survey = app.complete_survey().await;
    let (_, job) = app.post(&format!("{survey}/jobs"), json!({"rows_per_bench": 2, "seed": 1})).await;
    let job = app.follow(&job).await;
    let (plant, id) = (job["plant"].as_str().unwrap(), job["id"].as_str().unwrap());
    let (plant, survey) = (PlantId(plant.parse().unwrap()), SurveyId(job["survey"].as_str().unwrap().parse().unwrap()));
    // What is as by default is not written down, and told all the same.
    let kept = app.store.job(plant, JobId(id.parse().unwrap())).await.unwrap().unwrap();
    assert_eq!(kept.options, r#"{"rows_per_bench":2}"#);
    assert_eq!((&job["options"]["rows_per_bench"], &job["options"]["seed"]), (&json!(2), &json!(1)));

    let options = r#"{"of_tomorrow":7}"#.to_owned();
    let request = JobRequest { id: JobId(uuid::Uuid::new_v4()), plant, survey, options, priority: 0, max_attempts: 1 };
    let Enqueued::New(job) = app.store.enqueue_job(&request, Timestamp::now()).await.unwrap() else {
        panic!("the other job has ended")
    };
    let job = json!({"plant": plant, "id": job.id});
    let declined = |job: &serde_json::Value| job["state"] == "queued" && job["error"]["code"] == "another_version";
    let job = app.follow_until(&job, declined).await;
    assert_eq!(
        (&job["state"], &job["attempt"], &job["options"]),
        (&json!("queued"), &json!(0), &json!({"of_tomorrow": 7}))
    );
}
