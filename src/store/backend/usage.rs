//! What organisations keep, and may keep.

use super::super::{Row, Rows, Tx};
use super::read::{organisation, usage};
use crate::plant::PlantId;
use crate::store::usage::{Quotas, UNLIMITED, Usage, UsageStore};
use crate::store::{Digest, Organisation, OrganisationId, StoreError, sql};
use async_trait::async_trait;
use jiff::Timestamp;
use sqlx::Row as _;

#[async_trait]
impl UsageStore for Rows {
    async fn organisations(&self, now: Timestamp) -> Result<Vec<(Organisation, Usage)>, StoreError> {
        let rows = sqlx::query(sql::ORGANISATIONS).bind(now.as_millisecond()).fetch_all(&self.read).await?;
        rows.iter().map(|row| Ok((organisation(row)?, usage(row)?))).collect()
    }

    async fn usage(&self, organisation: OrganisationId, now: Timestamp) -> Result<Option<Usage>, StoreError> {
        let query = sqlx::query(sql::USAGE).bind(now.as_millisecond()).bind(organisation.to_string());
        query.fetch_optional(&self.read).await?.as_ref().map(usage).transpose()
    }

    async fn set_quotas(&self, organisation: OrganisationId, own: Quotas) -> Result<(), StoreError> {
        sqlx::query(sql::SET_QUOTAS)
            .bind(organisation.to_string())
            .bind(own.bytes.map(bounded))
            .bind(own.plants.map(bounded))
            .execute(&self.write)
            .await?;
        Ok(())
    }

    async fn reserve_bytes(&self, plant: PlantId, blobs: &[(Digest, u64)], defaults: Quotas) -> Result<(), StoreError> {
        let mut tx = self.begin().await?;
        let owner: Option<String> =
            sqlx::query_scalar(sql::OWNER).bind(plant.to_string()).fetch_optional(&mut *tx).await?;
        let owner = owner.ok_or(StoreError::Gone { what: "plant" })?;
        let quota = quotas(&mut tx, &owner, defaults).await?.bytes;
        let more = count_bytes(&mut tx, plant, blobs).await?;
        if let Some(quota) = quota.filter(|_| more > 0) {
            let query = sqlx::query_scalar(sql::BYTES_OF_ORGANISATION).bind(&owner);
            let used = query.fetch_one(&mut *tx).await.map(|used: i64| used as u64)?;
            if used > quota {
                return Err(StoreError::OverQuota { what: "bytes", used: used - more, quota });
            }
        }
        tx.commit().await?;
        Ok(())
    }
}

fn bounded(quota: u64) -> i64 {
    quota.min(UNLIMITED) as i64
}

/// What holds for an organisation. Until the transaction ends, no other decides about it.
pub async fn quotas(tx: &mut Tx, organisation: &str, defaults: Quotas) -> Result<Quotas, StoreError> {
    let row: Option<Row> = sqlx::query(sql::LOCK_QUOTAS).bind(organisation).fetch_optional(&mut **tx).await?;
    let row = row.ok_or(StoreError::Gone { what: "organisation" })?;
    let own = |column: &str| Ok::<_, StoreError>(row.try_get::<Option<i64>, _>(column)?.map(|quota| quota as u64));
    Ok(Quotas { bytes: own("max_bytes")?, plants: own("max_plants")? }.or(defaults))
}

/// Counts what a plant did not keep yet, which is the answer.
pub async fn count_bytes(tx: &mut Tx, plant: PlantId, blobs: &[(Digest, u64)]) -> Result<u64, StoreError> {
    let mut more = 0;
    for (sha256, size) in blobs {
        let query = sqlx::query(sql::KEEP_BLOB).bind(plant.to_string()).bind(sha256.to_string()).bind(*size as i64);
        if query.execute(&mut **tx).await.map_err(super::gone("plant"))?.rows_affected() > 0 {
            more += size;
        }
    }
    if more > 0 {
        sqlx::query(sql::COUNT_BYTES).bind(plant.to_string()).bind(more as i64).execute(&mut **tx).await?;
    }
    Ok(more)
}
