//! Plants.

use super::super::{Row, Rows};
use super::columns::{time, uuid};
use super::{gone, name_taken, usage};
use crate::store::error::StoreError;
use crate::store::ids::OrganisationId;
use crate::store::listing::{Created, Page};
use crate::store::plants::{Plant, PlantStore};
use crate::store::usage::Quotas;
use async_trait::async_trait;
use heliomap_model::PlantId;
use jiff::Timestamp;
use sqlx::Row as _;
use uuid::Uuid;

macro_rules! plant_columns {
    () => {
        "seq, id, organisation_id, name, created_ms"
    };
}

#[async_trait]
impl PlantStore for Rows {
    async fn create_plant(
        &self,
        organisation: OrganisationId,
        name: &str,
        defaults: Quotas,
        now: Timestamp,
    ) -> Result<Created<Plant>, StoreError> {
        const CREATE_PLANT: &str = concat!(
            "INSERT INTO plants (id, organisation_id, name, created_ms) VALUES ($1, $2, $3, $4) \
             ON CONFLICT (organisation_id, name) DO NOTHING RETURNING ",
            plant_columns!()
        );
        const PLANTS_OF_ORGANISATION: &str = "SELECT COUNT(*) FROM plants WHERE organisation_id = $1";
        const PLANT_BY_NAME: &str =
            concat!("SELECT ", plant_columns!(), " FROM plants WHERE organisation_id = $1 AND name = $2");
        let mut tx = self.begin().await?;
        let quota = usage::quotas(&mut tx, &organisation.to_string(), defaults).await?.plants;
        let row = sqlx::query(CREATE_PLANT)
            .bind(Uuid::new_v4().to_string())
            .bind(organisation.to_string())
            .bind(name)
            .bind(now.as_millisecond())
            .fetch_optional(&mut *tx)
            .await
            .map_err(gone("organisation"))?;
        let created = match row {
            Some(row) => {
                let query = sqlx::query_scalar(PLANTS_OF_ORGANISATION).bind(organisation.to_string());
                let plants = query.fetch_one(&mut *tx).await.map(|plants: i64| plants as u64)?;
                if let Some(quota) = quota.filter(|quota| plants > *quota) {
                    return Err(StoreError::OverQuota { what: "plants", used: plants - 1, quota });
                }
                Created::New(plant(&row)?)
            }
            None => {
                let query = sqlx::query(PLANT_BY_NAME).bind(organisation.to_string()).bind(name);
                Created::Existing(plant(&query.fetch_one(&mut *tx).await?)?)
            }
        };
        tx.commit().await?;
        Ok(created)
    }

    async fn plant(&self, id: PlantId) -> Result<Option<Plant>, StoreError> {
        const PLANT: &str = concat!("SELECT ", plant_columns!(), " FROM plants WHERE id = $1");
        let row = sqlx::query(PLANT).bind(id.to_string()).fetch_optional(&self.read).await?;
        row.as_ref().map(plant).transpose()
    }

    async fn plants(
        &self,
        organisation: OrganisationId,
        only: Option<&[PlantId]>,
        prefix: &str,
        page: Page,
    ) -> Result<Vec<Plant>, StoreError> {
        /// `$2` is the JSON array of the plants that may be seen, or NULL for all.
        const PLANTS: &str = concat!(
            "SELECT ",
            plant_columns!(),
            " FROM plants WHERE organisation_id = $1 AND ($2 IS NULL OR id IN ",
            json_texts!("$2"),
            ") AND seq > $3 AND SUBSTR(name, 1, LENGTH($5)) = $5 ORDER BY seq LIMIT $4"
        );
        let query = sqlx::query(PLANTS)
            .bind(organisation.to_string())
            .bind(only.map(|plants| serde_json::json!(plants).to_string()))
            .bind(page.after.unwrap_or(0))
            .bind(i64::from(page.limit))
            .bind(prefix);
        query.fetch_all(&self.read).await?.iter().map(plant).collect()
    }

    async fn rename_plant(&self, id: PlantId, name: &str) -> Result<Plant, StoreError> {
        const RENAME_PLANT: &str = concat!("UPDATE plants SET name = $2 WHERE id = $1 RETURNING ", plant_columns!());
        let query = sqlx::query(RENAME_PLANT).bind(id.to_string()).bind(name);
        let row = query.fetch_optional(&self.write).await.map_err(name_taken)?;
        plant(&row.ok_or(StoreError::Gone { what: "plant" })?)
    }

    async fn delete_plant(&self, id: PlantId, now: Timestamp) -> Result<bool, StoreError> {
        const DELETE_PLANT: &str = "DELETE FROM plants WHERE id = $1";
        const NOTE_DELETED_PLANT: &str =
            "INSERT INTO deleted_plants (plant_id, deleted_ms) VALUES ($1, $2) ON CONFLICT (plant_id) DO NOTHING";
        let mut tx = self.begin().await?;
        let done = sqlx::query(DELETE_PLANT).bind(id.to_string()).execute(&mut *tx).await?;
        if done.rows_affected() > 0 {
            let query = sqlx::query(NOTE_DELETED_PLANT).bind(id.to_string()).bind(now.as_millisecond());
            query.execute(&mut *tx).await?;
        }
        tx.commit().await?;
        Ok(done.rows_affected() > 0)
    }

    async fn deleted_plants(&self) -> Result<Vec<PlantId>, StoreError> {
        const DELETED_PLANTS: &str = "SELECT plant_id AS id FROM deleted_plants";
        let rows = sqlx::query(DELETED_PLANTS).fetch_all(&self.read).await?;
        rows.iter().map(|row| Ok(PlantId(uuid(row, "id")?))).collect()
    }

    async fn forget_deleted_plants(&self, before: Timestamp) -> Result<(), StoreError> {
        const FORGET_DELETED_PLANTS: &str = "DELETE FROM deleted_plants WHERE deleted_ms < $1";
        sqlx::query(FORGET_DELETED_PLANTS).bind(before.as_millisecond()).execute(&self.write).await?;
        Ok(())
    }
}

fn plant(row: &Row) -> Result<Plant, StoreError> {
    Ok(Plant {
        seq: row.try_get("seq")?,
        id: PlantId(uuid(row, "id")?),
        organisation: OrganisationId(uuid(row, "organisation_id")?),
        name: row.try_get("name")?,
        created: time(row, "created_ms")?,
    })
}
