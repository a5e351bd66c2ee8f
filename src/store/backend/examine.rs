//! How the database stands, looked at without changing anything.

use super::super::{CLOCK, MIGRATOR, Place, Rows};
use crate::store::error::StoreError;
use crate::store::repository::Store;
use crate::store::schema::{Examined, Schema};
use jiff::Timestamp;

impl Rows {
    /// Looks at a database without changing its schema.
    pub async fn examine(place: &Place) -> Result<Examined, StoreError> {
        let rows = Self::open_as_it_is(place).await?;
        let examined = rows.examine_open().await;
        rows.close().await;
        examined
    }

    async fn examine_open(&self) -> Result<Examined, StoreError> {
        const CHANGES_MADE: &str = "SELECT version FROM _sqlx_migrations WHERE success ORDER BY version";
        const ANY_KEY: &str = "SELECT 1 FROM api_keys WHERE revoked_ms IS NULL LIMIT 1";
        let made: Vec<i64> = match sqlx::query_scalar(CHANGES_MADE).fetch_all(&self.read).await {
            Ok(made) => made,
            // There is no such table.
            Err(sqlx::Error::Database(error))
                if error.code().as_deref() == Some("42P01") || error.message().starts_with("no such table") =>
            {
                Vec::new()
            }
            Err(error) => return Err(error.into()),
        };
        let known = MIGRATOR.iter().filter(|change| !change.migration_type.is_down_migration());
        let schema = Schema::of(known.map(|change| change.version), &made);
        let now = match CLOCK {
            Some(clock) => {
                let now: i64 = sqlx::query_scalar(clock).fetch_one(&self.read).await?;
                Timestamp::from_millisecond(now).ok()
            }
            None => None,
        };
        let current = schema == Schema::Current;
        let writable = if current { self.try_to_write().await } else { Ok(()) };
        let has_keys = current && sqlx::query(ANY_KEY).fetch_optional(&self.read).await?.is_some();
        Ok(Examined { schema, writable, now, has_keys })
    }
}
