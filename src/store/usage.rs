//! What an organisation keeps, and what it may keep.

use super::{BlobRecord, Digest, Organisation, OrganisationId, StoreError};
use heliomap_model::PlantId;
use jiff::Timestamp;
use std::time::Duration;

/// As much as there is room for.
pub const UNLIMITED: u64 = i64::MAX as u64;

/// What an organisation may keep; where nothing is said, what holds for all.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Quotas {
    /// Bytes of files and models.
    pub bytes: Option<u64>,
    /// Plants.
    pub plants: Option<u64>,
}

impl Quotas {
    /// These, and others for what they do not say.
    pub fn or(self, others: Self) -> Self {
        Self { bytes: self.bytes.or(others.bytes), plants: self.plants.or(others.plants) }
    }
}

/// What an organisation keeps.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Usage {
    /// Bytes of files and models; in a plant, the same bytes count once.
    pub bytes: u64,
    /// Bytes that resumable uploads announced and that are not stored yet.
    pub announced_bytes: u64,
    pub plants: u64,
    /// What was said of this organisation alone.
    pub own: Quotas,
}

/// A blob that no row names, in the hands of whoever deletes its bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct UnusedBlob {
    pub blob: BlobRecord,
    /// When it was taken to be deleted.
    pub taken: Timestamp,
}

/// What organisations keep, and may keep.
#[async_trait::async_trait]
pub trait UsageStore: Send + Sync + 'static {
    /// All organisations by name, each with what it keeps.
    async fn organisations(&self, now: Timestamp) -> Result<Vec<(Organisation, Usage)>, StoreError>;
    /// What an organisation keeps.
    async fn usage(&self, organisation: OrganisationId, now: Timestamp) -> Result<Option<Usage>, StoreError>;
    /// Says what an organisation may keep.
    async fn set_quotas(&self, organisation: OrganisationId, own: Quotas) -> Result<(), StoreError>;
    /// Counts bytes that are about to be stored in a plant, each by digest and size; those that it keeps already count for
    /// nothing more. [`StoreError::OverQuota`] where they do not fit, [`StoreError::BeingFreed`] where some are just being
    /// deleted: none is counted then. `defaults` holds for what was not said of the organisation alone. What no row comes to
    /// name is unused from `now` on.
    async fn reserve_bytes(
        &self,
        plant: PlantId,
        blobs: &[(Digest, u64)],
        defaults: Quotas,
        now: Timestamp,
    ) -> Result<(), StoreError>;

    /// Counts a model that is about to be stored in a plant, which no quota forbids; else as [`Self::reserve_bytes`].
    async fn reserve_model(&self, plant: PlantId, model: (Digest, u64), now: Timestamp) -> Result<(), StoreError>;

    /// Takes blobs that have been unused since before a time, so that their bytes can be deleted: of each of at most `limit`
    /// plants at most as many, and none of a plant of which a job runs, for that may still read them. Until it is told that
    /// one is gone nobody may reserve or name it; where that is not told within `lease`, it is taken again.
    async fn take_unused_blobs(
        &self,
        before: Timestamp,
        lease: Duration,
        limit: u32,
        now: Timestamp,
    ) -> Result<Vec<UnusedBlob>, StoreError>;
    /// Notes that the bytes of a blob are gone, which counts no more; `false` where it was taken again, or is forgotten.
    async fn blob_is_gone(&self, unused: &UnusedBlob) -> Result<bool, StoreError>;
}
