//! What a survey lacks before it can be mapped.

use crate::store::{Content, FileRecord};
use std::collections::BTreeSet;

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
    if !has("reconstruction.json") && !has("undistorted/reconstruction.json") {
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
    missing
}
