//! What an organisation stores, what it may store, and blobs that no row refers to.

use super::access::Organisation;
use super::digest::Digest;
use super::error::StoreError;
use super::ids::OrganisationId;
use heliomap_model::PlantId;
use jiff::Timestamp;
use std::time::Duration;

/// No quota.
pub const UNLIMITED: u64 = i64::MAX as u64;

/// Quotas of an organisation; `None` means the default of the service.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Quotas {
    /// Bytes of files and models.
    pub bytes: Option<u64>,
    /// Plants.
    pub plants: Option<u64>,
}

impl Quotas {
    /// These quotas, completed by others.
    pub fn or(self, others: Self) -> Self {
        Self { bytes: self.bytes.or(others.bytes), plants: self.plants.or(others.plants) }
    }
}

/// What an organisation stores.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Usage {
    /// Bytes of files and models; in a plant, the same bytes count once.
    pub bytes: u64,
    /// Bytes that resumable uploads announced and that are not stored yet.
    pub announced_bytes: u64,
    pub plants: u64,
    /// Quotas of this organisation alone.
    pub own: Quotas,
}

/// A blob that rows refer to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BlobRecord {
    pub plant: PlantId,
    pub sha256: Digest,
    /// Bytes.
    pub size: u64,
}

/// A blob without references that this process has claimed for deletion.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct UnusedBlob {
    pub blob: BlobRecord,
    /// When it was claimed.
    pub taken: Timestamp,
}

/// Storage used by organisations, their quotas, and references to blobs.
#[async_trait::async_trait]
pub trait UsageStore: Send + Sync + 'static {
    /// All organisations by name, each with its usage.
    async fn organisations(&self, now: Timestamp) -> Result<Vec<(Organisation, Usage)>, StoreError>;
    /// The usage of an organisation.
    async fn usage(&self, organisation: OrganisationId, now: Timestamp) -> Result<Option<Usage>, StoreError>;
    /// Sets the quotas of an organisation.
    async fn set_quotas(&self, organisation: OrganisationId, own: Quotas) -> Result<(), StoreError>;
    /// Counts blobs that are about to be stored in a plant, by digest and size; blobs that it has already are not counted again.
    /// Fails with [`StoreError::OverQuota`] where they do not fit and [`StoreError::BeingFreed`] where some are being deleted;
    /// none is counted then. `defaults` applies where the organisation has no quota of its own. Blobs are unused from `now`
    /// on until a row refers to them.
    async fn reserve_bytes(
        &self,
        plant: PlantId,
        blobs: &[(Digest, u64)],
        defaults: Quotas,
        now: Timestamp,
    ) -> Result<(), StoreError>;

    /// As [`Self::reserve_bytes`] for a model, without a quota.
    async fn reserve_model(&self, plant: PlantId, model: (Digest, u64), now: Timestamp) -> Result<(), StoreError>;

    /// Claims blobs that have been unused since before a time, to delete their bytes: at most `limit` of each of at most `limit`
    /// plants, and none of a plant with a running job, which may still read them. A claimed blob cannot be reserved or
    /// referred to. A claim that does not end in [`Self::blob_is_gone`] within `lease` is made again.
    async fn take_unused_blobs(
        &self,
        before: Timestamp,
        lease: Duration,
        limit: u32,
        now: Timestamp,
    ) -> Result<Vec<UnusedBlob>, StoreError>;
    /// Records that the bytes of a claimed blob are deleted, and counts them no longer; `false` where it was claimed again or is
    /// gone.
    async fn blob_is_gone(&self, unused: &UnusedBlob) -> Result<bool, StoreError>;
    /// The blobs that files and models refer to, once per plant, by plant and digest: at most `limit` of those after `after`.
    async fn blobs(&self, after: Option<(PlantId, Digest)>, limit: u32) -> Result<Vec<BlobRecord>, StoreError>;
}
