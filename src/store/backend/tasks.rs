//! Images of running jobs that other workers may search.

use super::super::{Db, Rows, queues, tell_of_work};
use super::{after, read};
use crate::store::{Checkpoint, Claim, GivenBack, ImageTask, JobId, OwnTask, StoreError, TaskClaim, TaskStore, sql};
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
        let mut tx = self.begin_alone().await?;
        let job = claim.job.id.to_string();
        let held = sqlx::query(sql::IS_CLAIMED).bind(&job).bind(claim.fence).fetch_optional(&mut *tx).await?;
        if held.is_none() {
            return Ok(false);
        }
        sqlx::query(sql::WITHDRAW_TASKS).bind(&job).execute(&mut *tx).await?;
        let mut placed = (0_i64..).zip(tasks);
        for chunk in tasks.chunks(TASKS_AT_ONCE) {
            let mut insert = QueryBuilder::<Db>::new(sql::OFFER_TASKS);
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
            tell_of_work(&mut tx).await?;
        }
        tx.commit().await?;
        Ok(true)
    }

    async fn take_own_task(&self, claim: &Claim, now: Timestamp) -> Result<OwnTask, StoreError> {
        let mut tx = self.begin_alone().await?;
        let job = claim.job.id.to_string();
        let image: Option<String> = sqlx::query_scalar(queues::TAKE_OWN_TASK)
            .bind(&job)
            .bind(claim.fence)
            .bind(now.as_millisecond())
            .bind(i64::MAX)
            .fetch_optional(&mut *tx)
            .await?;
        let own = match image {
            Some(image) => OwnTask::Image(image),
            None => {
                let query = sqlx::query(sql::TASK_IN_OTHER_HANDS).bind(&job).bind(i64::MAX);
                match query.fetch_optional(&mut *tx).await? {
                    Some(_) => OwnTask::InOtherHands,
                    None => OwnTask::None,
                }
            }
        };
        tx.commit().await?;
        Ok(own)
    }

    async fn gather_tasks(&self, claim: &Claim) -> Result<Vec<Checkpoint>, StoreError> {
        let job = claim.job.id.to_string();
        // Most of the time there is nothing, and nobody is to wait for that.
        if sqlx::query(sql::DONE_TASK).bind(&job).fetch_optional(&self.read).await?.is_none() {
            return Ok(Vec::new());
        }
        let mut tx = self.begin().await?;
        let query = sqlx::query_scalar(sql::GATHER_TASKS).bind(&job).bind(claim.fence);
        let images: Vec<String> = query.fetch_all(&mut *tx).await?;
        let mut found = Vec::with_capacity(images.len());
        for name in images {
            let query = sqlx::query_scalar(sql::ONE_CHECKPOINT).bind(&job).bind(&name);
            if let Some(document) = query.fetch_optional(&mut *tx).await? {
                found.push(Checkpoint { name, document });
            }
        }
        tx.commit().await?;
        Ok(found)
    }

    async fn waiting_tasks(&self, now: Timestamp) -> Result<u64, StoreError> {
        let query = sqlx::query_scalar::<_, i64>(sql::WAITING_TASKS).bind(now.as_millisecond());
        Ok(query.fetch_one(&self.read).await? as u64)
    }

    async fn take_task(&self, mapper: &str, lease: Duration, now: Timestamp) -> Result<Option<TaskClaim>, StoreError> {
        let mut tx = self.begin_alone().await?;
        let token = Uuid::new_v4();
        let row = sqlx::query(queues::TAKE_TASK)
            .bind(mapper)
            .bind(now.as_millisecond())
            .bind(token.to_string())
            .bind(after(now, lease))
            .fetch_optional(&mut *tx)
            .await?;
        tx.commit().await?;
        row.map(|row| {
            Ok(TaskClaim {
                plant: PlantId(read::uuid(&row, "plant_id")?),
                job: JobId(read::uuid(&row, "job_id")?),
                task: ImageTask { image: row.try_get("image")?, document: row.try_get("document")? },
                token,
            })
        })
        .transpose()
    }

    async fn extend_tasks(&self, tokens: &[Uuid], lease: Duration, now: Timestamp) -> Result<Vec<Uuid>, StoreError> {
        // One by one: whoever deletes them at the end of their job has them in an order of its own.
        let mut held = Vec::with_capacity(tokens.len());
        for token in tokens {
            let query = sqlx::query(sql::EXTEND_TASK).bind(token.to_string()).bind(after(now, lease));
            if query.execute(&self.write).await?.rows_affected() > 0 {
                held.push(*token);
            }
        }
        Ok(held)
    }

    async fn finish_task(&self, claim: &TaskClaim, document: &[u8]) -> Result<bool, StoreError> {
        let mut tx = self.begin().await?;
        // The job's row first, as whoever ends the job has it first.
        let query = sqlx::query(sql::OTHERS_MADE_PROGRESS).bind(claim.job.to_string()).bind(claim.token.to_string());
        if query.execute(&mut *tx).await?.rows_affected() == 0 {
            return Ok(false);
        }
        let query = sqlx::query_scalar(sql::FINISH_TASK).bind(claim.token.to_string()).bind(i64::MAX);
        let fingerprint: Option<String> = query.fetch_optional(&mut *tx).await?;
        let Some(fingerprint) = fingerprint else { return Ok(false) };
        sqlx::query(sql::CHECKPOINT)
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
        let mut tx = self.begin().await?;
        let query = sqlx::query(sql::GIVE_BACK_TASK).bind(claim.token.to_string());
        query.bind(to == GivenBack::ToOwner).execute(&mut *tx).await?;
        if to == GivenBack::ToAll {
            tell_of_work(&mut tx).await?;
        }
        tx.commit().await?;
        Ok(())
    }
}
