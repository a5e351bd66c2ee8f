//! Organisations, keys and the audit log.

use super::super::Rows;
use super::read::{audit_entry, key, organisation};
use crate::store::{
    AccessStore, ApiKey, AuditEntry, Created, Digest, KeyId, NewKey, Organisation, OrganisationId, Page, SecretRecord,
    StoreError, TimeSpan, sql,
};
use async_trait::async_trait;
use heliomap_model::PlantId;
use jiff::Timestamp;
use sqlx::Row as _;
use uuid::Uuid;

#[async_trait]
impl AccessStore for Rows {
    async fn create_organisation(&self, name: &str, now: Timestamp) -> Result<Created<Organisation>, StoreError> {
        let mut tx = self.begin().await?;
        let row = sqlx::query(sql::CREATE_ORGANISATION)
            .bind(Uuid::new_v4().to_string())
            .bind(name)
            .bind(now.as_millisecond())
            .fetch_optional(&mut *tx)
            .await?;
        let created = match row {
            Some(row) => Created::New(organisation(&row)?),
            None => {
                let query = sqlx::query(sql::ORGANISATION_BY_NAME).bind(name);
                Created::Existing(organisation(&query.fetch_one(&mut *tx).await?)?)
            }
        };
        tx.commit().await?;
        Ok(created)
    }

    async fn organisation(&self, name: &str) -> Result<Option<Organisation>, StoreError> {
        let query = sqlx::query(sql::ORGANISATION_BY_NAME).bind(name);
        query.fetch_optional(&self.read).await?.as_ref().map(organisation).transpose()
    }

    async fn create_key(&self, new: &NewKey, now: Timestamp) -> Result<ApiKey, StoreError> {
        let words: Vec<&str> = new.scopes.iter().map(|scope| scope.as_str()).collect();
        let row = sqlx::query(sql::CREATE_KEY)
            .bind(Uuid::new_v4().to_string())
            .bind(new.organisation.to_string())
            .bind(&new.name)
            .bind(&new.secret.prefix)
            .bind(new.secret.sha256.to_string())
            .bind(words.join(" "))
            .bind(new.plants.as_deref().map(plants_text))
            .bind(now.as_millisecond())
            .bind(new.expires.map(Timestamp::as_millisecond))
            .fetch_one(&self.write)
            .await
            .map_err(super::gone("organisation"))?;
        key(&row)
    }

    async fn key(&self, organisation: OrganisationId, id: KeyId) -> Result<Option<ApiKey>, StoreError> {
        let query = sqlx::query(sql::KEY).bind(organisation.to_string()).bind(id.to_string());
        query.fetch_optional(&self.read).await?.as_ref().map(key).transpose()
    }

    async fn keys(
        &self,
        organisation: Option<OrganisationId>,
        made: TimeSpan,
        page: Page,
    ) -> Result<Vec<ApiKey>, StoreError> {
        let (since_ms, until_ms) = span_ms(made);
        let query = sqlx::query(sql::KEYS)
            .bind(organisation.map(|id| id.to_string()))
            .bind(page.after.unwrap_or(0))
            .bind(i64::from(page.limit))
            .bind(since_ms)
            .bind(until_ms);
        query.fetch_all(&self.read).await?.iter().map(key).collect()
    }

    async fn key_of_secret(&self, sha256: Digest, now: Timestamp) -> Result<Option<ApiKey>, StoreError> {
        let query = sqlx::query(sql::KEY_OF_SECRET).bind(sha256.to_string()).bind(now.as_millisecond());
        query.fetch_optional(&self.read).await?.as_ref().map(key).transpose()
    }

    async fn revoke_key(
        &self,
        organisation: OrganisationId,
        id: KeyId,
        prefix: Option<&str>,
        now: Timestamp,
    ) -> Result<Option<ApiKey>, StoreError> {
        let query = sqlx::query(sql::REVOKE_KEY)
            .bind(organisation.to_string())
            .bind(id.to_string())
            .bind(now.as_millisecond())
            .bind(prefix);
        query.fetch_optional(&self.write).await?.as_ref().map(key).transpose()
    }

    async fn rotate_key(
        &self,
        organisation: OrganisationId,
        id: KeyId,
        prefix: Option<&str>,
        secret: &SecretRecord,
        previous_until: Timestamp,
    ) -> Result<Option<ApiKey>, StoreError> {
        let row = sqlx::query(sql::ROTATE_KEY)
            .bind(organisation.to_string())
            .bind(id.to_string())
            .bind(&secret.prefix)
            .bind(secret.sha256.to_string())
            .bind(previous_until.as_millisecond())
            .bind(prefix)
            .fetch_optional(&self.write)
            .await?;
        row.as_ref().map(key).transpose()
    }

    async fn key_used(&self, id: KeyId, now: Timestamp) -> Result<(), StoreError> {
        sqlx::query(sql::KEY_USED).bind(id.to_string()).bind(now.as_millisecond()).execute(&self.write).await?;
        Ok(())
    }

    async fn record(&self, entry: &AuditEntry) -> Result<(), StoreError> {
        sqlx::query(sql::RECORD)
            .bind(entry.organisation.to_string())
            .bind(entry.at.as_millisecond())
            .bind(entry.key.as_ref().map(|(id, _)| id.to_string()))
            .bind(entry.key.as_ref().map(|(_, name)| name.clone()))
            .bind(&entry.method)
            .bind(&entry.path)
            .bind(i64::from(entry.status))
            .bind(&entry.request_id)
            .bind(&entry.subject)
            .execute(&self.write)
            .await?;
        Ok(())
    }

    async fn forget_audit(&self, before: Timestamp) -> Result<(), StoreError> {
        sqlx::query(sql::FORGET_AUDIT).bind(before.as_millisecond()).execute(&self.write).await?;
        Ok(())
    }

    async fn audit(
        &self,
        organisation: OrganisationId,
        within: TimeSpan,
        page: Page,
    ) -> Result<Vec<(i64, AuditEntry)>, StoreError> {
        let (since_ms, until_ms) = span_ms(within);
        let query = sqlx::query(sql::AUDIT)
            .bind(organisation.to_string())
            .bind(page.after.unwrap_or(i64::MAX))
            .bind(i64::from(page.limit))
            .bind(since_ms)
            .bind(until_ms);
        let rows = query.fetch_all(&self.read).await?;
        rows.iter().map(|row| Ok((row.try_get("seq")?, audit_entry(row)?))).collect()
    }
}

/// The first millisecond of a span of time, and the first after it.
fn span_ms(span: TimeSpan) -> (i64, i64) {
    // A time between two milliseconds is before all of the next.
    let ms = |time: Timestamp| time.as_millisecond() + i64::from(time.subsec_nanosecond().rem_euclid(1_000_000) != 0);
    (span.since.map_or(i64::MIN, ms), span.until.map_or(i64::MAX, ms))
}

/// Identifiers as a row holds them.
pub fn plants_text(plants: &[PlantId]) -> String {
    plants.iter().map(PlantId::to_string).collect::<Vec<_>>().join(" ")
}
