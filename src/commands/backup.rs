//! `heliomap backup`, `restore` and `verify`: the data of the service, with every blob checked.

use super::output::print;
use super::{ROWS, open_blobs, open_storage_there, run_async};
use anyhow::{Context, bail, ensure};
use futures::{Stream, TryStreamExt, stream};
use heliomap::config::{BackupArgs, RestoreArgs, StorageArgs, VerifyArgs};
use heliomap::store::schema::Schema;
use heliomap::store::{BlobRecord, Blobs, Digest, PlantStore, SqliteStore, StagedFile, Store, UploadStore};
use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::pin::pin;

/// Written last: a backup without it is incomplete.
const MANIFEST: &str = "backup.json";
/// Blobs that are looked up at once.
const LOOKS_AT_ONCE: usize = 16;
/// Blobs whose records are read at once.
const PAGE: u32 = 1000;
/// Blobs with which something is wrong that are named.
const NAMED: usize = 10;

/// What a backup holds.
#[derive(Debug, Serialize, Deserialize)]
struct Manifest {
    /// The program that made it.
    version: String,
    created: Timestamp,
    blobs: u64,
    /// Of the blobs.
    bytes: u64,
}

/// Makes a backup of a service that may be running.
pub fn backup(args: BackupArgs) -> anyhow::Result<()> {
    run_async(async {
        only_sqlite(&args.storage, "make a backup of a Postgres database with pg_dump")?;
        let folder = new_folder(&args.folder)?;
        let rows = args.storage.data_dir.join(ROWS);
        ensure!(rows.is_file(), "there is no {}: name the service's data folder with --data-dir", rows.display());
        let (live, blobs) = (SqliteStore::open_as_it_is(&rows).await?, open_blobs(&args.storage).await?);
        let target = folder.join(ROWS);
        live.snapshot(&target).await.context("copying the database")?;
        // An older version's copy is brought up to date, and not what that version is at work with.
        if SqliteStore::examine(&target).await?.schema == Schema::Ahead {
            std::fs::remove_file(&target)?;
            bail!("the database is of a newer version of heliomap: make the backup by that version's program");
        }
        // Bytes of uploads that are not whole stay behind: clients begin these anew.
        let snapshot = SqliteStore::open(&target).await?;
        snapshot.delete_expired_uploads(Timestamp::MAX).await?;
        let (mut count, mut bytes) = (0, 0);
        let mut recorded = pin!(recorded(&snapshot));
        while let Some(blob) = recorded.try_next().await? {
            let place = folder.join(place(&blob));
            let parent = place.parent().context("a blob lies in a folder")?;
            std::fs::create_dir_all(parent).with_context(|| format!("creating {}", parent.display()))?;
            match blobs.copy(blob.plant, blob.sha256, &place).await {
                Ok(()) => {
                    sync(&place)?;
                    count += 1;
                    bytes += blob.size;
                }
                // Its plant was deleted meanwhile: that holds here, too.
                Err(_) if live.plant(blob.plant).await.is_ok_and(|plant| plant.is_none()) => {
                    snapshot.delete_plant(blob.plant, Timestamp::now()).await?;
                }
                Err(error) => {
                    return Err(error).context("a blob cannot be copied; `heliomap verify` lists all such");
                }
            }
        }
        snapshot.close().await;
        live.close().await;
        let _ = std::fs::remove_file(target.with_extension("lock"));
        sync(&target)?;
        let manifest =
            Manifest { version: env!("CARGO_PKG_VERSION").to_owned(), created: Timestamp::now(), blobs: count, bytes };
        write_synced(&folder.join(MANIFEST), &serde_json::to_vec_pretty(&manifest)?)?;
        sync(folder)?;
        print(format_args!("{count} blobs of {bytes} bytes and their rows are in {}\n", folder.display()))
    })
}

/// Makes a data folder of a backup; a folder that has rows is left alone, and rows come only after all their blobs.
pub fn restore(args: RestoreArgs) -> anyhow::Result<()> {
    run_async(async {
        only_sqlite(&args.storage, "bring a Postgres database back with pg_restore")?;
        let manifest = args.folder.join(MANIFEST);
        let manifest = match std::fs::read(&manifest) {
            Ok(text) => serde_json::from_slice::<Manifest>(&text)
                .with_context(|| format!("{} is not what `heliomap backup` writes", manifest.display()))?,
            Err(error) if error.kind() == ErrorKind::NotFound => {
                bail!("{} is not a complete backup: it has no {MANIFEST}", args.folder.display())
            }
            Err(error) => return Err(error).with_context(|| format!("reading {}", manifest.display())),
        };
        let data = &args.storage.data_dir;
        let rows = data.join(ROWS);
        ensure!(!rows.exists(), "{} has a database already: name a new folder with --data-dir", data.display());
        std::fs::create_dir_all(data).with_context(|| format!("creating {}", data.display()))?;
        let blobs = open_blobs(&args.storage).await?;
        // A journal of a database that is not here any more would be taken for the new one's.
        let coming = data.join("heliomap.restoring");
        for name in [&rows, &coming] {
            remove_journals(name)?;
        }
        remove(&coming)?;
        sync(data)?;
        std::fs::copy(args.folder.join(ROWS), &coming).with_context(|| format!("copying {ROWS}"))?;
        let store = SqliteStore::open(&coming).await.context("the backup's database cannot be read")?;
        let taken = take_blobs(&store, &blobs, &args.folder).await;
        store.close().await;
        let _ = std::fs::remove_file(coming.with_extension("lock"));
        let count = match taken {
            Ok(count) => count,
            Err(error) => {
                let _ = std::fs::remove_file(&coming);
                return Err(error);
            }
        };
        ensure!(
            count == manifest.blobs,
            "the manifest of the backup lists {} blobs, but it holds {count}",
            manifest.blobs
        );
        sync(&coming)?;
        std::fs::rename(&coming, &rows).with_context(|| format!("renaming {}", coming.display()))?;
        sync(data)?;
        print(format_args!("restored {count} blobs and their rows, as of {}\n", manifest.created))
    })
}

/// Removes the logs that SQLite keeps beside a database file.
fn remove_journals(database: &Path) -> anyhow::Result<()> {
    for ending in ["-wal", "-shm", "-journal"] {
        let mut name = database.as_os_str().to_owned();
        name.push(ending);
        remove(Path::new(&name))?;
    }
    Ok(())
}

/// Removes a file that may not be there.
fn remove(file: &Path) -> anyhow::Result<()> {
    match std::fs::remove_file(file) {
        Err(error) if error.kind() != ErrorKind::NotFound => {
            Err(error).with_context(|| format!("removing {}", file.display()))
        }
        _ => Ok(()),
    }
}

/// Stores all blobs that the rows name, from a backup; how many.
async fn take_blobs(store: &dyn Store, blobs: &Blobs, backup: &Path) -> anyhow::Result<u64> {
    let mut count = 0;
    let mut recorded = pin!(recorded(store));
    while let Some(blob) = recorded.try_next().await? {
        let source = backup.join(place(&blob));
        let staged = tempfile::Builder::new().prefix("restore-").tempfile_in(blobs.staging())?.into_temp_path();
        std::fs::copy(&source, &staged).with_context(|| format!("the backup lacks {}", source.display()))?;
        let sha256 = Digest::of_file(&staged)?;
        ensure!(sha256 == blob.sha256, "{} is damaged: it holds other bytes", source.display());
        sync(&staged)?;
        blobs.put_file(blob.plant, StagedFile { path: staged, size: blob.size, sha256 }).await?;
        count += 1;
    }
    Ok(count)
}

/// Checks that every blob that the rows name is there.
pub fn verify(args: VerifyArgs) -> anyhow::Result<()> {
    run_async(async {
        let (store, blobs) = open_storage_there(&args.storage).await?;
        let (blobs, content) = (&blobs, args.content);
        let looks = recorded(&*store).map_ok(|blob| async move {
            let fault = blobs.check(blob.plant, blob.sha256, blob.size, content).await?;
            anyhow::Ok(fault.map(|fault| format!("plant {}, blob {}: {fault}", blob.plant, blob.sha256)))
        });
        let looked: Vec<Option<String>> = looks.try_buffered(LOOKS_AT_ONCE).try_collect().await?;
        let count = looked.len();
        let wrong: Vec<String> = looked.into_iter().flatten().collect();
        for fault in wrong.iter().take(NAMED) {
            print(format_args!("{fault}\n"))?;
        }
        ensure!(
            wrong.is_empty(),
            "{} of {count} blobs are not as they were stored: put them back from a backup",
            wrong.len()
        );
        print(format_args!("all {count} blobs are there\n"))
    })
}

/// All blobs that the rows name.
fn recorded(store: &dyn Store) -> impl Stream<Item = anyhow::Result<BlobRecord>> + '_ {
    let pages = stream::try_unfold(None, move |after| async move {
        let page = store.blobs(after, PAGE).await?;
        let last = page.last().map(|last| (last.plant, last.sha256));
        anyhow::Ok(last.map(|last| (stream::iter(page.into_iter().map(anyhow::Ok)), Some(last))))
    });
    pages.try_flatten()
}

/// Where a blob lies in a backup, as in a data folder.
fn place(blob: &BlobRecord) -> PathBuf {
    let digest = blob.sha256.to_string();
    PathBuf::from(format!("blobs/plants/{}/{}/{digest}", blob.plant, &digest[..2]))
}

fn only_sqlite(storage: &StorageArgs, what: &str) -> anyhow::Result<()> {
    ensure!(
        storage.database.is_none(),
        "{what} and its blobs with the tools of their store; docs/OPERATION.md shows how"
    );
    Ok(())
}

/// A folder that is new, or empty.
fn new_folder(folder: &Path) -> anyhow::Result<&Path> {
    std::fs::create_dir_all(folder).with_context(|| format!("creating {}", folder.display()))?;
    let empty = std::fs::read_dir(folder).with_context(|| format!("reading {}", folder.display()))?.next().is_none();
    ensure!(empty, "{} is not empty: every backup has a folder of its own", folder.display());
    Ok(folder)
}

fn write_synced(path: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    let mut file = std::fs::File::create(path).with_context(|| format!("creating {}", path.display()))?;
    file.write_all(bytes).and_then(|()| file.sync_all()).with_context(|| format!("writing {}", path.display()))
}

/// Makes a file or folder durable.
fn sync(path: &Path) -> anyhow::Result<()> {
    let synced = std::fs::File::open(path).and_then(|file| file.sync_all());
    synced.with_context(|| format!("syncing {}", path.display()))
}
