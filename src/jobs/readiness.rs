//! What a survey lacks before it can be mapped.

use crate::store::{Content, FileRecord};
use std::collections::BTreeSet;

/// Where a survey's reconstruction may be; the first that is there counts.
pub const RECONSTRUCTIONS: [&str; 2] = ["reconstruction.json", "undistorted/reconstruction.json"];

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
                 for each",
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

/// Whether a reconstruction was made from an image.
pub fn is_shot(shots: &BTreeSet<String>, image: &str) -> bool {
    SUFFIXES.iter().any(|suffix| shots.contains(&format!("{image}{suffix}")))
}

/// The images from which a survey's reconstruction was made and of which neither the photo nor the undistorted image is
/// there.
pub fn shots_without_image(files: &[FileRecord]) -> Vec<String> {
    let paths: BTreeSet<&str> = files.iter().map(|file| file.path.as_str()).collect();
    let is_there = |shot: &str| {
        paths.contains(format!("images/{shot}").as_str())
            || SUFFIXES.iter().any(|suffix| paths.contains(format!("undistorted/images/{shot}{suffix}").as_str()))
    };
    shots(files).unwrap_or_default().iter().filter(|shot| !is_there(shot)).cloned().collect()
}
