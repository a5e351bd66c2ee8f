//! `heliomap worker`: jobs in a process of their own.

use super::output::print;
use super::{
    keep_tidy, open_storage, pipeline_mapper, pipeline_worker, run_async, send_messages, serve_metrics, stop_signal,
};
use heliomap::config::WorkerArgs;
use heliomap::telemetry::metrics::{Metrics, Scrape};
use std::sync::Arc;
use tokio::sync::Notify;

/// Runs jobs until the process receives a signal to stop.
pub fn run(args: WorkerArgs) -> anyhow::Result<()> {
    run_async(async {
        let mapper = pipeline_mapper(&args.detector).await?;
        let (store, blobs) = open_storage(&args.storage).await?;
        let stop = stop_signal()?;
        let metrics = Metrics::default();
        let scrape = Scrape { metrics: metrics.clone(), store: store.clone(), blobs: blobs.clone() };
        let sending = send_messages(&args.webhooks, &store, &metrics, &stop);
        keep_tidy(&args.retention, &store, &blobs, &stop);
        let worker = pipeline_worker(store, blobs, mapper, &args.jobs, metrics, Arc::new(Notify::new()));
        print(format_args!("heliomap works on jobs in {}\n", args.storage.data_dir.display()))?;
        serve_metrics(&args.metrics, scrape, &stop).await?;
        let work = async {
            worker.run(stop.clone()).await;
            let _ = sending.await;
        };
        tokio::pin!(work);
        tokio::select! {
            () = &mut work => {}
            () = stop.cancelled() => { let _ = tokio::time::timeout(args.stop.grace, work).await; }
        }
        Ok(())
    })
}
