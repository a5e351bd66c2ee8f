//! Boxes made by another program or corrected by a person: the form that `heliomap detect` writes.

use super::{Detection, ImageDetections, Source};
use crate::geometry::Quad;
use serde::{Deserialize, Serialize};
use std::fs::File;
use std::io::{BufReader, Read};
use std::path::Path;

const MAX_BYTES: u64 = 2 << 30;

/// A file of boxes: `{"images": [{"image", "width", "height", "boxes": [{"corners", "score", "source"}]}]}`. Corners are
/// pixels of the undistorted image, in any order or direction.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct BoxFile {
    pub images: Vec<BoxImage>,
}

/// The boxes of one image.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct BoxImage {
    /// Name of the shot.
    pub image: String,
    pub width: u32,
    pub height: u32,
    pub boxes: Vec<OrientedBox>,
}

/// One module.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct OrientedBox {
    pub corners: [[f64; 2]; 4],
    #[serde(default = "certain")]
    pub score: f32,
    #[serde(default = "external")]
    pub source: Source,
}

fn certain() -> f32 {
    1.0
}

fn external() -> Source {
    Source::External
}

/// Why a file of boxes is refused.
#[derive(Debug, thiserror::Error)]
pub enum BoxError {
    #[error("{name} cannot be read: {source}")]
    Unreadable { name: String, source: std::io::Error },
    #[error("{name} has {bytes} bytes, more than the {MAX_BYTES} that are read")]
    TooLarge { name: String, bytes: u64 },
    #[error(
        "{name} is not a file of boxes (`{{\"images\": [{{\"image\", \"width\", \"height\", \"boxes\"}}]}}`): {what}"
    )]
    Malformed { name: String, what: String },
    #[error(
        "{name}: box {index} of {image} has corners that are no quadrilateral (four different, finite points are needed)"
    )]
    NoQuad { name: String, image: String, index: usize },
}

/// Reads a file of boxes.
///
/// # Errors
/// A file that is not of this form, or a box without area.
pub fn read(path: &Path) -> Result<Vec<ImageDetections>, BoxError> {
    let name = path.file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned());
    let unreadable = |source| BoxError::Unreadable { name: name.clone(), source };
    let file = File::open(path).map_err(unreadable)?;
    let bytes = file.metadata().map_err(unreadable)?.len();
    if bytes > MAX_BYTES {
        return Err(BoxError::TooLarge { name, bytes });
    }
    let boxes: BoxFile = serde_json::from_reader(BufReader::new(file.take(MAX_BYTES)))
        .map_err(|error| BoxError::Malformed { name: name.clone(), what: error.to_string() })?;
    boxes
        .images
        .into_iter()
        .map(|image| {
            if image.width == 0 || image.height == 0 {
                return Err(BoxError::Malformed { name: name.clone(), what: format!("{} has no size", image.image) });
            }
            let detections = image
                .boxes
                .iter()
                .enumerate()
                .map(|(index, b)| {
                    let no_quad = || BoxError::NoQuad { name: name.clone(), image: image.image.clone(), index };
                    let quad = Quad::from_unordered(b.corners.map(Into::into)).ok_or_else(no_quad)?;
                    let score = if b.score.is_finite() { b.score.clamp(0.0, 1.0) } else { return Err(no_quad()) };
                    Ok(Detection { quad, score, source: b.source })
                })
                .collect::<Result<Vec<_>, BoxError>>()?;
            Ok(ImageDetections { image: image.image, width_px: image.width, height_px: image.height, detections })
        })
        .collect()
}

/// The form in which boxes are written.
pub fn to_file(detections: &[ImageDetections]) -> BoxFile {
    BoxFile {
        images: detections
            .iter()
            .map(|image| BoxImage {
                image: image.image.clone(),
                width: image.width_px,
                height: image.height_px,
                boxes: image
                    .detections
                    .iter()
                    .map(|d| OrientedBox { corners: d.quad.corners.map(Into::into), score: d.score, source: d.source })
                    .collect(),
            })
            .collect(),
    }
}
