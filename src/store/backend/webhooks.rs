//! Webhooks and the messages to them.

use super::super::{Rows, Tx, queues};
use super::read::{self, delivery, job, webhook};
use crate::store::webhooks::{MAX_ATTEMPTS, MAX_WEBHOOKS, SigningSecret};
use crate::store::{
    Delivery, DeliveryClaim, DeliveryId, DeliveryState, JobId, NewWebhook, OrganisationId, Page, Sent, StoreError,
    Webhook, WebhookId, WebhookStore, sql,
};
use async_trait::async_trait;
use jiff::Timestamp;
use sqlx::Row as _;
use std::time::Duration;
use uuid::Uuid;

#[async_trait]
impl WebhookStore for Rows {
    async fn create_webhook(&self, new: &NewWebhook, now: Timestamp) -> Result<Option<Webhook>, StoreError> {
        let mut tx = self.begin().await?;
        let count: i64 =
            sqlx::query_scalar(sql::COUNT_WEBHOOKS).bind(new.organisation.to_string()).fetch_one(&mut *tx).await?;
        if count >= i64::from(MAX_WEBHOOKS) {
            return Ok(None);
        }
        let row = sqlx::query(sql::CREATE_WEBHOOK)
            .bind(Uuid::new_v4().to_string())
            .bind(new.organisation.to_string())
            .bind(new.plant.map(|plant| plant.to_string()))
            .bind(&new.url)
            .bind(new.secret.reveal())
            .bind(now.as_millisecond())
            .fetch_one(&mut *tx)
            .await
            .map_err(super::gone("plant"))?;
        tx.commit().await?;
        webhook(&row).map(Some)
    }

    async fn webhook(&self, organisation: OrganisationId, id: WebhookId) -> Result<Option<Webhook>, StoreError> {
        let query = sqlx::query(sql::WEBHOOK).bind(organisation.to_string()).bind(id.to_string());
        query.fetch_optional(&self.read).await?.as_ref().map(webhook).transpose()
    }

    async fn webhooks(&self, organisation: OrganisationId, page: Page) -> Result<Vec<Webhook>, StoreError> {
        let query = sqlx::query(sql::WEBHOOKS)
            .bind(organisation.to_string())
            .bind(page.after.unwrap_or(0))
            .bind(i64::from(page.limit));
        query.fetch_all(&self.read).await?.iter().map(webhook).collect()
    }

    async fn delete_webhook(&self, organisation: OrganisationId, id: WebhookId) -> Result<bool, StoreError> {
        let query = sqlx::query(sql::DELETE_WEBHOOK).bind(organisation.to_string()).bind(id.to_string());
        Ok(query.execute(&self.write).await?.rows_affected() > 0)
    }

    async fn deliveries(
        &self,
        webhook: WebhookId,
        state: Option<DeliveryState>,
        page: Page,
    ) -> Result<Vec<Delivery>, StoreError> {
        let query = sqlx::query(sql::DELIVERIES)
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
        now: Timestamp,
    ) -> Result<Option<Delivery>, StoreError> {
        let query = sqlx::query(sql::RESEND_DELIVERY)
            .bind(webhook.to_string())
            .bind(id.to_string())
            .bind(now.as_millisecond())
            .bind(i64::from(MAX_ATTEMPTS));
        query.fetch_optional(&self.write).await?.as_ref().map(delivery).transpose()
    }

    async fn claim_delivery(
        &self,
        busy: &[OrganisationId],
        lease: Duration,
        now: Timestamp,
    ) -> Result<Option<DeliveryClaim>, StoreError> {
        // Mostly there is none: finding that out takes no turn from those who write.
        let due = sqlx::query(sql::DELIVERY_DUE).bind(now.as_millisecond()).fetch_optional(&self.read).await?;
        if due.is_none() {
            return Ok(None);
        }
        let mut tx = self.begin().await?;
        let busy: Vec<String> = busy.iter().map(OrganisationId::to_string).collect();
        let query = sqlx::query(queues::CLAIM_DELIVERY).bind(now.as_millisecond()).bind(super::after(now, lease));
        let Some(row) = query.bind(busy.join(" ")).fetch_optional(&mut *tx).await? else { return Ok(None) };
        let delivery = delivery(&row)?;
        let to = sqlx::query(sql::WEBHOOK_OF_DELIVERY).bind(delivery.webhook.to_string()).fetch_one(&mut *tx).await?;
        let of = sqlx::query(sql::JOB_OF_DELIVERY).bind(delivery.job.to_string()).fetch_one(&mut *tx).await?;
        let secret = SigningSecret::kept(to.try_get("secret")?);
        let organisation = OrganisationId(read::uuid(&to, "organisation_id")?);
        let claim = DeliveryClaim { organisation, delivery, url: to.try_get("url")?, secret, job: job(&of)? };
        tx.commit().await?;
        Ok(Some(claim))
    }

    async fn end_delivery(&self, claim: &DeliveryClaim, sent: &Sent, now: Timestamp) -> Result<bool, StoreError> {
        let now_ms = Some(now.as_millisecond());
        let (state, error, run_after_ms, finished_ms) = match sent {
            Sent::Arrived => (DeliveryState::Delivered, None, None, now_ms),
            Sent::Failed { error, .. } if claim.delivery.attempts_left == 0 => {
                (DeliveryState::Dead, Some(error), None, now_ms)
            }
            Sent::Failed { error, at } => (DeliveryState::Waiting, Some(error), Some(at.as_millisecond()), None),
        };
        let query = sqlx::query(sql::END_DELIVERY)
            .bind(claim.delivery.id.to_string())
            .bind(i64::from(claim.delivery.attempts))
            .bind(state.as_str())
            .bind(error)
            .bind(run_after_ms)
            .bind(finished_ms);
        Ok(query.execute(&self.write).await?.rows_affected() > 0)
    }

    async fn forget_old_deliveries(&self, before: Timestamp) -> Result<(), StoreError> {
        sqlx::query(sql::FORGET_OLD_DELIVERIES).bind(before.as_millisecond()).execute(&self.write).await?;
        Ok(())
    }
}

/// Writes a message to every webhook that wants to hear of the end of a job, which is part of the same transaction.
pub async fn announce(tx: &mut Tx, job: JobId, now: Timestamp) -> Result<(), StoreError> {
    for row in sqlx::query(sql::WEBHOOKS_OF_JOB).bind(job.to_string()).fetch_all(&mut **tx).await? {
        sqlx::query(sql::CREATE_DELIVERY)
            .bind(Uuid::new_v4().to_string())
            .bind(read::uuid(&row, "id")?.to_string())
            .bind(job.to_string())
            .bind(i64::from(MAX_ATTEMPTS))
            .bind(now.as_millisecond())
            .execute(&mut **tx)
            .await?;
    }
    Ok(())
}
