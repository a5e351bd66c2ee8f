//! The folder of a job: the survey's files, laid out as OpenSfM leaves them. Each photo is fetched when it is read and deleted
//! afterwards: a job begins at once, and needs no disk space for all of them.

use super::error::AttemptError;
use crate::store::{Blobs, Digest, FileKind, FileRecord, StoreError};
use futures::{StreamExt, TryStreamExt, stream};
use heliomap_mapping::reconstruction::photo::{Photo, PhotoError, PhotoHeader};
use heliomap_mapping::reconstruction::{ProjectFolder, ReadError};
use heliomap_model::PlantId;
use image::RgbImage;
use std::collections::HashMap;
use std::path::{Path, PathBuf};
use tempfile::TempDir;
use tokio::runtime::Handle;

/// Files fetched from a bucket at once.
const FILES_AT_ONCE: usize = 8;

/// What the upload recorded of a photo.
#[derive(Debug)]
struct Kept {
    sha256: Digest,
    /// Width and height in pixels.
    size_px: [u32; 2],
}

/// A survey's files in a new temporary folder. Its photos are loaded from threads that may block.
#[derive(Debug)]
pub(super) struct JobFolder {
    folder: TempDir,
    blobs: Blobs,
    plant: PlantId,
    /// The photos, by their places in the folder.
    photos: HashMap<PathBuf, Kept>,
    /// The places of the photos, sorted.
    images: Vec<PathBuf>,
    runtime: Handle,
}

impl JobFolder {
    /// Lays out all but the photos, as hard links where the file system has them.
    ///
    /// # Errors
    /// A store that does not give a file, a folder that does not take one.
    pub async fn lay_out(blobs: &Blobs, plant: PlantId, files: &[FileRecord]) -> Result<Self, AttemptError> {
        let folder = tempfile::Builder::new().prefix("job-").tempdir_in(blobs.staging())?;
        let (mut photos, mut others) = (HashMap::new(), Vec::new());
        for file in files {
            let place = PathBuf::from(file.path.as_str());
            match file.size_px {
                Some(size_px) => {
                    photos.insert(place, Kept { sha256: file.sha256, size_px });
                }
                None => others.push((folder.path().join(place), file.sha256)),
            }
        }
        let placed = stream::iter(others).map(|(target, sha256)| async move {
            if let Some(parent) = target.parent() {
                tokio::fs::create_dir_all(parent).await?;
            }
            Ok::<_, AttemptError>(blobs.place(plant, sha256, &target).await?)
        });
        placed.buffer_unordered(FILES_AT_ONCE).try_collect::<()>().await?;
        let images = files.iter().filter(|file| file.path.kind() == FileKind::Image);
        let mut images: Vec<PathBuf> = images.map(|file| PathBuf::from(file.path.as_str())).collect();
        images.sort();
        Ok(Self { folder, blobs: blobs.clone(), plant, photos, images, runtime: Handle::current() })
    }

    /// The photo, alone in a new folder.
    async fn bring(&self, photo: &Photo) -> Result<TempDir, AttemptError> {
        let gone = StoreError::Gone { what: "image" };
        let place = photo.path.strip_prefix(self.path()).ok();
        let (kept, name) = place.and_then(|place| Some((self.photos.get(place)?, place.file_name()?))).ok_or(gone)?;
        let alone = tempfile::Builder::new().prefix("photo-").tempdir_in(self.path())?;
        self.blobs.place(self.plant, kept.sha256, &alone.path().join(name)).await?;
        Ok(alone)
    }
}

impl ProjectFolder for JobFolder {
    fn path(&self) -> &Path {
        self.folder.path()
    }

    fn inspect(&self, place: &Path, max_pixels: u64) -> Result<Option<PhotoHeader>, PhotoError> {
        match (self.photos.get(place), place.file_name().and_then(|name| name.to_str())) {
            (Some(kept), Some(name)) => PhotoHeader::known(name, kept.size_px, max_pixels),
            _ => Ok(None),
        }
    }

    fn images(&self) -> Vec<PathBuf> {
        self.images.clone()
    }

    fn load(&self, photo: &Photo) -> Result<RgbImage, ReadError> {
        let not_fetched = |error: AttemptError| {
            tracing::error!(%error, image = photo.shot, "cannot fetch a photo");
            let reason = "the service's storage failed; see the log of the service".to_owned();
            ReadError::NotFetched { name: photo.shot.clone(), reason }
        };
        // In a folder of its own, which goes when the photo is in memory.
        let brought = self.runtime.block_on(self.bring(photo)).map_err(not_fetched)?;
        let name = photo.path.file_name().unwrap_or_default();
        Ok(Photo { path: brought.path().join(name), ..photo.clone() }.load()?)
    }
}
