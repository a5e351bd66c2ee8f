//! Connections, within bounds of number and time: who sends nothing, or takes nothing of what is sent, is let go.

use crate::config::Limits;
use crate::http::middleware::rates::network;
use axum::Router;
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::server::graceful::GracefulShutdown;
use std::collections::HashMap;
use std::net::{IpAddr, SocketAddr};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Semaphore;
use tokio_io_timeout::TimeoutStream;
use tokio_util::sync::CancellationToken;
use tower::ServiceExt;

/// Largest head of a request, bytes.
const MAX_HEAD_BYTES: usize = 64 << 10;
/// How long nothing is accepted after accepting failed, as it does without free file descriptors.
const PAUSE: Duration = Duration::from_millis(100);

/// How long a connection may be silent at its beginning.
const FIRST_BYTE: Duration = Duration::from_secs(10);

/// An address may hold so many connections however few are free, and beyond them so large a share of those that are: a few
/// addresses do not take all.
const FEW: usize = 4;
const SHARE_OF_FREE: usize = 4;

/// Where a request came from.
#[derive(Debug, Clone, Copy)]
pub struct Peer(pub SocketAddr);

/// Serves until `stop`, then ends the requests that are being answered, and returns.
///
/// A connection is closed whose first byte does not come within 10 s, whose next request's head is not whole within
/// `limits.request_timeout`, or whose client takes nothing of an answer for so long. Beyond `limits.max_connections` new
/// ones wait; beyond `limits.max_connections_per_address`, or a quarter of those that are free, those of one address are
/// closed.
pub async fn serve(listener: TcpListener, router: Router, limits: &Limits, stop: CancellationToken) {
    let graceful = GracefulShutdown::new();
    let room = Arc::new(Semaphore::new(limits.max_connections));
    let patience = limits.request_timeout;
    let crowd = Arc::new(Crowd::default());
    loop {
        let accepted = async {
            // The semaphore is never closed.
            let place = room.clone().acquire_owned().await.ok();
            (place, listener.accept().await)
        };
        let (place, accepted) = tokio::select! {
            () = stop.cancelled() => break,
            accepted = accepted => accepted,
        };
        let (stream, address) = match accepted {
            Ok(accepted) => accepted,
            Err(error) => {
                tracing::warn!(%error, "a connection cannot be accepted");
                tokio::time::sleep(PAUSE).await;
                continue;
            }
        };
        let most = match limits.max_connections_per_address {
            most if most < limits.max_connections => most.min(FEW.max(room.available_permits() / SHARE_OF_FREE)),
            most => most,
        };
        let Some(one) = crowd.admit(address.ip(), most) else {
            tracing::debug!(%address, "there are too many connections from this address");
            continue;
        };
        let watcher = graceful.watcher();
        let (router, closing) = (router.clone(), stop.clone());
        tokio::spawn(async move {
            let _held = (place, one);
            let service = hyper::service::service_fn(move |mut request: hyper::Request<hyper::body::Incoming>| {
                request.extensions_mut().insert(Peer(address));
                router.clone().oneshot(request)
            });
            // Nothing is lost with a connection on which nothing came.
            let first = tokio::time::timeout(FIRST_BYTE.min(patience), stream.readable());
            let came = tokio::select! {
                biased;
                first = first => matches!(first, Ok(Ok(()))),
                () = closing.cancelled() => false,
            };
            if !came {
                return;
            }
            let mut builder = http1::Builder::new();
            builder.timer(TokioTimer::new()).header_read_timeout(patience).max_buf_size(MAX_HEAD_BYTES);
            let connection = builder.serve_connection(TokioIo::new(bounded(stream, patience)), service);
            if let Err(error) = watcher.watch(connection).await {
                tracing::debug!(%error, %address, "connection ended");
            }
        });
    }
    drop(listener);
    graceful.shutdown().await;
}

/// How many connections there are from each address.
#[derive(Debug, Default)]
struct Crowd(Mutex<HashMap<IpAddr, usize>>);

/// One connection of an address, until it is dropped.
struct One {
    crowd: Arc<Crowd>,
    network: IpAddr,
}

impl Crowd {
    fn counts(&self) -> std::sync::MutexGuard<'_, HashMap<IpAddr, usize>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// One more connection from an address; `None` where there are as many as there may be.
    fn admit(self: &Arc<Self>, address: IpAddr, most: usize) -> Option<One> {
        let network = network(address);
        let mut counts = self.counts();
        let count = counts.entry(network).or_default();
        if *count >= most {
            return None;
        }
        *count += 1;
        Some(One { crowd: self.clone(), network })
    }
}

impl Drop for One {
    fn drop(&mut self) {
        let mut counts = self.crowd.counts();
        if let Some(count) = counts.get_mut(&self.network) {
            *count -= 1;
            if *count == 0 {
                counts.remove(&self.network);
            }
        }
    }
}

/// A stream whose client takes something of what is sent within so long.
fn bounded(stream: TcpStream, patience: Duration) -> std::pin::Pin<Box<TimeoutStream<TcpStream>>> {
    // Small answers go at once.
    if let Err(error) = stream.set_nodelay(true) {
        tracing::debug!(%error, "answers may be held back");
    }
    let mut stream = TimeoutStream::new(stream);
    stream.set_write_timeout(Some(patience));
    Box::pin(stream)
}
