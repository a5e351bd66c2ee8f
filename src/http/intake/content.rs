//! Whether a file holds what its name says.

use super::disk;
use super::jpeg::{self, JpegError};
use crate::config::Limits;
use crate::http::error::{ApiError, Code};
use crate::store::{Content, SurveyPath};
use serde::de::IgnoredAny;
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::Path;

/// Image formats that the pipeline reads.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Format {
    Jpeg,
    Png,
    Tiff,
}

impl Format {
    fn of_name(name: &str) -> Option<Self> {
        match name.rsplit('.').next()?.to_ascii_lowercase().as_str() {
            "jpg" | "jpeg" => Some(Self::Jpeg),
            "png" => Some(Self::Png),
            "tif" | "tiff" => Some(Self::Tiff),
            _ => None,
        }
    }

    fn of_content(head: &[u8]) -> Option<Self> {
        match head {
            [0xff, 0xd8, 0xff, ..] => Some(Self::Jpeg),
            [0x89, b'P', b'N', b'G', b'\r', b'\n', 0x1a, b'\n', ..] => Some(Self::Png),
            [b'I', b'I', 42 | 43, 0, ..] | [b'M', b'M', 0, 42 | 43, ..] => Some(Self::Tiff),
            _ => None,
        }
    }

    fn name(self) -> &'static str {
        match self {
            Self::Jpeg => "JPEG",
            Self::Png => "PNG",
            Self::Tiff => "TIFF",
        }
    }

    fn ending(self) -> &'static str {
        match self {
            Self::Jpeg => ".jpg",
            Self::Png => ".png",
            Self::Tiff => ".tif",
        }
    }
}

/// Checks a file by what it must hold at its place in the survey. Width and height in pixels, where it is an image.
pub fn check(file: &Path, place: &SurveyPath, limits: &Limits) -> Result<Option<[u32; 2]>, ApiError> {
    match place.content() {
        Content::Image => image(file, place, limits).map(Some),
        Content::Json { array } => json(file, place, array).map(|()| None),
        Content::Ply => ply(file, place).map(|()| None),
    }
}

fn image(file: &Path, place: &SurveyPath, limits: &Limits) -> Result<[u32; 2], ApiError> {
    let io = |error| disk(file, error);
    let mut reader = File::open(file).map_err(io)?;
    let mut head = Vec::new();
    reader.by_ref().take(16).read_to_end(&mut head).map_err(io)?;
    let expected = Format::of_name(place.file_name());
    let Some(found) = Format::of_content(&head) else {
        return Err(ApiError::new(
            Code::ImageUnreadable,
            format!(
                "{place} is no JPEG, PNG or TIFF image ({} bytes begin otherwise); send the photo itself",
                head.len()
            ),
        ));
    };
    if let Some(expected) = expected.filter(|expected| *expected != found) {
        return Err(ApiError::new(
            Code::ImageFormatMismatch,
            format!(
                "{place} holds a {} but is named as a {}: convert it to {}, or give it the ending {} here and in the \
                 reconstruction",
                found.name(),
                expected.name(),
                expected.name(),
                found.ending(),
            ),
        ));
    }
    reader.seek(SeekFrom::Start(0)).map_err(io)?;
    let within = |size: [u32; 2]| f64::from(size[0]) * f64::from(size[1]) <= limits.max_image_megapixels * 1e6;
    let size_px = match found {
        Format::Jpeg => jpeg::walk(BufReader::with_capacity(1 << 16, reader), within).map_err(|error| match error {
            JpegError::CutShort => cut_short(place),
            JpegError::Malformed(what) => unreadable(place, what),
            JpegError::Io(error) => io(error),
        })?,
        Format::Png => png_size(reader, place)?,
        Format::Tiff => decoded_size(file, place, &within)?,
    };
    if !within(size_px) {
        return Err(ApiError::new(
            Code::ImageTooLarge,
            format!(
                "{place} has {} x {} pixels, more than the limit of {} megapixels; send it smaller, with the \
                 reconstruction made from it so, or ask for a higher limit",
                size_px[0], size_px[1], limits.max_image_megapixels
            ),
        ));
    }
    Ok(size_px)
}

/// Walks a PNG's chunks to its end.
fn png_size(mut file: File, place: &SurveyPath) -> Result<[u32; 2], ApiError> {
    let cut = |error: std::io::Error| match error.kind() {
        std::io::ErrorKind::UnexpectedEof => cut_short(place),
        _ => disk(Path::new(place.as_str()), error),
    };
    let length = file.seek(SeekFrom::End(0)).map_err(cut)?;
    file.seek(SeekFrom::Start(8)).map_err(cut)?;
    let mut reader = BufReader::new(file);
    let mut at = 8;
    let mut size_px = None;
    loop {
        let mut head = [0; 8];
        reader.read_exact(&mut head).map_err(cut)?;
        let chunk = u64::from(u32::from_be_bytes([head[0], head[1], head[2], head[3]]));
        at += 8 + chunk + 4;
        if at > length {
            return Err(cut_short(place));
        }
        match (&head[4..], size_px) {
            (b"IHDR", None) if chunk == 13 => {
                let mut size = [0; 8];
                reader.read_exact(&mut size).map_err(cut)?;
                let number = |at: usize| u32::from_be_bytes([size[at], size[at + 1], size[at + 2], size[at + 3]]);
                size_px = Some([number(0), number(4)]);
                reader.seek_relative(5 + 4).map_err(cut)?;
            }
            (_, None) => return Err(unreadable(place, "its header is missing")),
            (b"IEND", Some(size_px)) if size_px[0] > 0 && size_px[1] > 0 => return Ok(size_px),
            (b"IEND", _) => return Err(unreadable(place, "it has no pixels")),
            _ => reader.seek_relative(chunk as i64 + 4).map_err(cut)?,
        }
    }
}

/// Decodes an image within the limit: the formats whose structure does not tell whether they are whole.
fn decoded_size(file: &Path, place: &SurveyPath, within: &dyn Fn([u32; 2]) -> bool) -> Result<[u32; 2], ApiError> {
    let open = || -> Result<_, ApiError> {
        let mut reader = image::ImageReader::open(file).map_err(|error| disk(file, error))?;
        reader.set_format(image::ImageFormat::Tiff);
        Ok(reader)
    };
    let wrong = |error: image::ImageError| match error {
        image::ImageError::IoError(error) if error.kind() == std::io::ErrorKind::UnexpectedEof => cut_short(place),
        error => unreadable(place, &error.to_string()),
    };
    let (width, height) = open()?.into_dimensions().map_err(wrong)?;
    if within([width, height]) {
        open()?.decode().map_err(wrong)?;
    }
    Ok([width, height])
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

fn cut_short(place: &SurveyPath) -> ApiError {
    ApiError::new(
        Code::ImageTruncated,
        format!("{place} is cut short: copy it from the drone's card again, then send it again"),
    )
}

fn unreadable(place: &SurveyPath, what: &str) -> ApiError {
    ApiError::new(
        Code::ImageUnreadable,
        format!("{place} cannot be read: {what}; copy it from the drone's card again, then send it again"),
    )
}
