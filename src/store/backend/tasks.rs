//! Image tasks of running jobs.

use super::super::{Db, Rows, notify_workers};
use super::after;
use super::columns::uuid;
use super::jobs::CHECKPOINT;
use super::models::is_claimed;
use crate::store::error::StoreError;
use crate::store::ids::JobId;
use crate::store::jobs::{Checkpoint, Claim};
use crate::store::tasks::{GivenBack, ImageTask, OwnTask, TaskClaim, TaskStore};
use async_trait::async_trait;
use heliomap_model::PlantId;
use jiff::Timestamp;
use sqlx::{QueryBuilder, Row as _};
use std::time::Duration;
use uuid::Uuid;

/// Tasks that one statement inserts; a row has six parameters.
const TASKS_AT_ONCE: usize = 500;

#[async_trait]
impl TaskStore for Rows {
    async fn offer_tasks(
        &self,
        claim: &Claim,
        fingerprint: &str,
        mapper: &str,
        tasks: &[ImageTask],
    ) -> Result<bool, StoreError> {
        const WITHDRAW_TASKS: &str = "DELETE FROM image_tasks WHERE job_id = $1";
        /// Rows follow, as many as one statement may have.
        const OFFER_TASKS: &str = "INSERT INTO image_tasks (job_id, image, position, fingerprint, mapper, document) ";
        let mut tx = self.begin_alone().await?;
        let job = claim.job.id.to_string();
        if !is_claimed(&mut tx, claim).await? {
            tx.rollback().await?;
            return Ok(false);
        }
        sqlx::query(WITHDRAW_TASKS).bind(&job).execute(&mut *tx).await?;
        let mut placed = (0_i64..).zip(tasks);
        for chunk in tasks.chunks(TASKS_AT_ONCE) {
            let mut insert = QueryBuilder::<Db>::new(OFFER_TASKS);
            insert.push_values(placed.by_ref().take(chunk.len()), |mut row, (position, task)| {
                row.push_bind(&job)
                    .push_bind(&task.image)
                    .push_bind(position)
                    .push_bind(fingerprint)
                    .push_bind(mapper)
                    .push_bind(&task.document);
            });
            insert.build().persistent(false).execute(&mut *tx).await?;
        }
        if !tasks.is_empty() {
            notify_workers(&mut tx).await?;
        }
        tx.commit().await?;
        Ok(true)
    }

    async fn take_own_task(&self, claim: &Claim, now: Timestamp) -> Result<OwnTask, StoreError> {
        /// The job's own worker holds it for as long as it has the job: `$4` is the end of time.
        const TAKE_OWN_TASK: &str = concat!(
            "UPDATE image_tasks SET token = NULL, lease_until_ms = $4 \
             WHERE job_id = $1 AND NOT done AND lease_until_ms < $3 AND image = (\
             SELECT candidate.image FROM image_tasks AS candidate \
             WHERE candidate.job_id = $1 AND NOT candidate.done AND candidate.lease_until_ms < $3 \
             ORDER BY candidate.position LIMIT 1",
            skip_locked!(),
            ") AND EXISTS (SELECT 1 FROM jobs WHERE id = $1 AND fence = $2 AND state = 'running') RETURNING image"
        );
        const TASK_OF_OTHERS: &str =
            "SELECT 1 FROM image_tasks WHERE job_id = $1 AND (done OR lease_until_ms < $2) LIMIT 1";
        let mut tx = self.begin_alone().await?;
        let job = claim.job.id.to_string();
        let image: Option<String> = sqlx::query_scalar(TAKE_OWN_TASK)
            .bind(&job)
            .bind(claim.fence)
            .bind(now.as_millisecond())
            .bind(i64::MAX)
            .fetch_optional(&mut *tx)
            .await?;
        let own = match image {
            Some(image) => OwnTask::Image(image),
            None => {
                let query = sqlx::query(TASK_OF_OTHERS).bind(&job).bind(i64::MAX);
                match query.fetch_optional(&mut *tx).await? {
                    Some(_) => OwnTask::HeldByOthers,
                    None => OwnTask::None,
                }
            }
        };
        tx.commit().await?;
        Ok(own)
    }

    async fn gather_tasks(&self, claim: &Claim) -> Result<Vec<Checkpoint>, StoreError> {
        const DONE_TASK: &str = "SELECT 1 FROM image_tasks WHERE job_id = $1 AND done LIMIT 1";
        const GATHER_TASKS: &str = "\
            DELETE FROM image_tasks WHERE job_id = $1 AND done \
            AND EXISTS (SELECT 1 FROM jobs WHERE id = $1 AND fence = $2 AND state = 'running') RETURNING image";
        const ONE_CHECKPOINT: &str = "SELECT document FROM checkpoints WHERE job_id = $1 AND name = $2";
        let job = claim.job.id.to_string();
        // Mostly there is nothing: find that out without a lock.
        if sqlx::query(DONE_TASK).bind(&job).fetch_optional(&self.read).await?.is_none() {
            return Ok(Vec::new());
        }
        let mut tx = self.begin().await?;
        let query = sqlx::query_scalar(GATHER_TASKS).bind(&job).bind(claim.fence);
        let images: Vec<String> = query.fetch_all(&mut *tx).await?;
        let mut found = Vec::with_capacity(images.len());
        for name in images {
            let query = sqlx::query_scalar(ONE_CHECKPOINT).bind(&job).bind(&name);
            if let Some(document) = query.fetch_optional(&mut *tx).await? {
                found.push(Checkpoint { name, document });
            }
        }
        tx.commit().await?;
        Ok(found)
    }

    async fn waiting_tasks(&self, now: Timestamp) -> Result<u64, StoreError> {
        const WAITING_TASKS: &str = "\
            SELECT COUNT(*) FROM image_tasks WHERE NOT done AND NOT left_to_owner AND lease_until_ms < $1 \
            AND EXISTS (SELECT 1 FROM jobs WHERE jobs.id = image_tasks.job_id AND jobs.state = 'running' \
            AND NOT jobs.cancel_requested)";
        let query = sqlx::query_scalar::<_, i64>(WAITING_TASKS).bind(now.as_millisecond());
        Ok(query.fetch_one(&self.read).await? as u64)
    }

    async fn take_task(&self, mapper: &str, lease: Duration, now: Timestamp) -> Result<Option<TaskClaim>, StoreError> {
        const TAKE_TASK: &str = concat!(
            "UPDATE image_tasks SET token = $3, lease_until_ms = $4 \
             WHERE NOT done AND NOT left_to_owner AND lease_until_ms < $2 AND (job_id, image) = (\
             SELECT candidate.job_id, candidate.image \
             FROM image_tasks AS candidate JOIN jobs ON jobs.id = candidate.job_id \
             WHERE candidate.mapper = $1 AND NOT candidate.done AND NOT candidate.left_to_owner \
             AND candidate.lease_until_ms < $2 AND jobs.state = 'running' AND NOT jobs.cancel_requested \
             ORDER BY jobs.priority DESC, jobs.seq, candidate.position LIMIT 1",
            skip_locked!(),
            ") RETURNING job_id, image, document, \
             (SELECT plant_id FROM jobs WHERE jobs.id = image_tasks.job_id) AS plant_id"
        );
        let mut tx = self.begin_alone().await?;
        let token = Uuid::new_v4();
        let row = sqlx::query(TAKE_TASK)
            .bind(mapper)
            .bind(now.as_millisecond())
            .bind(token.to_string())
            .bind(after(now, lease))
            .fetch_optional(&mut *tx)
            .await?;
        tx.commit().await?;
        row.map(|row| {
            Ok(TaskClaim {
                plant: PlantId(uuid(&row, "plant_id")?),
                job: JobId(uuid(&row, "job_id")?),
                task: ImageTask { image: row.try_get("image")?, document: row.try_get("document")? },
                token,
            })
        })
        .transpose()
    }

    async fn extend_tasks(&self, tokens: &[Uuid], lease: Duration, now: Timestamp) -> Result<Vec<Uuid>, StoreError> {
        const EXTEND_TASK: &str = "\
            UPDATE image_tasks SET lease_until_ms = $2 WHERE token = $1 AND EXISTS (SELECT 1 FROM jobs \
            WHERE jobs.id = image_tasks.job_id AND jobs.state = 'running' AND NOT jobs.cancel_requested)";
        // One by one: the end of a job deletes its tasks in another order, and two orders could deadlock.
        let mut held = Vec::with_capacity(tokens.len());
        for token in tokens {
            let query = sqlx::query(EXTEND_TASK).bind(token.to_string()).bind(after(now, lease));
            if query.execute(&self.write).await?.rows_affected() > 0 {
                held.push(*token);
            }
        }
        Ok(held)
    }

    async fn finish_task(&self, claim: &TaskClaim, document: &[u8]) -> Result<bool, StoreError> {
        /// `$2` the token of one of the job's tasks.
        const OTHERS_MADE_PROGRESS: &str = "\
            UPDATE jobs SET attempts_before = attempt - 1 WHERE id = $1 AND state = 'running' \
            AND EXISTS (SELECT 1 FROM image_tasks WHERE token = $2)";
        const FINISH_TASK: &str = "\
            UPDATE image_tasks SET done = TRUE, token = NULL, lease_until_ms = $2 WHERE token = $1 RETURNING fingerprint";
        let mut tx = self.begin().await?;
        // The job's row first, in the same order as the end of a job.
        let query = sqlx::query(OTHERS_MADE_PROGRESS).bind(claim.job.to_string()).bind(claim.token.to_string());
        if query.execute(&mut *tx).await?.rows_affected() == 0 {
            tx.rollback().await?;
            return Ok(false);
        }
        let query = sqlx::query_scalar(FINISH_TASK).bind(claim.token.to_string()).bind(i64::MAX);
        let fingerprint: Option<String> = query.fetch_optional(&mut *tx).await?;
        let Some(fingerprint) = fingerprint else {
            tx.rollback().await?;
            return Ok(false);
        };
        sqlx::query(CHECKPOINT)
            .bind(claim.job.to_string())
            .bind(&claim.task.image)
            .bind(fingerprint)
            .bind(document)
            .execute(&mut *tx)
            .await?;
        tx.commit().await?;
        Ok(true)
    }

    async fn give_back_task(&self, claim: &TaskClaim, to: GivenBack) -> Result<(), StoreError> {
        const GIVE_BACK_TASK: &str = "\
            UPDATE image_tasks SET token = NULL, lease_until_ms = 0, left_to_owner = (left_to_owner OR $2) WHERE token = $1";
        let mut tx = self.begin().await?;
        let query = sqlx::query(GIVE_BACK_TASK).bind(claim.token.to_string());
        query.bind(to == GivenBack::ToOwner).execute(&mut *tx).await?;
        if to == GivenBack::ToAll {
            notify_workers(&mut tx).await?;
        }
        tx.commit().await?;
        Ok(())
    }
}
