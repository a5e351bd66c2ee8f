//! The methods of the store, written once for both databases: this module is compiled once beside each of them and knows
//! its database by the names `Rows` (the store), `Db`, `Row` and `Tx` of its parent. Each statement stands in the method
//! that binds it; parameters are `$n`, times are milliseconds, identifiers and documents are text.

mod access;
mod announcement;
mod columns;
mod examine;
mod jobs;
mod models;
mod plants;
mod requests;
mod surveys;
mod tasks;
mod uploads;
mod usage;
mod webhooks;

use super::{MIGRATOR, Rows, Tx};
use crate::store::error::StoreError;
use crate::store::ids::OrganisationId;
use crate::store::repository::{Pool, Store};
use async_trait::async_trait;
use jiff::Timestamp;
use std::time::Duration;
use tokio::sync::Notify;
use uuid::Uuid;

/// The newest change of the schema that was made.
const NEWEST_CHANGE: &str = "SELECT MAX(version) FROM _sqlx_migrations";

impl Rows {
    /// Begins a transaction that writes, unless a newer version of the program has changed the schema: rows mean something
    /// else then, and a process of this version must not touch them.
    pub(super) async fn begin(&self) -> Result<Tx, StoreError> {
        let mut tx = self.begin_any_schema().await?;
        let newest = sqlx::query_scalar(NEWEST_CHANGE).fetch_one(&mut *tx).await?;
        if let Err(error) = refuse_newer(newest) {
            tx.rollback().await?;
            return Err(error);
        }
        Ok(tx)
    }
}

/// Fails where a change of the schema is newer than those that this program knows.
fn refuse_newer(newest: Option<i64>) -> Result<(), StoreError> {
    let known = MIGRATOR.iter().map(|change| change.version).max();
    match newest {
        Some(change) if newest > known => Err(StoreError::NewerSchema { change }),
        _ => Ok(()),
    }
}

#[async_trait]
impl Store for Rows {
    async fn ping(&self) -> Result<(), StoreError> {
        refuse_newer(sqlx::query_scalar(NEWEST_CHANGE).fetch_one(&self.read).await?)
    }

    async fn try_to_write(&self) -> Result<(), StoreError> {
        /// The row is deleted in the same transaction.
        const TRY_TO_WRITE: &str =
            "INSERT INTO requests (organisation_id, name, expires_ms, body) VALUES ($1, $2, 0, $3)";
        const UNDO_TRY: &str = "DELETE FROM requests WHERE organisation_id = $1 AND name = $2";
        /// More than the rows of a request, so that what succeeds here succeeds there.
        const BYTES: usize = 64 << 10;
        let (organisation, name) = (OrganisationId::DEFAULT.to_string(), Uuid::new_v4().to_string());
        let mut tx = self.begin().await?;
        let query = sqlx::query(TRY_TO_WRITE).bind(&organisation).bind(&name);
        query.bind(vec![0_u8; BYTES]).execute(&mut *tx).await?;
        sqlx::query(UNDO_TRY).bind(&organisation).bind(&name).execute(&mut *tx).await?;
        tx.commit().await?;
        Ok(())
    }

    async fn listen_for_work(&self, work_notify: &Notify) {
        self.listen(work_notify).await;
    }

    fn pools(&self) -> Vec<Pool> {
        let pool = |(name, open, idle): (&'static str, u32, usize)| Pool { name, open: open.into(), idle: idle as u64 };
        self.sizes().into_iter().map(pool).collect()
    }
}

/// Milliseconds at the end of a lease that begins now.
fn after(now: Timestamp, lease: Duration) -> i64 {
    now.as_millisecond().saturating_add(i64::try_from(lease.as_millis()).unwrap_or(i64::MAX))
}

/// Where a name that must differ is another row's already.
fn name_taken(error: sqlx::Error) -> StoreError {
    match &error {
        sqlx::Error::Database(database) if database.is_unique_violation() => StoreError::NameTaken,
        _ => StoreError::Database(error),
    }
}

/// A row whose owner was deleted meanwhile cannot be written.
fn gone(what: &'static str) -> impl FnOnce(sqlx::Error) -> StoreError {
    move |error| match &error {
        sqlx::Error::Database(database) if database.is_foreign_key_violation() => StoreError::Gone { what },
        _ => StoreError::Database(error),
    }
}
