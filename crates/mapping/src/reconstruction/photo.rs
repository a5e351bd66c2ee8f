//! Photos: checked by their header before anything is decoded, decoded whole or refused, undistorted where the file is
//! as the lens drew it.

use super::entropy;
use super::excerpt::{Excerpt, Parts};
use super::exif::{self, Exposure};
use super::jpeg::{self, JpegError};
use super::quality::{MEASURED_PX, Quality};
use crate::geometry::Camera;
use fast_image_resize as fir;
use image::error::UnsupportedErrorKind;
use image::{
    ColorType, DynamicImage, ExtendedColorType, GrayImage, ImageDecoder, ImageError, ImageFormat, ImageReader, RgbImage,
};
use nalgebra::Vector2;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

/// Default for the most pixels that an image may have: 100 megapixels.
pub const DEFAULT_MAX_PIXELS: u64 = 100_000_000;
/// Most values of an entry of a TIFF's directory: 100 megapixels in tiles of 16 x 16 pixels have so many places.
const MAX_TIFF_VALUES: u32 = 400_000;

/// Why a photo is refused. Each sentence names the file and says what to do.
#[derive(Debug, thiserror::Error)]
pub enum PhotoError {
    #[error("{name} cannot be read: {source}")]
    Unreadable { name: String, source: std::io::Error },
    #[error("{name} is no image that can be read (JPEG, PNG or TIFF): {what}; copy it from the camera again")]
    NotAnImage { name: String, what: String },
    #[error(
        "{name} holds a {held} but is named as a {named}: convert it to {named}, or name it by what it is here and in the \
         reconstruction"
    )]
    WrongName { name: String, named: &'static str, held: &'static str },
    #[error(
        "{name} is {width} x {height} pixels, more than the {limit} pixels allowed: scale it down, or raise the limit"
    )]
    TooLarge { name: String, width: u32, height: u32, limit: u64 },
    #[error(
        "{name} is {} x {} pixels, but its camera was calibrated at {} x {}: it was turned after the reconstruction, by an \
         image viewer perhaps; give the photo as the camera wrote it",
        size_px[0], size_px[1], expected_px[0], expected_px[1]
    )]
    Turned { name: String, size_px: [u32; 2], expected_px: [u32; 2] },
    #[error(
        "{name} holds 32-bit numbers, as thermal cameras write temperatures: it is no photo of modules; give the colour photo, \
         or convert it to 8 bits"
    )]
    FloatingPoint { name: String },
    #[error("{name} is cut short: its image data ends early; copy it from the camera again")]
    Truncated { name: String },
}

impl PhotoError {
    /// A stable word for programs.
    pub fn code(&self) -> &'static str {
        match self {
            Self::Unreadable { .. } => "file_unreadable",
            Self::NotAnImage { .. } => "image_unreadable",
            Self::WrongName { .. } => "image_format_mismatch",
            Self::TooLarge { .. } => "image_too_large",
            Self::Truncated { .. } => "image_truncated",
            Self::Turned { .. } => "image_turned",
            Self::FloatingPoint { .. } => "image_floating_point",
        }
    }
}

/// What the header of a photo says.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PhotoHeader {
    pub width_px: u32,
    pub height_px: u32,
    pub format: ImageFormat,
}

impl PhotoHeader {
    /// Of the photo `name`, which [`inspect`] let through before and found to be of this size, width and height in pixels;
    /// `None` where the name does not tell the format.
    ///
    /// # Errors
    /// More than `max_pixels`.
    pub fn known(name: &str, [width_px, height_px]: [u32; 2], max_pixels: u64) -> Result<Option<Self>, PhotoError> {
        let Some(format) = format_by_name(name) else { return Ok(None) };
        Self { width_px, height_px, format }.within(name, max_pixels).map(Some)
    }

    fn within(self, name: &str, limit: u64) -> Result<Self, PhotoError> {
        let Self { width_px: width, height_px: height, .. } = self;
        if u64::from(width) * u64::from(height) <= limit {
            return Ok(self);
        }
        Err(PhotoError::TooLarge { name: name.to_owned(), width, height, limit })
    }
}

/// The last part of a path.
pub(crate) fn file_name(path: &Path) -> String {
    path.file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned())
}

fn format_by_name(name: &str) -> Option<ImageFormat> {
    let extension = Path::new(name).extension().and_then(|e| e.to_str()).unwrap_or("").to_ascii_lowercase();
    match extension.as_str() {
        "jpg" | "jpeg" => Some(ImageFormat::Jpeg),
        "png" => Some(ImageFormat::Png),
        "tif" | "tiff" => Some(ImageFormat::Tiff),
        _ => None,
    }
}

/// Whether a file is named as photos that can be read are.
pub fn is_photo_name(name: &str) -> bool {
    format_by_name(name).is_some()
}

fn format_name(format: ImageFormat) -> &'static str {
    match format {
        ImageFormat::Jpeg => "JPEG",
        ImageFormat::Png => "PNG",
        ImageFormat::Tiff => "TIFF",
        _ => "another format",
    }
}

/// Checks a photo without decoding it: its format by content and by `name` (what the user calls it), its size against
/// `max_pixels`, and that a JPEG or PNG runs to its end.
///
/// # Errors
/// What is wrong with the photo.
pub fn inspect(path: &Path, name: &str, max_pixels: u64) -> Result<PhotoHeader, PhotoError> {
    let unreadable = |source| PhotoError::Unreadable { name: name.to_owned(), source };
    let not_an_image = |what: &str| PhotoError::NotAnImage { name: name.to_owned(), what: what.to_owned() };
    let mut file = File::open(path).map_err(unreadable)?;
    let mut start = Vec::new();
    file.by_ref().take(64).read_to_end(&mut start).map_err(unreadable)?;
    file.rewind().map_err(unreadable)?;
    let format = image::guess_format(&start)
        .ok()
        .filter(|format| matches!(format, ImageFormat::Jpeg | ImageFormat::Png | ImageFormat::Tiff))
        .ok_or_else(|| not_an_image("it begins otherwise"))?;
    if let Some(named) = format_by_name(name).filter(|named| *named != format) {
        return Err(PhotoError::WrongName {
            name: name.to_owned(),
            named: format_name(named),
            held: format_name(format),
        });
    }
    let within = |size: [u32; 2]| u64::from(size[0]) * u64::from(size[1]) <= max_pixels;
    let size_px = match format {
        ImageFormat::Jpeg => walk_jpeg(file, name, within)?.size_px,
        ImageFormat::Png => walk_png(file, name)?.0,
        _ => tiff_size(file, name)?,
    };
    let [width_px, height_px] = size_px;
    if width_px == 0 || height_px == 0 {
        return Err(not_an_image("it has no pixels"));
    }
    PhotoHeader { width_px, height_px, format }.within(name, max_pixels)
}

fn walk_jpeg(file: impl Read, name: &str, limit: impl Fn([u32; 2]) -> bool) -> Result<jpeg::Structure, PhotoError> {
    jpeg::walk(BufReader::with_capacity(1 << 18, file), limit).map_err(|error| match error {
        JpegError::CutShort => PhotoError::Truncated { name: name.to_owned() },
        JpegError::Io(source) => PhotoError::Unreadable { name: name.to_owned(), source },
        JpegError::Malformed(_) | JpegError::TooManyParts => {
            PhotoError::NotAnImage { name: name.to_owned(), what: error.to_string() }
        }
    })
}

/// Chunks of a PNG that make its picture (PNG specification, third edition, 11.2, and transparency).
const PICTURE_CHUNKS: [&[u8]; 5] = [b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND"];

/// Walks a PNG's chunks to its end: its size, and the bytes that make the picture.
fn walk_png(mut file: impl Read + Seek, name: &str) -> Result<([u32; 2], Parts), PhotoError> {
    let cut = |error: std::io::Error| match error.kind() {
        std::io::ErrorKind::UnexpectedEof => PhotoError::Truncated { name: name.to_owned() },
        _ => PhotoError::Unreadable { name: name.to_owned(), source: error },
    };
    let not_an_image = |what: &str| PhotoError::NotAnImage { name: name.to_owned(), what: what.to_owned() };
    let length = file.seek(SeekFrom::End(0)).map_err(cut)?;
    file.seek(SeekFrom::Start(8)).map_err(cut)?;
    let mut reader = BufReader::new(file);
    let mut picture = Parts::default();
    let mut keep =
        |from: u64, to: u64| picture.add(from..to).map_err(|_| not_an_image("its picture is in too many pieces"));
    keep(0, 8)?;
    let mut at = 8;
    let mut size_px = None;
    loop {
        let mut head = [0; 8];
        reader.read_exact(&mut head).map_err(cut)?;
        let chunk = u64::from(u32::from_be_bytes([head[0], head[1], head[2], head[3]]));
        let from = at;
        at += 8 + chunk + 4;
        if at > length {
            return Err(PhotoError::Truncated { name: name.to_owned() });
        }
        if PICTURE_CHUNKS.contains(&&head[4..]) {
            keep(from, at)?;
        }
        match (&head[4..], size_px) {
            (b"IHDR", None) if chunk == 13 => {
                let mut size = [0; 8];
                reader.read_exact(&mut size).map_err(cut)?;
                let number = |at: usize| u32::from_be_bytes([size[at], size[at + 1], size[at + 2], size[at + 3]]);
                size_px = Some([number(0), number(4)]);
                reader.seek_relative(5 + 4).map_err(cut)?;
            }
            (_, None) => return Err(not_an_image("its header is missing")),
            (b"IEND", Some(size_px)) => return Ok((size_px, picture)),
            _ => reader.seek_relative(chunk as i64 + 4).map_err(cut)?,
        }
    }
}

/// Refuses a TIFF whose directory claims so many values that a decoder, which keeps each of them, would need far more
/// memory than the picture.
fn require_sane_tiff(file: &mut (impl Read + Seek), name: &str) -> Result<(), PhotoError> {
    match exif::most_tiff_values(file) {
        Some(most) if most <= MAX_TIFF_VALUES => Ok(()),
        Some(_) => Err(PhotoError::NotAnImage {
            name: name.to_owned(),
            what: format!("its directory has an entry of more than {MAX_TIFF_VALUES} values"),
        }),
        None => Err(PhotoError::NotAnImage { name: name.to_owned(), what: "it has no directory".to_owned() }),
    }
}

fn tiff_size(mut file: File, name: &str) -> Result<[u32; 2], PhotoError> {
    require_sane_tiff(&mut file, name)?;
    file.rewind().map_err(|source| PhotoError::Unreadable { name: name.to_owned(), source })?;
    let mut reader = ImageReader::new(BufReader::new(file));
    reader.set_format(ImageFormat::Tiff);
    let decoder = reader.into_decoder().map_err(|error| undecodable(name, error))?;
    if matches!(decoder.color_type(), ColorType::Rgb32F | ColorType::Rgba32F) {
        return Err(PhotoError::FloatingPoint { name: name.to_owned() });
    }
    let (width, height) = decoder.dimensions();
    Ok([width, height])
}

/// What it means that an image cannot be decoded.
fn undecodable(name: &str, error: ImageError) -> PhotoError {
    match error {
        // One channel of 32-bit numbers, which the decoder does not know.
        ImageError::Unsupported(error)
            if matches!(error.kind(), UnsupportedErrorKind::Color(ExtendedColorType::Unknown(32))) =>
        {
            PhotoError::FloatingPoint { name: name.to_owned() }
        }
        ImageError::IoError(error) if error.kind() == std::io::ErrorKind::UnexpectedEof => {
            PhotoError::Truncated { name: name.to_owned() }
        }
        error => PhotoError::NotAnImage { name: name.to_owned(), what: error.to_string() },
    }
}

/// As [`inspect`], and decodes what does not tell by its structure whether it is whole (TIFF).
///
/// # Errors
/// What is wrong with the photo.
pub fn inspect_whole(path: &Path, name: &str, max_pixels: u64) -> Result<PhotoHeader, PhotoError> {
    let header = inspect(path, name, max_pixels)?;
    if header.format == ImageFormat::Tiff {
        decode(path, name, header.format)?;
    }
    Ok(header)
}

/// What a photo tells of itself, and how good it is.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PhotoFacts {
    #[serde(flatten)]
    pub exposure: Exposure,
    pub quality: Quality,
    /// Whether the data of the picture is damaged within, so that what decoders show is not what the camera saw.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub damaged: bool,
}

/// Decodes a photo that [`inspect`] let through, and measures it.
///
/// # Errors
/// Data that does not decode.
pub fn examine(path: &Path, name: &str, header: PhotoHeader) -> Result<PhotoFacts, PhotoError> {
    let mut picture = decode(path, name, header.format)?.into_luma8();
    let shrink = f64::from(MEASURED_PX) / f64::from(picture.width().max(picture.height()));
    if shrink < 1.0 {
        let size = |pixels: u32| ((f64::from(pixels) * shrink).round() as u32).max(1);
        let mut shrunk = GrayImage::new(size(picture.width()), size(picture.height()));
        let options = fir::ResizeOptions::new().resize_alg(fir::ResizeAlg::Convolution(fir::FilterType::Box));
        fir::Resizer::new()
            .resize(&picture, &mut shrunk, Some(&options))
            .map_err(|error| PhotoError::NotAnImage { name: name.to_owned(), what: error.to_string() })?;
        picture = shrunk;
    }
    let damaged = header.format == ImageFormat::Jpeg && {
        let file = File::open(path).map_err(|source| PhotoError::Unreadable { name: name.to_owned(), source })?;
        entropy::damage(BufReader::with_capacity(1 << 16, file)).is_some()
    };
    Ok(PhotoFacts { exposure: exif::read(path), quality: Quality::measure(&picture), damaged })
}

/// Decodes a photo. What is no part of the picture, metadata and what follows its end, does not come to the decoder.
fn decode(path: &Path, name: &str, format: ImageFormat) -> Result<DynamicImage, PhotoError> {
    let unreadable = |source| PhotoError::Unreadable { name: name.to_owned(), source };
    let mut file = File::open(path).map_err(unreadable)?;
    let picture = match format {
        ImageFormat::Jpeg => Some(walk_jpeg(&file, name, |_| true)?.picture),
        ImageFormat::Png => Some(walk_png(&file, name)?.1),
        _ => {
            require_sane_tiff(&mut file, name)?;
            None
        }
    };
    file.rewind().map_err(unreadable)?;
    let decoded = match picture {
        Some(parts) => {
            let excerpt = BufReader::with_capacity(1 << 16, Excerpt::new(file, parts));
            ImageReader::with_format(excerpt, format).decode()
        }
        None => ImageReader::with_format(BufReader::new(file), format).decode(),
    };
    decoded.map_err(|error| undecodable(name, error))
}

/// A photo on disk that belongs to a shot.
#[derive(Debug, Clone)]
pub struct Photo {
    /// The shot's name.
    pub shot: String,
    pub path: PathBuf,
    pub header: PhotoHeader,
    /// The camera of the file as it is, distorted or not, at the file's size.
    pub camera: Camera,
}

impl Photo {
    /// The camera of what [`Photo::load`] gives: free of distortion.
    pub fn undistorted_camera(&self) -> Camera {
        self.camera.undistorted()
    }

    /// Decodes the photo and undistorts it where the file is as the lens drew it. H x W, 8-bit RGB.
    ///
    /// # Errors
    /// Data that does not decode.
    pub fn load(&self) -> Result<RgbImage, PhotoError> {
        let decoded = decode(&self.path, &file_name(&self.path), self.header.format)?.into_rgb8();
        if self.camera.is_undistorted() { Ok(decoded) } else { Ok(undistort(&decoded, &self.camera)) }
    }
}

/// The image that the same camera without distortion would have taken: same size, focal length and principal point
/// (OpenSfM's convention). Bilinear; black where the photo does not reach.
pub fn undistort(photo: &RgbImage, camera: &Camera) -> RgbImage {
    let target = camera.undistorted();
    let (width, height) = photo.dimensions();
    let source = photo.as_raw();
    let stride = width as usize * 3;
    let mut pixels = vec![0_u8; stride * height as usize];
    // The lens is smooth: exact at every 8th column and in between interpolated, to well below 0.01 px.
    const STEP: usize = 8;
    pixels.par_chunks_mut(stride).enumerate().for_each(|(v, row)| {
        let knot = |u: usize| {
            let n = target.normalised_from_pixel(Vector2::new(u as f64, v as f64));
            camera.pixel_from_normalised(n.x, n.y)
        };
        let mut left = knot(0);
        for start in (0..width as usize).step_by(STEP) {
            let right = knot(start + STEP);
            for (offset, pixel) in row[start * 3..].chunks_exact_mut(3).take(STEP).enumerate() {
                let at = left + (right - left) * (offset as f64 / STEP as f64);
                let (x0, y0) = (at.x.floor(), at.y.floor());
                if x0 < 0.0 || y0 < 0.0 || x0 + 1.0 >= f64::from(width) || y0 + 1.0 >= f64::from(height) {
                    continue;
                }
                let (fx, fy) = ((at.x - x0) as f32, (at.y - y0) as f32);
                let base = y0 as usize * stride + x0 as usize * 3;
                for (channel, value) in pixel.iter_mut().enumerate() {
                    let sample = |offset: usize| f32::from(source[base + offset + channel]);
                    let top = sample(0) * (1.0 - fx) + sample(3) * fx;
                    let bottom = sample(stride) * (1.0 - fx) + sample(stride + 3) * fx;
                    *value = (top * (1.0 - fy) + bottom * fy + 0.5) as u8;
                }
            }
            left = right;
        }
    });
    RgbImage::from_raw(width, height, pixels).expect("the buffer was made for this size")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::camera::Lens;
    use image::Rgb;

    fn picture() -> RgbImage {
        RgbImage::from_fn(160, 120, |x, y| Rgb([(x + y) as u8, (2 * x) as u8, (255 - y) as u8]))
    }

    #[test]
    fn a_jpeg_cut_short_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.jpg");
        picture().save(&path).unwrap();
        let header = inspect(&path, "a.jpg", DEFAULT_MAX_PIXELS).unwrap();
        assert_eq!((header.width_px, header.height_px), (160, 120));
        let bytes = std::fs::read(&path).unwrap();
        std::fs::write(&path, &bytes[..bytes.len() * 2 / 3]).unwrap();
        assert!(matches!(inspect(&path, "a.jpg", DEFAULT_MAX_PIXELS), Err(PhotoError::Truncated { .. })));
    }

    #[test]
    fn format_and_size_are_checked_by_the_header() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.png");
        picture().save(&path).unwrap();
        assert!(matches!(inspect(&path, "a.jpg", DEFAULT_MAX_PIXELS), Err(PhotoError::WrongName { .. })));
        assert!(matches!(inspect(&path, "a.png", 1000), Err(PhotoError::TooLarge { .. })));
        std::fs::write(&path, b"no image at all").unwrap();
        assert!(matches!(inspect(&path, "a.png", 1000), Err(PhotoError::NotAnImage { .. })));
    }

    #[test]
    fn undistortion_puts_a_mark_where_the_pinhole_camera_sees_it() {
        let mut camera = Camera::pinhole(161, 121, 0.8);
        camera.lens = Lens::Radial { k1: -0.1, k2: 0.01, k3: 0.0, p1: 0.0, p2: 0.0 };
        let normalised = Vector2::new(0.4, 0.25);
        let distorted = camera.pixel_from_normalised(normalised.x, normalised.y);
        let photo = RgbImage::from_fn(161, 121, |x, y| {
            let d = (Vector2::new(f64::from(x), f64::from(y)) - distorted).norm();
            Rgb([(255.0 * (-d * d / 8.0).exp()) as u8; 3])
        });
        let flat = undistort(&photo, &camera);
        let (mut sum, mut weight) = (Vector2::zeros(), 0.0);
        for (x, y, p) in flat.enumerate_pixels() {
            let w = f64::from(p.0[0]);
            sum += Vector2::new(f64::from(x), f64::from(y)) * w;
            weight += w;
        }
        let expected = camera.undistorted().pixel_from_normalised(normalised.x, normalised.y);
        assert!((sum / weight - expected).norm() < 0.05);
    }
}
