//! Whether rows and files can be written, tried at most every few seconds however often it is asked.

use crate::store::{Blobs, Store, StoreError};
use std::time::{Duration, Instant};
use tokio::sync::Mutex;

/// How long an answer holds: a try writes to the disk, and anyone may ask.
const HOLDS: Duration = Duration::from_secs(2);

/// The newest answer.
#[derive(Debug, Default)]
pub struct Writable(Mutex<Option<(Instant, Vec<String>)>>);

impl Writable {
    /// What cannot be written, each with the reason; empty where all can. One caller tries, the others wait for its answer.
    pub async fn faults(&self, store: &dyn Store, blobs: &Blobs) -> Vec<String> {
        let mut newest = self.0.lock().await;
        if let Some((_, faults)) = newest.as_ref().filter(|(at, _)| at.elapsed() < HOLDS) {
            return faults.clone();
        }
        let tries = [
            ("the database", store.try_to_write().await),
            ("the folder of incoming files", blobs.try_to_write().await),
        ];
        let faults: Vec<String> =
            tries.into_iter().filter_map(|(what, done)| Some(fault(what, &done.err()?))).collect();
        *newest = Some((Instant::now(), faults.clone()));
        faults
    }
}

/// What is said of something that cannot be written.
fn fault(what: &str, error: &StoreError) -> String {
    tracing::error!(%error, "{what} cannot be written");
    let reason = if error.is_full() { "its disk is full" } else { "the service's log has the reason" };
    format!("{what} cannot be written: {reason}")
}
