//! Organisations, keys and the audit log.

use super::super::{Row, Rows};
use super::columns::{document, optional_document, optional_time, small, time, uuid};
use super::gone;
use crate::store::access::{AccessStore, ApiKey, AuditEntry, NewKey, Organisation, SecretRecord};
use crate::store::digest::Digest;
use crate::store::error::StoreError;
use crate::store::ids::{KeyId, OrganisationId};
use crate::store::listing::{Created, Page, TimeSpan};
use async_trait::async_trait;
use jiff::Timestamp;
use sqlx::Row as _;
use uuid::Uuid;

macro_rules! key_columns {
    () => {
        "seq, id, organisation_id, name, prefix, scopes_json, plants_json, created_ms, expires_ms, revoked_ms, last_used_ms"
    };
}

const ORGANISATION_BY_NAME: &str = "SELECT id, name, created_ms FROM organisations WHERE name = $1";

#[async_trait]
impl AccessStore for Rows {
    async fn create_organisation(&self, name: &str, now: Timestamp) -> Result<Created<Organisation>, StoreError> {
        const CREATE_ORGANISATION: &str = "\
            INSERT INTO organisations (id, name, created_ms) VALUES ($1, $2, $3) ON CONFLICT (name) DO NOTHING \
            RETURNING id, name, created_ms";
        let mut tx = self.begin().await?;
        let row = sqlx::query(CREATE_ORGANISATION)
            .bind(Uuid::new_v4().to_string())
            .bind(name)
            .bind(now.as_millisecond())
            .fetch_optional(&mut *tx)
            .await?;
        let created = match row {
            Some(row) => Created::New(organisation(&row)?),
            None => {
                let query = sqlx::query(ORGANISATION_BY_NAME).bind(name);
                Created::Existing(organisation(&query.fetch_one(&mut *tx).await?)?)
            }
        };
        tx.commit().await?;
        Ok(created)
    }

    async fn organisation(&self, name: &str) -> Result<Option<Organisation>, StoreError> {
        let query = sqlx::query(ORGANISATION_BY_NAME).bind(name);
        query.fetch_optional(&self.read).await?.as_ref().map(organisation).transpose()
    }

    async fn create_key(&self, new: &NewKey, now: Timestamp) -> Result<ApiKey, StoreError> {
        const CREATE_KEY: &str = concat!(
            "INSERT INTO api_keys (id, organisation_id, name, prefix, sha256, scopes_json, plants_json, created_ms, expires_ms) \
             VALUES ($1, $2, $3, $4, $5, $6, $7, $8, $9) RETURNING ",
            key_columns!()
        );
        let row = sqlx::query(CREATE_KEY)
            .bind(Uuid::new_v4().to_string())
            .bind(new.organisation.to_string())
            .bind(&new.name)
            .bind(&new.secret.prefix)
            .bind(new.secret.sha256.to_string())
            .bind(serde_json::json!(new.scopes).to_string())
            .bind(new.plants.as_ref().map(|plants| serde_json::json!(plants).to_string()))
            .bind(now.as_millisecond())
            .bind(new.expires.map(Timestamp::as_millisecond))
            .fetch_one(&self.write)
            .await
            .map_err(gone("organisation"))?;
        key(&row)
    }

    async fn key(&self, organisation: OrganisationId, id: KeyId) -> Result<Option<ApiKey>, StoreError> {
        const KEY: &str = concat!("SELECT ", key_columns!(), " FROM api_keys WHERE organisation_id = $1 AND id = $2");
        let query = sqlx::query(KEY).bind(organisation.to_string()).bind(id.to_string());
        query.fetch_optional(&self.read).await?.as_ref().map(key).transpose()
    }

    async fn keys(
        &self,
        organisation: Option<OrganisationId>,
        made: TimeSpan,
        page: Page,
    ) -> Result<Vec<ApiKey>, StoreError> {
        const KEYS: &str = concat!(
            "SELECT ",
            key_columns!(),
            " FROM api_keys WHERE organisation_id = COALESCE($1, organisation_id) AND seq > $2 AND created_ms >= $4 \
             AND created_ms < $5 ORDER BY seq LIMIT $3"
        );
        let (since_ms, until_ms) = span_ms(made);
        let query = sqlx::query(KEYS)
            .bind(organisation.map(|id| id.to_string()))
            .bind(page.after.unwrap_or(0))
            .bind(i64::from(page.limit))
            .bind(since_ms)
            .bind(until_ms);
        query.fetch_all(&self.read).await?.iter().map(key).collect()
    }

    async fn key_of_secret(&self, sha256: Digest, now: Timestamp) -> Result<Option<ApiKey>, StoreError> {
        const KEY_OF_SECRET: &str = concat!(
            "SELECT ",
            key_columns!(),
            " FROM api_keys WHERE (sha256 = $1 OR (previous_sha256 = $1 AND previous_until_ms > $2)) \
             AND revoked_ms IS NULL AND (expires_ms IS NULL OR expires_ms > $2)"
        );
        let query = sqlx::query(KEY_OF_SECRET).bind(sha256.to_string()).bind(now.as_millisecond());
        query.fetch_optional(&self.read).await?.as_ref().map(key).transpose()
    }

    async fn revoke_key(
        &self,
        organisation: OrganisationId,
        id: KeyId,
        prefix: Option<&str>,
        now: Timestamp,
    ) -> Result<Option<ApiKey>, StoreError> {
        const REVOKE_KEY: &str = concat!(
            "UPDATE api_keys SET revoked_ms = COALESCE(revoked_ms, $3) WHERE organisation_id = $1 AND id = $2 \
             AND prefix = COALESCE($4, prefix) RETURNING ",
            key_columns!()
        );
        let query = sqlx::query(REVOKE_KEY)
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
        const ROTATE_KEY: &str = concat!(
            "UPDATE api_keys SET previous_sha256 = sha256, previous_until_ms = $5, prefix = $3, sha256 = $4 \
             WHERE organisation_id = $1 AND id = $2 AND revoked_ms IS NULL AND prefix = COALESCE($6, prefix) RETURNING ",
            key_columns!()
        );
        let row = sqlx::query(ROTATE_KEY)
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
        const KEY_USED: &str = "UPDATE api_keys SET last_used_ms = $2 WHERE id = $1";
        sqlx::query(KEY_USED).bind(id.to_string()).bind(now.as_millisecond()).execute(&self.write).await?;
        Ok(())
    }

    async fn record(&self, entry: &AuditEntry) -> Result<(), StoreError> {
        const RECORD: &str = "\
            INSERT INTO audit (organisation_id, at_ms, key_id, key_name, method, path, status, request_id, subject) \
            VALUES ($1, $2, $3, $4, $5, $6, $7, $8, $9)";
        sqlx::query(RECORD)
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
        const FORGET_AUDIT: &str = "DELETE FROM audit WHERE at_ms < $1";
        sqlx::query(FORGET_AUDIT).bind(before.as_millisecond()).execute(&self.write).await?;
        Ok(())
    }

    async fn audit(
        &self,
        organisation: OrganisationId,
        within: TimeSpan,
        page: Page,
    ) -> Result<Vec<(i64, AuditEntry)>, StoreError> {
        const AUDIT: &str = "\
            SELECT seq, organisation_id, at_ms, key_id, key_name, method, path, status, request_id, subject FROM audit \
            WHERE organisation_id = $1 AND seq < $2 AND at_ms >= $4 AND at_ms < $5 ORDER BY seq DESC LIMIT $3";
        let (since_ms, until_ms) = span_ms(within);
        let query = sqlx::query(AUDIT)
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

pub fn organisation(row: &Row) -> Result<Organisation, StoreError> {
    Ok(Organisation {
        id: OrganisationId(uuid(row, "id")?),
        name: row.try_get("name")?,
        created: time(row, "created_ms")?,
    })
}

fn key(row: &Row) -> Result<ApiKey, StoreError> {
    Ok(ApiKey {
        seq: row.try_get("seq")?,
        id: KeyId(uuid(row, "id")?),
        organisation: OrganisationId(uuid(row, "organisation_id")?),
        name: row.try_get("name")?,
        prefix: row.try_get("prefix")?,
        scopes: document(row, "scopes_json")?,
        plants: optional_document(row, "plants_json")?,
        created: time(row, "created_ms")?,
        expires: optional_time(row, "expires_ms")?,
        revoked: optional_time(row, "revoked_ms")?,
        last_used: optional_time(row, "last_used_ms")?,
    })
}

fn audit_entry(row: &Row) -> Result<AuditEntry, StoreError> {
    let key_id: Option<String> = row.try_get("key_id")?;
    let key_name: Option<String> = row.try_get("key_name")?;
    Ok(AuditEntry {
        organisation: OrganisationId(uuid(row, "organisation_id")?),
        at: time(row, "at_ms")?,
        key: match key_id.zip(key_name) {
            Some((_, name)) => Some((KeyId(uuid(row, "key_id")?), name)),
            None => None,
        },
        subject: row.try_get("subject")?,
        method: row.try_get("method")?,
        path: row.try_get("path")?,
        status: small("status", row.try_get("status")?)?,
        request_id: row.try_get("request_id")?,
    })
}
