//! What every store must do, whichever database is behind it.

mod conformance;

use heliomap::store::SqliteStore;

/// Runs the whole suite on a store of its own per test.
macro_rules! on_sqlite {
    ($($name:ident),* $(,)?) => {
        mod sqlite {
            $(
                #[tokio::test]
                async fn $name() {
                    let folder = tempfile::tempdir().unwrap();
                    let store = super::SqliteStore::open(&folder.path().join("heliomap.db")).await.unwrap();
                    super::conformance::$name(&store).await;
                }
            )*
        }
    };
}

on_sqlite!(
    plants_and_surveys,
    files_all_or_none,
    one_unfinished_job_per_survey,
    jobs_of_one_plant_run_one_after_the_other,
    an_abandoned_job_is_taken_up_and_its_first_worker_is_fenced_out,
    a_job_that_kills_its_workers_ends,
    a_released_job_has_its_attempt_back,
    retry_waits_and_ends,
    cancel,
    models_and_features,
    two_models_of_one_version_are_not_written,
    a_deleted_plant_takes_everything_with_it,
    boxes_find_what_touches_them,
);

#[tokio::test]
async fn rows_survive_the_process_and_two_may_open_at_once() {
    use heliomap::store::{Created, Store};
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("heliomap.db");
    let (first, second) = tokio::join!(SqliteStore::open(&file), SqliteStore::open(&file));
    let now = jiff::Timestamp::UNIX_EPOCH;
    let created = first.unwrap().create_plant("A", now).await.unwrap();
    assert!(matches!(created, Created::New(_)));
    assert!(matches!(second.unwrap().create_plant("A", now).await.unwrap(), Created::Existing(_)));
    let again = SqliteStore::open(&file).await.unwrap();
    assert!(matches!(again.create_plant("A", now).await.unwrap(), Created::Existing(_)));
}
