//! What organisations keep, and may keep.

use super::super::{Row, Rows, Tx};
use super::read::{self, organisation, usage};
use crate::store::usage::{Quotas, UNLIMITED, UnusedBlob, Usage, UsageStore};
use crate::store::{Digest, Organisation, OrganisationId, StoreError, SurveyId, sql};
use async_trait::async_trait;
use heliomap_model::PlantId;
use jiff::Timestamp;
use sqlx::Row as _;
use std::time::Duration;

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

    async fn reserve_bytes(
        &self,
        plant: PlantId,
        blobs: &[(Digest, u64)],
        defaults: Quotas,
        now: Timestamp,
    ) -> Result<(), StoreError> {
        let mut tx = self.begin().await?;
        let owner: Option<String> =
            sqlx::query_scalar(sql::OWNER).bind(plant.to_string()).fetch_optional(&mut *tx).await?;
        let owner = owner.ok_or(StoreError::Gone { what: "plant" })?;
        let quota = quotas(&mut tx, &owner, defaults).await?.bytes;
        let more = count_bytes(&mut tx, plant, blobs, Some(now)).await?;
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

    async fn reserve_model(&self, plant: PlantId, model: (Digest, u64), now: Timestamp) -> Result<(), StoreError> {
        let mut tx = self.begin().await?;
        count_bytes(&mut tx, plant, &[model], Some(now)).await?;
        tx.commit().await?;
        Ok(())
    }

    async fn take_unused_blobs(
        &self,
        before: Timestamp,
        lease: Duration,
        limit: u32,
        now: Timestamp,
    ) -> Result<Vec<UnusedBlob>, StoreError> {
        let (before_ms, now_ms) = (before.as_millisecond(), now.as_millisecond());
        let lost_ms = now_ms.saturating_sub(i64::try_from(lease.as_millis()).unwrap_or(i64::MAX));
        let query = sqlx::query(sql::PLANTS_WITH_UNUSED_BLOBS).bind(before_ms).bind(lost_ms).bind(i64::from(limit));
        let mut taken = Vec::new();
        for plant in query.fetch_all(&self.read).await? {
            let plant = PlantId(read::uuid(&plant, "id")?);
            let mut tx = self.begin().await?;
            if let Err(StoreError::Gone { .. }) = lock_plant(&mut tx, plant).await {
                continue;
            }
            let query = sqlx::query(sql::TAKE_UNUSED_BLOBS)
                .bind(plant.to_string())
                .bind(before_ms)
                .bind(lost_ms)
                .bind(i64::from(limit))
                .bind(now_ms);
            let rows = query.fetch_all(&mut *tx).await?;
            let blobs: Result<Vec<_>, _> = rows.iter().map(read::blob).collect();
            tx.commit().await?;
            taken.extend(blobs?.into_iter().map(|blob| UnusedBlob { blob, taken: now }));
        }
        Ok(taken)
    }

    async fn blob_is_gone(&self, unused: &UnusedBlob) -> Result<bool, StoreError> {
        let plant = unused.blob.plant;
        let mut tx = self.begin().await?;
        match lock_plant(&mut tx, plant).await {
            Err(StoreError::Gone { .. }) => return Ok(false),
            locked => locked?,
        }
        let size: Option<i64> = sqlx::query_scalar(sql::FORGET_BLOB)
            .bind(plant.to_string())
            .bind(unused.blob.sha256.to_string())
            .bind(unused.taken.as_millisecond())
            .fetch_optional(&mut *tx)
            .await?;
        if let Some(size) = size {
            sqlx::query(sql::COUNT_BYTES).bind(plant.to_string()).bind(-size).execute(&mut *tx).await?;
        }
        tx.commit().await?;
        Ok(size.is_some())
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

/// Makes a plant's blobs, and what names them, this transaction's own.
async fn lock_plant(tx: &mut Tx, plant: PlantId) -> Result<(), StoreError> {
    let row = sqlx::query(sql::LOCK_PLANT).bind(plant.to_string()).fetch_optional(&mut **tx).await?;
    row.map(drop).ok_or(StoreError::Gone { what: "plant" })
}

/// Counts what a plant did not keep yet, which is the answer. The blobs are unused since a time unless a row names them, or
/// named by a row of this transaction where there is no such time.
pub async fn count_bytes(
    tx: &mut Tx,
    plant: PlantId,
    blobs: &[(Digest, u64)],
    unused: Option<Timestamp>,
) -> Result<u64, StoreError> {
    lock_plant(tx, plant).await?;
    let unused_ms = unused.map(Timestamp::as_millisecond);
    let mut more = 0;
    for (sha256, size) in blobs {
        let (plant_id, digest) = (plant.to_string(), sha256.to_string());
        let reserve = sqlx::query(sql::RESERVE_BLOB).bind(&plant_id).bind(&digest).bind(unused_ms);
        if reserve.execute(&mut **tx).await?.rows_affected() > 0 {
            continue;
        }
        let keep = sqlx::query(sql::KEEP_BLOB).bind(&plant_id).bind(&digest).bind(*size as i64).bind(unused_ms);
        if keep.execute(&mut **tx).await?.rows_affected() == 0 {
            return Err(StoreError::BeingFreed { sha256: *sha256 });
        }
        more += size;
    }
    if more > 0 {
        sqlx::query(sql::COUNT_BYTES).bind(plant.to_string()).bind(more as i64).execute(&mut **tx).await?;
    }
    Ok(more)
}

/// Makes the blobs of a survey's plant, and what names them, this transaction's own; the plant.
pub async fn lock_plant_of(tx: &mut Tx, survey: SurveyId) -> Result<PlantId, StoreError> {
    let query = sqlx::query(sql::LOCK_PLANT_OF_SURVEY).bind(survey.to_string());
    let row: Option<Row> = query.fetch_optional(&mut **tx).await?;
    Ok(PlantId(read::uuid(&row.ok_or(StoreError::Gone { what: "survey" })?, "id")?))
}

/// Says that a row of this transaction names a blob, which must be there.
pub async fn name_blob(tx: &mut Tx, plant: PlantId, sha256: Digest) -> Result<(), StoreError> {
    let query = sqlx::query(sql::NAME_BLOB).bind(plant.to_string()).bind(sha256.to_string());
    match query.execute(&mut **tx).await?.rows_affected() {
        0 => Err(StoreError::BeingFreed { sha256 }),
        _ => Ok(()),
    }
}

/// Says that a row of this transaction names a blob no more: it is unused from now on, unless another row does.
pub async fn unname_blob(tx: &mut Tx, plant: PlantId, digest: &str, now: Timestamp) -> Result<(), StoreError> {
    let query = sqlx::query(sql::UNNAME_BLOB).bind(plant.to_string()).bind(digest).bind(now.as_millisecond());
    query.execute(&mut **tx).await?;
    Ok(())
}
