//! Uploads that may be resumed.

use super::super::{Db, Row, Rows, Tx};
use super::read;
use super::usage::quotas;
use crate::store::{Piece, StoreError, SurveyId, Upload, UploadBounds, UploadId, UploadStore, sql};
use async_trait::async_trait;
use heliomap_model::PlantId;
use jiff::Timestamp;
use sqlx::{QueryBuilder, Row as _};
use std::time::Duration;
use uuid::Uuid;

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
        let mut tx = self.begin().await?;
        if let Some(bounds) = bounds {
            require_within(&mut tx, upload, bounds, now).await?;
        }
        sqlx::query(sql::CREATE_UPLOAD)
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
            .map_err(super::gone("survey"))?;
        tx.commit().await?;
        Ok(())
    }

    async fn upload(&self, survey: SurveyId, id: UploadId) -> Result<Option<Upload>, StoreError> {
        let query = sqlx::query(sql::UPLOAD).bind(survey.to_string()).bind(id.to_string());
        query.fetch_optional(&self.read).await?.as_ref().map(read::upload).transpose()
    }

    async fn uploads_of_survey(
        &self,
        survey: SurveyId,
        after: &str,
        limit: u32,
        now: Timestamp,
    ) -> Result<Vec<Upload>, StoreError> {
        let query = sqlx::query(sql::UPLOADS_OF_SURVEY)
            .bind(survey.to_string())
            .bind(after)
            .bind(i64::from(limit))
            .bind(now.as_millisecond());
        query.fetch_all(&self.read).await?.iter().map(read::upload).collect()
    }

    async fn upload_received(
        &self,
        upload: &Upload,
        received: u64,
        home: Option<Uuid>,
        pieces: &[Piece],
        expires: Timestamp,
    ) -> Result<bool, StoreError> {
        let mut tx = self.begin().await?;
        let query = sqlx::query(sql::UPLOAD_RECEIVED)
            .bind(upload.id.to_string())
            .bind(received as i64)
            .bind(expires.as_millisecond())
            .bind(home.map(|home| home.to_string()))
            .bind(upload.received as i64);
        if query.execute(&mut *tx).await?.rows_affected() == 0 {
            return Ok(false);
        }
        for pieces in pieces.chunks(PIECES_AT_ONCE) {
            let mut insert = QueryBuilder::<Db>::new(sql::ADD_PIECES);
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
        let rows = sqlx::query(sql::UPLOAD_PIECES).bind(id.to_string()).fetch_all(&self.read).await?;
        let piece = |row: &Row| {
            Ok(Piece {
                from: row.try_get::<i64, _>("begins")? as u64,
                to: row.try_get::<i64, _>("ends")? as u64,
                name: read::uuid(row, "name")?,
                home: read::uuid(row, "home")?,
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
        let query = sqlx::query(sql::TAKE_UPLOAD_END)
            .bind(id.to_string())
            .bind(token.to_string())
            .bind(super::after(now, lease))
            .bind(now.as_millisecond());
        Ok(query.execute(&self.write).await?.rows_affected() > 0)
    }

    async fn end_upload(&self, id: UploadId, token: Uuid, outcome: Option<&str>) -> Result<(), StoreError> {
        let query = sqlx::query(sql::END_UPLOAD).bind(id.to_string()).bind(token.to_string()).bind(outcome);
        query.execute(&self.write).await?;
        Ok(())
    }

    async fn delete_upload(&self, survey: SurveyId, id: UploadId) -> Result<bool, StoreError> {
        let query = sqlx::query(sql::DELETE_UPLOAD).bind(survey.to_string()).bind(id.to_string());
        Ok(query.execute(&self.write).await?.rows_affected() > 0)
    }

    async fn delete_expired_uploads(&self, now: Timestamp) -> Result<(), StoreError> {
        sqlx::query(sql::DELETE_EXPIRED_UPLOADS).bind(now.as_millisecond()).execute(&self.write).await?;
        Ok(())
    }

    async fn uploads_of_plant(&self, plant: PlantId) -> Result<Vec<UploadId>, StoreError> {
        let rows = sqlx::query(sql::UPLOADS_OF_PLANT).bind(plant.to_string()).fetch_all(&self.read).await?;
        rows.iter().map(|row| Ok(UploadId(read::uuid(row, "id")?))).collect()
    }

    async fn uploads(&self) -> Result<Vec<UploadId>, StoreError> {
        let rows = sqlx::query(sql::UPLOADS).fetch_all(&self.read).await?;
        rows.iter().map(|row| Ok(UploadId(read::uuid(row, "id")?))).collect()
    }
}

/// Refuses an upload beyond its bounds. Until the transaction ends, no other of its organisation begins.
async fn require_within(tx: &mut Tx, upload: &Upload, bounds: &UploadBounds, now: Timestamp) -> Result<(), StoreError> {
    let owner: Option<String> =
        sqlx::query_scalar(sql::OWNER_OF_SURVEY).bind(upload.survey.to_string()).fetch_optional(&mut **tx).await?;
    let owner = owner.ok_or(StoreError::Gone { what: "survey" })?;
    let quota = quotas(tx, &owner, bounds.quotas).await?.bytes;
    let query = sqlx::query(sql::ANNOUNCED_BY_ORGANISATION).bind(&owner).bind(now.as_millisecond());
    let row = query.fetch_one(&mut **tx).await?;
    let (open, announced) = (row.try_get::<i64, _>("uploads")? as u64, row.try_get::<i64, _>("bytes")? as u64);
    if open >= bounds.open {
        return Err(StoreError::TooManyUploads { open, most: bounds.open });
    }
    let Some(quota) = quota else { return Ok(()) };
    let kept = sqlx::query_scalar(sql::BYTES_OF_ORGANISATION).bind(&owner).fetch_one(&mut **tx).await;
    let kept = kept.map(|bytes: i64| bytes as u64)?;
    let counted = if bounds.may_be_there { 0 } else { kept };
    if counted.saturating_add(announced).saturating_add(upload.length) > quota {
        return Err(StoreError::OverQuota { what: "bytes", used: kept.saturating_add(announced), quota });
    }
    Ok(())
}
