//! Uploads that may be resumed.

use super::super::{Db, Row, Rows, Tx};
use super::columns::{time, uuid};
use super::usage::{BYTES_OF_ORGANISATION, quotas};
use super::{after, gone};
use crate::store::error::StoreError;
use crate::store::ids::{SurveyId, UploadId};
use crate::store::pieces::Piece;
use crate::store::uploads::{Upload, UploadBounds, UploadStore};
use async_trait::async_trait;
use heliomap_model::PlantId;
use jiff::Timestamp;
use sqlx::{QueryBuilder, Row as _};
use std::time::Duration;
use uuid::Uuid;

macro_rules! select_upload {
    ($parts:literal) => {
        concat!(
            "SELECT id, survey_id, length, received, partial, metadata, expires_ms, outcome, home, ",
            $parts,
            " AS parts FROM uploads WHERE survey_id = $1 AND "
        )
    };
}

/// Pieces that one statement inserts; a row has five parameters.
const PIECES_AT_ONCE: usize = 500;

#[async_trait]
impl UploadStore for Rows {
    async fn create_upload(
        &self,
        upload: &Upload,
        bounds: Option<&UploadBounds>,
        now: Timestamp,
    ) -> Result<(), StoreError> {
        const CREATE_UPLOAD: &str = "\
            INSERT INTO uploads (id, survey_id, length, received, partial, metadata, expires_ms, parts, home) \
            VALUES ($1, $2, $3, $4, $5, $6, $7, $8, $9)";
        let mut tx = self.begin().await?;
        if let Some(bounds) = bounds {
            require_within(&mut tx, upload, bounds, now).await?;
        }
        sqlx::query(CREATE_UPLOAD)
            .bind(upload.id.to_string())
            .bind(upload.survey.to_string())
            .bind(upload.length as i64)
            .bind(upload.received as i64)
            .bind(upload.partial)
            .bind(&upload.metadata)
            .bind(upload.expires.as_millisecond())
            .bind(&upload.parts)
            .bind(upload.home.map(|home| home.to_string()))
            .execute(&mut *tx)
            .await
            .map_err(gone("survey"))?;
        tx.commit().await?;
        Ok(())
    }

    async fn upload(&self, survey: SurveyId, id: UploadId) -> Result<Option<Upload>, StoreError> {
        const UPLOAD: &str = concat!(select_upload!("parts"), "id = $2");
        let query = sqlx::query(UPLOAD).bind(survey.to_string()).bind(id.to_string());
        query.fetch_optional(&self.read).await?.as_ref().map(upload).transpose()
    }

    async fn uploads_of_survey(
        &self,
        survey: SurveyId,
        after: &str,
        limit: u32,
        now: Timestamp,
    ) -> Result<Vec<Upload>, StoreError> {
        const UPLOADS_OF_SURVEY: &str =
            concat!(select_upload!("CAST(NULL AS TEXT)"), "id > $2 AND expires_ms > $4 ORDER BY id LIMIT $3");
        let query = sqlx::query(UPLOADS_OF_SURVEY)
            .bind(survey.to_string())
            .bind(after)
            .bind(i64::from(limit))
            .bind(now.as_millisecond());
        query.fetch_all(&self.read).await?.iter().map(upload).collect()
    }

    async fn upload_received(
        &self,
        upload: &Upload,
        received: u64,
        home: Option<Uuid>,
        pieces: &[Piece],
        expires: Timestamp,
    ) -> Result<bool, StoreError> {
        const UPLOAD_RECEIVED: &str =
            "UPDATE uploads SET received = $2, expires_ms = $3, home = $4 WHERE id = $1 AND received = $5";
        const ADD_PIECES: &str = "INSERT INTO upload_pieces (upload_id, begins, ends, name, home) ";
        let mut tx = self.begin().await?;
        let query = sqlx::query(UPLOAD_RECEIVED)
            .bind(upload.id.to_string())
            .bind(received as i64)
            .bind(expires.as_millisecond())
            .bind(home.map(|home| home.to_string()))
            .bind(upload.received as i64);
        if query.execute(&mut *tx).await?.rows_affected() == 0 {
            tx.rollback().await?;
            return Ok(false);
        }
        for pieces in pieces.chunks(PIECES_AT_ONCE) {
            let mut insert = QueryBuilder::<Db>::new(ADD_PIECES);
            insert.push_values(pieces, |mut row, piece| {
                row.push_bind(upload.id.to_string())
                    .push_bind(piece.from as i64)
                    .push_bind(piece.to as i64)
                    .push_bind(piece.name.to_string())
                    .push_bind(piece.home.to_string());
            });
            insert.build().persistent(false).execute(&mut *tx).await?;
        }
        tx.commit().await?;
        Ok(true)
    }

    async fn upload_pieces(&self, id: UploadId) -> Result<Vec<Piece>, StoreError> {
        const UPLOAD_PIECES: &str =
            "SELECT begins, ends, name, home FROM upload_pieces WHERE upload_id = $1 ORDER BY begins";
        let rows = sqlx::query(UPLOAD_PIECES).bind(id.to_string()).fetch_all(&self.read).await?;
        let piece = |row: &Row| {
            Ok(Piece {
                from: row.try_get::<i64, _>("begins")? as u64,
                to: row.try_get::<i64, _>("ends")? as u64,
                name: uuid(row, "name")?,
                home: uuid(row, "home")?,
            })
        };
        rows.iter().map(piece).collect()
    }

    async fn take_upload_end(
        &self,
        id: UploadId,
        token: Uuid,
        lease: Duration,
        now: Timestamp,
    ) -> Result<bool, StoreError> {
        const TAKE_UPLOAD_END: &str = "\
            UPDATE uploads SET ender = $2, ending_until_ms = $3 \
            WHERE id = $1 AND outcome IS NULL AND (ending_until_ms < $4 OR ender = $2)";
        let query = sqlx::query(TAKE_UPLOAD_END)
            .bind(id.to_string())
            .bind(token.to_string())
            .bind(after(now, lease))
            .bind(now.as_millisecond());
        Ok(query.execute(&self.write).await?.rows_affected() > 0)
    }

    async fn end_upload(&self, id: UploadId, token: Uuid, outcome: Option<&str>) -> Result<(), StoreError> {
        const END_UPLOAD: &str = "\
            UPDATE uploads SET outcome = $3, ender = NULL, ending_until_ms = 0 \
            WHERE id = $1 AND outcome IS NULL AND ender = $2";
        let query = sqlx::query(END_UPLOAD).bind(id.to_string()).bind(token.to_string()).bind(outcome);
        query.execute(&self.write).await?;
        Ok(())
    }

    async fn delete_upload(&self, survey: SurveyId, id: UploadId) -> Result<bool, StoreError> {
        const DELETE_UPLOAD: &str = "DELETE FROM uploads WHERE survey_id = $1 AND id = $2";
        let query = sqlx::query(DELETE_UPLOAD).bind(survey.to_string()).bind(id.to_string());
        Ok(query.execute(&self.write).await?.rows_affected() > 0)
    }

    async fn delete_expired_uploads(&self, now: Timestamp) -> Result<(), StoreError> {
        const DELETE_EXPIRED_UPLOADS: &str = "DELETE FROM uploads WHERE expires_ms <= $1";
        sqlx::query(DELETE_EXPIRED_UPLOADS).bind(now.as_millisecond()).execute(&self.write).await?;
        Ok(())
    }

    async fn uploads_of_plant(&self, plant: PlantId) -> Result<Vec<UploadId>, StoreError> {
        const UPLOADS_OF_PLANT: &str = "\
            SELECT uploads.id FROM uploads JOIN surveys ON surveys.id = uploads.survey_id WHERE surveys.plant_id = $1";
        let rows = sqlx::query(UPLOADS_OF_PLANT).bind(plant.to_string()).fetch_all(&self.read).await?;
        rows.iter().map(|row| Ok(UploadId(uuid(row, "id")?))).collect()
    }

    async fn uploads(&self) -> Result<Vec<UploadId>, StoreError> {
        const UPLOADS: &str = "SELECT id FROM uploads";
        let rows = sqlx::query(UPLOADS).fetch_all(&self.read).await?;
        rows.iter().map(|row| Ok(UploadId(uuid(row, "id")?))).collect()
    }
}

/// Refuses an upload beyond its bounds. Until the transaction ends, no other of its organisation begins.
async fn require_within(tx: &mut Tx, upload: &Upload, bounds: &UploadBounds, now: Timestamp) -> Result<(), StoreError> {
    const OWNER_OF_SURVEY: &str =
        "SELECT plants.organisation_id FROM surveys JOIN plants ON plants.id = surveys.plant_id WHERE surveys.id = $1";
    const ANNOUNCED_BY_ORGANISATION: &str = "\
        SELECT COUNT(*) AS uploads, CAST(COALESCE(SUM(uploads.length), 0) AS BIGINT) AS bytes FROM uploads \
        JOIN surveys ON surveys.id = uploads.survey_id JOIN plants ON plants.id = surveys.plant_id \
        WHERE plants.organisation_id = $1 AND uploads.outcome IS NULL AND uploads.expires_ms > $2";
    let owner: Option<String> =
        sqlx::query_scalar(OWNER_OF_SURVEY).bind(upload.survey.to_string()).fetch_optional(&mut **tx).await?;
    let owner = owner.ok_or(StoreError::Gone { what: "survey" })?;
    let quota = quotas(tx, &owner, bounds.quotas).await?.bytes;
    let query = sqlx::query(ANNOUNCED_BY_ORGANISATION).bind(&owner).bind(now.as_millisecond());
    let row = query.fetch_one(&mut **tx).await?;
    let (open, announced) = (row.try_get::<i64, _>("uploads")? as u64, row.try_get::<i64, _>("bytes")? as u64);
    if open >= bounds.open {
        return Err(StoreError::TooManyUploads { open, max: bounds.open });
    }
    let Some(quota) = quota else { return Ok(()) };
    let kept = sqlx::query_scalar(BYTES_OF_ORGANISATION).bind(&owner).fetch_one(&mut **tx).await;
    let kept = kept.map(|bytes: i64| bytes as u64)?;
    let counted = if bounds.may_be_there { 0 } else { kept };
    if counted.saturating_add(announced).saturating_add(upload.length) > quota {
        return Err(StoreError::OverQuota { what: "bytes", used: kept.saturating_add(announced), quota });
    }
    Ok(())
}

fn upload(row: &Row) -> Result<Upload, StoreError> {
    Ok(Upload {
        id: UploadId(uuid(row, "id")?),
        survey: SurveyId(uuid(row, "survey_id")?),
        length: row.try_get::<i64, _>("length")? as u64,
        received: row.try_get::<i64, _>("received")? as u64,
        partial: row.try_get("partial")?,
        parts: row.try_get("parts")?,
        metadata: row.try_get("metadata")?,
        expires: time(row, "expires_ms")?,
        outcome: row.try_get("outcome")?,
        home: row.try_get::<Option<&str>, _>("home")?.map(|_| uuid(row, "home")).transpose()?,
    })
}
