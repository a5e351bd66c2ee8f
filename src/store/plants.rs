//! Plants.

use super::error::StoreError;
use super::ids::OrganisationId;
use super::listing::{Created, Page};
use super::usage::Quotas;
use heliomap_model::PlantId;
use jiff::Timestamp;

/// A photovoltaic plant.
#[derive(Debug, Clone)]
pub struct Plant {
    pub seq: i64,
    pub id: PlantId,
    pub organisation: OrganisationId,
    pub name: String,
    pub created: Timestamp,
}

/// Plants.
#[async_trait::async_trait]
pub trait PlantStore: Send + Sync + 'static {
    /// Creates an organisation's plant, or returns the existing one of that name. Fails with [`StoreError::OverQuota`] beyond the
    /// quota; `defaults` applies where the organisation has no quota of its own.
    async fn create_plant(
        &self,
        organisation: OrganisationId,
        name: &str,
        defaults: Quotas,
        now: Timestamp,
    ) -> Result<Created<Plant>, StoreError>;
    /// One plant of any organisation.
    async fn plant(&self, id: PlantId) -> Result<Option<Plant>, StoreError>;
    /// An organisation's plants whose names begin with `prefix`, in order of creation; only those in a list where one is given.
    async fn plants(
        &self,
        organisation: OrganisationId,
        only: Option<&[PlantId]>,
        prefix: &str,
        page: Page,
    ) -> Result<Vec<Plant>, StoreError>;
    /// Gives a plant another name. Fails with [`StoreError::NameTaken`] where another of its organisation has it, and
    /// [`StoreError::Gone`] where there is no such plant.
    async fn rename_plant(&self, id: PlantId, name: &str) -> Result<Plant, StoreError>;
    /// Deletes a plant with all rows that belong to it, and records that its blobs are to be deleted; `false` where there was
    /// none. Workers lose the leases of its jobs.
    async fn delete_plant(&self, id: PlantId, now: Timestamp) -> Result<bool, StoreError>;
    /// Deleted plants whose blobs may still exist.
    async fn deleted_plants(&self) -> Result<Vec<PlantId>, StoreError>;
    /// Removes plants that were deleted before a time from that list.
    async fn forget_deleted_plants(&self, before: Timestamp) -> Result<(), StoreError>;
}
