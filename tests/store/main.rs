//! What every store must do, whichever database is behind it, and every blob store, wherever its bytes lie.

mod blobs;
mod conformance;

use heliomap::store::{PostgresStore, SqliteStore};

/// Runs the whole suite on every database, on a store of its own per test.
macro_rules! on_both {
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

        mod postgres {
            $(
                #[tokio::test]
                #[ignore = "needs Postgres; run `make unit`"]
                async fn $name() {
                    super::conformance::$name(&super::postgres_store().await).await;
                }
            )*
        }
    };
}

/// A store in a new database of the server that `tests/with-postgres.sh` started for the tests.
async fn postgres_store() -> PostgresStore {
    PostgresStore::open(&postgres_database().await).await.unwrap()
}

/// The URL of a new database of that server.
async fn postgres_database() -> String {
    let server = std::env::var("HELIOMAP_TEST_POSTGRES").expect(
        "HELIOMAP_TEST_POSTGRES must name a server: run `make unit`, or tests/with-postgres.sh before cargo test",
    );
    let name = format!("test_{}", uuid::Uuid::new_v4().simple());
    let pool = sqlx::PgPool::connect(&format!("{server}/postgres")).await.unwrap();
    sqlx::query(sqlx::AssertSqlSafe(format!("CREATE DATABASE {name}"))).execute(&pool).await.unwrap();
    pool.close().await;
    format!("{server}/{name}")
}

on_both!(
    organisations_and_their_plants,
    keys,
    audit_log,
    named_requests,
    plants_and_surveys,
    files_all_or_none,
    photos_and_what_was_found_in_them,
    uploads,
    one_unfinished_job_per_survey,
    jobs_of_one_plant_run_one_after_the_other,
    an_abandoned_job_is_taken_up_and_its_first_worker_is_fenced_out,
    a_job_that_kills_its_workers_ends,
    a_released_job_has_its_attempt_back,
    retry_waits_and_ends,
    the_pause_before_a_retry_grows_while_the_job_gets_nowhere,
    a_job_that_a_worker_cannot_do_waits_for_another,
    what_is_cancelled_does_not_go_back_to_the_queue,
    checkpoints_live_as_long_as_their_job,
    jobs_by_priority,
    the_last_jobs_pace_is_known,
    deleted_plants_are_remembered,
    cancel,
    models_and_features,
    large_models,
    two_models_of_one_version_are_not_written,
    a_deleted_plant_takes_everything_with_it,
    boxes_find_what_touches_them,
    quotas,
    a_file_is_replaced_only_where_it_is_as_wanted,
    lists_are_filtered,
    webhooks,
    messages_are_sent_by_one_at_a_time_and_not_for_ever,
    messages_of_a_busy_organisation_keep_no_other_waiting,
    blobs_that_rows_name,
    what_nothing_names_any_more_is_freed,
    bytes_that_come_again_are_kept,
    a_model_that_no_row_came_to_name_is_freed,
    bytes_that_a_job_may_read_are_kept,
    the_last_name_counts_whoever_is_last,
    images_of_a_job_are_shared,
    images_in_silent_hands_come_back,
    images_go_with_their_job,
);

/// Workers of other processes need not wait until they look.
#[tokio::test]
#[ignore = "needs Postgres; run `make unit`"]
async fn postgres_rings_for_work() {
    conformance::work_is_told(&postgres_store().await).await;
}

/// What happens where transactions meet.
macro_rules! on_postgres {
    ($($name:ident),* $(,)?) => {
        mod contention {
            $(
                #[tokio::test]
                #[ignore = "needs Postgres; run `make unit`"]
                async fn $name() {
                    let database = super::postgres_database().await;
                    let store = super::PostgresStore::open(&database).await.unwrap();
                    let pool = sqlx::PgPool::connect(&database).await.unwrap();
                    super::conformance::contention::$name(&store, &pool).await;
                }
            )*
        }
    };
}

on_postgres!(
    a_job_that_is_just_ending_is_not_claimed_again,
    a_job_that_is_just_cancelled_is_not_claimed,
    an_image_that_is_just_found_is_not_taken_again,
    heartbeats_go_on_while_a_model_is_stored,
    an_image_that_is_found_as_its_job_ends_holds_up_neither,
    an_end_that_comes_too_late_is_told_to_nobody,
);

/// A data folder of before there were organisations keeps all that it holds.
#[tokio::test]
async fn what_was_there_before_is_kept() {
    use heliomap::store::{OrganisationId, Page, Store};
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("heliomap.db");
    let options = sqlx::sqlite::SqliteConnectOptions::new().filename(&file).create_if_missing(true);
    let pool = sqlx::SqlitePool::connect_with(options).await.unwrap();
    let mut migrator = sqlx::migrate!("migrations/sqlite");
    migrator.migrations.to_mut().truncate(1);
    migrator.run(&pool).await.unwrap();
    let (plant, survey) = ("11111111-1111-4111-8111-111111111111", "22222222-2222-4222-8222-222222222222");
    for (statement, id) in [
        ("INSERT INTO plants (id, name, created_ms) VALUES ($1, 'A', 1)", plant),
        (
            "INSERT INTO surveys (id, plant_id, name, created_ms) VALUES ($1, (SELECT id FROM plants), 'June', 1)",
            survey,
        ),
    ] {
        sqlx::query(statement).bind(id).execute(&pool).await.unwrap();
    }
    pool.close().await;
    let store = SqliteStore::open(&file).await.unwrap();
    let all = Page { after: None, limit: 9 };
    let plants = store.plants(OrganisationId::DEFAULT, None, "", all).await.unwrap();
    assert_eq!((plants.len(), plants[0].id.to_string().as_str()), (1, plant));
    assert_eq!(store.surveys(plants[0].id, "", all).await.unwrap().len(), 1);
    assert!(store.delete_plant(plants[0].id, jiff::Timestamp::UNIX_EPOCH).await.unwrap());
    assert!(store.surveys(plants[0].id, "", all).await.unwrap().is_empty());
}

#[tokio::test]
async fn rows_survive_the_process_and_two_may_open_at_once() {
    use heliomap::store::{Created, OrganisationId, Store};
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("heliomap.db");
    let (first, second) = tokio::join!(SqliteStore::open(&file), SqliteStore::open(&file));
    let now = jiff::Timestamp::UNIX_EPOCH;
    let created = first.unwrap().create_plant(OrganisationId::DEFAULT, "A", Default::default(), now).await.unwrap();
    assert!(matches!(created, Created::New(_)));
    assert!(matches!(
        second.unwrap().create_plant(OrganisationId::DEFAULT, "A", Default::default(), now).await.unwrap(),
        Created::Existing(_)
    ));
    let again = SqliteStore::open(&file).await.unwrap();
    assert!(matches!(
        again.create_plant(OrganisationId::DEFAULT, "A", Default::default(), now).await.unwrap(),
        Created::Existing(_)
    ));
}
