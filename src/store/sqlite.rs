//! The rows in an SQLite file: one connection that writes, several that read beside it (write-ahead log).

use super::blobs::io;
use super::connections::{Connections, Transaction};
use super::error::StoreError;
use sqlx::Sqlite;
use sqlx::migrate::Migrator;
use sqlx::sqlite::{SqliteConnectOptions, SqliteJournalMode, SqlitePool, SqlitePoolOptions, SqliteSynchronous};
use std::path::Path;
use std::time::Duration;
use tokio::sync::Notify;

// What the methods in `backend` need to know of this database.
use SqliteStore as Rows;
use sqlx::sqlite::SqliteRow as Row;
type Db = Sqlite;
type Tx = Transaction<Db>;
/// Where a database is.
type Place = Path;

/// The changes of the schema, in order.
static MIGRATOR: Migrator = sqlx::migrate!("migrations/sqlite");

/// Appended to the choice of a row that is then updated: nothing, because no other transaction writes at the same time.
macro_rules! skip_locked {
    () => {
        ""
    };
}

/// The texts of the JSON array that is bound to a parameter, as a subquery.
macro_rules! json_texts {
    ($parameter:literal) => {
        concat!("(SELECT value FROM json_each(", $parameter, "))")
    };
}

#[path = "backend/mod.rs"]
mod backend;

/// How long a statement waits for another process's transaction.
const BUSY_TIMEOUT: Duration = Duration::from_secs(20);

/// SQLite has no clock of its own.
const CLOCK: Option<&str> = None;

/// How many rows of a result may wait to be read.
const ROWS_AT_ONCE: usize = 2048;

/// The rows in an SQLite file.
#[derive(Debug, Clone)]
pub struct SqliteStore {
    read: Connections<Db>,
    /// One connection: writers of this process queue here instead of for SQLite's lock.
    write: Connections<Db>,
}

impl SqliteStore {
    /// Opens or creates the file and brings its schema up to date.
    pub async fn open(file: &Path) -> Result<Self, StoreError> {
        Self::open_bounded(file, None).await
    }

    /// As [`Self::open`]. The file does not grow to more than `max_pages` of its pages: what would need another fails as on a
    /// full disk.
    pub async fn open_bounded(file: &Path, max_pages: Option<u32>) -> Result<Self, StoreError> {
        let options = SqliteConnectOptions::new()
            .filename(file)
            .create_if_missing(true)
            .journal_mode(SqliteJournalMode::Wal)
            // What was acknowledged survives a power cut.
            .synchronous(SqliteSynchronous::Full)
            .busy_timeout(BUSY_TIMEOUT)
            .foreign_keys(true)
            // Rows come from a thread of their own: handing over many at once saves switching between the two.
            .row_buffer_size(ROWS_AT_ONCE);
        migrate(options.clone(), file).await?;
        let options = match max_pages {
            Some(pages) => options.pragma("max_page_count", pages.to_string()),
            None => options,
        };
        let write = SqlitePoolOptions::new().max_connections(1).connect_with(options.clone()).await?;
        let read = SqlitePoolOptions::new().max_connections(8).connect_with(options).await?;
        Ok(Self { read: read.into(), write: write.into() })
    }

    /// Opens a file and leaves its schema as it is: another version of the program may be using it.
    pub async fn open_as_it_is(file: &Path) -> Result<Self, StoreError> {
        let options = SqliteConnectOptions::new().filename(file).busy_timeout(BUSY_TIMEOUT).foreign_keys(true);
        let write = SqlitePoolOptions::new().max_connections(1).connect_with(options).await?;
        let write = Connections::from(write);
        Ok(Self { read: write.clone(), write })
    }

    /// Writes all rows as they are at one moment to a new file, while others read and write.
    pub async fn snapshot(&self, target: &Path) -> Result<(), StoreError> {
        let name = target.to_str().ok_or_else(|| io("name", target)(std::io::ErrorKind::InvalidFilename.into()))?;
        sqlx::query("VACUUM INTO $1").bind(name).execute(&self.read).await?;
        Ok(())
    }

    /// Ends all connections, after which the file is whole without the logs beside it.
    pub async fn close(&self) {
        self.read.pool().close().await;
        self.write.pool().close().await;
    }

    /// Name, open and idle connections of each pool.
    fn sizes(&self) -> Vec<(&'static str, u32, usize)> {
        let size = |name, pool: &SqlitePool| (name, pool.size(), pool.num_idle());
        vec![size("read", self.read.pool()), size("write", self.write.pool())]
    }

    /// A transaction that holds the write lock from its start, so that it cannot fail half-way for want of it.
    async fn begin_any_schema(&self) -> Result<Tx, StoreError> {
        Ok(self.write.begin("BEGIN IMMEDIATE").await?)
    }

    /// A transaction that looks at the whole queue: no other runs beside it.
    async fn begin_alone(&self) -> Result<Tx, StoreError> {
        self.begin().await
    }

    /// Never notifies: SQLite has no notifications between processes.
    async fn listen(&self, _: &Notify) {
        std::future::pending().await
    }
}

async fn notify_workers(_: &mut Tx) -> Result<(), StoreError> {
    Ok(())
}

/// Brings the schema up to date, one process at a time: a server and its workers may start together.
async fn migrate(options: SqliteConnectOptions, file: &Path) -> Result<(), StoreError> {
    let path = file.with_extension("lock");
    let lock = path.clone();
    let locked = tokio::task::spawn_blocking(move || {
        let lock = std::fs::File::create(lock)?;
        lock.lock()?;
        Ok(lock)
    });
    let _lock = locked.await.unwrap_or_else(|error| Err(std::io::Error::other(error))).map_err(io("lock", &path))?;
    // A table that is built anew is dropped in between, which would take with it all rows that refer to it.
    let pool = SqlitePoolOptions::new().max_connections(1).connect_with(options.foreign_keys(false)).await?;
    let migrated = MIGRATOR.run(&pool).await;
    pool.close().await;
    migrated.map_err(StoreError::from)
}
