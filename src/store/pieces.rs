//! Uploads that are not whole, where several servers share a bucket: the server that took some bytes writes them to its own
//! disk and puts them into the bucket as well, before they count, so that whichever server the client comes back to goes on.
//!
//! Each row tells whose disk has all that counts. Another server makes the file anew of its pieces. Servers that write to
//! one upload at once, because a client left one of them without a word, do not mix: bytes count only where the row still
//! tells what they were added to.

use super::blobs::io;
use super::{Blobs, StoreError, UploadId};
use futures::TryStreamExt;
use object_store::path::Path as Key;
use object_store::{ObjectMeta, ObjectStore, ObjectStoreExt};
use std::collections::HashSet;
use std::io::{SeekFrom, Write};
use std::path::Path;
use std::time::Duration;
use tokio::io::{AsyncReadExt, AsyncSeekExt, AsyncWriteExt};
use uuid::Uuid;

/// Bytes of a piece at the most.
const PIECE_BYTES: u64 = 8 << 20;
/// The folder of all pieces.
const FOLDER: &str = "uploads";
/// The file of a data folder that names it.
const NAME: &str = "server-id";

/// Bytes of an upload's file.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
struct Piece {
    from: u64,
    to: u64,
}

impl Piece {
    fn key(&self, id: UploadId) -> Key {
        Key::from(format!("{FOLDER}/{id}/{:020}-{:020}", self.from, self.to))
    }

    fn of(object: &ObjectMeta) -> Option<Self> {
        let (from, to) = object.location.filename()?.split_once('-')?;
        Some(Self { from: from.parse().ok()?, to: to.parse().ok()? })
    }
}

/// Reads what a data folder is called among those of one bucket; a new one is given a name.
pub(super) fn name_of(data: &Path) -> std::io::Result<Uuid> {
    let path = data.join(NAME);
    if !path.exists() {
        let mut file = tempfile::NamedTempFile::new_in(data)?;
        file.write_all(Uuid::new_v4().to_string().as_bytes())?;
        file.as_file().sync_all()?;
        match file.persist_noclobber(&path) {
            Err(error) if error.error.kind() != std::io::ErrorKind::AlreadyExists => return Err(error.error),
            _ => std::fs::File::open(data)?.sync_all()?,
        }
    }
    std::fs::read_to_string(path)?.trim().parse().map_err(std::io::Error::other)
}

impl Blobs {
    /// Puts the bytes from one offset of an upload's file to another into the bucket, where there is one.
    pub async fn keep_pieces(&self, id: UploadId, from: u64, to: u64) -> Result<(), StoreError> {
        if self.home.is_none() || from >= to {
            return Ok(());
        }
        let path = self.upload_file(id);
        let mut file = tokio::fs::File::open(&path).await.map_err(io("open", &path))?;
        file.seek(SeekFrom::Start(from)).await.map_err(io("read", &path))?;
        let mut at = from;
        while at < to {
            let piece = Piece { from: at, to: to.min(at + PIECE_BYTES) };
            // The semaphore is never closed.
            let _turn = self.senders.acquire().await;
            let mut bytes = vec![0; (piece.to - piece.from) as usize];
            file.read_exact(&mut bytes).await.map_err(io("read", &path))?;
            self.store.put(&piece.key(id), bytes.into()).await?;
            at = piece.to;
        }
        Ok(())
    }

    /// Whether the bucket has the first bytes of an upload, so many.
    pub async fn has_pieces(&self, id: UploadId, received: u64) -> Result<bool, StoreError> {
        Ok(self.pieces(id, received).await?.is_some())
    }

    /// Makes an upload's file anew of its first bytes, so many; `false` where the bucket lacks some. `has_room` tells
    /// whether the disk takes more.
    pub async fn bring_upload(
        &self,
        id: UploadId,
        received: u64,
        has_room: impl Fn() -> std::io::Result<()>,
    ) -> Result<bool, StoreError> {
        let Some(pieces) = self.pieces(id, received).await? else { return Ok(false) };
        let path = self.upload_file(id);
        let staged =
            tempfile::Builder::new().prefix("upload-").tempfile_in(&self.staging).map_err(io("create", &path))?;
        let (file, staged) = staged.into_parts();
        let mut file = tokio::fs::File::from_std(file);
        for piece in pieces {
            has_room().map_err(io("write", &path))?;
            let _turn = self.senders.acquire().await;
            let bytes = self.store.get(&piece.key(id)).await?.bytes().await?;
            if bytes.len() as u64 != piece.to - piece.from {
                return Ok(false);
            }
            file.seek(SeekFrom::Start(piece.from)).await.map_err(io("write", &path))?;
            file.write_all(&bytes).await.map_err(io("write", &path))?;
        }
        file.flush().await.map_err(io("write", &path))?;
        file.set_len(received).await.map_err(io("write", &path))?;
        file.sync_all().await.map_err(io("write", &path))?;
        staged.persist(&path).map_err(|error| io("write", &path)(error.error))?;
        Ok(true)
    }

    /// The pieces of an upload's first bytes, so many, in order; `None` where some lack.
    async fn pieces(&self, id: UploadId, received: u64) -> Result<Option<Vec<Piece>>, StoreError> {
        if self.home.is_none() {
            return Ok(None);
        }
        let folder = Key::from(format!("{FOLDER}/{id}"));
        let found: Vec<ObjectMeta> = self.store.list(Some(&folder)).try_collect().await?;
        let mut pieces: Vec<Piece> = found.iter().filter_map(Piece::of).filter(|piece| piece.from < received).collect();
        pieces.sort();
        let mut covered = 0;
        for piece in &pieces {
            if piece.from > covered {
                return Ok(None);
            }
            covered = covered.max(piece.to);
        }
        Ok((covered >= received).then_some(pieces))
    }

    /// Deletes an upload's bytes, wherever they are; what cannot be deleted now is swept up later.
    pub async fn drop_upload(&self, id: UploadId) {
        let file = self.upload_file(id);
        if let Err(error) = tokio::fs::remove_file(&file).await
            && error.kind() != std::io::ErrorKind::NotFound
        {
            tracing::warn!(%error, path = %file.display(), "an upload's file cannot be deleted");
        }
        if self.home.is_some() {
            let folder = Key::from(format!("{FOLDER}/{id}"));
            let keys = self.store.list(Some(&folder)).map_ok(|object| object.location);
            let deleted = self.store.delete_stream(Box::pin(keys)).try_for_each(|_| async { Ok(()) }).await;
            if let Err(error) = deleted {
                tracing::warn!(%error, upload = %id, "the pieces of an upload cannot be deleted");
            }
        }
    }

    /// Deletes the pieces of uploads that are not known, but for those so young that they may be just beginning.
    pub(super) async fn sweep_pieces(&self, known: &HashSet<String>, young: Duration) -> Result<(), StoreError> {
        if self.home.is_none() {
            return Ok(());
        }
        let mut pieces = self.store.list(Some(&Key::from(FOLDER)));
        while let Some(piece) = pieces.try_next().await? {
            let upload = piece.location.parts().nth(1);
            let is_known = upload.is_some_and(|upload| known.contains(upload.as_ref()));
            let age = std::time::SystemTime::from(piece.last_modified).elapsed();
            if !is_known && age.is_ok_and(|age| age >= young) {
                self.store.delete(&piece.location).await?;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_data_folder_keeps_its_name() {
        let [one, other] = [(); 2].map(|()| tempfile::tempdir().unwrap());
        let name = name_of(one.path()).unwrap();
        assert_eq!(name_of(one.path()).unwrap(), name);
        assert_ne!(name_of(other.path()).unwrap(), name);
    }
}
