//! Storage used by organisations, their quotas, and references to blobs.

use super::super::{Row, Rows, Tx};
use super::access::organisation;
use super::columns::{parsed, uuid};
use crate::store::access::Organisation;
use crate::store::digest::Digest;
use crate::store::error::StoreError;
use crate::store::ids::{OrganisationId, SurveyId};
use crate::store::usage::{BlobRecord, Quotas, UNLIMITED, UnusedBlob, Usage, UsageStore};
use async_trait::async_trait;
use heliomap_model::PlantId;
use jiff::Timestamp;
use sqlx::Row as _;
use std::time::Duration;

macro_rules! select_usage {
    () => {
        "SELECT id, name, created_ms, max_bytes, max_plants, \
         (SELECT COUNT(*) FROM plants WHERE plants.organisation_id = organisations.id) AS plants, \
         (SELECT CAST(COALESCE(SUM(plants.bytes), 0) AS BIGINT) FROM plants \
         WHERE plants.organisation_id = organisations.id) AS bytes, \
         (SELECT CAST(COALESCE(SUM(uploads.length), 0) AS BIGINT) FROM uploads \
         JOIN surveys ON surveys.id = uploads.survey_id JOIN plants ON plants.id = surveys.plant_id \
         WHERE plants.organisation_id = organisations.id AND uploads.outcome IS NULL AND uploads.expires_ms > $1) \
         AS announced_bytes FROM organisations"
    };
}

macro_rules! is_unreferenced {
    () => {
        "NOT EXISTS (SELECT 1 FROM files JOIN surveys ON surveys.id = files.survey_id \
         WHERE surveys.plant_id = blobs.plant_id AND files.sha256 = blobs.sha256) \
         AND NOT EXISTS (SELECT 1 FROM models WHERE models.plant_id = blobs.plant_id AND models.sha256 = blobs.sha256)"
    };
}

/// A blob whose deletion has begun cannot be needed by a job that began later.
macro_rules! is_needed_by_no_job {
    () => {
        "(freeing_ms IS NOT NULL \
         OR NOT EXISTS (SELECT 1 FROM jobs WHERE jobs.plant_id = blobs.plant_id AND jobs.state = 'running'))"
    };
}

pub const BYTES_OF_ORGANISATION: &str =
    "SELECT CAST(COALESCE(SUM(bytes), 0) AS BIGINT) FROM plants WHERE organisation_id = $1";

const COUNT_BYTES: &str = "UPDATE plants SET bytes = bytes + $2 WHERE id = $1";

#[async_trait]
impl UsageStore for Rows {
    async fn organisations(&self, now: Timestamp) -> Result<Vec<(Organisation, Usage)>, StoreError> {
        const ORGANISATIONS: &str = concat!(select_usage!(), " ORDER BY name");
        let rows = sqlx::query(ORGANISATIONS).bind(now.as_millisecond()).fetch_all(&self.read).await?;
        rows.iter().map(|row| Ok((organisation(row)?, usage(row)?))).collect()
    }

    async fn usage(&self, organisation: OrganisationId, now: Timestamp) -> Result<Option<Usage>, StoreError> {
        const USAGE: &str = concat!(select_usage!(), " WHERE id = $2");
        let query = sqlx::query(USAGE).bind(now.as_millisecond()).bind(organisation.to_string());
        query.fetch_optional(&self.read).await?.as_ref().map(usage).transpose()
    }

    async fn set_quotas(&self, organisation: OrganisationId, own: Quotas) -> Result<(), StoreError> {
        const SET_QUOTAS: &str = "UPDATE organisations SET max_bytes = $2, max_plants = $3 WHERE id = $1";
        sqlx::query(SET_QUOTAS)
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
        const OWNER: &str = "SELECT organisation_id FROM plants WHERE id = $1";
        let mut tx = self.begin().await?;
        let owner: Option<String> = sqlx::query_scalar(OWNER).bind(plant.to_string()).fetch_optional(&mut *tx).await?;
        let owner = owner.ok_or(StoreError::Gone { what: "plant" })?;
        let quota = quotas(&mut tx, &owner, defaults).await?.bytes;
        let more = count_bytes(&mut tx, plant, blobs, Some(now)).await?;
        if let Some(quota) = quota.filter(|_| more > 0) {
            let query = sqlx::query_scalar(BYTES_OF_ORGANISATION).bind(&owner);
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
        const PLANTS_WITH_UNUSED_BLOBS: &str = concat!(
            "SELECT DISTINCT plant_id AS id FROM blobs WHERE unused_ms IS NOT NULL \
             AND ((freeing_ms IS NULL AND unused_ms < $1) OR freeing_ms < $2) AND ",
            is_needed_by_no_job!(),
            " ORDER BY plant_id LIMIT $3"
        );
        const TAKE_UNUSED_BLOBS: &str = concat!(
            "UPDATE blobs SET freeing_ms = $5 WHERE plant_id = $1 AND sha256 IN (SELECT blobs.sha256 FROM blobs \
             WHERE plant_id = $1 AND unused_ms IS NOT NULL \
             AND ((freeing_ms IS NULL AND unused_ms < $2) OR freeing_ms < $3) AND ",
            is_unreferenced!(),
            " AND ",
            is_needed_by_no_job!(),
            " ORDER BY sha256 LIMIT $4) RETURNING plant_id, sha256, size"
        );
        let (before_ms, now_ms) = (before.as_millisecond(), now.as_millisecond());
        let lost_ms = now_ms.saturating_sub(i64::try_from(lease.as_millis()).unwrap_or(i64::MAX));
        let query = sqlx::query(PLANTS_WITH_UNUSED_BLOBS).bind(before_ms).bind(lost_ms).bind(i64::from(limit));
        let mut taken = Vec::new();
        for plant in query.fetch_all(&self.read).await? {
            let plant = PlantId(uuid(&plant, "id")?);
            let mut tx = self.begin().await?;
            if let Err(StoreError::Gone { .. }) = lock_plant(&mut tx, plant).await {
                tx.rollback().await?;
                continue;
            }
            let query = sqlx::query(TAKE_UNUSED_BLOBS)
                .bind(plant.to_string())
                .bind(before_ms)
                .bind(lost_ms)
                .bind(i64::from(limit))
                .bind(now_ms);
            let rows = query.fetch_all(&mut *tx).await?;
            let blobs: Result<Vec<_>, _> = rows.iter().map(blob).collect();
            tx.commit().await?;
            taken.extend(blobs?.into_iter().map(|blob| UnusedBlob { blob, taken: now }));
        }
        Ok(taken)
    }

    async fn blob_is_gone(&self, unused: &UnusedBlob) -> Result<bool, StoreError> {
        const FORGET_BLOB: &str =
            "DELETE FROM blobs WHERE plant_id = $1 AND sha256 = $2 AND freeing_ms = $3 RETURNING size";
        let plant = unused.blob.plant;
        let mut tx = self.begin().await?;
        match lock_plant(&mut tx, plant).await {
            Err(StoreError::Gone { .. }) => {
                tx.rollback().await?;
                return Ok(false);
            }
            locked => locked?,
        }
        let size: Option<i64> = sqlx::query_scalar(FORGET_BLOB)
            .bind(plant.to_string())
            .bind(unused.blob.sha256.to_string())
            .bind(unused.taken.as_millisecond())
            .fetch_optional(&mut *tx)
            .await?;
        if let Some(size) = size {
            sqlx::query(COUNT_BYTES).bind(plant.to_string()).bind(-size).execute(&mut *tx).await?;
        }
        tx.commit().await?;
        Ok(size.is_some())
    }

    async fn blobs(&self, after: Option<(PlantId, Digest)>, limit: u32) -> Result<Vec<BlobRecord>, StoreError> {
        /// All blobs with references, by plant and digest, after `$1` and `$2`.
        const BLOBS: &str = "\
            SELECT plant_id, sha256, size FROM (\
            SELECT surveys.plant_id, files.sha256, files.size FROM files JOIN surveys ON surveys.id = files.survey_id \
            UNION SELECT plant_id, sha256, size FROM models\
            ) AS blobs WHERE (plant_id, sha256) > ($1, $2) ORDER BY plant_id, sha256 LIMIT $3";
        let (plant, digest) = match after {
            Some((plant, digest)) => (plant.to_string(), digest.to_string()),
            None => (String::new(), String::new()),
        };
        let rows = sqlx::query(BLOBS).bind(plant).bind(digest).bind(i64::from(limit)).fetch_all(&self.read).await?;
        rows.iter().map(blob).collect()
    }
}

fn bounded(quota: u64) -> i64 {
    quota.min(UNLIMITED) as i64
}

/// The quotas of an organisation, locked until the transaction ends.
pub async fn quotas(tx: &mut Tx, organisation: &str, defaults: Quotas) -> Result<Quotas, StoreError> {
    /// Changes nothing, but locks the row until the transaction ends.
    const LOCK_QUOTAS: &str = "UPDATE organisations SET name = name WHERE id = $1 RETURNING max_bytes, max_plants";
    let row: Option<Row> = sqlx::query(LOCK_QUOTAS).bind(organisation).fetch_optional(&mut **tx).await?;
    let row = row.ok_or(StoreError::Gone { what: "organisation" })?;
    let own = |column: &str| Ok::<_, StoreError>(row.try_get::<Option<i64>, _>(column)?.map(|quota| quota as u64));
    Ok(Quotas { bytes: own("max_bytes")?, plants: own("max_plants")? }.or(defaults))
}

/// Locks a plant's blobs and the references to them until the transaction ends.
async fn lock_plant(tx: &mut Tx, plant: PlantId) -> Result<(), StoreError> {
    /// Changes nothing. Every transaction that changes a plant's blobs or the references to them locks the plant's row first, so
    /// that no two of them run at the same time or deadlock.
    const LOCK_PLANT: &str = "UPDATE plants SET bytes = bytes WHERE id = $1 RETURNING id";
    let row = sqlx::query(LOCK_PLANT).bind(plant.to_string()).fetch_optional(&mut **tx).await?;
    row.map(drop).ok_or(StoreError::Gone { what: "plant" })
}

/// Counts blobs that a plant does not have yet and returns their bytes. Blobs without references are unused from `unused` on; without
/// that time a row of this transaction refers to them.
pub async fn count_bytes(
    tx: &mut Tx,
    plant: PlantId,
    blobs: &[(Digest, u64)],
    unused: Option<Timestamp>,
) -> Result<u64, StoreError> {
    /// A blob with references stays referred to.
    const RESERVE_BLOB: &str = "\
        UPDATE blobs SET unused_ms = CASE WHEN unused_ms IS NULL THEN NULL ELSE $3 END \
        WHERE plant_id = $1 AND sha256 = $2 AND freeing_ms IS NULL";
    const KEEP_BLOB: &str = "\
        INSERT INTO blobs (plant_id, sha256, size, unused_ms) VALUES ($1, $2, $3, $4) \
        ON CONFLICT (plant_id, sha256) DO NOTHING";
    lock_plant(tx, plant).await?;
    let unused_ms = unused.map(Timestamp::as_millisecond);
    let mut more = 0;
    for (sha256, size) in blobs {
        let (plant_id, digest) = (plant.to_string(), sha256.to_string());
        let reserve = sqlx::query(RESERVE_BLOB).bind(&plant_id).bind(&digest).bind(unused_ms);
        if reserve.execute(&mut **tx).await?.rows_affected() > 0 {
            continue;
        }
        let keep = sqlx::query(KEEP_BLOB).bind(&plant_id).bind(&digest).bind(*size as i64).bind(unused_ms);
        if keep.execute(&mut **tx).await?.rows_affected() == 0 {
            return Err(StoreError::BeingFreed { sha256: *sha256 });
        }
        more += size;
    }
    if more > 0 {
        sqlx::query(COUNT_BYTES).bind(plant.to_string()).bind(more as i64).execute(&mut **tx).await?;
    }
    Ok(more)
}

/// As [`lock_plant`] for the plant of a survey; returns the plant.
pub async fn lock_plant_of(tx: &mut Tx, survey: SurveyId) -> Result<PlantId, StoreError> {
    const LOCK_PLANT_OF_SURVEY: &str =
        "UPDATE plants SET bytes = bytes WHERE id = (SELECT plant_id FROM surveys WHERE id = $1) RETURNING id";
    let query = sqlx::query(LOCK_PLANT_OF_SURVEY).bind(survey.to_string());
    let row: Option<Row> = query.fetch_optional(&mut **tx).await?;
    Ok(PlantId(uuid(&row.ok_or(StoreError::Gone { what: "survey" })?, "id")?))
}

/// Records that a row of this transaction refers to a blob, which must exist.
pub async fn add_blob_ref(tx: &mut Tx, plant: PlantId, sha256: Digest) -> Result<(), StoreError> {
    const ADD_BLOB_REF: &str =
        "UPDATE blobs SET unused_ms = NULL WHERE plant_id = $1 AND sha256 = $2 AND freeing_ms IS NULL";
    let query = sqlx::query(ADD_BLOB_REF).bind(plant.to_string()).bind(sha256.to_string());
    match query.execute(&mut **tx).await?.rows_affected() {
        0 => Err(StoreError::BeingFreed { sha256 }),
        _ => Ok(()),
    }
}

/// Records that a row of this transaction refers to a blob no longer: the blob is unused from now on, unless another row refers to
/// it.
pub async fn remove_blob_ref(tx: &mut Tx, plant: PlantId, digest: &str, now: Timestamp) -> Result<(), StoreError> {
    const REMOVE_BLOB_REF: &str =
        concat!("UPDATE blobs SET unused_ms = $3 WHERE plant_id = $1 AND sha256 = $2 AND ", is_unreferenced!());
    let query = sqlx::query(REMOVE_BLOB_REF).bind(plant.to_string()).bind(digest).bind(now.as_millisecond());
    query.execute(&mut **tx).await?;
    Ok(())
}

/// As [`remove_blob_ref`], of all blobs of a plant whose rows went with another.
pub async fn remove_lost_blob_refs(tx: &mut Tx, plant: PlantId, now: Timestamp) -> Result<(), StoreError> {
    const REMOVE_LOST_BLOB_REFS: &str =
        concat!("UPDATE blobs SET unused_ms = $2 WHERE plant_id = $1 AND unused_ms IS NULL AND ", is_unreferenced!());
    let query = sqlx::query(REMOVE_LOST_BLOB_REFS).bind(plant.to_string()).bind(now.as_millisecond());
    query.execute(&mut **tx).await?;
    Ok(())
}

fn usage(row: &Row) -> Result<Usage, StoreError> {
    let count = |column: &str| Ok::<_, StoreError>(row.try_get::<i64, _>(column)? as u64);
    let quota = |column: &str| Ok::<_, StoreError>(row.try_get::<Option<i64>, _>(column)?.map(|quota| quota as u64));
    Ok(Usage {
        bytes: count("bytes")?,
        announced_bytes: count("announced_bytes")?,
        plants: count("plants")?,
        own: Quotas { bytes: quota("max_bytes")?, plants: quota("max_plants")? },
    })
}

fn blob(row: &Row) -> Result<BlobRecord, StoreError> {
    let size: i64 = row.try_get("size")?;
    Ok(BlobRecord { plant: PlantId(uuid(row, "plant_id")?), sha256: parsed(row, "sha256")?, size: size as u64 })
}
