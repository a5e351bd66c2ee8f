//! The rows in an SQLite file: one connection that writes, several that read beside it (write-ahead log).

use super::blobs::io;
use super::sql;
use super::{
    Cancelled, Claim, Completed, Created, Ending, Enqueued, Feature, FeatureQuery, FileRecord, FileWritten, GeoBox,
    Heartbeat, Job, JobId, JobRequest, LayerInfo, Model, NewFeature, NewModel, Page, Plant, Progress, Store,
    StoreError, Survey, SurveyId, SurveyPath,
};
use crate::plant::{Layer, ModuleId, PlantId, Warning};
use async_trait::async_trait;
use jiff::Timestamp;
use sqlx::sqlite::{
    SqliteConnectOptions, SqliteJournalMode, SqlitePool, SqlitePoolOptions, SqliteRow, SqliteSynchronous,
};
use sqlx::{Row, Sqlite, Transaction};
use std::path::Path;
use std::str::FromStr;
use std::time::Duration;
use uuid::Uuid;

/// How long a statement waits for another process's transaction.
const BUSY_TIMEOUT: Duration = Duration::from_secs(20);

/// A box that covers less of its layer than this is looked up by place.
const SMALL_BOX_SHARE: f64 = 0.05;

/// The rows in an SQLite file.
#[derive(Debug, Clone)]
pub struct SqliteStore {
    read: SqlitePool,
    /// One connection: writers of this process wait in line instead of for a lock.
    write: SqlitePool,
}

impl SqliteStore {
    /// Opens or creates the file and brings its schema up to date.
    pub async fn open(file: &Path) -> Result<Self, StoreError> {
        let options = SqliteConnectOptions::new()
            .filename(file)
            .create_if_missing(true)
            .journal_mode(SqliteJournalMode::Wal)
            // What was acknowledged survives a power cut.
            .synchronous(SqliteSynchronous::Full)
            .busy_timeout(BUSY_TIMEOUT)
            .foreign_keys(true);
        let write = SqlitePoolOptions::new().max_connections(1).connect_with(options.clone()).await?;
        migrate(&write, file).await?;
        let read = SqlitePoolOptions::new().max_connections(8).connect_with(options).await?;
        Ok(Self { read, write })
    }

    /// A transaction that holds the write lock from its start, so that it cannot fail half-way for want of it.
    async fn begin(&self) -> Result<Transaction<'static, Sqlite>, StoreError> {
        Ok(self.write.begin_with("BEGIN IMMEDIATE").await?)
    }
}

/// Brings the schema up to date, one process at a time: a server and its workers may start together.
async fn migrate(pool: &SqlitePool, file: &Path) -> Result<(), StoreError> {
    let path = file.with_extension("lock");
    let lock = path.clone();
    let locked = tokio::task::spawn_blocking(move || {
        let lock = std::fs::File::create(lock)?;
        lock.lock()?;
        Ok(lock)
    });
    let _lock = locked.await.unwrap_or_else(|error| Err(std::io::Error::other(error))).map_err(io("lock", &path))?;
    sqlx::migrate!("migrations/sqlite").run(pool).await?;
    Ok(())
}

#[async_trait]
impl Store for SqliteStore {
    async fn ping(&self) -> Result<(), StoreError> {
        sqlx::query(sql::PING).execute(&self.read).await?;
        Ok(())
    }

    async fn create_plant(&self, name: &str, now: Timestamp) -> Result<Created<Plant>, StoreError> {
        let mut tx = self.begin().await?;
        let row = sqlx::query(sql::CREATE_PLANT)
            .bind(Uuid::new_v4().to_string())
            .bind(name)
            .bind(now.as_millisecond())
            .fetch_optional(&mut *tx)
            .await?;
        let created = match row {
            Some(row) => Created::New(plant(&row)?),
            None => Created::Existing(plant(&sqlx::query(sql::PLANT_BY_NAME).bind(name).fetch_one(&mut *tx).await?)?),
        };
        tx.commit().await?;
        Ok(created)
    }

    async fn plant(&self, id: PlantId) -> Result<Option<Plant>, StoreError> {
        let row = sqlx::query(sql::PLANT).bind(id.to_string()).fetch_optional(&self.read).await?;
        row.as_ref().map(plant).transpose()
    }

    async fn plants(&self, page: Page) -> Result<Vec<Plant>, StoreError> {
        let rows =
            sqlx::query(sql::PLANTS).bind(page.after.unwrap_or(0)).bind(page.limit).fetch_all(&self.read).await?;
        rows.iter().map(plant).collect()
    }

    async fn delete_plant(&self, id: PlantId) -> Result<bool, StoreError> {
        let done = sqlx::query(sql::DELETE_PLANT).bind(id.to_string()).execute(&self.write).await?;
        Ok(done.rows_affected() > 0)
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

    async fn surveys(&self, plant: PlantId, page: Page) -> Result<Vec<Survey>, StoreError> {
        let query = sqlx::query(sql::SURVEYS).bind(plant.to_string()).bind(page.after.unwrap_or(0)).bind(page.limit);
        query.fetch_all(&self.read).await?.iter().map(survey).collect()
    }

    async fn put_files(&self, survey: SurveyId, files: &[FileRecord]) -> Result<Vec<FileWritten>, StoreError> {
        let mut tx = self.begin().await?;
        let mut written = Vec::with_capacity(files.len());
        for file in files {
            let before: Option<String> = sqlx::query_scalar(sql::FILE_DIGEST)
                .bind(survey.to_string())
                .bind(file.path.as_str())
                .fetch_optional(&mut *tx)
                .await?;
            let digest = file.sha256.to_string();
            let verdict = match before {
                Some(before) if before == digest => FileWritten::Unchanged,
                Some(_) => FileWritten::Replaced,
                None => FileWritten::Created,
            };
            if verdict != FileWritten::Unchanged {
                sqlx::query(sql::PUT_FILE)
                    .bind(survey.to_string())
                    .bind(file.path.as_str())
                    .bind(file.path.kind().as_str())
                    .bind(file.size as i64)
                    .bind(digest)
                    .bind(file.size_px.map(|size| i64::from(size[0])))
                    .bind(file.size_px.map(|size| i64::from(size[1])))
                    .bind(file.stored.as_millisecond())
                    .execute(&mut *tx)
                    .await
                    .map_err(gone("survey"))?;
            }
            written.push(verdict);
        }
        tx.commit().await?;
        Ok(written)
    }

    async fn files(&self, survey: SurveyId) -> Result<Vec<FileRecord>, StoreError> {
        let rows = sqlx::query(sql::FILES).bind(survey.to_string()).fetch_all(&self.read).await?;
        rows.iter().map(file).collect()
    }

    async fn enqueue_job(&self, request: &JobRequest, now: Timestamp) -> Result<Enqueued, StoreError> {
        let mut tx = self.begin().await?;
        let row = sqlx::query(sql::ENQUEUE_JOB)
            .bind(Uuid::new_v4().to_string())
            .bind(request.plant.to_string())
            .bind(request.survey.to_string())
            .bind(&request.options)
            .bind(request.max_attempts)
            .bind(now.as_millisecond())
            .fetch_optional(&mut *tx)
            .await
            .map_err(gone("survey"))?;
        let enqueued = match row {
            Some(row) => Enqueued::New(job(&row)?),
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

    async fn jobs(&self, plant: PlantId, survey: Option<SurveyId>, page: Page) -> Result<Vec<Job>, StoreError> {
        let statement = if survey.is_some() { sql::JOBS_OF_SURVEY } else { sql::JOBS_OF_PLANT };
        let mut query =
            sqlx::query(statement).bind(plant.to_string()).bind(page.after.unwrap_or(i64::MAX)).bind(page.limit);
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
            Some(row) => Some(Cancelled::Accepted(job(&row)?)),
            None => {
                let query = sqlx::query(sql::JOB).bind(plant.to_string()).bind(id.to_string());
                let row = query.fetch_optional(&mut *tx).await?;
                row.as_ref().map(job).transpose()?.map(Cancelled::TooLate)
            }
        };
        tx.commit().await?;
        Ok(outcome)
    }

    async fn claim_job(&self, worker: &str, lease: Duration, now: Timestamp) -> Result<Option<Claim>, StoreError> {
        let mut tx = self.begin().await?;
        sqlx::query(sql::BURY_ABANDONED_JOBS)
            .bind(now.as_millisecond())
            .bind("every worker that took this job fell silent; see the workers' logs, then start a new job")
            .execute(&mut *tx)
            .await?;
        let row = sqlx::query(sql::CLAIM_JOB)
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
            .fetch_optional(&self.write)
            .await?;
        Ok(match cancel {
            None => Heartbeat::Lost,
            Some(true) => Heartbeat::Cancel,
            Some(false) => Heartbeat::Continue,
        })
    }

    async fn complete_job(&self, claim: &Claim, new: &NewModel, now: Timestamp) -> Result<Completed, StoreError> {
        let mut tx = self.begin().await?;
        let warnings = serde_json::json!(new.warnings).to_string();
        let done = sqlx::query(sql::COMPLETE_JOB)
            .bind(claim.job.id.to_string())
            .bind(claim.fence)
            .bind(now.as_millisecond())
            .bind(&warnings)
            .bind(new.version)
            .execute(&mut *tx)
            .await?;
        if done.rows_affected() == 0 {
            return Ok(Completed::Fenced);
        }
        let row = sqlx::query(sql::INSERT_MODEL)
            .bind(claim.job.plant.to_string())
            .bind(new.version)
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
                .execute(&mut *tx)
                .await?;
            for (index, feature) in layer.features.iter().enumerate() {
                insert_feature(&mut tx, stored.seq, layer.layer, index as i64 + 1, feature).await?;
            }
        }
        tx.commit().await?;
        Ok(Completed::Done(Box::new(stored)))
    }

    async fn end_job(&self, claim: &Claim, ending: &Ending, now: Timestamp) -> Result<bool, StoreError> {
        let now_ms = Some(now.as_millisecond());
        let exhausted = claim.job.attempt >= claim.job.max_attempts;
        let (state, code, message, run_after_ms, finished_ms, attempts_back) = match ending {
            Ending::Failed { code, message } => ("failed", Some(code), Some(message), None, now_ms, 0),
            Ending::Retry { code, message, .. } if exhausted => ("failed", Some(code), Some(message), None, now_ms, 0),
            Ending::Retry { code, message, at } => {
                ("queued", Some(code), Some(message), Some(at.as_millisecond()), None, 0)
            }
            Ending::Cancelled => ("cancelled", None, None, None, now_ms, 0),
            Ending::Released => ("queued", None, None, now_ms, None, 1),
        };
        let done = sqlx::query(sql::END_JOB)
            .bind(claim.job.id.to_string())
            .bind(claim.fence)
            .bind(state)
            .bind(code)
            .bind(message)
            .bind(run_after_ms)
            .bind(finished_ms)
            .bind(attempts_back)
            .execute(&self.write)
            .await?;
        Ok(done.rows_affected() > 0)
    }

    async fn models(&self, plant: PlantId, page: Page) -> Result<Vec<Model>, StoreError> {
        let query =
            sqlx::query(sql::MODELS).bind(plant.to_string()).bind(page.after.unwrap_or(i64::MAX)).bind(page.limit);
        query.fetch_all(&self.read).await?.iter().map(model).collect()
    }

    async fn model(&self, plant: PlantId, version: Option<u32>) -> Result<Option<Model>, StoreError> {
        let query = match version {
            Some(version) => sqlx::query(sql::MODEL).bind(plant.to_string()).bind(version),
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
        }))
    }

    async fn features(&self, layer: &LayerInfo, page: FeatureQuery) -> Result<Vec<Feature>, StoreError> {
        let small = |within: GeoBox| {
            let share = |covered: f64, whole: f64| if whole > 0.0 { (covered / whole).clamp(0.0, 1.0) } else { 1.0 };
            layer.extent.is_none_or(|extent| {
                share(within.max_lon - within.min_lon, extent.max_lon - extent.min_lon)
                    * share(within.height_deg(), extent.height_deg())
                    < SMALL_BOX_SHARE
            })
        };
        let statement = match page.within {
            None => sql::FEATURES,
            Some(within) if small(within) => sql::FEATURES_IN_SMALL_BOX,
            Some(_) => sql::FEATURES_IN_LARGE_BOX,
        };
        let mut query = sqlx::query(statement)
            .bind(layer.model_seq)
            .bind(layer.layer.as_str())
            .bind(page.after.unwrap_or(0))
            .bind(page.limit);
        if let Some(within) = page.within {
            query = query.bind(within.min_lon).bind(within.min_lat).bind(within.max_lon).bind(within.max_lat);
            if small(within) {
                query = query.bind(within.min_lat - layer.tallest_deg);
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
        Ok(query.fetch_optional(&self.read).await?)
    }
}

async fn insert_feature(
    tx: &mut Transaction<'static, Sqlite>,
    model_seq: i64,
    layer: Layer,
    seq: i64,
    feature: &NewFeature,
) -> Result<(), StoreError> {
    sqlx::query(sql::INSERT_FEATURE)
        .bind(model_seq)
        .bind(layer.as_str())
        .bind(seq)
        .bind(&feature.id)
        .bind(&feature.label)
        .bind(&feature.json)
        .bind(feature.extent.map(|b| b.min_lon))
        .bind(feature.extent.map(|b| b.min_lat))
        .bind(feature.extent.map(|b| b.max_lon))
        .bind(feature.extent.map(|b| b.max_lat))
        .execute(&mut **tx)
        .await?;
    Ok(())
}

fn plant(row: &SqliteRow) -> Result<Plant, StoreError> {
    Ok(Plant {
        seq: row.try_get("seq")?,
        id: PlantId(uuid(row, "id")?),
        name: row.try_get("name")?,
        created: time(row, "created_ms")?,
    })
}

fn survey(row: &SqliteRow) -> Result<Survey, StoreError> {
    Ok(Survey {
        seq: row.try_get("seq")?,
        id: SurveyId(uuid(row, "id")?),
        plant: PlantId(uuid(row, "plant_id")?),
        name: row.try_get("name")?,
        created: time(row, "created_ms")?,
    })
}

fn file(row: &SqliteRow) -> Result<FileRecord, StoreError> {
    let path: String = row.try_get("path")?;
    let width_px: Option<u32> = row.try_get("width_px")?;
    let height_px: Option<u32> = row.try_get("height_px")?;
    Ok(FileRecord {
        path: SurveyPath::parse(&path).map_err(|_| StoreError::Corrupt { what: "path of a file", value: path })?,
        size: row.try_get::<i64, _>("size")? as u64,
        sha256: parsed(row, "sha256")?,
        size_px: width_px.zip(height_px).map(|(width, height)| [width, height]),
        stored: time(row, "stored_ms")?,
    })
}

fn job(row: &SqliteRow) -> Result<Job, StoreError> {
    let stage: Option<String> = row.try_get("stage")?;
    let error_code: Option<String> = row.try_get("error_code")?;
    let error_message: Option<String> = row.try_get("error_message")?;
    let progress = match stage {
        Some(stage) => Some(Progress {
            stage,
            done: row.try_get::<i64, _>("done")? as u64,
            total: row.try_get::<i64, _>("total")? as u64,
        }),
        None => None,
    };
    Ok(Job {
        seq: row.try_get("seq")?,
        id: JobId(uuid(row, "id")?),
        plant: PlantId(uuid(row, "plant_id")?),
        survey: SurveyId(uuid(row, "survey_id")?),
        state: parsed(row, "state")?,
        options: row.try_get("options")?,
        progress,
        warnings: warnings(row)?,
        error: error_code.zip(error_message),
        attempt: row.try_get("attempt")?,
        max_attempts: row.try_get("max_attempts")?,
        cancel_requested: row.try_get("cancel_requested")?,
        model_version: row.try_get("model_version")?,
        created: time(row, "created_ms")?,
        started: optional_time(row, "started_ms")?,
        finished: optional_time(row, "finished_ms")?,
    })
}

fn model(row: &SqliteRow) -> Result<Model, StoreError> {
    Ok(Model {
        seq: row.try_get("seq")?,
        plant: PlantId(uuid(row, "plant_id")?),
        version: row.try_get("version")?,
        survey: SurveyId(uuid(row, "survey_id")?),
        job: JobId(uuid(row, "job_id")?),
        sha256: parsed(row, "sha256")?,
        size: row.try_get::<i64, _>("size")? as u64,
        warnings: warnings(row)?,
        created: time(row, "created_ms")?,
    })
}

fn parsed<T: FromStr>(row: &SqliteRow, column: &'static str) -> Result<T, StoreError> {
    let value: String = row.try_get(column)?;
    value.parse().map_err(|_| StoreError::Corrupt { what: column, value })
}

fn uuid(row: &SqliteRow, column: &'static str) -> Result<Uuid, StoreError> {
    parsed(row, column)
}

fn warnings(row: &SqliteRow) -> Result<Vec<Warning>, StoreError> {
    let value: String = row.try_get("warnings")?;
    serde_json::from_str(&value).map_err(|_| StoreError::Corrupt { what: "warnings", value })
}

fn time(row: &SqliteRow, column: &'static str) -> Result<Timestamp, StoreError> {
    let value: i64 = row.try_get(column)?;
    Timestamp::from_millisecond(value).map_err(|_| StoreError::Corrupt { what: column, value: value.to_string() })
}

fn optional_time(row: &SqliteRow, column: &'static str) -> Result<Option<Timestamp>, StoreError> {
    let value: Option<i64> = row.try_get(column)?;
    value.map(|_| time(row, column)).transpose()
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
