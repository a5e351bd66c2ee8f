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

    /// The names of the files in `images/`, sorted.
    fn images(&self) -> Vec<String>;

    /// As [`Photo::load`], of a photo of this folder.
    ///
    /// # Errors
    /// Data that does not decode; a photo that cannot be brought here.
    fn load(&self, photo: &Photo) -> Result<RgbImage, ReadError>;
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

    fn images(&self) -> Vec<String> {
        let entries = std::fs::read_dir(self.join("images")).into_iter().flatten().flatten();
        let mut names: Vec<String> = entries.map(|entry| entry.file_name().to_string_lossy().into_owned()).collect();
        names.sort();
        names
    }

    fn load(&self, photo: &Photo) -> Result<RgbImage, ReadError> {
        Ok(photo.load()?)
    }
}
