//! `heliomap serve`: the HTTP API and the web page, with a worker inside.

use super::output::print;
use super::{
    keep_tidy, open_storage, pipeline_mapper, pipeline_worker, run_async, send_messages, serve_metrics, stop_signal,
};
use anyhow::Context;
use heliomap::config::ServeArgs;
use heliomap::http::{self, AppState};
use heliomap::oidc::Oidc;
use heliomap::store::{Page, TimeSpan};
use heliomap::telemetry::metrics::Scrape;
use heliomap::webhooks::Targets;
use std::sync::Arc;
use tokio::net::TcpListener;
use tokio::sync::Notify;

/// Serves until the process receives a signal to stop.
pub fn run(args: ServeArgs) -> anyhow::Result<()> {
    run_async(async {
        anyhow::ensure!(
            !args.insecure || args.listen.ip().is_loopback(),
            "--insecure gives access to everyone who can reach {}: listen on a loopback address such as 127.0.0.1:8080, or \
             omit --insecure and create keys with `heliomap keys create`",
            args.listen
        );
        let oidc = args.oidc.settings().map_err(anyhow::Error::msg)?.map(Oidc::new).transpose();
        let oidc = oidc.context("cannot use the provider of --oidc-issuer")?;
        let oidc = oidc.map(Arc::new);
        let mapper = match args.no_worker {
            true => None,
            false => Some(pipeline_mapper(&args.detector).await?),
        };
        let (store, blobs) = open_storage(&args.storage).await?;
        let stop = stop_signal()?;
        let listener = TcpListener::bind(args.listen)
            .await
            .with_context(|| format!("cannot listen on {}; choose another address with --listen", args.listen))?;
        let address = listener.local_addr()?;

        let mut limits = args.limits;
        if args.network.behind_proxy {
            limits.max_connections_per_address = usize::MAX;
        }
        let state = AppState {
            network: Arc::new(args.network),
            bell: Arc::new(Notify::new()),
            stop: stop.clone(),
            oidc,
            targets: Targets::allowing_private(args.webhooks.webhook_private_targets),
            mapper: mapper.clone(),
            insecure: args.insecure,
            ..AppState::new(store.clone(), blobs.clone(), limits.clone())
        };
        let (metrics, bell, answering) = (state.metrics.clone(), state.bell.clone(), state.answering.clone());
        let scrape = Scrape { metrics: metrics.clone(), store: store.clone(), blobs: blobs.clone() };
        let sending = send_messages(&args.webhooks, &store, &metrics, &stop);
        keep_tidy(&args.retention, &store, &blobs, &stop);
        let working = mapper.map(|mapper| {
            let worker = pipeline_worker(store.clone(), blobs, mapper, &args.jobs, metrics, bell);
            let stop = stop.clone();
            tokio::spawn(async move { worker.run(stop).await })
        });

        let (app, closing) = (http::router(state), stop.clone());
        let serving = tokio::spawn(async move { http::serve(listener, app, &limits, closing).await });
        if !args.insecure && store.keys(None, TimeSpan::default(), Page { after: None, limit: 1 }).await?.is_empty() {
            tracing::warn!(
                "no keys exist, so every request is refused: create the first with `heliomap keys create --scope admin --name NAME` \
                 on the same data folder"
            );
        }
        print(format_args!("heliomap is listening on http://{address}\n"))?;
        serve_metrics(&args.metrics, scrape, &stop).await?;

        stop.cancelled().await;
        let ending = async {
            serving.await?;
            answering.close();
            answering.wait().await;
            sending.await?;
            if let Some(working) = working {
                working.await?;
            }
            anyhow::Ok(())
        };
        match tokio::time::timeout(args.stop.grace, ending).await {
            Ok(outcome) => outcome,
            Err(_) => {
                tracing::warn!("some requests or a job did not end in time; the jobs will be resumed");
                Ok(())
            }
        }
    })
}
