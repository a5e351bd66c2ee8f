//! Deletes blobs to which no row refers any more, because a file was replaced or an upload never finished, after a while.
//!
//! A plant stores the same bytes once, for any number of rows, and a row must always find its bytes. Therefore each step is a
//! transaction that locks the plant's row:
//!
//! 1. Replacing a file records the time from which its previous bytes are unused, if no other row refers to them.
//! 2. An upload of the same bytes renews that time before it checks whether they exist. The row that refers to them clears it.
//! 3. Blobs that have been unused for long are marked as being deleted. From then on they cannot be reserved or referred to,
//!    until their bytes and then their row are gone.
//!
//! So an upload comes either before the mark and keeps the bytes, or after the row is gone and stores them again.
//!
//! The while is long, because bytes are also read without a reference: by a backup that has copied the rows, and by a job that
//! began before. Nothing of a plant is deleted while one of its jobs runs.

use super::blobs::Blobs;
use super::error::StoreError;
use super::repository::Store;
use jiff::Timestamp;
use std::time::{Duration, Instant};

/// How long a claim for deletion lasts.
const LEASE: Duration = Duration::from_secs(60);
/// Maximum number of plants, and of blobs of each, that are claimed at a time.
const BATCH: u32 = 100;

/// Deletes the bytes of blobs whose deletion another process began and did not finish.
///
/// # Errors
/// A store that does not answer.
pub async fn free_abandoned(store: &dyn Store, blobs: &Blobs) -> Result<usize, StoreError> {
    free_unused(store, blobs, Timestamp::MIN).await
}

/// Deletes the bytes of blobs that have been unused since before a time, or whose deletion another process did not finish.
/// Returns the number of blobs.
///
/// # Errors
/// A store that does not answer. What is left is deleted the next time.
pub async fn free_unused(store: &dyn Store, blobs: &Blobs, before: Timestamp) -> Result<usize, StoreError> {
    let mut freed = 0;
    loop {
        let begun = Instant::now();
        let taken = store.take_unused_blobs(before, LEASE, BATCH, Timestamp::now()).await?;
        if taken.is_empty() {
            return Ok(freed);
        }
        for unused in taken {
            // After a pause, for example of the machine, another process may have claimed the same blobs.
            if begun.elapsed() > LEASE / 4 {
                return Ok(freed);
            }
            let deleted = tokio::time::timeout(LEASE / 4, blobs.delete(unused.blob.plant, unused.blob.sha256));
            deleted.await.unwrap_or(Err(StoreError::Silent))?;
            freed += usize::from(store.blob_is_gone(&unused).await?);
        }
    }
}
