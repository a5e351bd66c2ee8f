//! Connections to a database of which the state is known.
//!
//! A driver counts transactions by itself, and its count goes wrong where a statement is cancelled half-way, where the
//! database rolls back on its own (a full disk, an I/O error) or where a rollback fails. A later statement on such a
//! connection fails, or succeeds inside a transaction that is never committed. So a connection goes back to its pool only
//! after the end of its transaction, or of its only statement, was seen; any other is closed, and the next caller opens a
//! new one.

use futures::future::BoxFuture;
use futures::stream::BoxStream;
use futures::{FutureExt, StreamExt, TryStreamExt, stream};
use sqlx::error::ErrorKind;
use sqlx::pool::PoolConnection;
use sqlx::{Database, Describe, Either, Error, Execute, Executor, Pool, SqlStr};
use std::ops::{Deref, DerefMut};

/// A pool whose connections run single statements, or transactions by [`Self::begin`].
#[derive(Debug)]
pub struct Connections<D: Database> {
    pool: Pool<D>,
}

impl<D: Database> Clone for Connections<D> {
    fn clone(&self) -> Self {
        Self { pool: self.pool.clone() }
    }
}

impl<D: Database> From<Pool<D>> for Connections<D> {
    fn from(pool: Pool<D>) -> Self {
        Self { pool }
    }
}

impl<D: Database> Connections<D>
where
    for<'c> &'c mut D::Connection: Executor<'c, Database = D>,
{
    /// Begins a transaction by a statement such as `BEGIN`.
    pub async fn begin(&self, statement: &'static str) -> Result<Transaction<D>, Error> {
        let mut lease = Lease::acquire(&self.pool).await?;
        sqlx::raw_sql(statement).execute(&mut *lease.connection).await?;
        Ok(Transaction { lease })
    }

    /// The pool itself, for what no statement is.
    pub fn pool(&self) -> &Pool<D> {
        &self.pool
    }
}

/// A connection that is closed where its state is not known when it is dropped.
#[derive(Debug)]
struct Lease<D: Database> {
    connection: PoolConnection<D>,
    is_known: bool,
}

impl<D: Database> Lease<D> {
    async fn acquire(pool: &Pool<D>) -> Result<Self, Error> {
        Ok(Self { connection: pool.acquire().await?, is_known: false })
    }

    /// The end of the only statement of this lease.
    fn end<T>(mut self, outcome: Result<T, Error>) -> Result<T, Error> {
        self.is_known = outcome.as_ref().err().is_none_or(leaves_connection_as_it_was);
        outcome
    }
}

impl<D: Database> Drop for Lease<D> {
    fn drop(&mut self) {
        if !self.is_known {
            self.connection.close_on_drop();
        }
    }
}

/// Whether a statement that failed so has changed nothing of its connection: it broke a rule of the schema.
fn leaves_connection_as_it_was(error: &Error) -> bool {
    match error {
        Error::Database(error) => !matches!(error.kind(), ErrorKind::Other),
        Error::RowNotFound | Error::ColumnNotFound(_) | Error::ColumnDecode { .. } | Error::Decode(_) => true,
        _ => false,
    }
}

/// A transaction that ends by [`Self::commit`] or [`Self::rollback`]. Where it is dropped before, its connection is closed,
/// which rolls it back.
#[derive(Debug)]
pub struct Transaction<D: Database> {
    lease: Lease<D>,
}

impl<D: Database> Transaction<D>
where
    for<'c> &'c mut D::Connection: Executor<'c, Database = D>,
{
    /// Keeps what the transaction has done.
    pub async fn commit(self) -> Result<(), Error> {
        self.end("COMMIT").await
    }

    /// Undoes what the transaction has done.
    pub async fn rollback(self) -> Result<(), Error> {
        self.end("ROLLBACK").await
    }

    async fn end(mut self, statement: &'static str) -> Result<(), Error> {
        sqlx::raw_sql(statement).execute(&mut *self.lease.connection).await?;
        self.lease.is_known = true;
        Ok(())
    }
}

impl<D: Database> Deref for Transaction<D> {
    type Target = D::Connection;

    fn deref(&self) -> &Self::Target {
        &self.lease.connection
    }
}

impl<D: Database> DerefMut for Transaction<D> {
    fn deref_mut(&mut self) -> &mut Self::Target {
        &mut self.lease.connection
    }
}

impl<'p, D: Database> Executor<'p> for &'_ Connections<D>
where
    for<'c> &'c mut D::Connection: Executor<'c, Database = D>,
{
    type Database = D;

    /// The rows are read to their end before the first is handed out.
    fn fetch_many<'e, 'q: 'e, E>(self, query: E) -> BoxStream<'e, Result<Either<D::QueryResult, D::Row>, Error>>
    where
        E: 'q + Execute<'q, D>,
    {
        let pool = self.pool.clone();
        let steps = async move {
            let mut lease = Lease::acquire(&pool).await?;
            let steps: Result<Vec<_>, _> = lease.connection.fetch_many(query).try_collect().await;
            lease.end(steps)
        };
        steps.into_stream().map_ok(|steps| stream::iter(steps.into_iter().map(Ok))).try_flatten().boxed()
    }

    fn fetch_optional<'e, 'q: 'e, E>(self, query: E) -> BoxFuture<'e, Result<Option<D::Row>, Error>>
    where
        E: 'q + Execute<'q, D>,
    {
        let pool = self.pool.clone();
        async move {
            let mut lease = Lease::acquire(&pool).await?;
            let row = lease.connection.fetch_optional(query).await;
            lease.end(row)
        }
        .boxed()
    }

    fn prepare_with<'e>(self, sql: SqlStr, parameters: &'e [D::TypeInfo]) -> BoxFuture<'e, Result<D::Statement, Error>>
    where
        'p: 'e,
    {
        let pool = self.pool.clone();
        async move {
            let mut lease = Lease::acquire(&pool).await?;
            let statement = lease.connection.prepare_with(sql, parameters).await;
            lease.end(statement)
        }
        .boxed()
    }

    fn describe<'e>(self, sql: SqlStr) -> BoxFuture<'e, Result<Describe<D>, Error>> {
        let pool = self.pool.clone();
        async move {
            let mut lease = Lease::acquire(&pool).await?;
            let description = lease.connection.describe(sql).await;
            lease.end(description)
        }
        .boxed()
    }
}
