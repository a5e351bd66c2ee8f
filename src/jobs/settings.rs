//! A worker's times.

use std::time::Duration;

/// A worker's times.
#[derive(Debug, Clone, Copy)]
pub struct WorkerSettings {
    /// How long a worker keeps its job without a heartbeat.
    pub lease: Duration,
    /// How often a worker reports progress and checks for cancellation; far below `lease`.
    pub heartbeat: Duration,
    /// How often an idle worker looks for work.
    pub poll: Duration,
    /// Pause before a retry after a first failure of the environment; see [`Ending::Retry`](crate::store::Ending::Retry).
    pub backoff: Duration,
}

impl WorkerSettings {
    /// Default times for a lease.
    pub fn with_lease(lease: Duration) -> Self {
        Self {
            lease,
            heartbeat: Duration::from_secs(1).min(lease / 4),
            poll: Duration::from_secs(1),
            backoff: Duration::from_secs(5),
        }
    }
}
