//! Whether a file holds what its name says.

use super::disk;
use crate::config::Limits;
use crate::http::error::{ApiError, Code};
use crate::reconstruction::photo::{self, PhotoError};
use crate::store::{Content, SurveyPath};
use serde::de::IgnoredAny;
use std::fs::File;
use std::io::{BufReader, Read};
use std::path::Path;

/// Checks a file by what it must hold at its place in the survey. Width and height in pixels, where it is an image.
pub fn check(file: &Path, place: &SurveyPath, limits: &Limits) -> Result<Option<[u32; 2]>, ApiError> {
    match place.content() {
        Content::Image => image(file, place, limits).map(Some),
        Content::Json { array } => json(file, place, array).map(|()| None),
        Content::Ply => ply(file, place).map(|()| None),
    }
}

fn image(file: &Path, place: &SurveyPath, limits: &Limits) -> Result<[u32; 2], ApiError> {
    let max_pixels = (limits.max_image_megapixels * 1e6) as u64;
    match photo::inspect_whole(file, place.as_str(), max_pixels) {
        Ok(header) => Ok([header.width_px, header.height_px]),
        Err(error) => Err(match error {
            PhotoError::Unreadable { source, .. } => disk(file, source),
            PhotoError::NotAnImage { .. } => ApiError::new(Code::ImageUnreadable, error.to_string()),
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

fn json(file: &Path, place: &SurveyPath, array: bool) -> Result<(), ApiError> {
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
    let document: Result<IgnoredAny, _> = serde_json::from_reader(open()?);
    match document {
        Ok(_) => Ok(()),
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
