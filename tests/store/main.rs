//! Conformance of stores on both databases, and of blob stores on disk and in a bucket.

mod blobs;
mod conformance;

use heliomap::store::{PostgresStore, SqliteStore};

/// Runs the suite on both databases, each test on a store of its own.
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
    what_is_deleted_goes_and_models_say_so,
    names_are_changed_where_they_are_free,
    uploads,
    one_unfinished_job_per_survey,
    jobs_of_one_plant_run_one_after_the_other,
    abandoned_jobs_are_claimed_again_and_their_first_worker_is_fenced,
    a_job_that_kills_its_workers_ends,
    released_jobs_get_their_attempt_back,
    retry_waits_and_ends,
    the_pause_before_a_retry_grows_without_progress,
    declined_jobs_wait_for_another_worker,
    cancelled_jobs_do_not_return_to_the_queue,
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
    files_are_replaced_only_if_the_precondition_holds,
    lists_are_filtered,
    webhooks,
    messages_are_claimed_once_and_have_limited_attempts,
    busy_organisations_do_not_delay_messages_of_others,
    referenced_blobs_are_listed,
    unreferenced_blobs_are_freed,
    blobs_that_are_uploaded_again_are_kept,
    unreferenced_models_are_freed,
    blobs_that_a_running_job_may_read_are_kept,
    blobs_are_kept_until_the_last_reference_is_gone,
    tasks_are_shared_among_workers,
    tasks_of_silent_workers_are_claimed_again,
    tasks_are_deleted_with_their_job,
);

/// Workers of other processes need not wait for their next poll.
#[tokio::test]
#[ignore = "needs Postgres; run `make unit`"]
async fn postgres_notifies_of_work() {
    conformance::workers_are_notified(&postgres_store().await).await;
}

/// Callers that go away, on every database; each test has a second store over the same rows.
macro_rules! cancelled {
    ($($name:ident),* $(,)?) => {
        mod cancelled_on_sqlite {
            $(
                #[tokio::test]
                async fn $name() {
                    let folder = tempfile::tempdir().unwrap();
                    let file = folder.path().join("heliomap.db");
                    let store = super::SqliteStore::open(&file).await.unwrap();
                    let other = super::SqliteStore::open(&file).await.unwrap();
                    super::conformance::cancelled::$name(&store, &other).await;
                }
            )*
        }

        mod cancelled_on_postgres {
            $(
                #[tokio::test]
                #[ignore = "needs Postgres; run `make unit`"]
                async fn $name() {
                    let database = super::postgres_database().await;
                    let store = super::PostgresStore::open(&database).await.unwrap();
                    let other = super::PostgresStore::open(&database).await.unwrap();
                    super::conformance::cancelled::$name(&store, &other).await;
                }
            )*
        }
    };
}

cancelled!(
    a_transaction_cancelled_at_any_await_is_whole_or_not_at_all,
    a_claim_cancelled_at_any_await_leaves_the_queue_whole,
    a_statement_cancelled_at_any_await_leaves_the_store_whole,
);

/// A file that may not grow stands for a disk that is full: every write says so, and once there is room all work again.
#[tokio::test]
async fn a_full_disk_is_full_no_longer_than_it_is() {
    use heliomap::store::{Created, JobStore, OrganisationId, Page, PlantStore, Store, StoreError};
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("heliomap.db");
    SqliteStore::open(&file).await.unwrap().close().await;
    let pages = std::fs::metadata(&file).unwrap().len() / 4096;
    let store = SqliteStore::open_bounded(&file, Some(pages as u32 + 40)).await.unwrap();
    let now = jiff::Timestamp::UNIX_EPOCH;
    let create = |name: String| {
        let store = store.clone();
        async move { store.create_plant(OrganisationId::DEFAULT, &name, Default::default(), now).await }
    };
    store.try_to_write().await.unwrap();
    let mut made = Vec::new();
    let full: StoreError = loop {
        match create(format!("{} {}", made.len(), "long ".repeat(200))).await {
            Ok(Created::New(plant)) => made.push(plant.id),
            Ok(Created::Existing(_)) => unreachable!("the names differ"),
            Err(error) => break error,
        }
    };
    assert!(full.is_full(), "{full}");
    // Not once, and not only the statement that met it.
    for attempt in 0..20 {
        let error = create(format!("more {attempt} {}", "long ".repeat(200))).await.unwrap_err();
        assert!(error.is_full(), "{error}");
        let error = store.try_to_write().await.unwrap_err();
        assert!(error.is_full(), "{error}");
        assert!(store.claim_job("worker", std::time::Duration::from_secs(9), now).await.unwrap().is_none());
    }
    let all = Page { after: None, limit: 1000 };
    assert_eq!(store.plants(OrganisationId::DEFAULT, None, "", all).await.unwrap().len(), made.len());
    for plant in &made {
        assert!(store.delete_plant(*plant, now).await.unwrap());
    }
    store.try_to_write().await.unwrap();
    assert!(matches!(create("room again".to_owned()).await.unwrap(), Created::New(_)));
}

/// Concurrent transactions.
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
    a_late_end_creates_no_message,
);

/// Data folders from before organisations existed.
#[tokio::test]
async fn data_from_before_organisations_is_kept() {
    use heliomap::store::{OrganisationId, Page, PlantStore, SurveyStore};
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
    use heliomap::store::{Created, OrganisationId, PlantStore};
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

/// Records a change of the schema that no version knows yet, as a newer version would.
const NEWER_CHANGE: &str = "INSERT INTO _sqlx_migrations (version, description, success, checksum, execution_time) \
    SELECT 999999, 'newer', success, checksum, 0 FROM _sqlx_migrations WHERE version = 60";

/// A process that still runs while a newer version upgrades the database neither takes nor gives work.
#[tokio::test]
async fn sqlite_refuses_a_newer_schema() {
    use heliomap::store::StoreError;
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("heliomap.db");
    let store = SqliteStore::open(&file).await.unwrap();
    let pool = sqlx::SqlitePool::connect(&format!("sqlite://{}", file.display())).await.unwrap();
    conformance::a_newer_schema_is_refused(&store, async || {
        sqlx::query(NEWER_CHANGE).execute(&pool).await.unwrap();
    })
    .await;
    assert!(matches!(SqliteStore::open(&file).await, Err(StoreError::NewerSchema { change: 999_999 })));
}

#[tokio::test]
#[ignore = "needs Postgres; run `make unit`"]
async fn postgres_refuses_a_newer_schema() {
    use heliomap::store::StoreError;
    let database = postgres_database().await;
    let store = PostgresStore::open(&database).await.unwrap();
    let pool = sqlx::PgPool::connect(&database).await.unwrap();
    conformance::a_newer_schema_is_refused(&store, async || {
        sqlx::query(NEWER_CHANGE).execute(&pool).await.unwrap();
    })
    .await;
    assert!(matches!(PostgresStore::open(&database).await, Err(StoreError::NewerSchema { change: 999_999 })));
}
