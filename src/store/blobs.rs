//! Bytes, addressed by their content within a plant: a blob is never half-written, deleting a plant deletes all its blobs, and an
//! upload reveals nothing about the contents of other plants.

use super::bucket::Bucket;
use super::digest::Digest;
use super::error::StoreError;
use super::ids::UploadId;
use super::server_id::server_id;
use futures::TryStreamExt;
use heliomap_model::PlantId;
use object_store::aws::AmazonS3Builder;
use object_store::buffered::BufWriter;
use object_store::local::LocalFileSystem;
use object_store::path::Path as Key;
use object_store::{ObjectStore, ObjectStoreExt};
use sha2::Digest as _;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;
use tempfile::TempPath;
use tokio::io::AsyncWriteExt;
use tokio::sync::Semaphore;
use tokio_util::io::ReaderStream;
use uuid::Uuid;

/// Size of a part of a multipart upload to a bucket, bytes. The maximum of 10,000 parts makes 160 GiB.
const PART_BYTES: usize = 16 << 20;
/// Parts of one blob that are sent at the same time.
const PARTS_AT_ONCE: usize = 2;
/// Blobs that are sent to a bucket at the same time, which bounds memory; others wait on disk.
const SENDERS: usize = 4;
/// Size of a read from disk on the way to a bucket, bytes.
const READ_BYTES: usize = 1 << 20;

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
    pub(super) store: Arc<dyn ObjectStore>,
    /// Where the store is a folder of this machine: a staged file is renamed into it, and a blob is handed out as a
    /// hard link, without copying either.
    local: Option<PathBuf>,
    pub(super) staging: PathBuf,
    pub(super) uploads: PathBuf,
    /// The identifier of this data folder among those that share a bucket.
    pub(super) home: Option<Uuid>,
    /// One permit for each blob that may be on its way to a bucket.
    pub(super) senders: Arc<Semaphore>,
}

impl Blobs {
    /// Blobs in the folder `blobs` of a data folder, files on their way in `incoming`, uploads that may be resumed in
    /// `uploads`.
    pub fn in_folder(data: &Path) -> Result<Self, StoreError> {
        let root = data.join("blobs");
        std::fs::create_dir_all(&root).map_err(io("create the folder", &root))?;
        let root = root.canonicalize().map_err(io("open the folder", &root))?;
        let store = LocalFileSystem::new_with_prefix(&root)?;
        Self::new(Arc::new(store), Some(root), data)
    }

    /// Blobs in an S3-compatible store with these connection settings; incoming files stay in the data folder
    /// of this machine until it is whole.
    pub fn in_bucket(data: &Path, bucket: &Bucket, settings: AmazonS3Builder) -> Result<Self, StoreError> {
        Self::new(bucket.open(settings)?, None, data)
    }

    fn new(store: Arc<dyn ObjectStore>, local: Option<PathBuf>, data: &Path) -> Result<Self, StoreError> {
        let (staging, uploads) = (data.join("incoming"), data.join("uploads"));
        for folder in [&staging, &uploads] {
            std::fs::create_dir_all(folder).map_err(io("create the folder", folder))?;
        }
        let home = match &local {
            Some(_) => None,
            None => Some(server_id(data).map_err(io("name the folder", data))?),
        };
        Ok(Self { store, local, staging, uploads, home, senders: Arc::new(Semaphore::new(SENDERS)) })
    }

    /// The local folder for files on their way in and for the folders of running jobs.
    pub fn staging(&self) -> &Path {
        &self.staging
    }

    /// The identifier of this data folder, where several share a bucket.
    pub fn home(&self) -> Option<Uuid> {
        self.home
    }

    /// Where the bytes of an upload that may be resumed lie until they are whole.
    pub fn upload_file(&self, id: UploadId) -> PathBuf {
        self.uploads.join(id.to_string())
    }

    /// Deletes files that crashes left in the staging folder: those not touched for so long.
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

    /// Stores a staged file in a plant; it appears as a whole or not at all. Bytes that are there already are replaced:
    /// should they have been damaged meanwhile, they are as they were stored again.
    pub async fn put_file(&self, plant: PlantId, file: StagedFile) -> Result<(), StoreError> {
        let key = key(plant, file.sha256);
        match &self.local {
            Some(root) => {
                let target = root.join(key.as_ref());
                run_blocking("store the file", target.clone(), move || move_into_place(file.path, &target)).await
            }
            None => self.send(key, file).await,
        }
    }

    /// Sends a staged file to the bucket, in parts where it is large.
    async fn send(&self, key: Key, file: StagedFile) -> Result<(), StoreError> {
        // The semaphore is never closed.
        let _turn = self.senders.acquire().await;
        let source = tokio::fs::File::open(&file.path).await.map_err(io("open", &file.path))?;
        let mut source = ReaderStream::with_capacity(source, READ_BYTES);
        let mut upload =
            BufWriter::with_capacity(self.store.clone(), key, PART_BYTES).with_max_concurrency(PARTS_AT_ONCE);
        loop {
            let sent = match source.try_next().await {
                Ok(None) => return upload.shutdown().await.map_err(io("store", &file.path)),
                Ok(Some(bytes)) => upload.put(bytes).await.map_err(StoreError::from),
                Err(error) => Err(io("read", &file.path)(error)),
            };
            if let Err(error) = sent {
                // Else the parts that came would stay, and cost.
                let _ = upload.abort().await;
                return Err(error);
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
        let bytes = self.store.get(&key(plant, sha256)).await?.bytes().await?;
        if Digest::of(&bytes) == sha256 { Ok(bytes) } else { Err(StoreError::Damaged { plant, sha256 }) }
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
        self.copy(plant, sha256, target).await
    }

    /// Copies a blob to the new file `target` and checks it on the way.
    pub async fn copy(&self, plant: PlantId, sha256: Digest, target: &Path) -> Result<(), StoreError> {
        // Never over what is there: that may be a hard link to a blob.
        let mut file = tokio::fs::File::create_new(target).await.map_err(io("create", target))?;
        let mut chunks = self.store.get(&key(plant, sha256)).await?.into_stream();
        let mut hasher = sha2::Sha256::new();
        while let Some(chunk) = chunks.try_next().await? {
            hasher.update(&chunk);
            file.write_all(&chunk).await.map_err(io("write", target))?;
        }
        file.flush().await.map_err(io("write", target))?;
        if Digest(hasher.finalize().into()) == sha256 { Ok(()) } else { Err(StoreError::Damaged { plant, sha256 }) }
    }

    /// What is wrong with a blob of so many bytes, which is read and compared with its digest where `content` is asked
    /// for.
    pub async fn check(
        &self,
        plant: PlantId,
        sha256: Digest,
        size: u64,
        content: bool,
    ) -> Result<Option<String>, StoreError> {
        let key = key(plant, sha256);
        match self.store.head(&key).await {
            Ok(there) if there.size != size => return Ok(Some(format!("it has {} bytes, not {size}", there.size))),
            Ok(_) => {}
            Err(object_store::Error::NotFound { .. }) => return Ok(Some("it is missing".to_owned())),
            Err(error) => return Err(error.into()),
        }
        if content {
            let mut chunks = self.store.get(&key).await?.into_stream();
            let mut hasher = sha2::Sha256::new();
            while let Some(chunk) = chunks.try_next().await? {
                hasher.update(&chunk);
            }
            if Digest(hasher.finalize().into()) != sha256 {
                return Ok(Some("it holds other bytes".to_owned()));
            }
        }
        Ok(None)
    }

    /// Deletes a blob, if it exists.
    pub async fn delete(&self, plant: PlantId, sha256: Digest) -> Result<(), StoreError> {
        match self.store.delete(&key(plant, sha256)).await {
            Ok(()) | Err(object_store::Error::NotFound { .. }) => Ok(()),
            Err(error) => Err(error.into()),
        }
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
        free_bytes(&self.staging).map_err(io("look for free space in", &self.staging))
    }

    /// Fails where no file can be written to the staging folder.
    pub async fn try_to_write(&self) -> Result<(), StoreError> {
        /// More than one block of any file system.
        const BYTES: usize = 64 << 10;
        let staging = self.staging.clone();
        run_blocking("write a file in", staging.clone(), move || {
            let mut file = tempfile::Builder::new().prefix("probe-").tempfile_in(&staging)?;
            file.write_all(&[0; BYTES])?;
            file.as_file().sync_all()
        })
        .await
    }

    /// Fails where the blob store does not answer.
    pub async fn ping(&self) -> Result<(), StoreError> {
        match &self.local {
            Some(root) => tokio::fs::metadata(root).await.map(drop).map_err(io("open", root)),
            None => Ok(self.store.list_with_delimiter(None).await.map(drop)?),
        }
    }
}

fn free_bytes(folder: &Path) -> std::io::Result<u64> {
    let found = rustix::fs::statvfs(folder)?;
    Ok(found.f_bavail.saturating_mul(found.f_frsize))
}

/// Fails as a full disk does where fewer bytes than `reserve` are free on the disk of a folder.
pub fn keep_free(folder: &Path, reserve: u64) -> std::io::Result<()> {
    if free_bytes(folder)? < reserve { Err(std::io::ErrorKind::StorageFull.into()) } else { Ok(()) }
}

fn key(plant: PlantId, sha256: Digest) -> Key {
    let digest = sha256.to_string();
    Key::from(format!("plants/{plant}/{}/{digest}", &digest[..2]))
}

/// Renames a synced file to its place and makes the new name durable.
fn move_into_place(staged: TempPath, target: &Path) -> std::io::Result<()> {
    let folder = target.parent().ok_or(std::io::ErrorKind::InvalidInput)?;
    std::fs::create_dir_all(folder)?;
    // Readers get hard links to it, so it must not be written to.
    let mut permissions = std::fs::metadata(&staged)?.permissions();
    permissions.set_readonly(true);
    std::fs::set_permissions(&staged, permissions)?;
    let name = staged.to_path_buf();
    staged.persist(target).map_err(|error| error.error)?;
    // Where both are names of one file already, nothing was renamed.
    let _ = std::fs::remove_file(name);
    std::fs::File::open(folder)?.sync_all()
}

pub(super) fn io(action: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> StoreError {
    let path = path.to_owned();
    move |source| StoreError::Io { action, path, source }
}

pub(super) async fn run_blocking<T: Send + 'static>(
    action: &'static str,
    path: PathBuf,
    work: impl FnOnce() -> std::io::Result<T> + Send + 'static,
) -> Result<T, StoreError> {
    let done = tokio::task::spawn_blocking(work).await;
    done.unwrap_or_else(|error| Err(std::io::Error::other(error))).map_err(io(action, &path))
}
