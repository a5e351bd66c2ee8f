//! Which file shows a shot: its undistorted image, or the photo itself.

use super::cameras::of_undistorted_image;
use crate::geometry::Camera;
use crate::reconstruction::photo::{PhotoError, PhotoHeader};
use crate::reconstruction::{Note, ProjectFolder, ReadError};
use std::collections::{BTreeMap, HashMap};
use std::path::{Component, Path, PathBuf};
use unicode_normalization::UnicodeNormalization;

/// How far the shape (width over height) of a photo may be off that of its camera.
const MAX_SHAPE_CHANGE: f64 = 0.01;

/// The undistorted images of a project.
#[derive(Default)]
pub(super) struct Undistorted {
    /// Where they lie, relative to the project folder.
    pub(super) images: PathBuf,
    /// Their names by shot (`undistorted_shot_ids.json`).
    pub(super) names: BTreeMap<String, Vec<String>>,
    /// Their cameras by their names, where the undistorted reconstruction is there.
    pub(super) cameras: BTreeMap<String, Camera>,
}

/// The files of a project, found by the names of shots.
pub(super) struct PhotoFinder<'a> {
    project: &'a dyn ProjectFolder,
    undistorted: Undistorted,
    max_pixels: u64,
    /// Photos by their normalised name; several where names differ only in what normalising removes.
    by_name: HashMap<String, Vec<PathBuf>>,
}

/// A file that shows a shot.
pub(super) struct FoundPhoto {
    /// Relative to the project folder.
    pub(super) place: PathBuf,
    /// The camera of the file as it is, at the size of the file.
    pub(super) camera: Camera,
    pub(super) header: PhotoHeader,
}

impl<'a> PhotoFinder<'a> {
    pub(super) fn new(project: &'a dyn ProjectFolder, undistorted: Undistorted, max_pixels: u64) -> Self {
        let mut by_name: HashMap<String, Vec<PathBuf>> = HashMap::new();
        for place in project.images() {
            if let Some(name) = place.file_name().and_then(|name| name.to_str()) {
                by_name.entry(normalised(name)).or_default().push(place);
            }
        }
        Self { project, undistorted, max_pixels, by_name }
    }

    /// The file of `shot`, taken by `original`: the undistorted image first, then the photo of that name, then the only photo
    /// whose name differs in its folder, its case or its Unicode form alone. A note where the shape disagrees.
    ///
    /// # Errors
    /// A photo that cannot be used, or that was turned after the reconstruction.
    pub(super) fn find(
        &self,
        shot: &str,
        original: &Camera,
        notes: &mut Vec<Note>,
    ) -> Result<Option<FoundPhoto>, ReadError> {
        if !Path::new(shot).components().all(|part| matches!(part, Component::Normal(_))) {
            return Ok(None);
        }
        let photo = [PathBuf::from("images").join(shot), PathBuf::from("opensfm/images").join(shot)];
        let photo = photo.into_iter().chain(self.by_similar_name(shot)).map(|place| (place, *original));
        for (place, camera) in self.undistorted_images(shot, original).into_iter().chain(photo) {
            if let Some(header) = self.project.inspect(&place, self.max_pixels)? {
                let camera = fitted(&camera, shot, header, notes)?;
                return Ok(Some(FoundPhoto { place, camera, header }));
            }
        }
        Ok(None)
    }

    /// Where the undistorted image of a shot may lie, with its camera.
    fn undistorted_images(&self, shot: &str, original: &Camera) -> Vec<(PathBuf, Camera)> {
        let listed = self.undistorted.names.get(shot).into_iter().flatten().cloned();
        let usual = ["", ".jpg", ".tif", ".png"].map(|suffix| format!("{shot}{suffix}"));
        listed
            .chain(usual)
            .filter(|name| Path::new(name).components().all(|part| matches!(part, Component::Normal(_))))
            .map(|name| {
                let camera = self.undistorted.cameras.get(&name).copied();
                (self.undistorted.images.join(name), camera.unwrap_or_else(|| of_undistorted_image(original)))
            })
            .collect()
    }

    fn by_similar_name(&self, shot: &str) -> Option<PathBuf> {
        let name = Path::new(shot).file_name()?.to_str()?;
        match self.by_name.get(&normalised(name))?.as_slice() {
            [only] => Some(only.clone()),
            _ => None,
        }
    }
}

/// A file name without what file systems and copying change: its case and Unicode form.
fn normalised(name: &str) -> String {
    name.nfc().flat_map(char::to_lowercase).collect()
}

/// The camera at the size that the file really has.
fn fitted(camera: &Camera, shot: &str, header: PhotoHeader, notes: &mut Vec<Note>) -> Result<Camera, PhotoError> {
    let shape = |width_px: u32, height_px: u32| f64::from(width_px) / f64::from(height_px);
    let (expected, found) = (shape(camera.width_px, camera.height_px), shape(header.width_px, header.height_px));
    if (expected / found - 1.0).abs() > MAX_SHAPE_CHANGE {
        if (expected * found - 1.0).abs() <= MAX_SHAPE_CHANGE {
            return Err(PhotoError::Turned {
                name: shot.to_owned(),
                size_px: [header.width_px, header.height_px],
                expected_px: [camera.width_px, camera.height_px],
            });
        }
        notes.push(Note {
            code: "image_shape_differs",
            message: format!(
                "{shot} is {} x {} pixels, but its camera was calibrated at {} x {}: is it cropped?",
                header.width_px, header.height_px, camera.width_px, camera.height_px
            ),
        });
    }
    Ok(camera.resized(header.width_px, header.height_px))
}
