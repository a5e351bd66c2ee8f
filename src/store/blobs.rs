//! Bytes: content-addressed within a plant, so that what is stored once is never half-written, a plant's deletion
//! deletes everything of it, and nobody learns from an upload what another plant holds.

use super::{StoreError, UploadId};
use crate::plant::PlantId;
use futures::TryStreamExt;
use object_store::local::LocalFileSystem;
use object_store::path::Path as Key;
use object_store::{ObjectStore, ObjectStoreExt};
use sha2::Digest as _;
use std::collections::HashSet;
use std::fmt;
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::sync::Arc;
use std::time::Duration;
use tempfile::TempPath;
use tokio::io::AsyncWriteExt;

/// A SHA-256 digest.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Digest(pub [u8; 32]);

impl Digest {
    /// The digest of some bytes.
    pub fn of(bytes: &[u8]) -> Self {
        Self(sha2::Sha256::digest(bytes).into())
    }

    /// The digest of a file, which is read in parts.
    pub fn of_file(path: &Path) -> std::io::Result<Self> {
        let mut file = BufReader::with_capacity(1 << 20, std::fs::File::open(path)?);
        let mut hasher = sha2::Sha256::new();
        loop {
            let bytes = file.fill_buf()?;
            if bytes.is_empty() {
                return Ok(Self(hasher.finalize().into()));
            }
            hasher.update(bytes);
            let count = bytes.len();
            file.consume(count);
        }
    }
}

impl fmt::Display for Digest {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

impl FromStr for Digest {
    type Err = ();

    fn from_str(text: &str) -> Result<Self, ()> {
        if text.len() != 64 || !text.bytes().all(|b| b.is_ascii_hexdigit()) {
            return Err(());
        }
        let mut digest = [0; 32];
        for (byte, pair) in digest.iter_mut().zip(text.as_bytes().chunks(2)) {
            let pair = std::str::from_utf8(pair).map_err(|_| ())?;
            *byte = u8::from_str_radix(pair, 16).map_err(|_| ())?;
        }
        Ok(Self(digest))
    }
}

/// A whole file on local disk that is not stored yet; it is deleted with this value.
#[derive(Debug)]
pub struct StagedFile {
    pub path: TempPath,
    /// Bytes.
    pub size: u64,
    pub sha256: Digest,
}

/// The blob store.
#[derive(Debug, Clone)]
pub struct Blobs {
    store: Arc<dyn ObjectStore>,
    /// Where the store is a folder of this machine: a staged file is renamed into it, and a blob is handed out as a
    /// hard link, without copying either.
    local: Option<PathBuf>,
    staging: PathBuf,
    uploads: PathBuf,
}

impl Blobs {
    /// Blobs in the folder `blobs` of a data folder, files on their way in `incoming`, uploads that may be resumed in
    /// `uploads`.
    pub fn in_folder(data: &Path) -> Result<Self, StoreError> {
        let (root, staging, uploads) = (data.join("blobs"), data.join("incoming"), data.join("uploads"));
        for folder in [&root, &staging, &uploads] {
            std::fs::create_dir_all(folder).map_err(io("create the folder", folder))?;
        }
        let root = root.canonicalize().map_err(io("open the folder", &root))?;
        let store = LocalFileSystem::new_with_prefix(&root)?;
        Ok(Self { store: Arc::new(store), local: Some(root), staging, uploads })
    }

    /// The local folder for files on their way in and for the folders of running jobs.
    pub fn staging(&self) -> &Path {
        &self.staging
    }

    /// Where the bytes of an upload that may be resumed lie until they are whole.
    pub fn upload_file(&self, id: UploadId) -> PathBuf {
        self.uploads.join(id.to_string())
    }

    /// Deletes the bytes of uploads that are not known, but for those so young that they may be just beginning.
    pub async fn sweep_uploads(&self, known: HashSet<UploadId>, young: Duration) -> Result<(), StoreError> {
        let known: HashSet<String> = known.iter().map(UploadId::to_string).collect();
        let uploads = self.uploads.clone();
        run_blocking("clean the folder", uploads.clone(), move || {
            for entry in std::fs::read_dir(&uploads)? {
                let entry = entry?;
                let old = entry.metadata()?.modified()?.elapsed().is_ok_and(|age| age > young);
                if old && !entry.file_name().to_str().is_some_and(|name| known.contains(name)) {
                    std::fs::remove_file(entry.path())?;
                }
            }
            Ok(())
        })
        .await
    }

    /// Deletes what crashes left among the files on their way in: whatever nobody touched for so long.
    pub async fn sweep_staging(&self, untouched: Duration) -> Result<(), StoreError> {
        let staging = self.staging.clone();
        run_blocking("clean the folder", staging.clone(), move || {
            for entry in std::fs::read_dir(&staging)? {
                let entry = entry?;
                let metadata = entry.metadata()?;
                if metadata.modified()?.elapsed().is_ok_and(|age| age > untouched) {
                    match metadata.is_dir() {
                        true => std::fs::remove_dir_all(entry.path())?,
                        false => std::fs::remove_file(entry.path())?,
                    }
                }
            }
            Ok(())
        })
        .await
    }

    /// Stores a staged file in a plant; it appears as a whole or not at all. Storing the same bytes again is harmless.
    pub async fn put_file(&self, plant: PlantId, file: StagedFile) -> Result<(), StoreError> {
        let key = key(plant, file.sha256);
        match &self.local {
            Some(root) => {
                let target = root.join(key.as_ref());
                run_blocking("store the file", target.clone(), move || move_into_place(file.path, &target)).await
            }
            None => {
                let mut upload = object_store::buffered::BufWriter::new(self.store.clone(), key);
                let mut source = tokio::fs::File::open(&file.path).await.map_err(io("open", &file.path))?;
                tokio::io::copy(&mut source, &mut upload).await.map_err(io("store", &file.path))?;
                upload.shutdown().await.map_err(io("store", &file.path))
            }
        }
    }

    /// Stores bytes in a plant.
    pub async fn put_bytes(&self, plant: PlantId, bytes: Vec<u8>) -> Result<Digest, StoreError> {
        let staging = self.staging.clone();
        let staged = run_blocking("write a file in", staging.clone(), move || {
            let mut file = tempfile::Builder::new().prefix("blob-").tempfile_in(&staging)?;
            file.write_all(&bytes)?;
            file.as_file().sync_all()?;
            Ok(StagedFile { path: file.into_temp_path(), size: bytes.len() as u64, sha256: Digest::of(&bytes) })
        })
        .await?;
        let sha256 = staged.sha256;
        self.put_file(plant, staged).await?;
        Ok(sha256)
    }

    /// All bytes of a blob.
    pub async fn get(&self, plant: PlantId, sha256: Digest) -> Result<bytes::Bytes, StoreError> {
        Ok(self.store.get(&key(plant, sha256)).await?.bytes().await?)
    }

    /// Makes a blob appear as the file `target`, which must not be written to.
    pub async fn place(&self, plant: PlantId, sha256: Digest, target: &Path) -> Result<(), StoreError> {
        let key = key(plant, sha256);
        if let Some(root) = &self.local {
            let source = root.join(key.as_ref());
            if tokio::fs::hard_link(&source, target).await.is_ok() {
                return Ok(());
            }
        }
        let mut file = tokio::fs::File::create(target).await.map_err(io("create", target))?;
        let mut chunks = self.store.get(&key).await?.into_stream();
        while let Some(chunk) = chunks.try_next().await? {
            file.write_all(&chunk).await.map_err(io("write", target))?;
        }
        file.flush().await.map_err(io("write", target))
    }

    /// Deletes everything of a plant.
    pub async fn delete_plant(&self, plant: PlantId) -> Result<(), StoreError> {
        if let Some(root) = &self.local {
            let folder = root.join(format!("plants/{plant}"));
            return match tokio::fs::remove_dir_all(&folder).await {
                Err(error) if error.kind() != std::io::ErrorKind::NotFound => Err(io("delete", &folder)(error)),
                _ => Ok(()),
            };
        }
        let prefix = Key::from(format!("plants/{plant}"));
        let keys = self.store.list(Some(&prefix)).map_ok(|object| object.location);
        self.store.delete_stream(Box::pin(keys)).try_for_each(|_| async { Ok(()) }).await?;
        Ok(())
    }

    /// Free bytes for those who are not root on the disk that takes what comes in.
    pub fn free_bytes(&self) -> Result<u64, StoreError> {
        let found = rustix::fs::statvfs(&self.staging);
        let found = found.map_err(|error| io("look for free space in", &self.staging)(error.into()))?;
        Ok(found.f_bavail.saturating_mul(found.f_frsize))
    }

    /// Fails where the blob store does not answer.
    pub async fn ping(&self) -> Result<(), StoreError> {
        match &self.local {
            Some(root) => tokio::fs::metadata(root).await.map(drop).map_err(io("open", root)),
            None => Ok(self.store.list_with_delimiter(None).await.map(drop)?),
        }
    }
}

fn key(plant: PlantId, sha256: Digest) -> Key {
    let digest = sha256.to_string();
    Key::from(format!("plants/{plant}/{}/{digest}", &digest[..2]))
}

/// Renames a synced file to its place and makes the new name durable.
fn move_into_place(staged: TempPath, target: &Path) -> std::io::Result<()> {
    if target.exists() {
        return Ok(());
    }
    let folder = target.parent().ok_or(std::io::ErrorKind::InvalidInput)?;
    std::fs::create_dir_all(folder)?;
    // Readers get hard links to it: nobody may write to it.
    let mut permissions = std::fs::metadata(&staged)?.permissions();
    permissions.set_readonly(true);
    std::fs::set_permissions(&staged, permissions)?;
    staged.persist(target).map_err(|error| error.error)?;
    std::fs::File::open(folder)?.sync_all()
}

pub(super) fn io(action: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> StoreError {
    let path = path.to_owned();
    move |source| StoreError::Io { action, path, source }
}

async fn run_blocking<T: Send + 'static>(
    action: &'static str,
    path: PathBuf,
    work: impl FnOnce() -> std::io::Result<T> + Send + 'static,
) -> Result<T, StoreError> {
    let done = tokio::task::spawn_blocking(work).await;
    done.unwrap_or_else(|error| Err(std::io::Error::other(error))).map_err(io(action, &path))
}
