//! Webhooks and the messages to them.

use super::super::{Row, Rows};
use super::columns::{optional_time, parsed, small, time, uuid};
use super::{after, gone, jobs};
use crate::store::error::StoreError;
use crate::store::ids::{DeliveryId, JobId, OrganisationId, WebhookId};
use crate::store::listing::Page;
use crate::store::webhooks::{
    Delivery, DeliveryClaim, DeliveryState, MAX_ATTEMPTS, MAX_WEBHOOKS, NewWebhook, Sent, SigningSecret, Webhook,
    WebhookStore,
};
use async_trait::async_trait;
use heliomap_model::PlantId;
use jiff::{SignedDuration, Timestamp};
use sqlx::Row as _;
use std::time::Duration;
use uuid::Uuid;

macro_rules! webhook_columns {
    () => {
        "seq, id, organisation_id, plant_id, url, created_ms"
    };
}

macro_rules! delivery_columns {
    () => {
        "seq, id, webhook_id, job_id, state, attempts, attempts_left, run_after_ms, error, created_ms, finished_ms"
    };
}

/// How long it is known that a message was sent again under an identifier.
const ONCE_KEPT: SignedDuration = SignedDuration::from_hours(24);

#[async_trait]
impl WebhookStore for Rows {
    async fn create_webhook(&self, new: &NewWebhook, now: Timestamp) -> Result<Option<Webhook>, StoreError> {
        const COUNT_WEBHOOKS: &str = "SELECT COUNT(*) FROM webhooks WHERE organisation_id = $1";
        const CREATE_WEBHOOK: &str = concat!(
            "INSERT INTO webhooks (id, organisation_id, plant_id, url, secret, created_ms) VALUES ($1, $2, $3, $4, $5, $6) \
             RETURNING ",
            webhook_columns!()
        );
        let mut tx = self.begin().await?;
        let count: i64 =
            sqlx::query_scalar(COUNT_WEBHOOKS).bind(new.organisation.to_string()).fetch_one(&mut *tx).await?;
        if count >= i64::from(MAX_WEBHOOKS) {
            tx.rollback().await?;
            return Ok(None);
        }
        let row = sqlx::query(CREATE_WEBHOOK)
            .bind(Uuid::new_v4().to_string())
            .bind(new.organisation.to_string())
            .bind(new.plant.map(|plant| plant.to_string()))
            .bind(&new.url)
            .bind(new.secret.reveal())
            .bind(now.as_millisecond())
            .fetch_one(&mut *tx)
            .await
            .map_err(gone("plant"))?;
        tx.commit().await?;
        webhook(&row).map(Some)
    }

    async fn webhook(&self, organisation: OrganisationId, id: WebhookId) -> Result<Option<Webhook>, StoreError> {
        const WEBHOOK: &str =
            concat!("SELECT ", webhook_columns!(), " FROM webhooks WHERE organisation_id = $1 AND id = $2");
        let query = sqlx::query(WEBHOOK).bind(organisation.to_string()).bind(id.to_string());
        query.fetch_optional(&self.read).await?.as_ref().map(webhook).transpose()
    }

    async fn webhooks(&self, organisation: OrganisationId, page: Page) -> Result<Vec<Webhook>, StoreError> {
        const WEBHOOKS: &str = concat!(
            "SELECT ",
            webhook_columns!(),
            " FROM webhooks WHERE organisation_id = $1 AND seq > $2 ORDER BY seq LIMIT $3"
        );
        let query = sqlx::query(WEBHOOKS)
            .bind(organisation.to_string())
            .bind(page.after.unwrap_or(0))
            .bind(i64::from(page.limit));
        query.fetch_all(&self.read).await?.iter().map(webhook).collect()
    }

    async fn delete_webhook(&self, organisation: OrganisationId, id: WebhookId) -> Result<bool, StoreError> {
        const DELETE_WEBHOOK: &str = "DELETE FROM webhooks WHERE organisation_id = $1 AND id = $2";
        let query = sqlx::query(DELETE_WEBHOOK).bind(organisation.to_string()).bind(id.to_string());
        Ok(query.execute(&self.write).await?.rows_affected() > 0)
    }

    async fn deliveries(
        &self,
        webhook: WebhookId,
        state: Option<DeliveryState>,
        page: Page,
    ) -> Result<Vec<Delivery>, StoreError> {
        const DELIVERIES: &str = concat!(
            "SELECT ",
            delivery_columns!(),
            " FROM deliveries WHERE webhook_id = $1 AND state = COALESCE($2, state) AND seq < $3 ORDER BY seq DESC LIMIT $4"
        );
        let query = sqlx::query(DELIVERIES)
            .bind(webhook.to_string())
            .bind(state.map(DeliveryState::as_str))
            .bind(page.after.unwrap_or(i64::MAX))
            .bind(i64::from(page.limit));
        query.fetch_all(&self.read).await?.iter().map(delivery).collect()
    }

    async fn resend_delivery(
        &self,
        webhook: WebhookId,
        id: DeliveryId,
        once: Option<Uuid>,
        now: Timestamp,
    ) -> Result<Option<Delivery>, StoreError> {
        const RESEND_DELIVERY: &str = concat!(
            "UPDATE deliveries SET state = 'waiting', attempts_left = $4, run_after_ms = $3, finished_ms = NULL \
             WHERE webhook_id = $1 AND id = $2 RETURNING ",
            delivery_columns!()
        );
        const DELIVERY: &str =
            concat!("SELECT ", delivery_columns!(), " FROM deliveries WHERE webhook_id = $1 AND id = $2");
        /// A name with a space is no client's.
        const NOTE_ONCE: &str = "\
            INSERT INTO requests (organisation_id, name, expires_ms) SELECT organisation_id, $2, $3 FROM webhooks WHERE id = $1 \
            ON CONFLICT (organisation_id, name) DO NOTHING";
        let mut tx = self.begin().await?;
        if let Some(once) = once {
            let query = sqlx::query(NOTE_ONCE).bind(webhook.to_string()).bind(format!("once {once}"));
            let noted = query.bind((now + ONCE_KEPT).as_millisecond()).execute(&mut *tx).await?;
            if noted.rows_affected() == 0 {
                let query = sqlx::query(DELIVERY).bind(webhook.to_string()).bind(id.to_string());
                let found = query.fetch_optional(&mut *tx).await?.as_ref().map(delivery).transpose()?;
                tx.commit().await?;
                return Ok(found);
            }
        }
        let query = sqlx::query(RESEND_DELIVERY)
            .bind(webhook.to_string())
            .bind(id.to_string())
            .bind(now.as_millisecond())
            .bind(i64::from(MAX_ATTEMPTS));
        let found = query.fetch_optional(&mut *tx).await?.as_ref().map(delivery).transpose()?;
        tx.commit().await?;
        Ok(found)
    }

    async fn claim_delivery(
        &self,
        busy: &[OrganisationId],
        lease: Duration,
        now: Timestamp,
    ) -> Result<Option<DeliveryClaim>, StoreError> {
        const DELIVERY_DUE: &str = "SELECT 1 FROM deliveries WHERE state = 'waiting' AND run_after_ms <= $1 LIMIT 1";
        /// `$3` is the JSON array of the organisations that are passed over.
        const CLAIM_DELIVERY: &str = concat!(
            "UPDATE deliveries SET attempts = attempts + 1, run_after_ms = $2, \
             attempts_left = CASE WHEN attempts_left > 0 THEN attempts_left - 1 ELSE 0 END \
             WHERE state = 'waiting' AND run_after_ms <= $1 AND seq = (SELECT candidate.seq \
             FROM deliveries AS candidate JOIN webhooks ON webhooks.id = candidate.webhook_id \
             WHERE candidate.state = 'waiting' AND candidate.run_after_ms <= $1 \
             AND webhooks.organisation_id NOT IN ",
            json_texts!("$3"),
            " ORDER BY candidate.run_after_ms, candidate.seq LIMIT 1",
            skip_locked!(),
            ") RETURNING ",
            delivery_columns!()
        );
        const WEBHOOK_OF_DELIVERY: &str = "SELECT organisation_id, url, secret FROM webhooks WHERE id = $1";
        // Mostly there is none: find that out without a lock.
        let due = sqlx::query(DELIVERY_DUE).bind(now.as_millisecond()).fetch_optional(&self.read).await?;
        if due.is_none() {
            return Ok(None);
        }
        let mut tx = self.begin().await?;
        let query = sqlx::query(CLAIM_DELIVERY).bind(now.as_millisecond()).bind(after(now, lease));
        let Some(row) = query.bind(serde_json::json!(busy).to_string()).fetch_optional(&mut *tx).await? else {
            tx.rollback().await?;
            return Ok(None);
        };
        let delivery = delivery(&row)?;
        let to = sqlx::query(WEBHOOK_OF_DELIVERY).bind(delivery.webhook.to_string()).fetch_one(&mut *tx).await?;
        let job = jobs::job_by_id(&mut tx, delivery.job).await?;
        let secret = SigningSecret::kept(to.try_get("secret")?);
        let organisation = OrganisationId(uuid(&to, "organisation_id")?);
        let claim = DeliveryClaim { organisation, delivery, url: to.try_get("url")?, secret, job };
        tx.commit().await?;
        Ok(Some(claim))
    }

    async fn end_delivery(&self, claim: &DeliveryClaim, sent: &Sent, now: Timestamp) -> Result<bool, StoreError> {
        /// `$2` the attempt, `$3` the state, `$4` the error, `$5` the time of the next attempt, `$6` the time of the end.
        const END_DELIVERY: &str = "\
            UPDATE deliveries SET state = $3, error = $4, run_after_ms = COALESCE($5, run_after_ms), finished_ms = $6 \
            WHERE id = $1 AND attempts = $2 AND state = 'waiting'";
        let now_ms = Some(now.as_millisecond());
        let (state, error, run_after_ms, finished_ms) = match sent {
            Sent::Arrived => (DeliveryState::Delivered, None, None, now_ms),
            Sent::Failed { error, .. } if claim.delivery.attempts_left == 0 => {
                (DeliveryState::Dead, Some(error), None, now_ms)
            }
            Sent::Failed { error, at } => (DeliveryState::Waiting, Some(error), Some(at.as_millisecond()), None),
        };
        let query = sqlx::query(END_DELIVERY)
            .bind(claim.delivery.id.to_string())
            .bind(i64::from(claim.delivery.attempts))
            .bind(state.as_str())
            .bind(error)
            .bind(run_after_ms)
            .bind(finished_ms);
        Ok(query.execute(&self.write).await?.rows_affected() > 0)
    }

    async fn forget_old_deliveries(&self, before: Timestamp) -> Result<(), StoreError> {
        const FORGET_OLD_DELIVERIES: &str = "DELETE FROM deliveries WHERE finished_ms < $1";
        sqlx::query(FORGET_OLD_DELIVERIES).bind(before.as_millisecond()).execute(&self.write).await?;
        Ok(())
    }
}

fn webhook(row: &Row) -> Result<Webhook, StoreError> {
    let plant: Option<String> = row.try_get("plant_id")?;
    Ok(Webhook {
        seq: row.try_get("seq")?,
        id: WebhookId(uuid(row, "id")?),
        organisation: OrganisationId(uuid(row, "organisation_id")?),
        plant: plant.map(|_| uuid(row, "plant_id").map(PlantId)).transpose()?,
        url: row.try_get("url")?,
        created: time(row, "created_ms")?,
    })
}

fn delivery(row: &Row) -> Result<Delivery, StoreError> {
    Ok(Delivery {
        seq: row.try_get("seq")?,
        id: DeliveryId(uuid(row, "id")?),
        webhook: WebhookId(uuid(row, "webhook_id")?),
        job: JobId(uuid(row, "job_id")?),
        state: parsed(row, "state")?,
        attempts: small("attempts", row.try_get("attempts")?)?,
        attempts_left: small("attempts_left", row.try_get("attempts_left")?)?,
        run_after: time(row, "run_after_ms")?,
        error: row.try_get("error")?,
        created: time(row, "created_ms")?,
        finished: optional_time(row, "finished_ms")?,
    })
}
