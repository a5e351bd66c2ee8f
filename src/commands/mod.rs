//! One file per command. Concrete databases and blob stores are named here only.

pub mod backup;
pub mod configuration;
pub mod detect;
pub mod doctor;
pub mod evaluate;
pub mod evaluate_detection;
pub mod keys;
pub mod map;
pub mod openapi;
pub mod organisations;
pub mod output;
mod progress;
pub mod reconstruct;
pub mod serve;
pub mod worker;

use anyhow::{Context, ensure};
use heliomap::config::{DetectorArgs, JobArgs, Limits, MetricsArgs, RetentionArgs, StorageArgs, WebhookArgs};
use heliomap::http;
use heliomap::jobs::{PipelineMapper, Worker, WorkerSettings};
use heliomap::store::freeing::free_unused;
use heliomap::store::schema::Schema;
use heliomap::store::{Blobs, PostgresStore, SqliteStore, Store, StoreError};
use heliomap::telemetry::metrics::{self, Metrics, Scrape};
use heliomap::webhooks::{Sender, SenderSettings, Targets};
use jiff::Timestamp;
use object_store::aws::AmazonS3Builder;
use std::fs::Permissions;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;
use tokio::net::TcpListener;
use tokio::sync::Notify;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;

/// The database of a data folder.
const ROWS: &str = "heliomap.db";

/// Leftovers of crashes among the uploads are deleted after this time.
const STALE_UPLOADS: Duration = Duration::from_secs(24 * 3600);

/// Webhook deliveries are deleted so long after they succeeded or were given up.
const OLD_DELIVERIES: Duration = Duration::from_secs(30 * 24 * 3600);

/// Longest time between two removals of expired data.
const TIDY_EVERY: Duration = Duration::from_secs(600);

/// The error for a data folder that cannot be used.
fn unusable(folder: &Path) -> String {
    format!("cannot use the data folder {}; choose another with --data-dir", folder.display())
}

/// The blobs of a data folder, or of a bucket beside it.
async fn open_blobs(args: &StorageArgs) -> anyhow::Result<Blobs> {
    let folder = &args.data_dir;
    let Some(bucket) = &args.blobs else { return Blobs::in_folder(folder).with_context(|| unusable(folder)) };
    let hint = || {
        format!(
            "cannot use the bucket {} of --blobs; check that it is there, and AWS_ENDPOINT_URL, AWS_REGION, \
             AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY",
            bucket.name
        )
    };
    let blobs = Blobs::in_bucket(folder, bucket, AmazonS3Builder::from_env()).with_context(hint)?;
    blobs.ping().await.with_context(hint)?;
    Ok(blobs)
}

/// The database and the blobs of a data folder.
async fn open_storage(args: &StorageArgs) -> anyhow::Result<(Arc<dyn Store>, Blobs)> {
    let folder = &args.data_dir;
    let hint = || unusable(folder);
    let blobs = open_blobs(args).await?;
    keep_to_owner(folder);
    blobs.sweep_staging(STALE_UPLOADS).await.with_context(hint)?;
    let store: Arc<dyn Store> = match &args.database {
        // The URL may hold a password: the error does not repeat it.
        Some(url) => Arc::new(PostgresStore::open(url).await.context("cannot use the database of --database")?),
        None => Arc::new(SqliteStore::open(&folder.join(ROWS)).await.with_context(hint)?),
    };
    delete_expired(&*store, &blobs).await.with_context(hint)?;
    Ok((store, blobs))
}

/// Closes a data folder to other users of the machine; earlier versions left it as open as the system did.
fn keep_to_owner(folder: &Path) {
    const OWNER_ONLY: u32 = 0o700;
    let is_open = |found: &std::fs::Metadata| found.permissions().mode() & 0o777 & !OWNER_ONLY != 0;
    if !std::fs::metadata(folder).is_ok_and(|found| is_open(&found)) {
        return;
    }
    if let Err(error) = std::fs::set_permissions(folder, Permissions::from_mode(OWNER_ONLY)) {
        tracing::warn!(%error, folder = %folder.display(), "other users of this machine may read the data folder");
    }
}

/// Deletes expired data.
async fn delete_expired(store: &dyn Store, blobs: &Blobs) -> Result<(), StoreError> {
    store.delete_expired_uploads(Timestamp::now()).await?;
    store.forget_old_requests(Timestamp::now()).await?;
    store.forget_old_deliveries(Timestamp::now() - OLD_DELIVERIES).await?;
    blobs.sweep_uploads(store.uploads().await?.into_iter().collect(), STALE_UPLOADS).await?;
    // A plant may have been deleted without its blobs, or while some were still coming.
    for plant in store.deleted_plants().await? {
        blobs.delete_plant(plant).await?;
    }
    store.forget_deleted_plants(Timestamp::now() - STALE_UPLOADS).await
}

/// As [`open_storage`], for commands beside a service: a database that the service has not brought up to date is left as
/// it is.
async fn open_storage_beside(args: &StorageArgs) -> anyhow::Result<(Arc<dyn Store>, Blobs)> {
    only_of_this_version(schema_of(args).await?)?;
    open_storage(args).await
}

/// How the database of a data folder stands, or the one beside it.
async fn schema_of(args: &StorageArgs) -> anyhow::Result<Schema> {
    let rows = args.data_dir.join(ROWS);
    Ok(match &args.database {
        Some(url) => PostgresStore::examine(url).await.context("cannot use the database of --database")?.schema,
        None if rows.is_file() => SqliteStore::examine(&rows).await.with_context(|| unusable(&args.data_dir))?.schema,
        None => Schema::Absent,
    })
}

/// Refuses a database to which an older or a newer version of the program belongs.
fn only_of_this_version(schema: Schema) -> anyhow::Result<()> {
    ensure!(
        !matches!(schema, Schema::Behind { .. }),
        "the database is of an older version of heliomap: use that version's program, or start this version's `heliomap \
         serve` first, which brings it up to date"
    );
    ensure!(schema != Schema::Ahead, "the database is of a newer version of heliomap: use that version's program");
    Ok(())
}

/// As [`open_storage_beside`], for commands that create nothing: a missing service is an error.
async fn open_storage_there(args: &StorageArgs) -> anyhow::Result<(Arc<dyn Store>, Blobs)> {
    let (folder, schema) = (&args.data_dir, schema_of(args).await?);
    match &args.database {
        Some(_) => {
            ensure!(schema != Schema::Absent, "the database of --database is empty: no service has used it yet");
            ensure!(
                args.blobs.is_some() || folder.is_dir(),
                "there is no folder {}: name the service's data folder with --data-dir",
                folder.display()
            );
        }
        None => {
            let rows = folder.join(ROWS);
            ensure!(rows.is_file(), "there is no {}: name the service's data folder with --data-dir", rows.display());
        }
    }
    only_of_this_version(schema)?;
    open_storage(args).await
}

/// The pipeline with its detector opened. If that fails, it is an error if the user chose models or a runtime. A service without
/// a detector still takes uploads, and maps surveys that have boxes of their own.
async fn pipeline_mapper(args: &DetectorArgs) -> anyhow::Result<Arc<PipelineMapper>> {
    let detector = args.clone();
    let mapper = Arc::new(PipelineMapper::new(Box::new(move || Ok(detector.open(0)?.into()))));
    let opening = mapper.clone();
    match tokio::task::spawn_blocking(move || opening.open()).await? {
        Ok(()) => {}
        Err(error) if args.is_own() => return Err(error).context("cannot use the detector"),
        Err(error) => tracing::warn!(%error, "no detector: jobs that need one will fail"),
    }
    Ok(mapper)
}

/// A worker that runs the pipeline.
fn pipeline_worker(
    store: Arc<dyn Store>,
    blobs: Blobs,
    mapper: Arc<PipelineMapper>,
    jobs: &JobArgs,
    metrics: Metrics,
    work_notify: Arc<Notify>,
) -> Worker {
    Worker {
        name: format!("{}-{}", std::process::id(), &uuid::Uuid::new_v4().simple().to_string()[..8]),
        store,
        blobs,
        mapper,
        settings: WorkerSettings::with_lease(jobs.lease),
        metrics,
        work_notify,
    }
}

/// Sends messages to webhooks in the background, until the process stops.
fn send_messages(
    args: &WebhookArgs,
    store: &Arc<dyn Store>,
    metrics: &Metrics,
    stop: &CancellationToken,
) -> JoinHandle<()> {
    let sender = Sender::new(
        store.clone(),
        Targets::allowing_private(args.webhook_private_targets),
        SenderSettings::default(),
        metrics.clone(),
    );
    let stop = stop.clone();
    tokio::spawn(async move {
        match sender {
            Ok(sender) => sender.run(stop).await,
            Err(error) => {
                let cause = std::error::Error::source(&error).map(ToString::to_string).unwrap_or_default();
                tracing::error!(%error, cause, "no messages are sent to webhooks: install CA certificates on this machine");
            }
        }
    })
}

/// Deletes expired data and unused blobs in the background, until the process stops.
fn keep_tidy(args: &RetentionArgs, store: &Arc<dyn Store>, blobs: &Blobs, stop: &CancellationToken) {
    let (store, blobs, stop, kept) = (store.clone(), blobs.clone(), stop.clone(), args.keep_replaced);
    let audited = args.keep_audit;
    tokio::spawn(async move {
        loop {
            let tidied = async {
                delete_expired(&*store, &blobs).await?;
                store.forget_audit(before(audited)).await?;
                free_unused(&*store, &blobs, before(kept)).await
            };
            match tidied.await {
                Ok(0) => {}
                Ok(freed) => tracing::info!(blobs = freed, "unused blobs deleted"),
                Err(error) => tracing::warn!(%error, "cannot delete expired data now"),
            }
            tokio::select! {
                () = stop.cancelled() => return,
                () = tokio::time::sleep(TIDY_EVERY.min(kept)) => {}
            }
        }
    });
}

/// Serves the metrics of the process, if configured, until it stops.
async fn serve_metrics(args: &MetricsArgs, scrape: Scrape, stop: &CancellationToken) -> anyhow::Result<()> {
    let Some(address) = args.metrics_listen else { return Ok(()) };
    let listener = TcpListener::bind(address).await;
    let hint = || format!("cannot listen on {address}; choose another address with --metrics-listen");
    let listener = listener.with_context(hint)?;
    output::print(format_args!("metrics are on http://{}/metrics\n", listener.local_addr()?))?;
    let stop = stop.clone();
    tokio::spawn(async move { http::serve(listener, metrics::router(scrape), &Limits::default(), stop).await });
    Ok(())
}

/// The time that lies so far back, or the earliest that there is.
fn before(duration: Duration) -> Timestamp {
    Timestamp::now().checked_sub(duration).unwrap_or(Timestamp::MIN)
}

/// Runs a service until its end; tasks that still run then get one second.
fn run_async(service: impl Future<Output = anyhow::Result<()>>) -> anyhow::Result<()> {
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
    let outcome = runtime.block_on(service);
    runtime.shutdown_timeout(Duration::from_secs(1));
    outcome
}

/// A token that is cancelled when the process receives a signal to stop.
fn stop_signal() -> anyhow::Result<CancellationToken> {
    use tokio::signal::unix::{SignalKind, signal};
    let stop = CancellationToken::new();
    let (mut terminate, mut interrupt) = (signal(SignalKind::terminate())?, signal(SignalKind::interrupt())?);
    let raised = stop.clone();
    tokio::spawn(async move {
        tokio::select! {
            _ = terminate.recv() => {}
            _ = interrupt.recv() => {}
        }
        tracing::info!("stopping");
        raised.cancel();
    });
    Ok(stop)
}
