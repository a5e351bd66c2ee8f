//! Whether a file holds what its name says.

use super::disk;
use super::shots::{self, Shots};
use crate::config::Limits;
use crate::http::error::{ApiError, Code};
use crate::store::{Content, FileKind, SurveyPath};
use heliomap_mapping::reconstruction::PhotoFacts;
use heliomap_mapping::reconstruction::photo::{self, PhotoError};
use serde::de::IgnoredAny;
use std::fs::File;
use std::io::{BufReader, Read};
use std::path::Path;

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
        Content::Json { array } => Ok(Found { shots: json(file, place, array)?, ..Found::default() }),
        Content::Ply => ply(file, place).map(|()| Found::default()),
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

/// Checks a document; the images that it names, where it is a reconstruction whose shots could be read.
fn json(file: &Path, place: &SurveyPath, array: bool) -> Result<Option<Vec<String>>, ApiError> {
    let wrong = |what: &str| {
        ApiError::new(
            Code::FileUnreadable,
            format!("{place} {what}; send the file as OpenSfM wrote it, after its run ended without an error"),
        )
    };
    let open = || File::open(file).map(BufReader::new).map_err(|error| disk(file, error));
    let first = open()?.bytes().map_while(Result::ok).find(|byte| !byte.is_ascii_whitespace());
    match (first, array) {
        (None, _) => return Err(wrong("is empty")),
        (Some(b'['), true) | (Some(b'{'), false) => {}
        (_, true) => return Err(wrong("is no JSON array of reconstructions")),
        (_, false) => return Err(wrong("is no JSON object")),
    }
    if array {
        match shots::read(open()?) {
            Shots::Named(names) => return Ok(Some(names.into_iter().collect())),
            Shots::TooMany => return Err(wrong(&format!("names more than {} images", shots::MAX_SHOTS))),
            Shots::Unknown => {}
        }
    }
    let document: Result<IgnoredAny, _> = serde_json::from_reader(open()?);
    match document {
        Ok(_) => Ok(None),
        Err(error) if error.is_io() => Err(disk(file, error.into())),
        Err(error) if error.is_eof() => Err(wrong("is cut short")),
        Err(error) => Err(wrong(&format!("is no valid JSON: {error} (NaN and Infinity are none)"))),
    }
}

fn ply(file: &Path, place: &SurveyPath) -> Result<(), ApiError> {
    let mut head = [0; 4];
    let begun = File::open(file).and_then(|mut file| file.read_exact(&mut head));
    match begun {
        Ok(()) if head.starts_with(b"ply") && head[3].is_ascii_whitespace() => Ok(()),
        Err(error) if error.kind() != std::io::ErrorKind::UnexpectedEof => Err(disk(file, error)),
        _ => Err(ApiError::new(
            Code::FileUnreadable,
            format!("{place} is no PLY point cloud; send undistorted/depthmaps/merged.ply as OpenSfM wrote it"),
        )),
    }
}
