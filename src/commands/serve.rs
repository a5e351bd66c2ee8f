//! `heliomap serve`: the HTTP API and the web page, with a worker inside.

use super::{GRACE, open_storage, pipeline_worker, run_async, stop_signal};
use anyhow::Context;
use heliomap::config::ServeArgs;
use heliomap::http::{self, AppState};
use heliomap::store::Page;
use std::sync::Arc;
use tokio::net::TcpListener;
use tokio::sync::Notify;

/// Serves until the process is told to stop.
pub fn run(args: ServeArgs) -> anyhow::Result<()> {
    run_async(async {
        anyhow::ensure!(
            !args.insecure || args.listen.ip().is_loopback(),
            "--insecure lets anyone in who reaches {}: listen on a loopback address such as 127.0.0.1:8080, or leave \
             --insecure out and make keys with `heliomap keys create`",
            args.listen
        );
        let (store, blobs) = open_storage(&args.storage).await?;
        let stop = stop_signal()?;
        let bell = Arc::new(Notify::new());
        let listener = TcpListener::bind(args.listen)
            .await
            .with_context(|| format!("cannot listen on {}; choose another address with --listen", args.listen))?;
        let address = listener.local_addr()?;

        let worker = pipeline_worker(store.clone(), blobs.clone(), args.detector, &args.jobs, bell.clone());
        let worker_stop = stop.clone();
        let working = (!args.no_worker).then(|| tokio::spawn(async move { worker.run(worker_stop).await }));

        let app = http::router(AppState {
            store: store.clone(),
            blobs,
            limits: Arc::new(args.limits),
            bell,
            desk: Arc::default(),
            decoding: http::decoders(),
            stop: stop.clone(),
            insecure: args.insecure,
        });
        let shutdown = stop.clone().cancelled_owned();
        let serving = tokio::spawn(axum::serve(listener, app).with_graceful_shutdown(shutdown).into_future());
        if !args.insecure && store.keys(None, Page { after: None, limit: 1 }).await?.is_empty() {
            tracing::warn!(
                "there is no key yet, so nobody gets in: make the first with `heliomap keys create --scope admin --name NAME` \
                 on the same data folder"
            );
        }
        println!("heliomap is listening on http://{address}");

        stop.cancelled().await;
        let ending = async {
            serving.await??;
            if let Some(working) = working {
                working.await?;
            }
            anyhow::Ok(())
        };
        match tokio::time::timeout(GRACE, ending).await {
            Ok(outcome) => outcome,
            Err(_) => {
                tracing::warn!("some requests or a job did not end in time; jobs left behind are taken up again");
                Ok(())
            }
        }
    })
}
