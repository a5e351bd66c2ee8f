//! Who writes to which upload.

use crate::http::error::{ApiError, Code};
use crate::store::UploadId;
use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;
use tokio_util::sync::CancellationToken;

/// How long a request waits for the one before it, which it interrupts, to make safe what came.
const TURN: Duration = Duration::from_secs(10);

/// Who writes to which upload: one request at a time, and the newest wins, for a client that comes back from another
/// address while the service still waits for its old connection.
#[derive(Debug, Default)]
pub struct Desk(Mutex<HashMap<UploadId, Seat>>);

#[derive(Debug, Default, Clone)]
struct Seat {
    turn: Arc<tokio::sync::Mutex<()>>,
    interrupt: CancellationToken,
}

/// An upload in the hands of one request.
pub(super) struct Taken {
    desk: Arc<Desk>,
    id: UploadId,
    /// Raised when a newer request wants the upload.
    pub(super) interrupt: CancellationToken,
    _turn: tokio::sync::OwnedMutexGuard<()>,
}

impl Desk {
    fn seats(&self) -> std::sync::MutexGuard<'_, HashMap<UploadId, Seat>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Interrupts whoever has the upload, and takes it until the answer is dropped.
    pub(super) async fn take(self: &Arc<Self>, id: UploadId) -> Result<Taken, ApiError> {
        let (turn, interrupt) = {
            let mut seats = self.seats();
            let seat = seats.entry(id).or_default();
            std::mem::take(&mut seat.interrupt).cancel();
            (seat.turn.clone(), seat.interrupt.clone())
        };
        let busy =
            || ApiError::new(Code::UploadBusy, "another request to this upload is being finished").retry_after(2);
        let turn = tokio::time::timeout(TURN, turn.lock_owned()).await.map_err(|_| busy())?;
        Ok(Taken { desk: self.clone(), id, interrupt, _turn: turn })
    }
}

impl Drop for Taken {
    fn drop(&mut self) {
        let mut seats = self.desk.seats();
        // The map's and this one's: nobody waits.
        if seats.get(&self.id).is_some_and(|seat| Arc::strong_count(&seat.turn) == 2) {
            seats.remove(&self.id);
        }
    }
}
