//! The methods of the store, written once for both databases: this module is compiled once beside each of them and knows
//! its database by the names `Rows` (the store), `Db`, `Row` and `Tx` of its parent.

mod access;
pub mod examine;
mod read;
mod requests;
mod tasks;
mod uploads;
mod usage;
mod webhooks;

use super::super::records::LONGEST_BACKOFF;
use super::super::sql;
use super::super::{
    BlobRecord, Cancelled, Checkpoint, Claim, Completed, Created, Digest, Ending, Enqueued, Feature, FeatureQuery,
    FileRecord, FileWritten, GeoBox, Heartbeat, Job, JobId, JobRequest, JobState, LayerInfo, Model, NewFeature,
    NewModel, OrganisationId, Page, Plant, Pool, Progress, Queue, Quotas, Store, StoreError, Survey, SurveyId,
    SurveyPath, TaskStore, Wanted,
};
use super::{Db, Row, Rows, Tx, queues, tell_of_work};
use async_trait::async_trait;
use heliomap_model::{Layer, ModuleId, PlantId};
use jiff::Timestamp;
use read::{file, job, model, plant, survey};
use sqlx::{QueryBuilder, Row as _};
use std::time::Duration;
use tokio::sync::Notify;
use uuid::Uuid;
use webhooks::announce;

/// A box that covers less of its layer than this is looked up by place.
const SMALL_BOX_SHARE: f64 = 0.05;

/// Features that one statement inserts. A row has eleven parameters, and SQLite takes 32,766 of them in one statement, Postgres
/// 65,535.
const FEATURES_AT_ONCE: usize = 500;

#[async_trait]
impl Store for Rows {
    async fn ping(&self) -> Result<(), StoreError> {
        sqlx::query(sql::PING).execute(&self.read).await?;
        Ok(())
    }

    async fn ring_for_work(&self, bell: &Notify) {
        self.listen(bell).await;
    }

    async fn create_plant(
        &self,
        organisation: OrganisationId,
        name: &str,
        defaults: Quotas,
        now: Timestamp,
    ) -> Result<Created<Plant>, StoreError> {
        let mut tx = self.begin().await?;
        let quota = usage::quotas(&mut tx, &organisation.to_string(), defaults).await?.plants;
        let row = sqlx::query(sql::CREATE_PLANT)
            .bind(Uuid::new_v4().to_string())
            .bind(organisation.to_string())
            .bind(name)
            .bind(now.as_millisecond())
            .fetch_optional(&mut *tx)
            .await
            .map_err(gone("organisation"))?;
        let created = match row {
            Some(row) => {
                let query = sqlx::query_scalar(sql::PLANTS_OF_ORGANISATION).bind(organisation.to_string());
                let plants = query.fetch_one(&mut *tx).await.map(|plants: i64| plants as u64)?;
                if let Some(quota) = quota.filter(|quota| plants > *quota) {
                    return Err(StoreError::OverQuota { what: "plants", used: plants - 1, quota });
                }
                Created::New(plant(&row)?)
            }
            None => {
                let query = sqlx::query(sql::PLANT_BY_NAME).bind(organisation.to_string()).bind(name);
                Created::Existing(plant(&query.fetch_one(&mut *tx).await?)?)
            }
        };
        tx.commit().await?;
        Ok(created)
    }

    async fn plant(&self, id: PlantId) -> Result<Option<Plant>, StoreError> {
        let row = sqlx::query(sql::PLANT).bind(id.to_string()).fetch_optional(&self.read).await?;
        row.as_ref().map(plant).transpose()
    }

    async fn plants(
        &self,
        organisation: OrganisationId,
        only: Option<&[PlantId]>,
        prefix: &str,
        page: Page,
    ) -> Result<Vec<Plant>, StoreError> {
        let query = sqlx::query(sql::PLANTS)
            .bind(organisation.to_string())
            .bind(only.map(access::plants_text))
            .bind(page.after.unwrap_or(0))
            .bind(i64::from(page.limit))
            .bind(prefix);
        query.fetch_all(&self.read).await?.iter().map(plant).collect()
    }

    async fn delete_plant(&self, id: PlantId, now: Timestamp) -> Result<bool, StoreError> {
        let mut tx = self.begin().await?;
        let done = sqlx::query(sql::DELETE_PLANT).bind(id.to_string()).execute(&mut *tx).await?;
        if done.rows_affected() > 0 {
            let query = sqlx::query(sql::NOTE_DELETED_PLANT).bind(id.to_string()).bind(now.as_millisecond());
            query.execute(&mut *tx).await?;
        }
        tx.commit().await?;
        Ok(done.rows_affected() > 0)
    }

    async fn deleted_plants(&self) -> Result<Vec<PlantId>, StoreError> {
        let rows = sqlx::query(sql::DELETED_PLANTS).fetch_all(&self.read).await?;
        rows.iter().map(|row| Ok(PlantId(read::uuid(row, "id")?))).collect()
    }

    async fn forget_deleted_plants(&self, before: Timestamp) -> Result<(), StoreError> {
        sqlx::query(sql::FORGET_DELETED_PLANTS).bind(before.as_millisecond()).execute(&self.write).await?;
        Ok(())
    }

    async fn create_survey(&self, plant: PlantId, name: &str, now: Timestamp) -> Result<Created<Survey>, StoreError> {
        let mut tx = self.begin().await?;
        let row = sqlx::query(sql::CREATE_SURVEY)
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
                let query = sqlx::query(sql::SURVEY_BY_NAME).bind(plant.to_string()).bind(name);
                Created::Existing(survey(&query.fetch_one(&mut *tx).await?)?)
            }
        };
        tx.commit().await?;
        Ok(created)
    }

    async fn survey(&self, plant: PlantId, id: SurveyId) -> Result<Option<Survey>, StoreError> {
        let query = sqlx::query(sql::SURVEY).bind(plant.to_string()).bind(id.to_string());
        query.fetch_optional(&self.read).await?.as_ref().map(survey).transpose()
    }

    async fn surveys(&self, plant: PlantId, prefix: &str, page: Page) -> Result<Vec<Survey>, StoreError> {
        let query = sqlx::query(sql::SURVEYS)
            .bind(plant.to_string())
            .bind(page.after.unwrap_or(0))
            .bind(i64::from(page.limit))
            .bind(prefix);
        query.fetch_all(&self.read).await?.iter().map(survey).collect()
    }

    async fn put_files(&self, survey: SurveyId, files: &[FileRecord]) -> Result<Vec<FileWritten>, StoreError> {
        let mut tx = self.begin().await?;
        let plant = usage::lock_plant_of(&mut tx, survey).await?;
        let mut written = Vec::with_capacity(files.len());
        for file in files {
            // Without a condition a file is always put.
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
        let rows = sqlx::query(sql::FILES).bind(survey.to_string()).fetch_all(&self.read).await?;
        rows.iter().map(file).collect()
    }

    async fn blobs(&self, after: Option<(PlantId, Digest)>, limit: u32) -> Result<Vec<BlobRecord>, StoreError> {
        let (plant, digest) = match after {
            Some((plant, digest)) => (plant.to_string(), digest.to_string()),
            None => (String::new(), String::new()),
        };
        let rows =
            sqlx::query(sql::BLOBS).bind(plant).bind(digest).bind(i64::from(limit)).fetch_all(&self.read).await?;
        rows.iter().map(read::blob).collect()
    }

    async fn file(&self, survey: SurveyId, path: &SurveyPath) -> Result<Option<FileRecord>, StoreError> {
        let query = sqlx::query(sql::FILE).bind(survey.to_string()).bind(path.as_str());
        query.fetch_optional(&self.read).await?.as_ref().map(file).transpose()
    }

    async fn photos(
        &self,
        survey: SurveyId,
        prefix: &str,
        after: &str,
        limit: u32,
    ) -> Result<Vec<FileRecord>, StoreError> {
        let query = sqlx::query(sql::PHOTOS)
            .bind(survey.to_string())
            .bind(after)
            .bind(i64::from(limit))
            .bind(format!("images/{prefix}"));
        query.fetch_all(&self.read).await?.iter().map(file).collect()
    }

    async fn photos_alike(&self, survey: SurveyId) -> Result<Vec<(Digest, SurveyPath)>, StoreError> {
        let query = sqlx::query(sql::PHOTOS_ALIKE).bind(survey.to_string());
        query.fetch_all(&self.read).await?.iter().map(read::digest_and_path).collect()
    }

    async fn photos_of_digest(
        &self,
        survey: SurveyId,
        sha256: Digest,
        limit: u32,
    ) -> Result<Vec<SurveyPath>, StoreError> {
        let query =
            sqlx::query(sql::PHOTOS_OF_DIGEST).bind(survey.to_string()).bind(sha256.to_string()).bind(i64::from(limit));
        query.fetch_all(&self.read).await?.iter().map(read::path).collect()
    }

    async fn enqueue_job(&self, request: &JobRequest, now: Timestamp) -> Result<Enqueued, StoreError> {
        let mut tx = self.begin_alone().await?;
        let row = sqlx::query(sql::ENQUEUE_JOB)
            .bind(Uuid::new_v4().to_string())
            .bind(request.plant.to_string())
            .bind(request.survey.to_string())
            .bind(&request.options)
            .bind(i64::from(request.max_attempts))
            .bind(now.as_millisecond())
            .bind(i64::from(request.priority))
            .fetch_optional(&mut *tx)
            .await
            .map_err(gone("survey"))?;
        let enqueued = match row {
            Some(row) => {
                tell_of_work(&mut tx).await?;
                Enqueued::New(job(&row)?)
            }
            None => {
                let query = sqlx::query(sql::UNFINISHED_JOB).bind(request.survey.to_string());
                Enqueued::Existing(job(&query.fetch_one(&mut *tx).await?)?)
            }
        };
        tx.commit().await?;
        Ok(enqueued)
    }

    async fn job(&self, plant: PlantId, id: JobId) -> Result<Option<Job>, StoreError> {
        let query = sqlx::query(sql::JOB).bind(plant.to_string()).bind(id.to_string());
        query.fetch_optional(&self.read).await?.as_ref().map(job).transpose()
    }

    async fn jobs(
        &self,
        plant: PlantId,
        survey: Option<SurveyId>,
        state: Option<JobState>,
        page: Page,
    ) -> Result<Vec<Job>, StoreError> {
        let statement = if survey.is_some() { sql::JOBS_OF_SURVEY } else { sql::JOBS_OF_PLANT };
        let mut query = sqlx::query(statement)
            .bind(plant.to_string())
            .bind(page.after.unwrap_or(i64::MAX))
            .bind(i64::from(page.limit))
            .bind(state.map(JobState::as_str));
        if let Some(survey) = survey {
            query = query.bind(survey.to_string());
        }
        query.fetch_all(&self.read).await?.iter().map(job).collect()
    }

    async fn cancel_job(&self, plant: PlantId, id: JobId, now: Timestamp) -> Result<Option<Cancelled>, StoreError> {
        let mut tx = self.begin().await?;
        let query = sqlx::query(sql::CANCEL_JOB).bind(plant.to_string()).bind(id.to_string());
        let row = query.bind(now.as_millisecond()).fetch_optional(&mut *tx).await?;
        let outcome = match row {
            Some(row) => {
                sweep(&mut tx, id).await?;
                let job = job(&row)?;
                if job.state.is_final() {
                    announce(&mut tx, id, now).await?;
                }
                Some(Cancelled::Accepted(job))
            }
            None => {
                let query = sqlx::query(sql::JOB).bind(plant.to_string()).bind(id.to_string());
                let row = query.fetch_optional(&mut *tx).await?;
                row.as_ref().map(job).transpose()?.map(Cancelled::TooLate)
            }
        };
        tx.commit().await?;
        Ok(outcome)
    }

    async fn queue(&self, now: Timestamp) -> Result<Queue, StoreError> {
        let rows = sqlx::query(sql::JOBS_BY_STATE).fetch_all(&self.read).await?;
        let mut jobs: Vec<_> = JobState::ALL.into_iter().map(|state| (state, 0)).collect();
        for row in rows {
            let (state, count): (String, i64) = (row.try_get("state")?, row.try_get("jobs")?);
            if let Some(known) = jobs.iter_mut().find(|(known, _)| known.as_str() == state) {
                known.1 = count as u64;
            }
        }
        let row = sqlx::query(sql::QUEUE).bind(now.as_millisecond()).fetch_one(&self.read).await?;
        let since_ms: Option<i64> = row.try_get("since_ms")?;
        let age = |since_ms: i64| Duration::from_millis(now.as_millisecond().saturating_sub(since_ms).max(0) as u64);
        let images = self.waiting_tasks(now).await?;
        Ok(Queue { jobs, waiting: row.try_get::<i64, _>("waiting")? as u64, oldest: since_ms.map(age), images })
    }

    fn pools(&self) -> Vec<Pool> {
        let pool = |(name, open, idle): (&'static str, u32, usize)| Pool { name, open: open.into(), idle: idle as u64 };
        self.sizes().into_iter().map(pool).collect()
    }

    async fn claim_job(&self, worker: &str, lease: Duration, now: Timestamp) -> Result<Option<Claim>, StoreError> {
        let mut tx = self.begin_alone().await?;
        let buried = sqlx::query(queues::BURY_ABANDONED_JOBS)
            .bind(now.as_millisecond())
            .bind("every worker that took this job fell silent; see the workers' logs, then start a new job")
            .fetch_all(&mut *tx)
            .await?;
        for row in &buried {
            let job = JobId(read::uuid(row, "id")?);
            sweep(&mut tx, job).await?;
            announce(&mut tx, job, now).await?;
        }
        let row = sqlx::query(queues::CLAIM_JOB)
            .bind(worker)
            .bind(now.as_millisecond())
            .bind(after(now, lease))
            .fetch_optional(&mut *tx)
            .await?;
        let claim = row.map(|row| Ok::<_, StoreError>(Claim { job: job(&row)?, fence: row.try_get("fence")? }));
        let claim = claim.transpose()?;
        tx.commit().await?;
        Ok(claim)
    }

    async fn heartbeat(
        &self,
        claim: &Claim,
        progress: Option<Progress>,
        lease: Duration,
        now: Timestamp,
    ) -> Result<Heartbeat, StoreError> {
        let cancel: Option<bool> = sqlx::query_scalar(sql::HEARTBEAT)
            .bind(claim.job.id.to_string())
            .bind(claim.fence)
            .bind(after(now, lease))
            .bind(progress.as_ref().map(|progress| progress.stage.clone()))
            .bind(progress.as_ref().map(|progress| progress.done as i64))
            .bind(progress.as_ref().map(|progress| progress.total as i64))
            .bind(progress.as_ref().and_then(|progress| Some(progress.remaining_ms? as i64)))
            .fetch_optional(&self.write)
            .await?;
        Ok(match cancel {
            None => Heartbeat::Lost,
            Some(true) => Heartbeat::Cancel,
            Some(false) => Heartbeat::Continue,
        })
    }

    async fn checkpoint(&self, claim: &Claim, fingerprint: &str, found: &[Checkpoint]) -> Result<bool, StoreError> {
        let mut tx = self.begin().await?;
        let query = sqlx::query(sql::MADE_PROGRESS).bind(claim.job.id.to_string()).bind(claim.fence);
        if query.execute(&mut *tx).await?.rows_affected() == 0 {
            return Ok(false);
        }
        for checkpoint in found {
            sqlx::query(sql::CHECKPOINT)
                .bind(claim.job.id.to_string())
                .bind(&checkpoint.name)
                .bind(fingerprint)
                .bind(&checkpoint.document)
                .execute(&mut *tx)
                .await?;
            let query = sqlx::query(sql::FORGET_TASK).bind(claim.job.id.to_string()).bind(&checkpoint.name);
            query.execute(&mut *tx).await?;
        }
        tx.commit().await?;
        Ok(true)
    }

    async fn checkpoints(&self, job: JobId, fingerprint: &str) -> Result<Vec<Checkpoint>, StoreError> {
        let query = sqlx::query(sql::CHECKPOINTS).bind(job.to_string()).bind(fingerprint);
        let rows = query.fetch_all(&self.read).await?;
        let read = |row: &Row| Ok(Checkpoint { name: row.try_get("name")?, document: row.try_get("document")? });
        rows.iter().map(read).collect()
    }

    async fn last_stage_ms(&self) -> Result<Option<String>, StoreError> {
        Ok(sqlx::query_scalar(sql::LAST_STAGE_MS).fetch_optional(&self.read).await?)
    }

    async fn complete_job(&self, claim: &Claim, new: &NewModel, now: Timestamp) -> Result<Completed, StoreError> {
        let mut tx = self.begin().await?;
        let warnings = serde_json::json!(new.warnings).to_string();
        let query = sqlx::query(sql::IS_CLAIMED).bind(claim.job.id.to_string()).bind(claim.fence);
        if query.fetch_optional(&mut *tx).await?.is_none() {
            return Ok(Completed::Fenced);
        }
        let row = sqlx::query(sql::INSERT_MODEL)
            .bind(claim.job.plant.to_string())
            .bind(i64::from(new.version))
            .bind(claim.job.survey.to_string())
            .bind(claim.job.id.to_string())
            .bind(new.sha256.to_string())
            .bind(new.size as i64)
            .bind(&warnings)
            .bind(now.as_millisecond())
            .fetch_optional(&mut *tx)
            .await?;
        let Some(row) = row else {
            return Ok(Completed::Outdated);
        };
        let stored = model(&row)?;
        for layer in &new.layers {
            let extents = || layer.features.iter().filter_map(|feature| feature.extent);
            let extent = extents().reduce(GeoBox::union);
            sqlx::query(sql::INSERT_LAYER)
                .bind(stored.seq)
                .bind(layer.layer.as_str())
                .bind(layer.features.len() as i64)
                .bind(&layer.properties)
                .bind(extent.map(|b| b.min_lon))
                .bind(extent.map(|b| b.min_lat))
                .bind(extent.map(|b| b.max_lon))
                .bind(extent.map(|b| b.max_lat))
                .bind(extents().map(GeoBox::height_deg).fold(0.0, f64::max))
                .bind(extents().map(GeoBox::width_deg).fold(0.0, f64::max))
                .execute(&mut *tx)
                .await?;
            let mut first = 1;
            for features in layer.features.chunks(FEATURES_AT_ONCE) {
                insert_features(&mut tx, stored.seq, layer.layer, first, features).await?;
                first += features.len() as i64;
            }
        }
        // Up to here the job's row was free for heartbeats.
        let done = sqlx::query(sql::COMPLETE_JOB)
            .bind(claim.job.id.to_string())
            .bind(claim.fence)
            .bind(now.as_millisecond())
            .bind(&warnings)
            .bind(i64::from(new.version))
            .bind(&new.stage_ms)
            .execute(&mut *tx)
            .await?;
        if done.rows_affected() == 0 {
            return Ok(Completed::Fenced);
        }
        // A model counts, and no quota keeps a job from its end. Those who upload to the plant wait from here on.
        usage::count_bytes(&mut tx, claim.job.plant, &[(new.sha256, new.size)], None).await?;
        sweep(&mut tx, claim.job.id).await?;
        announce(&mut tx, claim.job.id, now).await?;
        tx.commit().await?;
        Ok(Completed::Done(Box::new(stored)))
    }

    async fn end_job(&self, claim: &Claim, ending: &Ending, now: Timestamp) -> Result<bool, StoreError> {
        let now_ms = Some(now.as_millisecond());
        let mut tx = self.begin().await?;
        let used: Option<i64> = sqlx::query_scalar(sql::ATTEMPTS_USED)
            .bind(claim.job.id.to_string())
            .bind(claim.fence)
            .fetch_optional(&mut *tx)
            .await?;
        let Some(used) = used else { return Ok(false) };
        let exhausted = used >= i64::from(claim.job.max_attempts);
        let (state, code, message, run_after_ms, finished_ms, attempts_back) = match ending {
            Ending::Failed { code, message } => ("failed", Some(code), Some(message), None, now_ms, 0),
            Ending::Retry { code, message, .. } if exhausted => ("failed", Some(code), Some(message), None, now_ms, 0),
            Ending::Retry { code, message, backoff } => {
                let pause = backoff.saturating_mul(4_u32.saturating_pow(used.clamp(1, 16) as u32 - 1));
                ("queued", Some(code), Some(message), Some(after(now, pause.min(LONGEST_BACKOFF))), None, 0)
            }
            Ending::Declined { code, message, pause } => {
                ("queued", Some(code), Some(message), Some(after(now, *pause)), None, 1)
            }
            Ending::Cancelled => ("cancelled", None, None, None, now_ms, 0),
            Ending::Released => ("queued", None, None, now_ms, None, 1),
        };
        let ended = sqlx::query(sql::END_JOB)
            .bind(claim.job.id.to_string())
            .bind(claim.fence)
            .bind(state)
            .bind(code)
            .bind(message)
            .bind(run_after_ms)
            .bind(finished_ms)
            .bind(attempts_back)
            .bind(now.as_millisecond())
            .fetch_optional(&mut *tx)
            .await?;
        // It may have come into other hands since it was looked at.
        let Some(ended) = ended else { return Ok(false) };
        if matches!(ending, Ending::Released) {
            tell_of_work(&mut tx).await?;
        }
        sweep(&mut tx, claim.job.id).await?;
        if ended.try_get::<Option<i64>, _>("finished_ms")?.is_some() {
            announce(&mut tx, claim.job.id, now).await?;
        }
        tx.commit().await?;
        Ok(true)
    }

    async fn models(&self, plant: PlantId, page: Page) -> Result<Vec<Model>, StoreError> {
        let query = sqlx::query(sql::MODELS)
            .bind(plant.to_string())
            .bind(page.after.unwrap_or(i64::MAX))
            .bind(i64::from(page.limit));
        query.fetch_all(&self.read).await?.iter().map(model).collect()
    }

    async fn model(&self, plant: PlantId, version: Option<u32>) -> Result<Option<Model>, StoreError> {
        let query = match version {
            Some(version) => sqlx::query(sql::MODEL).bind(plant.to_string()).bind(i64::from(version)),
            None => sqlx::query(sql::NEWEST_MODEL).bind(plant.to_string()),
        };
        query.fetch_optional(&self.read).await?.as_ref().map(model).transpose()
    }

    async fn layer(&self, model: &Model, layer: Layer) -> Result<Option<LayerInfo>, StoreError> {
        let query = sqlx::query(sql::LAYER).bind(model.seq).bind(layer.as_str());
        let Some(row) = query.fetch_optional(&self.read).await? else { return Ok(None) };
        let min_lon: Option<f64> = row.try_get("min_lon")?;
        let extent = match min_lon {
            Some(min_lon) => Some(GeoBox {
                min_lon,
                min_lat: row.try_get("min_lat")?,
                max_lon: row.try_get("max_lon")?,
                max_lat: row.try_get("max_lat")?,
            }),
            None => None,
        };
        Ok(Some(LayerInfo {
            model_seq: model.seq,
            layer,
            features: row.try_get::<i64, _>("features")? as u64,
            properties: row.try_get("properties")?,
            extent,
            tallest_deg: row.try_get("tallest_deg")?,
            widest_deg: row.try_get("widest_deg")?,
        }))
    }

    async fn features(&self, layer: &LayerInfo, page: FeatureQuery) -> Result<Vec<Feature>, StoreError> {
        let share = |covered: f64, whole: f64| if whole > 0.0 { (covered / whole).clamp(0.0, 1.0) } else { 1.0 };
        let is_small = |within: GeoBox, extent: GeoBox| {
            share(within.width_deg(), extent.width_deg()) * share(within.height_deg(), extent.height_deg())
                < SMALL_BOX_SHARE
        };
        let statement = match (page.within, layer.extent) {
            (None, _) => sql::FEATURES,
            (Some(within), Some(extent)) if is_small(within, extent) => sql::FEATURES_IN_SMALL_BOX,
            (Some(_), _) => sql::FEATURES_IN_LARGE_BOX,
        };
        let mut query = sqlx::query(statement)
            .bind(layer.model_seq)
            .bind(layer.layer.as_str())
            .bind(page.after.unwrap_or(0))
            .bind(i64::from(page.limit));
        if let Some(within) = page.within {
            query = query.bind(within.min_lon).bind(within.min_lat).bind(within.max_lon).bind(within.max_lat);
            if let Some(extent) = layer.extent.filter(|extent| is_small(within, *extent)) {
                query = query
                    .bind(within.min_lat - layer.tallest_deg)
                    .bind(strip((within.min_lon - layer.widest_deg).max(extent.min_lon)))
                    .bind(strip(within.max_lon.min(extent.max_lon)));
            }
        }
        let rows = query.fetch_all(&self.read).await?;
        rows.iter().map(|row| Ok(Feature { seq: row.try_get("seq")?, json: row.try_get("feature")? })).collect()
    }

    async fn module(&self, model: &Model, id: ModuleId) -> Result<Option<String>, StoreError> {
        let query = sqlx::query_scalar(sql::MODULE).bind(id.to_string()).bind(model.seq);
        Ok(query.fetch_optional(&self.read).await?)
    }

    async fn module_last_seen(&self, plant: PlantId, id: ModuleId) -> Result<Option<u32>, StoreError> {
        let query = sqlx::query_scalar(sql::MODULE_LAST_SEEN).bind(id.to_string()).bind(plant.to_string());
        let version: Option<i64> = query.fetch_optional(&self.read).await?;
        version.map(|version| read::small("version", version)).transpose()
    }
}

/// What a job had found is in its model, or of no use, once it has ended; its images need no search.
async fn sweep(tx: &mut Tx, job: JobId) -> Result<(), StoreError> {
    for statement in [sql::SWEEP_CHECKPOINTS, sql::SWEEP_TASKS] {
        sqlx::query(statement).bind(job.to_string()).execute(&mut **tx).await?;
    }
    Ok(())
}

/// Puts a file where what is at its path is as wanted. Whoever calls has the plant's row: what is looked at stays so.
async fn put_file(
    tx: &mut Tx,
    plant: PlantId,
    survey: SurveyId,
    file: &FileRecord,
    wanted: Option<&Wanted>,
) -> Result<Option<FileWritten>, StoreError> {
    let before: Option<String> = sqlx::query_scalar(sql::FILE_DIGEST)
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
        sqlx::query(sql::COMPLETE_FILE)
            .bind(survey.to_string())
            .bind(file.path.as_str())
            .bind(photo)
            .bind(shots)
            .execute(&mut **tx)
            .await?;
        return Ok(Some(verdict));
    }
    usage::name_blob(tx, plant, file.sha256).await?;
    sqlx::query(sql::PUT_FILE)
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
        usage::unname_blob(tx, plant, &before, file.stored).await?;
    }
    Ok(Some(verdict))
}

/// Inserts features that follow each other in a layer, the first with the sequence number `first`, by one statement.
async fn insert_features(
    tx: &mut Tx,
    model_seq: i64,
    layer: Layer,
    first: i64,
    features: &[NewFeature],
) -> Result<(), StoreError> {
    let mut insert = QueryBuilder::<Db>::new(sql::INSERT_FEATURES);
    insert.push_values((first..).zip(features), |mut row, (seq, feature)| {
        row.push_bind(model_seq)
            .push_bind(layer.as_str())
            .push_bind(seq)
            .push_bind(&feature.id)
            .push_bind(&feature.label)
            .push_bind(&feature.json)
            .push_bind(feature.extent.map(|b| b.min_lon))
            .push_bind(feature.extent.map(|b| b.min_lat))
            .push_bind(feature.extent.map(|b| b.max_lon))
            .push_bind(feature.extent.map(|b| b.max_lat))
            .push_bind(feature.extent.map(|b| strip(b.min_lon)));
    });
    // The last rows of each layer are another number each time: no statement is kept for them.
    insert.build().persistent(features.len() == FEATURES_AT_ONCE).execute(&mut **tx).await?;
    Ok(())
}

/// The strip from pole to pole in which a longitude lies, by which features are found; migrations compute the same.
fn strip(lon: f64) -> i64 {
    /// Some 30 to 55 m where people live.
    const WIDTH_DEG: f64 = 0.0005;
    ((lon + 180.0) / WIDTH_DEG).floor() as i64
}

/// Milliseconds at the end of a lease that begins now.
fn after(now: Timestamp, lease: Duration) -> i64 {
    now.as_millisecond().saturating_add(i64::try_from(lease.as_millis()).unwrap_or(i64::MAX))
}

/// A row whose owner was deleted meanwhile cannot be written.
fn gone(what: &'static str) -> impl FnOnce(sqlx::Error) -> StoreError {
    move |error| match &error {
        sqlx::Error::Database(database) if database.is_foreign_key_violation() => StoreError::Gone { what },
        _ => StoreError::Database(error),
    }
}
