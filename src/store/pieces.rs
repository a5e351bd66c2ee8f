//! Unfinished uploads where several servers share a bucket. The server that receives bytes writes them to its own disk and, as
//! a piece, to the bucket before it acknowledges them, so that the client can continue with any server.
//!
//! The upload's row records how many bytes are acknowledged and in which pieces they are. A piece that is not recorded, because
//! another server was faster, does not belong to the upload. A server's disk has the bytes of its own pieces and all before
//! them; it fetches later ones.

use super::blobs::{Blobs, io, run_blocking};
use super::error::StoreError;
use super::ids::UploadId;
use futures::TryStreamExt;
use object_store::path::Path as Key;
use object_store::{ObjectStore, ObjectStoreExt};
use std::collections::HashSet;
use std::io::SeekFrom;
use std::time::Duration;
use tokio::io::{AsyncReadExt, AsyncSeekExt, AsyncWriteExt};
use uuid::Uuid;

/// Maximum size of a piece, bytes.
const PIECE_BYTES: u64 = 8 << 20;
/// The folder of all pieces.
const FOLDER: &str = "uploads";

/// Bytes of an upload's file that are in the bucket.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Piece {
    /// Where they begin and end in the file.
    pub from: u64,
    pub to: u64,
    pub name: Uuid,
    /// The data folder whose file of the upload has these bytes and all before them.
    pub home: Uuid,
}

fn key(id: UploadId, name: Uuid) -> Key {
    Key::from(format!("{FOLDER}/{id}/{name}"))
}

impl Blobs {
    /// Copies a range of an upload's file to the bucket, where there is one. Returns the pieces, in order.
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

    /// Deletes pieces that were not recorded; those that cannot be deleted now are deleted with the upload.
    pub async fn drop_pieces(&self, id: UploadId, pieces: &[Piece]) {
        for piece in pieces {
            if let Err(error) = self.store.delete(&key(id, piece.name)).await {
                tracing::warn!(%error, upload = %id, "cannot delete a piece of an upload");
            }
        }
    }

    /// Truncates an upload's file to `have` bytes and appends consecutive pieces. `has_room` fails where the disk is full.
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

    /// Deletes an upload's bytes on disk and in the bucket; those that cannot be deleted now are swept later.
    pub async fn drop_upload(&self, id: UploadId) {
        let file = self.upload_file(id);
        if let Err(error) = tokio::fs::remove_file(&file).await
            && error.kind() != std::io::ErrorKind::NotFound
        {
            tracing::warn!(%error, path = %file.display(), "cannot delete the file of an upload");
        }
        if self.home.is_some() {
            let folder = Key::from(format!("{FOLDER}/{id}"));
            let keys = self.store.list(Some(&folder)).map_ok(|object| object.location);
            let deleted = self.store.delete_stream(Box::pin(keys)).try_for_each(|_| async { Ok(()) }).await;
            if let Err(error) = deleted {
                tracing::warn!(%error, upload = %id, "cannot delete the pieces of an upload");
            }
        }
    }

    /// Deletes bytes of unknown uploads, except young ones, which may belong to an upload that is just beginning.
    pub async fn sweep_uploads(&self, known: HashSet<UploadId>, young: Duration) -> Result<(), StoreError> {
        let known: HashSet<String> = known.iter().map(UploadId::to_string).collect();
        self.sweep_pieces(&known, young).await?;
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

    /// Deletes pieces of unknown uploads, except young ones, which may belong to an upload that is just beginning.
    async fn sweep_pieces(&self, known: &HashSet<String>, young: Duration) -> Result<(), StoreError> {
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
