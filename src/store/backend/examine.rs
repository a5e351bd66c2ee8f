//! How the database stands, looked at without changing anything.

use super::super::{CLOCK, Rows};
use crate::store::schema::{Examined, Schema};
use crate::store::{StoreError, sql};
use jiff::Timestamp;
use sqlx::migrate::Migrator;

/// Looks at a database that was opened without bringing its schema up to date.
pub async fn examine(rows: &Rows, migrator: &Migrator) -> Result<Examined, StoreError> {
    let made: Vec<i64> = match sqlx::query_scalar(sql::MADE_CHANGES).fetch_all(&rows.read).await {
        Ok(made) => made,
        // There is no such table.
        Err(sqlx::Error::Database(error))
            if error.code().as_deref() == Some("42P01") || error.message().starts_with("no such table") =>
        {
            Vec::new()
        }
        Err(error) => return Err(error.into()),
    };
    let known = migrator.iter().filter(|change| !change.migration_type.is_down_migration());
    let schema = Schema::of(known.map(|change| change.version), &made);
    let now = match CLOCK {
        Some(clock) => {
            let now: i64 = sqlx::query_scalar(clock).fetch_one(&rows.read).await?;
            Timestamp::from_millisecond(now).ok()
        }
        None => None,
    };
    let current = schema == Schema::Current;
    let writable = if current { try_to_write(rows).await } else { Ok(()) };
    let has_keys = current && sqlx::query(sql::ANY_KEY).fetch_optional(&rows.read).await?.is_some();
    Ok(Examined { schema, writable, now, has_keys })
}

/// Writes a row and takes it back.
async fn try_to_write(rows: &Rows) -> Result<(), StoreError> {
    let mut tx = rows.begin().await?;
    sqlx::query(sql::NOTE_DELETED_PLANT).bind("doctor").bind(0_i64).execute(&mut *tx).await?;
    tx.rollback().await?;
    Ok(())
}
