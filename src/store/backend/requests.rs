//! Requests that may be sent again.

use super::super::Rows;
use super::read;
use crate::store::requests::{Begun, KeptAnswer, RequestStore};
use crate::store::{OrganisationId, StoreError, sql};
use async_trait::async_trait;
use jiff::Timestamp;
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
        let mut tx = self.begin().await?;
        let taken = sqlx::query(sql::BEGIN_REQUEST)
            .bind(organisation.to_string())
            .bind(name)
            .bind(now.as_millisecond())
            .bind(until.as_millisecond())
            .bind(token.to_string())
            .execute(&mut *tx)
            .await?;
        let begun = match taken.rows_affected() {
            0 => {
                let query = sqlx::query(sql::REQUEST).bind(organisation.to_string()).bind(name);
                let answer = query.fetch_optional(&mut *tx).await?.as_ref().map(read::kept_answer).transpose()?;
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
        sqlx::query(sql::RENEW_REQUEST)
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
        sqlx::query(sql::KEEP_ANSWER)
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
        let query = sqlx::query(sql::FORGET_REQUEST).bind(organisation.to_string()).bind(name);
        query.bind(token.to_string()).execute(&self.write).await?;
        Ok(())
    }

    async fn forget_old_requests(&self, now: Timestamp) -> Result<(), StoreError> {
        sqlx::query(sql::FORGET_OLD_REQUESTS).bind(now.as_millisecond()).execute(&self.write).await?;
        Ok(())
    }
}
