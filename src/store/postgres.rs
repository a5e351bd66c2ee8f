//! The rows in a Postgres database, which servers and workers on any number of machines share.

#[path = "backend/mod.rs"]
mod backend;

use super::StoreError;
use super::schema::Examined;
use super::sql::postgres as queues;
use sqlx::postgres::{PgConnectOptions, PgListener, PgPool, PgPoolOptions, PgSslMode};
use sqlx::{Postgres, Transaction};
use std::net::IpAddr;
use std::time::Duration;
use tokio::sync::Notify;

use PostgresStore as Rows;
use sqlx::postgres::PgRow as Row;
type Db = Postgres;
type Tx = Transaction<'static, Db>;

/// How long a statement waits for a connection.
const ACQUIRE_TIMEOUT: Duration = Duration::from_secs(20);
/// Most connections of one process.
const MAX_CONNECTIONS: u32 = 10;
/// Milliseconds since 1970 by the server's clock.
const CLOCK: Option<&str> = Some("SELECT CAST(EXTRACT(EPOCH FROM clock_timestamp()) * 1000 AS BIGINT)");
/// Where a process is cut off, the server ends its sessions and what they have locked after half a minute: by itself it
/// would wait for hours.
const LET_GO: &str = "\
    SET idle_in_transaction_session_timeout = '30s'; SET tcp_keepalives_idle = 15; \
    SET tcp_keepalives_interval = 5; SET tcp_keepalives_count = 3";
/// The lock under which jobs are queued and claimed: any number, as long as nothing else in the database takes it.
const QUEUE_LOCK: i64 = 0x6865_6c69_6f6d_6170;
/// The channel on which workers hear that there may be work.
const WORK: &str = "heliomap_work";
/// How long after a lost connection it is listened again.
const LISTEN_AGAIN: Duration = Duration::from_secs(10);

/// The rows in a Postgres database.
#[derive(Debug, Clone)]
pub struct PostgresStore {
    read: PgPool,
    write: PgPool,
}

impl PostgresStore {
    /// Opens the database at a URL and brings its schema up to date, one process at a time.
    pub async fn open(url: &str) -> Result<Self, StoreError> {
        let options = PgPoolOptions::new().max_connections(MAX_CONNECTIONS).acquire_timeout(ACQUIRE_TIMEOUT);
        let options = options.after_connect(|connection, _| {
            Box::pin(async move { sqlx::raw_sql(LET_GO).execute(&mut *connection).await.map(drop) })
        });
        let pool = options.connect(url).await?;
        sqlx::migrate!("migrations/postgres").run(&pool).await?;
        Ok(Self { read: pool.clone(), write: pool })
    }

    /// Whether nobody in between reads or changes what is said to the database at a URL: it is on this machine, or the
    /// connection is encrypted and its certificate checked.
    pub fn is_guarded(url: &str) -> Result<bool, StoreError> {
        let options: PgConnectOptions = url.parse()?;
        let host = options.get_host();
        let here = host == "localhost" || host.parse().is_ok_and(|address: IpAddr| address.is_loopback());
        let is_checked = matches!(options.get_ssl_mode(), PgSslMode::VerifyCa | PgSslMode::VerifyFull);
        Ok(here || host.starts_with('/') || options.get_socket().is_some() || is_checked)
    }

    /// Looks at the database at a URL without changing its schema.
    pub async fn examine(url: &str) -> Result<Examined, StoreError> {
        let options = PgPoolOptions::new().max_connections(1).acquire_timeout(ACQUIRE_TIMEOUT / 4);
        let pool = options.connect(url).await?;
        let rows = Self { read: pool.clone(), write: pool };
        backend::examine::examine(&rows, &sqlx::migrate!("migrations/postgres")).await
    }

    /// Name, open and idle connections of each pool.
    fn sizes(&self) -> Vec<(&'static str, u32, usize)> {
        vec![("all", self.read.size(), self.read.num_idle())]
    }

    async fn begin(&self) -> Result<Tx, StoreError> {
        Ok(self.write.begin().await?)
    }

    /// A transaction that looks at the whole queue: no other runs beside it.
    async fn begin_alone(&self) -> Result<Tx, StoreError> {
        let mut tx = self.begin().await?;
        sqlx::query("SELECT pg_advisory_xact_lock($1)").bind(QUEUE_LOCK).execute(&mut *tx).await?;
        Ok(tx)
    }

    /// Rings at every message of [`tell_of_work`], from whichever process.
    async fn listen(&self, bell: &Notify) {
        loop {
            if let Err(error) = self.listen_while_it_lasts(bell).await {
                tracing::warn!(%error, "the database tells of no work now: it is looked for now and then");
            }
            tokio::time::sleep(LISTEN_AGAIN).await;
        }
    }

    async fn listen_while_it_lasts(&self, bell: &Notify) -> Result<(), sqlx::Error> {
        let mut listener = PgListener::connect_with(&self.read).await?;
        listener.listen(WORK).await?;
        loop {
            listener.recv().await?;
            bell.notify_one();
        }
    }
}

/// Tells all that listen, when the transaction is committed, that there may be work.
async fn tell_of_work(tx: &mut Tx) -> Result<(), StoreError> {
    sqlx::query("SELECT pg_notify($1, '')").bind(WORK).execute(&mut **tx).await?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn connections_that_nobody_reads() {
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
