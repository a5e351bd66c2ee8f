//! Whether a file holds what its name says.

use super::disk;
use crate::config::Limits;
use crate::http::error::{ApiError, Code};
use crate::store::{Content, FileKind, SurveyPath};
use heliomap_mapping::detection::external;
use heliomap_mapping::reconstruction::opensfm::check;
use heliomap_mapping::reconstruction::photo::{self, PhotoError};
use heliomap_mapping::reconstruction::{PhotoFacts, ReconstructionError, ply};
use std::collections::BTreeSet;
use std::fs::File;
use std::io::{BufReader, Read};
use std::path::Path;
use unicode_normalization::UnicodeNormalization;

/// Fewest images that a plant can be mapped from.
const MIN_SHOTS: usize = 2;
/// Most bytes of a file of text: ODM's has a few lines.
const MAX_TEXT_BYTES: u64 = 64 << 10;
/// Most bytes of an object that no job reads.
const MAX_OBJECT_BYTES: u64 = 16 << 20;

/// What was found in a file.
#[derive(Debug, Default)]
pub struct Found {
    /// Width and height in pixels, where it is an image.
    pub size_px: Option<[u32; 2]>,
    /// Where it is a photo.
    pub photo: Option<PhotoFacts>,
    /// The images that it names, sorted, where it is a reconstruction that could be read.
    pub shots: Option<Vec<String>>,
}

/// Checks a file by what it must hold at its place in the survey.
pub fn check(file: &Path, place: &SurveyPath, limits: &Limits) -> Result<Found, ApiError> {
    match place.content() {
        Content::Image => image(file, place, limits),
        Content::Json { .. } | Content::Ply | Content::Text => reconstruction(file, place),
    }
}

/// A photo is decoded, so that what cannot be decoded is refused while the drone is still in the field; undistorted images
/// were made from photos, and are not.
fn image(file: &Path, place: &SurveyPath, limits: &Limits) -> Result<Found, ApiError> {
    let max_pixels = (limits.max_image_megapixels * 1e6) as u64;
    let looked = match place.kind() {
        FileKind::Image => photo::inspect(file, place.as_str(), max_pixels)
            .and_then(|header| Ok((header, Some(photo::examine(file, place.as_str(), header)?)))),
        FileKind::Reconstruction => photo::inspect_whole(file, place.as_str(), max_pixels).map(|header| (header, None)),
    };
    match looked {
        Ok((header, photo)) => {
            Ok(Found { size_px: Some([header.width_px, header.height_px]), photo, ..Found::default() })
        }
        Err(error) => Err(match error {
            PhotoError::Unreadable { source, .. } => disk(file, source),
            PhotoError::NotAnImage { .. } | PhotoError::FloatingPoint { .. } | PhotoError::Turned { .. } => {
                ApiError::new(Code::ImageUnreadable, error.to_string())
            }
            PhotoError::WrongName { .. } => ApiError::new(Code::ImageFormatMismatch, error.to_string()),
            PhotoError::Truncated { .. } => ApiError::new(Code::ImageTruncated, error.to_string()),
            PhotoError::TooLarge { width, height, .. } => ApiError::new(
                Code::ImageTooLarge,
                format!(
                    "{place} has {width} x {height} pixels, more than the limit of {} megapixels; send it smaller, with \
                     the reconstruction made from it so, or ask for a higher limit",
                    limits.max_image_megapixels
                ),
            ),
        }),
    }
}

/// Checks a part of a reconstruction as the job that reads it would.
fn reconstruction(file: &Path, place: &SurveyPath) -> Result<Found, ApiError> {
    let refused = |error: ReconstructionError| {
        let code = Code::of_word(error.code()).unwrap_or(Code::FileUnreadable);
        (code, error.to_string())
    };
    let checked = match place.as_str() {
        "reconstruction.json" | "reconstruction.topocentric.json" => {
            check::reconstruction(file, MIN_SHOTS).map(Some).map_err(refused)
        }
        "undistorted/reconstruction.json" => check::reconstruction(file, 0).map(Some).map_err(refused),
        "reference_lla.json" => check::reference(file).map(|()| None).map_err(refused),
        "undistorted/undistorted_shot_ids.json" => check::undistorted_names(file).map(|()| None).map_err(refused),
        "boxes.json" => external::read(file).map(|_| None).map_err(|error| (Code::BoxesInvalid, error.to_string())),
        _ => match place.content() {
            Content::Ply => ply::check(file).map(|()| None).map_err(refused),
            Content::Text => text(file).map(|()| None),
            _ => object(file).map(|()| None),
        },
    };
    match checked {
        Ok(names) => {
            let composed = |names: BTreeSet<String>| names.iter().map(|name| name.nfc().collect()).collect();
            Ok(Found { shots: names.map(composed), ..Found::default() })
        }
        // Files have their places for names, wherever they lie.
        Err((code, what)) => {
            let name = file.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
            let what = what.replace(&*file.to_string_lossy(), place.as_str()).replace(&name, place.file_name());
            Err(ApiError::new(code, what))
        }
    }
}

/// A JSON object that no job reads.
fn object(file: &Path) -> Result<(), (Code, String)> {
    let wrong = |what: String| {
        let name = file.display();
        (Code::FileUnreadable, format!("{name} {what}; send the file as OpenSfM wrote it"))
    };
    let reader = File::open(file)
        .map(|file| BufReader::new(file.take(MAX_OBJECT_BYTES)))
        .map_err(|error| wrong(format!("cannot be read: {error}")))?;
    let document: Result<serde_json::Map<String, serde_json::Value>, _> = serde_json::from_reader(reader);
    document.map(drop).map_err(|error| wrong(format!("is no JSON object: {error}")))
}

/// A few lines of text.
fn text(file: &Path) -> Result<(), (Code, String)> {
    let mut start = Vec::new();
    let read = File::open(file).and_then(|file| file.take(MAX_TEXT_BYTES).read_to_end(&mut start));
    match read {
        Ok(count) if (count as u64) < MAX_TEXT_BYTES && std::str::from_utf8(&start).is_ok() => Ok(()),
        _ => Err((Code::FileUnreadable, format!("{} is no text as ODM writes it", file.display()))),
    }
}
