//! The queue of jobs.

use super::super::{Row, Rows, Tx, notify_workers};
use super::announcement::announce;
use super::columns::{document, optional_small, optional_time, parsed, small, time, uuid};
use super::models::{is_claimed, publish_model};
use super::{after, gone, usage};
use crate::store::error::StoreError;
use crate::store::ids::{JobId, SurveyId};
use crate::store::jobs::{
    Cancelled, Checkpoint, Claim, Completed, Ending, Enqueued, Heartbeat, Job, JobRequest, JobState, JobStore,
    MAX_BACKOFF, Progress, Queue,
};
use crate::store::listing::Page;
use crate::store::models::NewModel;
use crate::store::tasks::TaskStore;
use async_trait::async_trait;
use heliomap_model::PlantId;
use jiff::Timestamp;
use sqlx::Row as _;
use std::time::Duration;

macro_rules! job_columns {
    () => {
        "seq, id, plant_id, survey_id, state, options_json, priority, stage, done, total, remaining_ms, warnings, error_code, \
         error_message, attempt, max_attempts, fence, cancel_requested, model_version, created_ms, started_ms, finished_ms"
    };
}

pub const CHECKPOINT: &str = "\
    INSERT INTO checkpoints (job_id, name, fingerprint, document) VALUES ($1, $2, $3, $4) \
    ON CONFLICT (job_id, name) DO UPDATE SET fingerprint = excluded.fingerprint, document = excluded.document";

const JOB: &str = concat!("SELECT ", job_columns!(), " FROM jobs WHERE plant_id = $1 AND id = $2");

#[async_trait]
impl JobStore for Rows {
    async fn enqueue_job(&self, request: &JobRequest, now: Timestamp) -> Result<Enqueued, StoreError> {
        const ENQUEUE_JOB: &str = concat!(
            "INSERT INTO jobs (id, plant_id, survey_id, state, options_json, max_attempts, run_after_ms, created_ms, priority) \
             VALUES ($1, $2, $3, 'queued', $4, $5, $6, $6, $7) \
             ON CONFLICT (survey_id) WHERE state IN ('queued', 'running') DO NOTHING RETURNING ",
            job_columns!()
        );
        const UNFINISHED_JOB: &str =
            concat!("SELECT ", job_columns!(), " FROM jobs WHERE survey_id = $1 AND state IN ('queued', 'running')");
        let mut tx = self.begin_alone().await?;
        let again = sqlx::query(JOB).bind(request.plant.to_string()).bind(request.id.to_string());
        if let Some(row) = again.fetch_optional(&mut *tx).await? {
            tx.commit().await?;
            return Ok(Enqueued::Existing(job(&row)?));
        }
        let row = sqlx::query(ENQUEUE_JOB)
            .bind(request.id.to_string())
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
                notify_workers(&mut tx).await?;
                Enqueued::New(job(&row)?)
            }
            None => {
                let query = sqlx::query(UNFINISHED_JOB).bind(request.survey.to_string());
                Enqueued::Existing(job(&query.fetch_one(&mut *tx).await?)?)
            }
        };
        tx.commit().await?;
        Ok(enqueued)
    }

    async fn job(&self, plant: PlantId, id: JobId) -> Result<Option<Job>, StoreError> {
        let query = sqlx::query(JOB).bind(plant.to_string()).bind(id.to_string());
        query.fetch_optional(&self.read).await?.as_ref().map(job).transpose()
    }

    async fn jobs(
        &self,
        plant: PlantId,
        survey: Option<SurveyId>,
        state: Option<JobState>,
        page: Page,
    ) -> Result<Vec<Job>, StoreError> {
        const JOBS_OF_SURVEY: &str = concat!(
            "SELECT ",
            job_columns!(),
            " FROM jobs WHERE plant_id = $1 AND survey_id = $5 AND seq < $2 AND state = COALESCE($4, state) \
             ORDER BY seq DESC LIMIT $3"
        );
        const JOBS_OF_PLANT: &str = concat!(
            "SELECT ",
            job_columns!(),
            " FROM jobs WHERE plant_id = $1 AND seq < $2 AND state = COALESCE($4, state) ORDER BY seq DESC LIMIT $3"
        );
        let statement = if survey.is_some() { JOBS_OF_SURVEY } else { JOBS_OF_PLANT };
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
        const CANCEL_JOB: &str = concat!(
            "UPDATE jobs SET cancel_requested = TRUE, \
             finished_ms = CASE WHEN state = 'queued' THEN $3 ELSE finished_ms END, \
             state = CASE WHEN state = 'queued' THEN 'cancelled' ELSE state END \
             WHERE plant_id = $1 AND id = $2 AND state IN ('queued', 'running') RETURNING ",
            job_columns!()
        );
        let mut tx = self.begin().await?;
        let query = sqlx::query(CANCEL_JOB).bind(plant.to_string()).bind(id.to_string());
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
                let query = sqlx::query(JOB).bind(plant.to_string()).bind(id.to_string());
                let row = query.fetch_optional(&mut *tx).await?;
                row.as_ref().map(job).transpose()?.map(Cancelled::TooLate)
            }
        };
        tx.commit().await?;
        Ok(outcome)
    }

    async fn queue(&self, now: Timestamp) -> Result<Queue, StoreError> {
        const JOBS_BY_STATE: &str = "SELECT state, COUNT(*) AS jobs FROM jobs GROUP BY state";
        /// How many plants have a job that [`Rows::claim_job`] would take, and since when the oldest of these waits.
        const QUEUE: &str = "\
            SELECT COUNT(DISTINCT plant_id) AS waiting, MIN(run_after_ms) AS since_ms FROM jobs AS candidate \
            WHERE ((state = 'queued' AND run_after_ms <= $1) OR (state = 'running' AND claim_expires_ms < $1)) \
            AND NOT EXISTS (SELECT 1 FROM jobs AS other WHERE other.plant_id = candidate.plant_id \
            AND other.seq <> candidate.seq AND other.state = 'running' AND other.claim_expires_ms >= $1)";
        let rows = sqlx::query(JOBS_BY_STATE).fetch_all(&self.read).await?;
        let mut jobs: Vec<_> = JobState::ALL.into_iter().map(|state| (state, 0)).collect();
        for row in rows {
            let (state, count): (String, i64) = (row.try_get("state")?, row.try_get("jobs")?);
            if let Some(known) = jobs.iter_mut().find(|(known, _)| known.as_str() == state) {
                known.1 = count as u64;
            }
        }
        let row = sqlx::query(QUEUE).bind(now.as_millisecond()).fetch_one(&self.read).await?;
        let since_ms: Option<i64> = row.try_get("since_ms")?;
        let age = |since_ms: i64| Duration::from_millis(now.as_millisecond().saturating_sub(since_ms).max(0) as u64);
        let images = self.waiting_tasks(now).await?;
        Ok(Queue { jobs, waiting: row.try_get::<i64, _>("waiting")? as u64, oldest: since_ms.map(age), images })
    }

    async fn claim_job(&self, worker: &str, lease: Duration, now: Timestamp) -> Result<Option<Claim>, StoreError> {
        /// Ends jobs whose worker stopped reporting and that were cancelled or had their last attempt. The condition stands twice,
        /// here and below: another transaction may have changed the row after it was chosen.
        const FAIL_ABANDONED_JOBS: &str = concat!(
            "UPDATE jobs SET finished_ms = $1, claim_expires_ms = NULL, \
             error_code = CASE WHEN cancel_requested THEN error_code ELSE 'worker_lost' END, \
             error_message = CASE WHEN cancel_requested THEN error_message ELSE $2 END, \
             state = CASE WHEN cancel_requested THEN 'cancelled' ELSE 'failed' END \
             WHERE state = 'running' AND claim_expires_ms < $1 \
             AND (cancel_requested OR attempt - attempts_before >= max_attempts) \
             AND seq IN (SELECT candidate.seq FROM jobs AS candidate \
             WHERE candidate.state = 'running' AND candidate.claim_expires_ms < $1",
            skip_locked!(),
            ") RETURNING id"
        );
        const CLAIM_JOB: &str = concat!(
            "UPDATE jobs SET state = 'running', worker = $1, attempt = attempt + 1, fence = fence + 1, \
             claim_expires_ms = $3, started_ms = COALESCE(started_ms, $2), stage = NULL, done = 0, total = 0, \
             remaining_ms = NULL \
             WHERE ((state = 'queued' AND run_after_ms <= $2) OR (state = 'running' AND claim_expires_ms < $2)) \
             AND seq = (SELECT candidate.seq FROM jobs AS candidate \
             WHERE ((candidate.state = 'queued' AND candidate.run_after_ms <= $2) \
             OR (candidate.state = 'running' AND candidate.claim_expires_ms < $2)) \
             AND NOT EXISTS (SELECT 1 FROM jobs AS other WHERE other.plant_id = candidate.plant_id \
             AND other.seq <> candidate.seq AND other.state = 'running' AND other.claim_expires_ms >= $2) \
             ORDER BY candidate.priority DESC, candidate.seq LIMIT 1",
            skip_locked!(),
            ") RETURNING ",
            job_columns!()
        );
        let mut tx = self.begin_alone().await?;
        let abandoned = sqlx::query(FAIL_ABANDONED_JOBS)
            .bind(now.as_millisecond())
            .bind("every worker that ran this job stopped reporting; see the workers' logs, then start a new job")
            .fetch_all(&mut *tx)
            .await?;
        for row in &abandoned {
            let job = JobId(uuid(row, "id")?);
            sweep(&mut tx, job).await?;
            announce(&mut tx, job, now).await?;
        }
        let row = sqlx::query(CLAIM_JOB)
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
        const HEARTBEAT: &str = "\
            UPDATE jobs SET claim_expires_ms = $3, stage = COALESCE($4, stage), done = COALESCE($5, done), \
            total = COALESCE($6, total), remaining_ms = CASE WHEN $4 IS NULL THEN remaining_ms ELSE $7 END \
            WHERE id = $1 AND fence = $2 AND state = 'running' RETURNING cancel_requested";
        let mut tx = self.begin().await?;
        let cancel: Option<bool> = sqlx::query_scalar(HEARTBEAT)
            .bind(claim.job.id.to_string())
            .bind(claim.fence)
            .bind(after(now, lease))
            .bind(progress.as_ref().map(|progress| progress.stage.clone()))
            .bind(progress.as_ref().map(|progress| progress.done as i64))
            .bind(progress.as_ref().map(|progress| progress.total as i64))
            .bind(progress.as_ref().and_then(|progress| Some(progress.remaining_ms? as i64)))
            .fetch_optional(&mut *tx)
            .await?;
        tx.commit().await?;
        Ok(match cancel {
            None => Heartbeat::Lost,
            Some(true) => Heartbeat::Cancel,
            Some(false) => Heartbeat::Continue,
        })
    }

    async fn checkpoint(&self, claim: &Claim, fingerprint: &str, found: &[Checkpoint]) -> Result<bool, StoreError> {
        const MADE_PROGRESS: &str =
            "UPDATE jobs SET attempts_before = attempt - 1 WHERE id = $1 AND fence = $2 AND state = 'running'";
        const FORGET_TASK: &str = "DELETE FROM image_tasks WHERE job_id = $1 AND image = $2";
        let mut tx = self.begin().await?;
        let query = sqlx::query(MADE_PROGRESS).bind(claim.job.id.to_string()).bind(claim.fence);
        if query.execute(&mut *tx).await?.rows_affected() == 0 {
            tx.rollback().await?;
            return Ok(false);
        }
        for checkpoint in found {
            sqlx::query(CHECKPOINT)
                .bind(claim.job.id.to_string())
                .bind(&checkpoint.name)
                .bind(fingerprint)
                .bind(&checkpoint.document)
                .execute(&mut *tx)
                .await?;
            let query = sqlx::query(FORGET_TASK).bind(claim.job.id.to_string()).bind(&checkpoint.name);
            query.execute(&mut *tx).await?;
        }
        tx.commit().await?;
        Ok(true)
    }

    async fn checkpoints(&self, job: JobId, fingerprint: &str) -> Result<Vec<Checkpoint>, StoreError> {
        const CHECKPOINTS: &str =
            "SELECT name, document FROM checkpoints WHERE job_id = $1 AND fingerprint = $2 ORDER BY name";
        let query = sqlx::query(CHECKPOINTS).bind(job.to_string()).bind(fingerprint);
        let rows = query.fetch_all(&self.read).await?;
        let read = |row: &Row| Ok(Checkpoint { name: row.try_get("name")?, document: row.try_get("document")? });
        rows.iter().map(read).collect()
    }

    async fn last_stage_ms(&self) -> Result<Option<String>, StoreError> {
        const LAST_STAGE_MS: &str = "SELECT stage_ms FROM jobs WHERE stage_ms IS NOT NULL ORDER BY seq DESC LIMIT 1";
        Ok(sqlx::query_scalar(LAST_STAGE_MS).fetch_optional(&self.read).await?)
    }

    async fn complete_job(&self, claim: &Claim, new: &NewModel, now: Timestamp) -> Result<Completed, StoreError> {
        const COMPLETE_JOB: &str = "\
            UPDATE jobs SET state = 'succeeded', finished_ms = $3, claim_expires_ms = NULL, warnings = $4, \
            model_version = $5, error_code = NULL, error_message = NULL, remaining_ms = NULL, stage_ms = $6 \
            WHERE id = $1 AND fence = $2 AND state = 'running'";
        let Some(staged) = self.stage_model(claim, new, now).await? else { return Ok(Completed::Fenced) };
        let mut tx = self.begin().await?;
        if !is_claimed(&mut tx, claim).await? {
            tx.rollback().await?;
            return Ok(Completed::Fenced);
        }
        let Some(stored) = publish_model(&mut tx, staged, new).await? else {
            tx.rollback().await?;
            return Ok(Completed::Outdated);
        };
        // Up to here the job's row was free for heartbeats.
        let done = sqlx::query(COMPLETE_JOB)
            .bind(claim.job.id.to_string())
            .bind(claim.fence)
            .bind(now.as_millisecond())
            .bind(serde_json::json!(new.warnings).to_string())
            .bind(i64::from(new.version))
            .bind(&new.stage_ms)
            .execute(&mut *tx)
            .await?;
        if done.rows_affected() == 0 {
            tx.rollback().await?;
            return Ok(Completed::Fenced);
        }
        // The model is counted even beyond the quota: no job fails for it. Uploads to the plant wait from here on.
        usage::count_bytes(&mut tx, claim.job.plant, &[(new.sha256, new.size)], None).await?;
        sweep(&mut tx, claim.job.id).await?;
        announce(&mut tx, claim.job.id, now).await?;
        tx.commit().await?;
        Ok(Completed::Done(Box::new(stored)))
    }

    async fn end_job(&self, claim: &Claim, ending: &Ending, now: Timestamp) -> Result<bool, StoreError> {
        const ATTEMPTS_USED: &str =
            "SELECT attempt - attempts_before FROM jobs WHERE id = $1 AND fence = $2 AND state = 'running'";
        /// `$3` the state, `$4` code, `$5` message, `$6` the time from which to retry, `$7` the time of the end, `$8` how many
        /// attempts are given back, `$9` the time now. A job that was cancelled meanwhile does not go back to the queue.
        const END_JOB: &str = "\
            UPDATE jobs SET state = CASE WHEN cancel_requested AND $3 = 'queued' THEN 'cancelled' ELSE $3 END, \
            error_code = COALESCE($4, error_code), error_message = COALESCE($5, error_message), \
            run_after_ms = COALESCE($6, run_after_ms), claim_expires_ms = NULL, remaining_ms = NULL, attempt = attempt - $8, \
            finished_ms = CASE WHEN cancel_requested AND $3 = 'queued' THEN $9 ELSE $7 END \
            WHERE id = $1 AND fence = $2 AND state = 'running' RETURNING finished_ms";
        let now_ms = Some(now.as_millisecond());
        let mut tx = self.begin().await?;
        let used: Option<i64> = sqlx::query_scalar(ATTEMPTS_USED)
            .bind(claim.job.id.to_string())
            .bind(claim.fence)
            .fetch_optional(&mut *tx)
            .await?;
        let Some(used) = used else {
            tx.rollback().await?;
            return Ok(false);
        };
        let exhausted = used >= i64::from(claim.job.max_attempts);
        let (state, code, message, run_after_ms, finished_ms, attempts_back) = match ending {
            Ending::Failed { code, message } => ("failed", Some(code), Some(message), None, now_ms, 0),
            Ending::Retry { code, message, .. } if exhausted => ("failed", Some(code), Some(message), None, now_ms, 0),
            Ending::Retry { code, message, backoff } => {
                let pause = backoff.saturating_mul(4_u32.saturating_pow(used.clamp(1, 16) as u32 - 1));
                ("queued", Some(code), Some(message), Some(after(now, pause.min(MAX_BACKOFF))), None, 0)
            }
            Ending::Declined { code, message, pause } => {
                ("queued", Some(code), Some(message), Some(after(now, *pause)), None, 1)
            }
            Ending::Cancelled => ("cancelled", None, None, None, now_ms, 0),
            Ending::Released => ("queued", None, None, now_ms, None, 1),
        };
        let ended = sqlx::query(END_JOB)
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
        // Another worker may have claimed it since it was read.
        let Some(ended) = ended else {
            tx.rollback().await?;
            return Ok(false);
        };
        if matches!(ending, Ending::Released) {
            notify_workers(&mut tx).await?;
        }
        sweep(&mut tx, claim.job.id).await?;
        if ended.try_get::<Option<i64>, _>("finished_ms")?.is_some() {
            announce(&mut tx, claim.job.id, now).await?;
        }
        tx.commit().await?;
        Ok(true)
    }
}

/// Deletes checkpoints and image tasks of a job that has ended.
async fn sweep(tx: &mut Tx, job: JobId) -> Result<(), StoreError> {
    const SWEEP_CHECKPOINTS: &str = "\
        DELETE FROM checkpoints WHERE job_id = $1 \
        AND NOT EXISTS (SELECT 1 FROM jobs WHERE jobs.id = $1 AND jobs.state IN ('queued', 'running'))";
    const SWEEP_TASKS: &str = "\
        DELETE FROM image_tasks WHERE job_id = $1 \
        AND NOT EXISTS (SELECT 1 FROM jobs WHERE jobs.id = $1 AND jobs.state IN ('queued', 'running'))";
    for statement in [SWEEP_CHECKPOINTS, SWEEP_TASKS] {
        sqlx::query(statement).bind(job.to_string()).execute(&mut **tx).await?;
    }
    Ok(())
}

fn job(row: &Row) -> Result<Job, StoreError> {
    let stage: Option<String> = row.try_get("stage")?;
    let error_code: Option<String> = row.try_get("error_code")?;
    let error_message: Option<String> = row.try_get("error_message")?;
    let progress = match stage {
        Some(stage) => Some(Progress {
            stage,
            done: row.try_get::<i64, _>("done")? as u64,
            total: row.try_get::<i64, _>("total")? as u64,
            remaining_ms: row.try_get::<Option<i64>, _>("remaining_ms")?.map(|ms| ms as u64),
        }),
        None => None,
    };
    Ok(Job {
        seq: row.try_get("seq")?,
        id: JobId(uuid(row, "id")?),
        plant: PlantId(uuid(row, "plant_id")?),
        survey: SurveyId(uuid(row, "survey_id")?),
        state: parsed(row, "state")?,
        options: row.try_get("options_json")?,
        priority: small("priority", row.try_get("priority")?)?,
        progress,
        warnings: document(row, "warnings")?,
        error: error_code.zip(error_message),
        attempt: small("attempt", row.try_get("attempt")?)?,
        max_attempts: small("max_attempts", row.try_get("max_attempts")?)?,
        cancel_requested: row.try_get("cancel_requested")?,
        model_version: optional_small(row, "model_version")?,
        created: time(row, "created_ms")?,
        started: optional_time(row, "started_ms")?,
        finished: optional_time(row, "finished_ms")?,
    })
}

/// A job of any plant, which must be there.
pub async fn job_by_id(tx: &mut Tx, id: JobId) -> Result<Job, StoreError> {
    const JOB_BY_ID: &str = concat!("SELECT ", job_columns!(), " FROM jobs WHERE id = $1");
    job(&sqlx::query(JOB_BY_ID).bind(id.to_string()).fetch_one(&mut **tx).await?)
}
