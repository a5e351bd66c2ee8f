//! Uploads that may be resumed.

use super::super::Rows;
use super::read;
use crate::store::{StoreError, SurveyId, Upload, UploadId, UploadStore, sql};
use async_trait::async_trait;
use jiff::Timestamp;

#[async_trait]
impl UploadStore for Rows {
    async fn create_upload(&self, upload: &Upload) -> Result<(), StoreError> {
        sqlx::query(sql::CREATE_UPLOAD)
            .bind(upload.id.to_string())
            .bind(upload.survey.to_string())
            .bind(upload.length as i64)
            .bind(upload.received as i64)
            .bind(upload.partial)
            .bind(&upload.metadata)
            .bind(upload.expires.as_millisecond())
            .execute(&self.write)
            .await
            .map_err(super::gone("survey"))?;
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

    async fn upload_received(&self, id: UploadId, received: u64, expires: Timestamp) -> Result<bool, StoreError> {
        let query = sqlx::query(sql::UPLOAD_RECEIVED).bind(id.to_string()).bind(received as i64);
        Ok(query.bind(expires.as_millisecond()).execute(&self.write).await?.rows_affected() > 0)
    }

    async fn end_upload(&self, id: UploadId, outcome: &str) -> Result<(), StoreError> {
        sqlx::query(sql::END_UPLOAD).bind(id.to_string()).bind(outcome).execute(&self.write).await?;
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

    async fn uploads(&self) -> Result<Vec<UploadId>, StoreError> {
        let rows = sqlx::query(sql::UPLOADS).fetch_all(&self.read).await?;
        rows.iter().map(|row| Ok(UploadId(read::uuid(row, "id")?))).collect()
    }
}
