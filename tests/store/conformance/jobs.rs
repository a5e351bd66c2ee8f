//! The queue.

use super::{ALL, LEASE, at, claim, enqueue, model, plant, state, survey};
use heliomap::store::{
    Cancelled, Checkpoint, Completed, Ending, Enqueued, Heartbeat, JobId, JobRequest, JobState, Page, Progress, Store,
    StoreError,
};
use heliomap_model::PlantId;
use std::time::Duration;
use uuid::Uuid;

pub async fn one_unfinished_job_per_survey(store: &dyn Store) {
    let survey = survey(store, plant(store, "A").await.id, "June").await;
    let job = enqueue(store, &survey).await;
    let request = JobRequest {
        id: JobId(Uuid::new_v4()),
        plant: survey.plant,
        survey: survey.id,
        options: "[]".to_owned(),
        priority: 0,
        max_attempts: 2,
    };
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

pub async fn abandoned_jobs_are_claimed_again_and_their_first_worker_is_fenced(store: &dyn Store) {
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

pub async fn released_jobs_get_their_attempt_back(store: &dyn Store) {
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
    let backoff = Duration::from_secs(9);
    let retry = Ending::Retry { code: "environment".to_owned(), message: "m".to_owned(), backoff };
    let first = claim(store, 0).await.unwrap();
    assert!(store.end_job(&first, &retry, at(1)).await.unwrap());
    assert_eq!(state(store, &job).await, JobState::Queued);
    assert!(claim(store, 9).await.is_none());
    let second = claim(store, 10).await.unwrap();
    assert!(store.end_job(&second, &retry, at(11)).await.unwrap());
    assert_eq!(state(store, &job).await, JobState::Failed);
    assert!(claim(store, 30).await.is_none());
}

pub async fn the_pause_before_a_retry_grows_without_progress(store: &dyn Store) {
    let survey = survey(store, plant(store, "A").await.id, "June").await;
    let options = "{}".to_owned();
    let request = JobRequest {
        id: JobId(Uuid::new_v4()),
        plant: survey.plant,
        survey: survey.id,
        options,
        priority: 0,
        max_attempts: 9,
    };
    store.enqueue_job(&request, at(0)).await.unwrap();
    let backoff = Duration::from_secs(5);
    let retry = Ending::Retry { code: "environment".to_owned(), message: "m".to_owned(), backoff };
    let mut now = 0;
    let pauses = [5, 20, 80, 320, 600, 600];
    for (attempt, pause) in pauses.into_iter().chain([5, 20]).enumerate() {
        let claimed = claim(store, now).await.unwrap();
        if attempt == pauses.len() {
            let found = Checkpoint { name: "a".to_owned(), document: Vec::new() };
            assert!(store.checkpoint(&claimed, "f", &[found]).await.unwrap());
        }
        assert!(store.end_job(&claimed, &retry, at(now)).await.unwrap());
        assert!(claim(store, now + pause - 1).await.is_none(), "attempt {attempt}");
        now += pause;
    }
}

pub async fn declined_jobs_wait_for_another_worker(store: &dyn Store) {
    let survey = survey(store, plant(store, "A").await.id, "June").await;
    let job = enqueue(store, &survey).await;
    let declined = Ending::Declined { code: "c".to_owned(), message: "m".to_owned(), pause: Duration::from_secs(5) };
    for now in [0, 5, 10, 15] {
        let claimed = claim(store, now).await.unwrap();
        assert_eq!(claimed.job.attempt, 1);
        assert!(store.end_job(&claimed, &declined, at(now)).await.unwrap());
        assert!(claim(store, now + 4).await.is_none());
    }
    let job = store.job(job.plant, job.id).await.unwrap().unwrap();
    assert_eq!((job.state, job.error), (JobState::Queued, Some(("c".to_owned(), "m".to_owned()))));
}

pub async fn cancelled_jobs_do_not_return_to_the_queue(store: &dyn Store) {
    let survey = survey(store, plant(store, "A").await.id, "June").await;
    let (code, message) = ("c".to_owned(), "m".to_owned());
    for ending in [
        Ending::Retry { code: code.clone(), message: message.clone(), backoff: Duration::from_secs(600) },
        Ending::Declined { code, message, pause: Duration::from_secs(5) },
        Ending::Released,
    ] {
        let job = enqueue(store, &survey).await;
        let claimed = claim(store, 0).await.unwrap();
        // After the worker's last heartbeat.
        store.cancel_job(job.plant, job.id, at(1)).await.unwrap();
        assert!(store.end_job(&claimed, &ending, at(2)).await.unwrap());
        let job = store.job(job.plant, job.id).await.unwrap().unwrap();
        assert_eq!((job.state, job.finished), (JobState::Cancelled, Some(at(2))), "{ending:?}");
        assert!(claim(store, 1000).await.is_none());
    }
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
    let backoff = Duration::ZERO;
    let retry = Ending::Retry { code: "environment".to_owned(), message: "m".to_owned(), backoff };
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
        let request = JobRequest {
            id: JobId(Uuid::new_v4()),
            plant: survey.plant,
            survey: survey.id,
            options,
            priority,
            max_attempts: 2,
        };
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

/// `upgrade` changes the schema as a newer version of the program would.
pub async fn a_newer_schema_is_refused(store: &dyn Store, upgrade: impl AsyncFnOnce()) {
    let refused = |error: Option<StoreError>| matches!(error, Some(StoreError::NewerSchema { change: 999_999 }));
    let plant = plant(store, "Sunfield").await;
    let [first, second] = [survey(store, plant.id, "June").await, survey(store, plant.id, "July").await];
    let job = enqueue(store, &first).await;
    let running = claim(store, 0).await.unwrap();
    store.ping().await.unwrap();
    upgrade().await;
    assert!(refused(store.ping().await.err()));
    assert!(refused(store.try_to_write().await.err()));
    assert!(refused(store.heartbeat(&running, None, LEASE, at(1)).await.err()));
    assert!(refused(store.claim_job("worker", LEASE, at(100)).await.err()));
    let request = JobRequest {
        id: JobId(Uuid::new_v4()),
        plant: plant.id,
        survey: second.id,
        options: "{}".to_owned(),
        priority: 0,
        max_attempts: 2,
    };
    assert!(refused(store.enqueue_job(&request, at(1)).await.err()));
    assert!(refused(store.complete_job(&running, &model(plant.id, 1, 1), at(1)).await.err()));
    assert!(refused(store.create_survey(plant.id, "August", at(1)).await.err()));
    assert_eq!(state(store, &job).await, JobState::Running);
    assert!(store.models(plant.id, ALL).await.unwrap().is_empty());
}
