//! Requests that may be sent again.

use super::super::{Row, Rows};
use super::columns::{parsed, small};
use crate::store::error::StoreError;
use crate::store::ids::OrganisationId;
use crate::store::requests::{Begun, KeptAnswer, RequestStore};
use async_trait::async_trait;
use jiff::Timestamp;
use sqlx::Row as _;
use uuid::Uuid;

#[async_trait]
impl RequestStore for Rows {
    async fn begin_request(
        &self,
        organisation: OrganisationId,
        name: &str,
        token: Uuid,
        now: Timestamp,
        until: Timestamp,
    ) -> Result<Begun, StoreError> {
        /// Reserves a key that is free or expired.
        const BEGIN_REQUEST: &str = "\
            INSERT INTO requests (organisation_id, name, expires_ms, token) VALUES ($1, $2, $4, $5) \
            ON CONFLICT (organisation_id, name) DO UPDATE SET fingerprint = NULL, status = NULL, headers = NULL, body = NULL, \
            expires_ms = excluded.expires_ms, token = excluded.token WHERE requests.expires_ms <= $3";
        const REQUEST: &str =
            "SELECT fingerprint, status, headers, body FROM requests WHERE organisation_id = $1 AND name = $2";
        let mut tx = self.begin().await?;
        let taken = sqlx::query(BEGIN_REQUEST)
            .bind(organisation.to_string())
            .bind(name)
            .bind(now.as_millisecond())
            .bind(until.as_millisecond())
            .bind(token.to_string())
            .execute(&mut *tx)
            .await?;
        let begun = match taken.rows_affected() {
            0 => {
                let query = sqlx::query(REQUEST).bind(organisation.to_string()).bind(name);
                let answer = query.fetch_optional(&mut *tx).await?.as_ref().map(kept_answer).transpose()?;
                answer.flatten().map_or(Begun::Running, |answer| Begun::Answered(Box::new(answer)))
            }
            _ => Begun::New,
        };
        tx.commit().await?;
        Ok(begun)
    }

    async fn renew_request(
        &self,
        organisation: OrganisationId,
        name: &str,
        token: Uuid,
        until: Timestamp,
    ) -> Result<(), StoreError> {
        const RENEW_REQUEST: &str = "UPDATE requests SET expires_ms = $4 WHERE organisation_id = $1 AND name = $2 AND token = $3 AND status IS NULL";
        sqlx::query(RENEW_REQUEST)
            .bind(organisation.to_string())
            .bind(name)
            .bind(token.to_string())
            .bind(until.as_millisecond())
            .execute(&self.write)
            .await?;
        Ok(())
    }

    async fn keep_answer(
        &self,
        organisation: OrganisationId,
        name: &str,
        token: Uuid,
        answer: &KeptAnswer,
        until: Timestamp,
    ) -> Result<(), StoreError> {
        const KEEP_ANSWER: &str = "\
            UPDATE requests SET fingerprint = $3, status = $4, headers = $5, body = $6, expires_ms = $7 \
            WHERE organisation_id = $1 AND name = $2 AND token = $8";
        sqlx::query(KEEP_ANSWER)
            .bind(organisation.to_string())
            .bind(name)
            .bind(answer.fingerprint.to_string())
            .bind(i64::from(answer.status))
            .bind(&answer.headers)
            .bind(&answer.body)
            .bind(until.as_millisecond())
            .bind(token.to_string())
            .execute(&self.write)
            .await?;
        Ok(())
    }

    async fn forget_request(&self, organisation: OrganisationId, name: &str, token: Uuid) -> Result<(), StoreError> {
        const FORGET_REQUEST: &str =
            "DELETE FROM requests WHERE organisation_id = $1 AND name = $2 AND token = $3 AND status IS NULL";
        let query = sqlx::query(FORGET_REQUEST).bind(organisation.to_string()).bind(name);
        query.bind(token.to_string()).execute(&self.write).await?;
        Ok(())
    }

    async fn forget_old_requests(&self, now: Timestamp) -> Result<(), StoreError> {
        const FORGET_OLD_REQUESTS: &str = "DELETE FROM requests WHERE expires_ms <= $1";
        sqlx::query(FORGET_OLD_REQUESTS).bind(now.as_millisecond()).execute(&self.write).await?;
        Ok(())
    }
}

/// The answer to a request, where it was answered.
fn kept_answer(row: &Row) -> Result<Option<KeptAnswer>, StoreError> {
    let status: Option<i64> = row.try_get("status")?;
    let Some(status) = status else { return Ok(None) };
    Ok(Some(KeptAnswer {
        fingerprint: parsed(row, "fingerprint")?,
        status: small("status", status)?,
        headers: row.try_get("headers")?,
        body: row.try_get("body")?,
    }))
}
