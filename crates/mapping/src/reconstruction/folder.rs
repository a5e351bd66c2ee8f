//! The folder of a project, whose photos may come to it only when they are looked at.

use super::ReadError;
use super::photo::{self, Photo, PhotoError, PhotoHeader};
use image::RgbImage;
use std::path::{Path, PathBuf};

/// What structure from motion left in a folder. Everything but the photos lies in it as files.
pub trait ProjectFolder: Sync {
    /// Where it is.
    fn path(&self) -> &Path;

    /// What the header of the photo at `place`, relative to the folder, says; `None` where there is no file.
    ///
    /// # Errors
    /// What is wrong with the photo, more than `max_pixels` among it.
    fn inspect(&self, place: &Path, max_pixels: u64) -> Result<Option<PhotoHeader>, PhotoError>;

    /// The files in `images/` and `opensfm/images/` and the folders below them, relative to the folder, sorted.
    fn images(&self) -> Vec<PathBuf>;

    /// As [`Photo::load`], of a photo of this folder.
    ///
    /// # Errors
    /// Data that does not decode; a photo that cannot be brought here.
    fn load(&self, photo: &Photo) -> Result<RgbImage, ReadError>;
}

/// How deep folders in `images/` are looked through: cameras split flights into `100MEDIA/`, people sort them by day.
const MAX_FOLDER_DEPTH: usize = 4;

/// Adds the files in `place` and, down to `depth`, below it; hidden ones and what archives leave for macOS apart.
fn collect_files(root: &Path, place: &Path, depth: usize, places: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(root.join(place)).into_iter().flatten().flatten() {
        let name = entry.file_name();
        if name.to_string_lossy().starts_with(['.', '_']) {
            continue;
        }
        let inner = place.join(&name);
        match entry.file_type() {
            Ok(kind) if kind.is_dir() && depth > 0 => collect_files(root, &inner, depth - 1, places),
            Ok(kind) if !kind.is_dir() => places.push(inner),
            _ => {}
        }
    }
}

/// A folder in which everything lies.
impl ProjectFolder for PathBuf {
    fn path(&self) -> &Path {
        self
    }

    fn inspect(&self, place: &Path, max_pixels: u64) -> Result<Option<PhotoHeader>, PhotoError> {
        let path = self.join(place);
        if !path.is_file() {
            return Ok(None);
        }
        photo::inspect(&path, &photo::file_name(place), max_pixels).map(Some)
    }

    fn images(&self) -> Vec<PathBuf> {
        let mut places = Vec::new();
        for images in ["images", "opensfm/images"] {
            collect_files(self, Path::new(images), MAX_FOLDER_DEPTH, &mut places);
        }
        places.sort();
        places
    }

    fn load(&self, photo: &Photo) -> Result<RgbImage, ReadError> {
        Ok(photo.load()?)
    }
}
