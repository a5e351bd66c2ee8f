//! What a survey lacks before it can be mapped.

use crate::store::{Content, FileKind, FileRecord};
use std::collections::{BTreeMap, BTreeSet};

/// Where a survey's reconstruction may be; the first that is there counts.
pub const RECONSTRUCTIONS: [&str; 3] =
    ["reconstruction.topocentric.json", "reconstruction.json", "undistorted/reconstruction.json"];

/// What OpenSfM may append to the name of an undistorted image.
const SUFFIXES: [&str; 4] = ["", ".jpg", ".tif", ".png"];

/// Something that a survey lacks.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Missing {
    /// A stable word.
    pub code: &'static str,
    /// What is missing and what to do.
    pub message: String,
}

/// What a survey with these files lacks; empty where it can be mapped.
pub fn missing(files: &[FileRecord]) -> Vec<Missing> {
    let has = |path: &str| files.iter().any(|file| file.path.as_str() == path);
    let images: BTreeSet<&str> =
        files.iter().filter(|file| file.path.content() == Content::Image).map(|file| file.path.file_name()).collect();
    let mut missing = Vec::new();
    if images.len() < 2 {
        missing.push(Missing {
            code: "too_few_images",
            message: format!(
                "the survey has {} image(s) and at least 2 are needed: PUT …/images/NAME for each photo",
                images.len()
            ),
        });
    }
    if !RECONSTRUCTIONS.into_iter().any(has) {
        missing.push(Missing {
            code: "no_reconstruction",
            message: "reconstruction.json is missing: run OpenSfM on the photos, then PUT …/reconstruction with its \
                      folder as one zip or tar, or PUT …/reconstruction/reconstruction.json"
                .to_owned(),
        });
    }
    if !has("reference_lla.json") {
        missing.push(Missing {
            code: "no_reference",
            message: "reference_lla.json, the origin of the reconstruction on the earth, is missing: \
                      PUT …/reconstruction/reference_lla.json"
                .to_owned(),
        });
    }
    let absent = shots_without_image(files);
    if let Some(first) = absent.first() {
        missing.push(Missing {
            code: "images_not_uploaded",
            message: format!(
                "the reconstruction was made from {} image(s) that were not uploaded, {first} among them: PUT …/images/NAME \
                 for each, under its name to the letter where two differ in case alone",
                absent.len()
            ),
        });
    }
    missing
}

/// The images from which a survey's reconstruction was made; `None` without a readable reconstruction.
pub fn shots(files: &[FileRecord]) -> Option<&[String]> {
    let reconstruction = RECONSTRUCTIONS.iter().find_map(|path| files.iter().find(|file| file.path.as_str() == *path));
    reconstruction?.shots.as_deref()
}

/// The shots of a reconstruction, found by the names of images. Names that differ in their case or in folders alone are one
/// where that is clear, as where a job looks for photos.
#[derive(Debug, Default)]
pub struct ShotNames {
    exact: BTreeSet<String>,
    folded: BTreeSet<String>,
}

impl FromIterator<String> for ShotNames {
    fn from_iter<T: IntoIterator<Item = String>>(names: T) -> Self {
        let exact: BTreeSet<String> = names.into_iter().collect();
        let folded = exact.iter().map(|name| folded(name)).collect();
        Self { exact, folded }
    }
}

impl ShotNames {
    /// How many there are.
    pub fn count(&self) -> usize {
        self.exact.len()
    }

    /// Whether the reconstruction was made from an image.
    pub fn contains(&self, image: &str) -> bool {
        SUFFIXES.iter().any(|suffix| self.exact.contains(&format!("{image}{suffix}")))
            || self.folded.contains(&folded(image))
    }
}

/// A file name without its folder and its case.
fn folded(name: &str) -> String {
    name.rsplit('/').next().unwrap_or(name).to_lowercase()
}

/// The images from which a survey's reconstruction was made and of which neither the photo nor the undistorted image is
/// there.
pub fn shots_without_image(files: &[FileRecord]) -> Vec<String> {
    let paths: BTreeSet<&str> = files.iter().map(|file| file.path.as_str()).collect();
    let mut alike: BTreeMap<String, usize> = BTreeMap::new();
    for photo in files.iter().filter(|file| file.path.kind() == FileKind::Image) {
        *alike.entry(folded(photo.path.file_name())).or_default() += 1;
    }
    let is_there = |shot: &str| {
        paths.contains(format!("images/{shot}").as_str())
            || SUFFIXES.iter().any(|suffix| paths.contains(format!("undistorted/images/{shot}{suffix}").as_str()))
            || alike.get(&folded(shot)) == Some(&1)
    };
    shots(files).unwrap_or_default().iter().filter(|shot| !is_there(shot)).cloned().collect()
}
