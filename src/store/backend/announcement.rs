//! Messages to webhooks that a job has ended.

use super::super::Tx;
use super::columns::uuid;
use crate::store::error::StoreError;
use crate::store::ids::JobId;
use crate::store::webhooks::MAX_ATTEMPTS;
use jiff::Timestamp;
use uuid::Uuid;

/// Creates a message to every webhook of a job that ends in the same transaction.
pub async fn announce(tx: &mut Tx, job: JobId, now: Timestamp) -> Result<(), StoreError> {
    const WEBHOOKS_OF_JOB: &str = "\
        SELECT webhooks.id FROM jobs JOIN plants ON plants.id = jobs.plant_id \
        JOIN webhooks ON webhooks.organisation_id = plants.organisation_id \
        WHERE jobs.id = $1 AND COALESCE(webhooks.plant_id, plants.id) = plants.id ORDER BY webhooks.seq";
    const CREATE_DELIVERY: &str = "\
        INSERT INTO deliveries (id, webhook_id, job_id, state, attempts_left, run_after_ms, created_ms) \
        VALUES ($1, $2, $3, 'waiting', $4, $5, $5)";
    for row in sqlx::query(WEBHOOKS_OF_JOB).bind(job.to_string()).fetch_all(&mut **tx).await? {
        sqlx::query(CREATE_DELIVERY)
            .bind(Uuid::new_v4().to_string())
            .bind(uuid(&row, "id")?.to_string())
            .bind(job.to_string())
            .bind(i64::from(MAX_ATTEMPTS))
            .bind(now.as_millisecond())
            .execute(&mut **tx)
            .await?;
    }
    Ok(())
}
