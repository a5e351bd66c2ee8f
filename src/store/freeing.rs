//! Bytes that nothing names any more, because other bytes came in their place or because their upload was never ended, are
//! deleted after a while.
//!
//! A plant stores the same bytes once, whatever names them, and a row that names them must find them. Therefore each step is
//! one transaction that has the plant's row: when a file is replaced and nothing else names what it was, that is noted with
//! the time; an upload that brings the same bytes again notes a new time before it looks for them, and that they are named
//! together with the row that names them; what has been unused for long is marked as being deleted, after which nobody may
//! reserve or name it until its bytes and then its row are gone. So an upload comes either before the mark, and keeps the
//! bytes, or after the row is gone, and brings them anew.
//!
//! The while is long, because what reads bytes without a row of its own needs them a little longer: a backup that has copied
//! the rows, and a job that began before (of whose plant nothing is deleted while it runs, however long that is).

use super::{Blobs, Store, StoreError};
use jiff::Timestamp;
use std::time::{Duration, Instant};

/// How long whoever deletes bytes may take before another does it.
const LEASE: Duration = Duration::from_secs(60);
/// Blobs of a plant, and plants, that are taken at once.
const AT_ONCE: u32 = 100;

/// Deletes the bytes that others had begun to delete, and did not come to the end of.
///
/// # Errors
/// A store that does not answer.
pub async fn free_abandoned(store: &dyn Store, blobs: &Blobs) -> Result<usize, StoreError> {
    free_unused(store, blobs, Timestamp::MIN).await
}

/// Deletes the bytes that have been unused since before a time, or that were to be deleted by somebody who fell silent; how
/// many blobs that were.
///
/// # Errors
/// A store that does not answer. What is left is deleted the next time.
pub async fn free_unused(store: &dyn Store, blobs: &Blobs, before: Timestamp) -> Result<usize, StoreError> {
    let mut freed = 0;
    loop {
        let begun = Instant::now();
        let taken = store.take_unused_blobs(before, LEASE, AT_ONCE, Timestamp::now()).await?;
        if taken.is_empty() {
            return Ok(freed);
        }
        for unused in taken {
            // Whoever was slow, or asleep, may not be the only one any more.
            if begun.elapsed() > LEASE / 4 {
                return Ok(freed);
            }
            let deleted = tokio::time::timeout(LEASE / 4, blobs.delete(unused.blob.plant, unused.blob.sha256));
            deleted.await.unwrap_or(Err(StoreError::Silent))?;
            freed += usize::from(store.blob_is_gone(&unused).await?);
        }
    }
}
