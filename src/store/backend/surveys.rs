//! Surveys and their files.

use super::super::{Row, Rows, Tx};
use super::columns::{document, optional_document, optional_small, parsed, time, uuid};
use super::{gone, name_taken, usage};
use crate::store::digest::Digest;
use crate::store::error::StoreError;
use crate::store::ids::{SurveyId, UploadId};
use crate::store::listing::{Created, Page};
use crate::store::survey_path::SurveyPath;
use crate::store::surveys::{FileDeleted, FileRecord, FileWritten, Survey, SurveyStore, Wanted};
use async_trait::async_trait;
use heliomap_model::{PlantId, Warning};
use jiff::Timestamp;
use sqlx::Row as _;
use uuid::Uuid;

macro_rules! survey_columns {
    () => {
        "seq, id, plant_id, name, created_ms"
    };
}

macro_rules! file_columns {
    () => {
        "path, size, sha256, width_px, height_px, photo, shots, stored_ms"
    };
}

#[async_trait]
impl SurveyStore for Rows {
    async fn create_survey(&self, plant: PlantId, name: &str, now: Timestamp) -> Result<Created<Survey>, StoreError> {
        const CREATE_SURVEY: &str = concat!(
            "INSERT INTO surveys (id, plant_id, name, created_ms) VALUES ($1, $2, $3, $4) \
             ON CONFLICT (plant_id, name) DO NOTHING RETURNING ",
            survey_columns!()
        );
        const SURVEY_BY_NAME: &str =
            concat!("SELECT ", survey_columns!(), " FROM surveys WHERE plant_id = $1 AND name = $2");
        let mut tx = self.begin().await?;
        let row = sqlx::query(CREATE_SURVEY)
            .bind(Uuid::new_v4().to_string())
            .bind(plant.to_string())
            .bind(name)
            .bind(now.as_millisecond())
            .fetch_optional(&mut *tx)
            .await
            .map_err(gone("plant"))?;
        let created = match row {
            Some(row) => Created::New(survey(&row)?),
            None => {
                let query = sqlx::query(SURVEY_BY_NAME).bind(plant.to_string()).bind(name);
                Created::Existing(survey(&query.fetch_one(&mut *tx).await?)?)
            }
        };
        tx.commit().await?;
        Ok(created)
    }

    async fn survey(&self, plant: PlantId, id: SurveyId) -> Result<Option<Survey>, StoreError> {
        const SURVEY: &str = concat!("SELECT ", survey_columns!(), " FROM surveys WHERE plant_id = $1 AND id = $2");
        let query = sqlx::query(SURVEY).bind(plant.to_string()).bind(id.to_string());
        query.fetch_optional(&self.read).await?.as_ref().map(survey).transpose()
    }

    async fn surveys(&self, plant: PlantId, prefix: &str, page: Page) -> Result<Vec<Survey>, StoreError> {
        const SURVEYS: &str = concat!(
            "SELECT ",
            survey_columns!(),
            " FROM surveys WHERE plant_id = $1 AND seq > $2 AND SUBSTR(name, 1, LENGTH($4)) = $4 ORDER BY seq LIMIT $3"
        );
        let query = sqlx::query(SURVEYS)
            .bind(plant.to_string())
            .bind(page.after.unwrap_or(0))
            .bind(i64::from(page.limit))
            .bind(prefix);
        query.fetch_all(&self.read).await?.iter().map(survey).collect()
    }

    async fn rename_survey(&self, id: SurveyId, name: &str) -> Result<Survey, StoreError> {
        const RENAME_SURVEY: &str = concat!("UPDATE surveys SET name = $2 WHERE id = $1 RETURNING ", survey_columns!());
        let query = sqlx::query(RENAME_SURVEY).bind(id.to_string()).bind(name);
        let row = query.fetch_optional(&self.write).await.map_err(name_taken)?;
        survey(&row.ok_or(StoreError::Gone { what: "survey" })?)
    }

    async fn delete_survey(&self, id: SurveyId, now: Timestamp) -> Result<Option<Vec<UploadId>>, StoreError> {
        const UPLOADS_OF_SURVEY: &str = "SELECT id FROM uploads WHERE survey_id = $1";
        const DELETE_SURVEY: &str = "DELETE FROM surveys WHERE id = $1";
        let mut tx = self.begin().await?;
        let plant = match usage::lock_plant_of(&mut tx, id).await {
            Err(StoreError::Gone { .. }) => {
                tx.rollback().await?;
                return Ok(None);
            }
            locked => locked?,
        };
        let rows = sqlx::query(UPLOADS_OF_SURVEY).bind(id.to_string()).fetch_all(&mut *tx).await?;
        let uploads: Result<Vec<_>, StoreError> = rows.iter().map(|row| Ok(UploadId(uuid(row, "id")?))).collect();
        sqlx::query(DELETE_SURVEY).bind(id.to_string()).execute(&mut *tx).await?;
        usage::remove_lost_blob_refs(&mut tx, plant, now).await?;
        warn_models(&mut tx, id, None).await?;
        tx.commit().await?;
        uploads.map(Some)
    }

    async fn delete_file(
        &self,
        survey: SurveyId,
        path: &SurveyPath,
        wanted: Option<&Wanted>,
        now: Timestamp,
    ) -> Result<FileDeleted, StoreError> {
        const DELETE_FILE: &str = "DELETE FROM files WHERE survey_id = $1 AND path = $2";
        let mut tx = self.begin().await?;
        let plant = usage::lock_plant_of(&mut tx, survey).await?;
        let query = sqlx::query_scalar(FILE_DIGEST).bind(survey.to_string()).bind(path.as_str());
        let digest: Option<String> = query.fetch_optional(&mut *tx).await?;
        let is_other =
            wanted.is_some_and(|wanted| !wanted.holds(digest.as_deref().and_then(|digest| digest.parse().ok())));
        let outcome = match digest {
            _ if is_other => FileDeleted::Other,
            None => FileDeleted::Absent,
            Some(digest) => {
                sqlx::query(DELETE_FILE).bind(survey.to_string()).bind(path.as_str()).execute(&mut *tx).await?;
                usage::remove_blob_ref(&mut tx, plant, &digest, now).await?;
                warn_models(&mut tx, survey, Some(path)).await?;
                FileDeleted::Deleted
            }
        };
        tx.commit().await?;
        Ok(outcome)
    }

    async fn put_files(&self, survey: SurveyId, files: &[FileRecord]) -> Result<Vec<FileWritten>, StoreError> {
        let mut tx = self.begin().await?;
        let plant = usage::lock_plant_of(&mut tx, survey).await?;
        let mut written = Vec::with_capacity(files.len());
        for file in files {
            // Without a precondition a file is always stored.
            written.extend(put_file(&mut tx, plant, survey, file, None).await?);
        }
        tx.commit().await?;
        Ok(written)
    }

    async fn replace_file(
        &self,
        survey: SurveyId,
        file: &FileRecord,
        wanted: &Wanted,
    ) -> Result<Option<FileWritten>, StoreError> {
        let mut tx = self.begin().await?;
        let plant = usage::lock_plant_of(&mut tx, survey).await?;
        let written = put_file(&mut tx, plant, survey, file, Some(wanted)).await?;
        tx.commit().await?;
        Ok(written)
    }

    async fn files(&self, survey: SurveyId) -> Result<Vec<FileRecord>, StoreError> {
        const FILES: &str = concat!("SELECT ", file_columns!(), " FROM files WHERE survey_id = $1 ORDER BY path");
        let rows = sqlx::query(FILES).bind(survey.to_string()).fetch_all(&self.read).await?;
        rows.iter().map(file).collect()
    }

    async fn file(&self, survey: SurveyId, path: &SurveyPath) -> Result<Option<FileRecord>, StoreError> {
        const FILE: &str = concat!("SELECT ", file_columns!(), " FROM files WHERE survey_id = $1 AND path = $2");
        let query = sqlx::query(FILE).bind(survey.to_string()).bind(path.as_str());
        query.fetch_optional(&self.read).await?.as_ref().map(file).transpose()
    }

    async fn photos(
        &self,
        survey: SurveyId,
        prefix: &str,
        after: &str,
        limit: u32,
    ) -> Result<Vec<FileRecord>, StoreError> {
        const PHOTOS: &str = concat!(
            "SELECT ",
            file_columns!(),
            " FROM files WHERE survey_id = $1 AND kind = 'image' AND path > $2 AND SUBSTR(path, 1, LENGTH($4)) = $4 \
             ORDER BY path LIMIT $3"
        );
        let query = sqlx::query(PHOTOS)
            .bind(survey.to_string())
            .bind(after)
            .bind(i64::from(limit))
            .bind(format!("images/{prefix}"));
        query.fetch_all(&self.read).await?.iter().map(file).collect()
    }

    async fn photos_alike(&self, survey: SurveyId) -> Result<Vec<(Digest, SurveyPath)>, StoreError> {
        const PHOTOS_ALIKE: &str = "\
            SELECT sha256, path FROM files WHERE survey_id = $1 AND kind = 'image' AND sha256 IN (\
            SELECT sha256 FROM files WHERE survey_id = $1 AND kind = 'image' GROUP BY sha256 HAVING COUNT(*) > 1\
            ) ORDER BY path";
        let query = sqlx::query(PHOTOS_ALIKE).bind(survey.to_string());
        query.fetch_all(&self.read).await?.iter().map(digest_and_path).collect()
    }

    async fn photos_of_digest(
        &self,
        survey: SurveyId,
        sha256: Digest,
        limit: u32,
    ) -> Result<Vec<SurveyPath>, StoreError> {
        const PHOTOS_OF_DIGEST: &str = "\
            SELECT path FROM files WHERE survey_id = $1 AND sha256 = $2 AND kind = 'image' ORDER BY path LIMIT $3";
        let query =
            sqlx::query(PHOTOS_OF_DIGEST).bind(survey.to_string()).bind(sha256.to_string()).bind(i64::from(limit));
        query.fetch_all(&self.read).await?.iter().map(path).collect()
    }
}

const FILE_DIGEST: &str = "SELECT sha256 FROM files WHERE survey_id = $1 AND path = $2";

/// Most files that a warning of a model names.
const MAX_WARNED: usize = 100;

/// Adds to the warnings of the models that were made from a survey that a file of it, or all of it, was deleted since.
async fn warn_models(tx: &mut Tx, survey: SurveyId, path: Option<&SurveyPath>) -> Result<(), StoreError> {
    const CODE: &str = "source_deleted";
    const WARNINGS_OF_MODELS: &str = "SELECT seq, warnings FROM models WHERE survey_id = $1";
    const SET_WARNINGS: &str = "UPDATE models SET warnings = $2 WHERE seq = $1";
    for row in sqlx::query(WARNINGS_OF_MODELS).bind(survey.to_string()).fetch_all(&mut **tx).await? {
        let mut warnings: Vec<Warning> = document(&row, "warnings")?;
        let earlier = warnings.iter().position(|warning| warning.code == CODE);
        let mut names = earlier.map(|at| warnings.remove(at).images).unwrap_or_default();
        names.extend(path.map(|path| path.file_name().to_owned()).filter(|_| names.len() < MAX_WARNED));
        let message = match path {
            None => "the survey that it was made from was deleted since".to_owned(),
            Some(_) => format!("files that it was made from were deleted since: {}", names.join(", ")),
        };
        warnings.push(Warning::new(CODE, message, names));
        let seq: i64 = row.try_get("seq")?;
        let query = sqlx::query(SET_WARNINGS).bind(seq).bind(serde_json::json!(warnings).to_string());
        query.execute(&mut **tx).await?;
    }
    Ok(())
}

/// Stores the record of a file if the existing one meets a precondition. The caller has locked the plant's row.
async fn put_file(
    tx: &mut Tx,
    plant: PlantId,
    survey: SurveyId,
    file: &FileRecord,
    wanted: Option<&Wanted>,
) -> Result<Option<FileWritten>, StoreError> {
    /// Adds metadata that older versions did not read.
    const COMPLETE_FILE: &str = "\
        UPDATE files SET photo = $3, shots = $4 WHERE survey_id = $1 AND path = $2 AND photo IS NULL AND shots IS NULL";
    const PUT_FILE: &str = "\
        INSERT INTO files (survey_id, path, kind, size, sha256, width_px, height_px, photo, shots, stored_ms) \
        VALUES ($1, $2, $3, $4, $5, $6, $7, $8, $9, $10) \
        ON CONFLICT (survey_id, path) DO UPDATE SET kind = excluded.kind, size = excluded.size, sha256 = excluded.sha256, \
        width_px = excluded.width_px, height_px = excluded.height_px, photo = excluded.photo, shots = excluded.shots, \
        stored_ms = excluded.stored_ms";
    let before: Option<String> = sqlx::query_scalar(FILE_DIGEST)
        .bind(survey.to_string())
        .bind(file.path.as_str())
        .fetch_optional(&mut **tx)
        .await?;
    if wanted.is_some_and(|wanted| !wanted.holds(before.as_deref().and_then(|digest| digest.parse().ok()))) {
        return Ok(None);
    }
    let digest = file.sha256.to_string();
    let verdict = match &before {
        Some(before) if *before == digest => FileWritten::Unchanged,
        Some(_) => FileWritten::Replaced,
        None => FileWritten::Created,
    };
    let photo = file.photo.as_ref().map(|photo| serde_json::json!(photo).to_string());
    let shots = file.shots.as_ref().map(|shots| serde_json::json!(shots).to_string());
    if verdict == FileWritten::Unchanged {
        sqlx::query(COMPLETE_FILE)
            .bind(survey.to_string())
            .bind(file.path.as_str())
            .bind(photo)
            .bind(shots)
            .execute(&mut **tx)
            .await?;
        return Ok(Some(verdict));
    }
    usage::add_blob_ref(tx, plant, file.sha256).await?;
    sqlx::query(PUT_FILE)
        .bind(survey.to_string())
        .bind(file.path.as_str())
        .bind(file.path.kind().as_str())
        .bind(file.size as i64)
        .bind(digest)
        .bind(file.size_px.map(|size| i64::from(size[0])))
        .bind(file.size_px.map(|size| i64::from(size[1])))
        .bind(photo)
        .bind(shots)
        .bind(file.stored.as_millisecond())
        .execute(&mut **tx)
        .await?;
    if let Some(before) = before {
        usage::remove_blob_ref(tx, plant, &before, file.stored).await?;
    }
    Ok(Some(verdict))
}

fn survey(row: &Row) -> Result<Survey, StoreError> {
    Ok(Survey {
        seq: row.try_get("seq")?,
        id: SurveyId(uuid(row, "id")?),
        plant: PlantId(uuid(row, "plant_id")?),
        name: row.try_get("name")?,
        created: time(row, "created_ms")?,
    })
}

fn path(row: &Row) -> Result<SurveyPath, StoreError> {
    let path: String = row.try_get("path")?;
    SurveyPath::stored(path.clone()).map_err(|_| StoreError::Corrupt { what: "path of a file", value: path })
}

fn digest_and_path(row: &Row) -> Result<(Digest, SurveyPath), StoreError> {
    Ok((parsed(row, "sha256")?, path(row)?))
}

fn file(row: &Row) -> Result<FileRecord, StoreError> {
    let width_px = optional_small(row, "width_px")?;
    let height_px = optional_small(row, "height_px")?;
    Ok(FileRecord {
        path: path(row)?,
        size: row.try_get::<i64, _>("size")? as u64,
        sha256: parsed(row, "sha256")?,
        size_px: width_px.zip(height_px).map(|(width, height)| [width, height]),
        photo: optional_document(row, "photo")?,
        shots: optional_document(row, "shots")?,
        stored: time(row, "stored_ms")?,
    })
}
