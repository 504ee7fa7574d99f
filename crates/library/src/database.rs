//! SQLite or PostgreSQL, with one schema and the same SQL.
//!
//! Statements use the common subset. This module handles the differences: beginning a transaction, locking a row, and reading the time.

use std::path::Path;
use std::time::Duration;

use sqlx::any::{AnyPoolOptions, AnyQueryResult, install_default_drivers};
use sqlx::{Any, AnyConnection, AnyPool, AssertSqlSafe, Connection as _, Executor as _, Transaction};

use crate::Millis;
use crate::change_notifications::{CHANNEL, Event, Events};
use crate::error::{LibraryError, Result};
use crate::ids::PhotoId;

/// Migrations; each runs once, in this order.
const MIGRATIONS: [&str; 1] = [include_str!("../migrations/1.sql")];
/// Reading connections of SQLite, and connections of a node to PostgreSQL.
const READERS: u32 = 4;
const CONNECTIONS: u32 = 10;
/// Idle time after which PostgreSQL ends a transaction.
const ABANDONED: Duration = Duration::from_secs(5);
/// Longest wait for a connection, or for another writing process.
const WAIT: Duration = Duration::from_secs(10);

/// PostgreSQL's advisory locks. SQLite has a single writer and needs none.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Lock {
    Migrations = 0x746d_7069,
    Queue,
    Secret,
    Webhooks,
    Deliveries,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    Sqlite,
    Postgres,
}

#[derive(Clone, Debug)]
pub(crate) struct Database {
    kind: Kind,
    writer: AnyPool,
    reader: AnyPool,
    events: Events,
    /// Offset of the database's clock in tests, in milliseconds.
    #[cfg(test)]
    pub skew: std::sync::Arc<std::sync::atomic::AtomicI64>,
}

/// Percent-encodes a path for a URL.
fn url_of(path: &Path) -> Result<String> {
    let text = path.to_str().ok_or_else(|| LibraryError::Invalid(format!("{} is not UTF-8", path.display())))?;
    let encoded: String = text
        .bytes()
        .map(|b| if b.is_ascii_alphanumeric() || b"/._-~\\:".contains(&b) { char::from(b).to_string() } else { format!("%{b:02X}") })
        .collect();
    Ok(format!("sqlite://{encoded}?mode=rwc"))
}

/// Opens one writing connection, and some for concurrent reading.
async fn sqlite(path: &Path) -> Result<(AnyPool, AnyPool)> {
    let url = url_of(path)?;
    let pool = |connections: u32, more: &'static str| {
        let options = AnyPoolOptions::new().max_connections(connections).acquire_timeout(WAIT);
        // SQLite connections do not go stale
        let options = options.test_before_acquire(false).idle_timeout(None).max_lifetime(None);
        // when a disk is full, SQLite ends a transaction by itself; sqlx does not notice, and the connection could begin no other
        let options = options.before_acquire(|connection, _| {
            let usable = !connection.is_in_transaction();
            Box::pin(async move { Ok(usable) })
        });
        options.after_connect(move |connection, _| {
            Box::pin(async move {
                let busy = WAIT.as_millis();
                let pragmas = format!(
                    "PRAGMA busy_timeout = {busy}; PRAGMA journal_mode = WAL; PRAGMA synchronous = FULL; PRAGMA foreign_keys = ON; {more}"
                );
                connection.execute(sqlx::raw_sql(AssertSqlSafe(pragmas))).await.map(drop)
            })
        })
    };
    let writer = pool(1, "").connect(&url).await?;
    let reader = pool(READERS, "PRAGMA query_only = ON").connect(&url).await?;
    Ok((writer, reader))
}

impl Database {
    /// Opens SQLite at `path`.
    pub async fn sqlite(path: &Path) -> Result<Self> {
        install_default_drivers();
        let (writer, reader) = sqlite(path).await?;
        Self::ready(Kind::Sqlite, writer, reader, Events::open(None).await?).await
    }

    /// Opens PostgreSQL at `url`.
    pub async fn postgres(url: &str) -> Result<Self> {
        install_default_drivers();
        let options = AnyPoolOptions::new().max_connections(CONNECTIONS).acquire_timeout(WAIT);
        // a transaction whose future was dropped holds its locks until this timeout
        let options = options.after_connect(|connection, _| {
            Box::pin(async move {
                let timeout = format!("SET idle_in_transaction_session_timeout = {}", ABANDONED.as_millis());
                connection.execute(sqlx::raw_sql(AssertSqlSafe(timeout))).await.map(drop)
            })
        });
        let pool = options.connect(url).await?;
        Self::ready(Kind::Postgres, pool.clone(), pool, Events::open(Some(url)).await?).await
    }

    async fn ready(kind: Kind, writer: AnyPool, reader: AnyPool, events: Events) -> Result<Self> {
        let database = Self {
            kind,
            writer,
            reader,
            events,
            #[cfg(test)]
            skew: std::sync::Arc::default(),
        };
        database.migrate().await?;
        Ok(database)
    }

    /// Migrates the schema, one node at a time.
    async fn migrate(&self) -> Result<()> {
        let begin = if self.kind == Kind::Sqlite { "BEGIN EXCLUSIVE" } else { "BEGIN" };
        let mut transaction = self.writer.begin_with(begin).await?;
        if self.kind == Kind::Postgres {
            sqlx::query("SELECT pg_advisory_xact_lock($1)").bind(Lock::Migrations as i64).execute(&mut *transaction).await?;
        }
        transaction.execute(sqlx::raw_sql("CREATE TABLE IF NOT EXISTS migrations (version BIGINT PRIMARY KEY)")).await?;
        let latest = sqlx::query_scalar("SELECT COALESCE(MAX(version), 0) FROM migrations");
        let version = latest.fetch_one(&mut *transaction).await.map(|version: i64| version as usize)?;
        if version > MIGRATIONS.len() {
            let known = MIGRATIONS.len();
            return Err(LibraryError::Invalid(format!("the database has schema {version}, but this program supports only up to {known}")));
        }
        for (n, migration) in MIGRATIONS.into_iter().enumerate().skip(version) {
            transaction.execute(sqlx::raw_sql(migration)).await?;
            sqlx::query("INSERT INTO migrations (version) VALUES ($1)").bind(n as i64 + 1).execute(&mut *transaction).await?;
        }
        Ok(transaction.commit().await?)
    }

    /// The pool for read-only statements.
    pub const fn reader(&self) -> &AnyPool {
        &self.reader
    }

    pub const fn events(&self) -> &Events {
        &self.events
    }

    /// The database's time.
    pub async fn now(&self) -> Result<Millis> {
        Ok(self.skewed(sqlx::query_scalar(self.clock()).fetch_one(&self.reader).await?))
    }

    const fn clock(&self) -> &'static str {
        match self.kind {
            Kind::Sqlite => "SELECT CAST(unixepoch('subsec') * 1000 AS INTEGER)",
            Kind::Postgres => "SELECT CAST(EXTRACT(EPOCH FROM clock_timestamp()) * 1000 AS BIGINT)",
        }
    }

    #[cfg(test)]
    fn skewed(&self, now: Millis) -> Millis {
        now + self.skew.load(std::sync::atomic::Ordering::SeqCst)
    }

    #[cfg(not(test))]
    #[allow(clippy::unused_self, reason = "tests shift the clock")]
    const fn skewed(&self, now: Millis) -> Millis {
        now
    }

    /// Begins a writing transaction, which is rolled back if dropped.
    pub async fn write(&self) -> Result<Tx> {
        let begin = if self.kind == Kind::Sqlite { "BEGIN IMMEDIATE" } else { "BEGIN" };
        let mut inner = self.writer.begin_with(begin).await?;
        let now = sqlx::query_scalar(self.clock()).fetch_one(&mut *inner).await?;
        Ok(Tx { inner, now: self.skewed(now), database: self.clone(), events: Vec::new() })
    }

    /// Sends an event without a transaction.
    pub async fn notify(&self, event: Event) -> Result<()> {
        if self.kind == Kind::Postgres {
            sqlx::query("SELECT pg_notify($1, $2)").bind(CHANNEL).bind(Events::payload(&event)?).execute(&self.writer).await?;
        }
        self.events.committed(vec![event]);
        Ok(())
    }

    /// Closes all connections.
    pub async fn close(&self) {
        self.reader.close().await;
        self.writer.close().await;
    }
}

#[derive(Debug)]
pub(crate) struct Tx {
    inner: Transaction<'static, Any>,
    /// When it began.
    pub now: Millis,
    database: Database,
    events: Vec<Event>,
}

impl Tx {
    /// The connection for statements.
    pub fn connection(&mut self) -> &mut AnyConnection {
        &mut self.inner
    }

    /// Whether the database supports and needs `FOR UPDATE SKIP LOCKED`.
    pub fn has_row_locks(&self) -> bool {
        self.database.kind == Kind::Postgres
    }

    /// Holds a lock until the transaction ends; does nothing in SQLite, which has a single writer.
    pub async fn lock(&mut self, lock: Lock) -> Result<()> {
        if self.has_row_locks() {
            sqlx::query("SELECT pg_advisory_xact_lock($1)").bind(lock as i64).execute(self.connection()).await?;
        }
        Ok(())
    }

    /// Locks the rows of a photo's jobs, in a fixed order.
    pub async fn lock_jobs(&mut self, photo: PhotoId) -> Result<()> {
        if self.has_row_locks() {
            let select = sqlx::query("SELECT id FROM jobs WHERE photo = $1 ORDER BY id FOR UPDATE").bind(photo.to_string());
            select.fetch_all(self.connection()).await?;
        }
        Ok(())
    }

    /// Inserts the row of an owner if it is missing, and locks it.
    pub async fn lock_owner(&mut self, owner: &str) -> Result<()> {
        let insert = sqlx::query("INSERT INTO owners (owner, created_at) VALUES ($1, $2) ON CONFLICT (owner) DO NOTHING");
        insert.bind(owner).bind(self.now).execute(self.connection()).await?;
        if self.has_row_locks() {
            sqlx::query("SELECT owner FROM owners WHERE owner = $1 FOR UPDATE").bind(owner).fetch_optional(self.connection()).await?;
        }
        Ok(())
    }

    /// Sends an event when the transaction commits.
    pub fn notify(&mut self, event: Event) {
        self.events.push(event);
    }

    /// Rolls back at once; a dropped transaction holds its locks until its connection is used again.
    pub async fn rollback(self) {
        // a broken connection has no locks
        let _ = self.inner.rollback().await;
    }

    /// Commits, and sends the events.
    pub async fn commit(mut self) -> Result<()> {
        let events = std::mem::take(&mut self.events);
        if self.has_row_locks() {
            for event in &events {
                let payload = Events::payload(event)?;
                sqlx::query("SELECT pg_notify($1, $2)").bind(CHANNEL).bind(payload).execute(self.connection()).await?;
            }
        }
        self.inner.commit().await?;
        self.database.events.committed(events);
        Ok(())
    }
}

/// Whether an update, which matches the token of a lease or its like, has found its row.
pub(crate) fn is_held(updated: &AnyQueryResult) -> Result<()> {
    if updated.rows_affected() == 0 { Err(LibraryError::LeaseLost) } else { Ok(()) }
}
