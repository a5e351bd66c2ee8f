//! Uploads that are not whole, where several servers share a bucket: the server that takes some bytes writes them to its own
//! disk and puts them into the bucket as well, before they count, so that whichever server the client comes back to goes on.
//!
//! What counts, the row tells: how many bytes, and which pieces these are. A piece whose bytes did not come to count,
//! because another server was told of others first, is none of the upload's. A server's disk has the bytes of its own
//! pieces and all before them, and fetches those behind them.

use super::blobs::io;
use super::{Blobs, StoreError, UploadId};
use futures::TryStreamExt;
use object_store::path::Path as Key;
use object_store::{ObjectStore, ObjectStoreExt};
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

/// Bytes of an upload's file that are in the bucket.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Piece {
    /// Where they begin and end in the file.
    pub from: u64,
    pub to: u64,
    pub name: Uuid,
    /// The data folder whose file of the upload has them, and all before them.
    pub home: Uuid,
}

fn key(id: UploadId, name: Uuid) -> Key {
    Key::from(format!("{FOLDER}/{id}/{name}"))
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
    /// Puts the bytes from one offset of an upload's file to another into the bucket, where there is one: the pieces that
    /// they are, in order.
    pub async fn keep_pieces(&self, id: UploadId, from: u64, to: u64) -> Result<Vec<Piece>, StoreError> {
        let Some(home) = self.home else { return Ok(Vec::new()) };
        let path = self.upload_file(id);
        let mut file = tokio::fs::File::open(&path).await.map_err(io("open", &path))?;
        file.seek(SeekFrom::Start(from)).await.map_err(io("read", &path))?;
        let (mut pieces, mut at) = (Vec::new(), from);
        while at < to {
            let piece = Piece { from: at, to: to.min(at + PIECE_BYTES), name: Uuid::new_v4(), home };
            // The semaphore is never closed.
            let _turn = self.senders.acquire().await;
            let mut bytes = vec![0; (piece.to - piece.from) as usize];
            file.read_exact(&mut bytes).await.map_err(io("read", &path))?;
            self.store.put(&key(id, piece.name), bytes.into()).await?;
            at = piece.to;
            pieces.push(piece);
        }
        Ok(pieces)
    }

    /// Deletes pieces that did not come to count; what cannot be deleted now goes with the upload.
    pub async fn drop_pieces(&self, id: UploadId, pieces: &[Piece]) {
        for piece in pieces {
            if let Err(error) = self.store.delete(&key(id, piece.name)).await {
                tracing::warn!(%error, upload = %id, "a piece of an upload cannot be deleted");
            }
        }
    }

    /// Leaves the first bytes of an upload's file, as many as `have`, and adds those of pieces that follow each other.
    /// `has_room` tells whether the disk takes more.
    pub async fn bring_pieces(
        &self,
        id: UploadId,
        have: u64,
        pieces: &[Piece],
        has_room: impl Fn() -> std::io::Result<()>,
    ) -> Result<(), StoreError> {
        let path = self.upload_file(id);
        let mut open = tokio::fs::OpenOptions::new();
        let open = open.write(true).create(true).truncate(have == 0);
        let mut file = open.open(&path).await.map_err(io("open", &path))?;
        file.set_len(have).await.map_err(io("write", &path))?;
        file.seek(SeekFrom::Start(have)).await.map_err(io("write", &path))?;
        for piece in pieces {
            has_room().map_err(io("write", &path))?;
            let _turn = self.senders.acquire().await;
            let bytes = self.store.get(&key(id, piece.name)).await?.bytes().await?;
            file.write_all(&bytes).await.map_err(io("write", &path))?;
        }
        file.flush().await.map_err(io("write", &path))?;
        file.sync_all().await.map_err(io("write", &path))
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
