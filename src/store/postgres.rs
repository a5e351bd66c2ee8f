//! The rows in a Postgres database, which servers and workers on any number of machines share.

use super::connections::{Connections, Transaction};
use super::error::StoreError;
use sqlx::Postgres;
use sqlx::migrate::Migrator;
use sqlx::postgres::{PgConnectOptions, PgListener, PgPoolOptions, PgSslMode};
use std::net::IpAddr;
use std::time::Duration;
use tokio::sync::Notify;

// What the methods in `backend` need to know of this database.
use PostgresStore as Rows;
use sqlx::postgres::PgRow as Row;
type Db = Postgres;
type Tx = Transaction<Db>;
/// The URL of a database.
type Place = str;

/// The changes of the schema, in order.
static MIGRATOR: Migrator = sqlx::migrate!("migrations/postgres");

/// Appended to the choice of a row that is then updated: rows that another transaction holds are passed over instead of
/// waited for.
macro_rules! skip_locked {
    () => {
        " FOR NO KEY UPDATE OF candidate SKIP LOCKED"
    };
}

/// The texts of the JSON array that is bound to a parameter, as a subquery.
macro_rules! json_texts {
    ($parameter:literal) => {
        concat!("(SELECT jsonb_array_elements_text(CAST(", $parameter, " AS JSONB)))")
    };
}

#[path = "backend/mod.rs"]
mod backend;

/// How long a statement waits for a connection.
const ACQUIRE_TIMEOUT: Duration = Duration::from_secs(20);
/// Maximum number of connections of one process.
const MAX_CONNECTIONS: u32 = 10;
/// Milliseconds since 1970 by the server's clock.
const CLOCK: Option<&str> = Some("SELECT CAST(EXTRACT(EPOCH FROM clock_timestamp()) * 1000 AS BIGINT)");
/// Ends the sessions of a process that lost its network, and their locks, after half a minute. The defaults are hours.
const SESSION_SETTINGS: &str = "\
    SET idle_in_transaction_session_timeout = '30s'; SET tcp_keepalives_idle = 15; \
    SET tcp_keepalives_interval = 5; SET tcp_keepalives_count = 3";
/// The lock under which jobs are queued and claimed: any number, as long as nothing else in the database takes it.
const QUEUE_LOCK: i64 = 0x6865_6c69_6f6d_6170;
/// The channel on which workers are notified of work.
const WORK: &str = "heliomap_work";
/// Pause before listening again after a lost connection.
const LISTEN_AGAIN: Duration = Duration::from_secs(10);

/// The rows in a Postgres database.
#[derive(Debug, Clone)]
pub struct PostgresStore {
    read: Connections<Db>,
    write: Connections<Db>,
}

impl PostgresStore {
    /// Opens the database at a URL and brings its schema up to date, one process at a time.
    pub async fn open(url: &str) -> Result<Self, StoreError> {
        let options = PgPoolOptions::new().max_connections(MAX_CONNECTIONS).acquire_timeout(ACQUIRE_TIMEOUT);
        let options = options.after_connect(|connection, _| {
            Box::pin(async move { sqlx::raw_sql(SESSION_SETTINGS).execute(&mut *connection).await.map(drop) })
        });
        let pool = options.connect(url).await?;
        MIGRATOR.run(&pool).await?;
        let pool = Connections::from(pool);
        Ok(Self { read: pool.clone(), write: pool })
    }

    /// Whether the connection to the database at a URL is safe from eavesdropping and tampering: the database is on this
    /// machine, or the connection is encrypted and its certificate checked.
    pub fn is_guarded(url: &str) -> Result<bool, StoreError> {
        let options: PgConnectOptions = url.parse()?;
        let host = options.get_host();
        let here = host == "localhost" || host.parse().is_ok_and(|address: IpAddr| address.is_loopback());
        let is_checked = matches!(options.get_ssl_mode(), PgSslMode::VerifyCa | PgSslMode::VerifyFull);
        Ok(here || host.starts_with('/') || options.get_socket().is_some() || is_checked)
    }

    /// Opens the database at a URL and leaves its schema as it is: another version of the program may be using it.
    async fn open_as_it_is(url: &str) -> Result<Self, StoreError> {
        let options = PgPoolOptions::new().max_connections(1).acquire_timeout(ACQUIRE_TIMEOUT / 4);
        let pool = Connections::from(options.connect(url).await?);
        Ok(Self { read: pool.clone(), write: pool })
    }

    /// Ends all connections.
    async fn close(&self) {
        self.read.pool().close().await;
    }

    /// Name, open and idle connections of each pool.
    fn sizes(&self) -> Vec<(&'static str, u32, usize)> {
        vec![("all", self.read.pool().size(), self.read.pool().num_idle())]
    }

    async fn begin_any_schema(&self) -> Result<Tx, StoreError> {
        Ok(self.write.begin("BEGIN").await?)
    }

    /// A transaction that looks at the whole queue: no other runs beside it.
    async fn begin_alone(&self) -> Result<Tx, StoreError> {
        let mut tx = self.begin().await?;
        sqlx::query("SELECT pg_advisory_xact_lock($1)").bind(QUEUE_LOCK).execute(&mut *tx).await?;
        Ok(tx)
    }

    /// Notifies at every message of [`notify_workers`], from any process.
    async fn listen(&self, work_notify: &Notify) {
        loop {
            if let Err(error) = self.listen_once(work_notify).await {
                tracing::warn!(%error, "listening for work failed; workers poll until it is back");
            }
            tokio::time::sleep(LISTEN_AGAIN).await;
        }
    }

    /// Listens until the connection is lost.
    async fn listen_once(&self, work_notify: &Notify) -> Result<(), sqlx::Error> {
        let mut listener = PgListener::connect_with(self.read.pool()).await?;
        listener.listen(WORK).await?;
        loop {
            listener.recv().await?;
            work_notify.notify_one();
        }
    }
}

/// Notifies all listening workers, when the transaction is committed, that there may be work.
async fn notify_workers(tx: &mut Tx) -> Result<(), StoreError> {
    sqlx::query("SELECT pg_notify($1, '')").bind(WORK).execute(&mut **tx).await?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn guarded_connections() {
        for (url, guarded) in [
            ("postgres://u:p@127.0.0.1/d", true),
            ("postgres://u:p@localhost/d?sslmode=disable", true),
            ("postgres:///d?host=/run/postgresql", true),
            ("postgres://u:p@db.example.org/d?sslmode=verify-full", true),
            ("postgres://u:p@db.example.org/d?sslmode=verify-ca&sslrootcert=ca.pem", true),
            ("postgres://u:p@db.example.org/d?sslmode=require", false),
            ("postgres://u:p@db.example.org/d", false),
            ("postgres://u:p@10.0.0.7/d?sslmode=prefer", false),
        ] {
            assert_eq!(PostgresStore::is_guarded(url).unwrap(), guarded, "{url}");
        }
        assert!(PostgresStore::is_guarded("postgres://u:p@h/d?sslmode=always").is_err());
    }
}
