//! `heliomap worker`: jobs in a process of their own.

use super::{GRACE, open_storage, pipeline_worker, run_async, stop_signal};
use heliomap::config::WorkerArgs;
use std::sync::Arc;
use tokio::sync::Notify;

/// Runs jobs until the process is told to stop.
pub fn run(args: WorkerArgs) -> anyhow::Result<()> {
    run_async(async {
        let (store, blobs) = open_storage(&args.storage).await?;
        let stop = stop_signal()?;
        let worker = pipeline_worker(store, blobs, args.detector, &args.jobs, Arc::new(Notify::new()));
        println!("heliomap works on jobs in {}", args.storage.data_dir.display());
        let work = worker.run(stop.clone());
        tokio::pin!(work);
        tokio::select! {
            () = &mut work => {}
            () = stop.cancelled() => { let _ = tokio::time::timeout(GRACE, work).await; }
        }
        Ok(())
    })
}
