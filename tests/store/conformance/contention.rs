//! What happens on Postgres where transactions meet: `pool` makes those of others, which stay open for as long as a test
//! likes. With SQLite they follow each other.

use super::{ALL, LEASE, ORGANISATION, at, claim, enqueue, model, plant, state, survey};
use heliomap::store::{
    Claim, Completed, Ending, Heartbeat, ImageTask, JobState, NewWebhook, OwnTask, SigningSecret, Store,
};
use sqlx::PgPool;
use std::time::Duration;

/// What waits for another transaction has not ended by then.
const AT_ONCE: Duration = Duration::from_secs(10);

async fn at_once<T>(work: impl Future<Output = T>) -> T {
    tokio::time::timeout(AT_ONCE, work).await.expect("it does not wait for another's transaction")
}

/// Comes back when a statement waits for another transaction's lock.
async fn someone_waits(pool: &PgPool) {
    let waiting = "SELECT 1 FROM pg_stat_activity WHERE datname = current_database() AND wait_event_type = 'Lock'";
    while sqlx::query(waiting).fetch_optional(pool).await.unwrap().is_none() {
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
}

async fn running(store: &dyn Store) -> Claim {
    let survey = survey(store, plant(store, "A").await.id, "June").await;
    enqueue(store, &survey).await;
    claim(store, 0).await.unwrap()
}

fn tasks(images: &[&str]) -> Vec<ImageTask> {
    let task = |image: &&str| ImageTask { image: (*image).to_owned(), document: String::new() };
    images.iter().map(task).collect()
}

pub async fn a_job_that_is_just_ending_is_not_claimed_again(store: &dyn Store, pool: &PgPool) {
    let claimed = running(store).await;
    let other = survey(store, plant(store, "B").await.id, "June").await;
    let mut tx = pool.begin().await.unwrap();
    let ends = "UPDATE jobs SET state = 'succeeded', finished_ms = 1, claim_expires_ms = NULL WHERE id = $1";
    sqlx::query(ends).bind(claimed.job.id.to_string()).execute(&mut *tx).await.unwrap();
    // Its lease is over; what else waits is not kept waiting by it.
    assert!(at_once(claim(store, 31)).await.is_none());
    let next = enqueue(store, &other).await;
    assert_eq!(at_once(claim(store, 31)).await.unwrap().job.id, next.id);
    tx.commit().await.unwrap();
    assert!(claim(store, 31).await.is_none());
    assert_eq!(state(store, &claimed.job).await, JobState::Succeeded);
}

pub async fn a_job_that_is_just_cancelled_is_not_claimed(store: &dyn Store, pool: &PgPool) {
    let survey = survey(store, plant(store, "A").await.id, "June").await;
    let job = enqueue(store, &survey).await;
    let mut tx = pool.begin().await.unwrap();
    let ends = "UPDATE jobs SET state = 'cancelled', finished_ms = 1 WHERE id = $1";
    sqlx::query(ends).bind(job.id.to_string()).execute(&mut *tx).await.unwrap();
    assert!(at_once(claim(store, 1)).await.is_none());
    tx.commit().await.unwrap();
    assert!(claim(store, 1).await.is_none());
    assert_eq!(state(store, &job).await, JobState::Cancelled);
}

pub async fn an_image_that_is_just_found_is_not_taken_again(store: &dyn Store, pool: &PgPool) {
    let owner = running(store).await;
    assert!(store.offer_tasks(&owner, "f", "v", &tasks(&["a", "b"])).await.unwrap());
    store.take_task("v", LEASE, at(0)).await.unwrap().unwrap();
    let mut tx = pool.begin().await.unwrap();
    let done = "UPDATE image_tasks SET done = TRUE, token = NULL WHERE image = 'a'";
    sqlx::query(done).execute(&mut *tx).await.unwrap();
    // The helper's lease is over.
    let own = at_once(store.take_own_task(&owner, at(31))).await.unwrap();
    assert_eq!(own, OwnTask::Image("b".to_owned()));
    assert_eq!(at_once(store.take_own_task(&owner, at(31))).await.unwrap(), OwnTask::HeldByOthers);
    assert!(at_once(store.take_task("v", LEASE, at(31))).await.unwrap().is_none());
    tx.commit().await.unwrap();
    assert!(store.take_task("v", LEASE, at(31)).await.unwrap().is_none());
}

pub async fn heartbeats_go_on_while_a_model_is_stored(store: &dyn Store, pool: &PgPool) {
    let claimed = running(store).await;
    let mut tx = pool.begin().await.unwrap();
    let other = "INSERT INTO models (plant_id, version, survey_id, job_id, sha256, size, warnings, created_ms) \
                 VALUES ($1, 1, $2, $3, '', 0, '[]', 0)";
    let insert = sqlx::query(other).bind(claimed.job.plant.to_string()).bind(claimed.job.survey.to_string());
    insert.bind(claimed.job.id.to_string()).execute(&mut *tx).await.unwrap();
    let model = model(claimed.job.plant, 1, 1);
    let storing = store.complete_job(&claimed, &model, at(31));
    let meanwhile = async {
        someone_waits(pool).await;
        let beat = at_once(store.heartbeat(&claimed, None, LEASE, at(20))).await.unwrap();
        assert_eq!(beat, Heartbeat::Continue);
        assert!(at_once(claim(store, 31)).await.is_none());
        tx.rollback().await.unwrap();
    };
    let (stored, ()) = tokio::join!(storing, meanwhile);
    assert!(matches!(stored.unwrap(), Completed::Done(_)));
    assert!(!store.end_job(&claimed, &Ending::Cancelled, at(32)).await.unwrap());
}

pub async fn an_image_that_is_found_as_its_job_ends_holds_up_neither(store: &dyn Store, pool: &PgPool) {
    let owner = running(store).await;
    assert!(store.offer_tasks(&owner, "f", "v", &tasks(&["a"])).await.unwrap());
    let helper = store.take_task("v", LEASE, at(0)).await.unwrap().unwrap();
    let mut tx = pool.begin().await.unwrap();
    let ends = "UPDATE jobs SET state = 'cancelled', finished_ms = 1 WHERE id = $1";
    sqlx::query(ends).bind(owner.job.id.to_string()).execute(&mut *tx).await.unwrap();
    let found = store.finish_task(&helper, b"in a");
    let meanwhile = async {
        someone_waits(pool).await;
        sqlx::query("DELETE FROM image_tasks").execute(&mut *tx).await.unwrap();
        tx.commit().await.unwrap();
    };
    let (found, ()) = tokio::join!(found, meanwhile);
    assert!(!found.unwrap());
}

pub async fn a_late_end_creates_no_message(store: &dyn Store, pool: &PgPool) {
    let secret = SigningSecret::random().unwrap();
    let new = NewWebhook { organisation: ORGANISATION, plant: None, url: "https://example.org/".to_owned(), secret };
    let webhook = store.create_webhook(&new, at(0)).await.unwrap().unwrap();
    let claimed = running(store).await;
    let mut tx = pool.begin().await.unwrap();
    let taken = "UPDATE jobs SET fence = fence + 1, worker = 'another' WHERE id = $1";
    sqlx::query(taken).bind(claimed.job.id.to_string()).execute(&mut *tx).await.unwrap();
    let ending = Ending::Failed { code: "c".to_owned(), message: "m".to_owned() };
    let ended = store.end_job(&claimed, &ending, at(31));
    let meanwhile = async {
        someone_waits(pool).await;
        tx.commit().await.unwrap();
    };
    let (ended, ()) = tokio::join!(ended, meanwhile);
    assert!(!ended.unwrap());
    assert_eq!(state(store, &claimed.job).await, JobState::Running);
    assert!(store.deliveries(webhook.id, None, ALL).await.unwrap().is_empty());
}
