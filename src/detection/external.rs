//! Boxes made by another program or corrected by a person: the form that `heliomap detect` writes.

use super::{Detection, ImageDetections, Source};
use crate::geometry::Quad;
use serde::{Deserialize, Serialize};
use std::collections::HashSet;
use std::fs::File;
use std::io::{BufReader, Read};
use std::path::Path;

const MAX_BYTES: u64 = 512 << 20;
/// The most boxes that one image may have: modules of ten pixels side by side would fill 20 megapixels.
const MAX_BOXES: usize = 200_000;

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
    #[error("{name}: {image} stands there twice; give the boxes of an image together")]
    Repeated { name: String, image: String },
    #[error("{name}: {image} has {count} boxes, more than the {MAX_BOXES} that an image may have")]
    TooMany { name: String, image: String, count: usize },
    #[error(
        "{name}: box {index} of {image} lies outside of its {width} x {height} pixels; corners are pixels of the undistorted \
         image, from its upper left"
    )]
    Outside { name: String, image: String, index: usize, width: u32, height: u32 },
    #[error(
        "{name}: box {index} of {image} has corners that are no convex quadrilateral (four different, finite points are needed)"
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
    let mut names = HashSet::new();
    boxes
        .images
        .into_iter()
        .map(|image| {
            if !names.insert(image.image.clone()) {
                return Err(BoxError::Repeated { name: name.clone(), image: image.image });
            }
            if image.boxes.len() > MAX_BOXES {
                return Err(BoxError::TooMany { name: name.clone(), count: image.boxes.len(), image: image.image });
            }
            let (width, height) = (image.width, image.height);
            if image.width == 0 || image.height == 0 {
                return Err(BoxError::Malformed { name: name.clone(), what: format!("{} has no size", image.image) });
            }
            let detections = image
                .boxes
                .iter()
                .enumerate()
                .map(|(index, b)| {
                    let no_quad = || BoxError::NoQuad { name: name.clone(), image: image.image.clone(), index };
                    let quad =
                        Quad::from_unordered(b.corners.map(Into::into)).filter(Quad::is_convex).ok_or_else(no_quad)?;
                    // A module that the frame cuts may reach out of it, but not lie outside.
                    let center = quad.center();
                    if !(0.0..f64::from(width)).contains(&center.x) || !(0.0..f64::from(height)).contains(&center.y) {
                        let (name, image) = (name.clone(), image.image.clone());
                        return Err(BoxError::Outside { name, image, index, width, height });
                    }
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

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::{Value, json};

    fn read_text(text: &str) -> Result<Vec<ImageDetections>, BoxError> {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), text).unwrap();
        read(file.path())
    }

    fn file_of(corners: &Value) -> String {
        json!({"images": [{"image": "a.jpg", "width": 100, "height": 80, "boxes": [{"corners": corners}]}]}).to_string()
    }

    #[test]
    fn corners_may_come_in_any_order_and_direction() {
        let corners = [[10.0, 10.0], [30.0, 12.0], [29.0, 24.0], [9.0, 22.0]];
        let expected = read_text(&file_of(&json!(corners))).unwrap();
        assert_eq!((expected[0].detections[0].score, expected[0].detections[0].source), (1.0, Source::External));
        for order in [[3, 2, 1, 0], [2, 3, 0, 1], [0, 2, 1, 3], [3, 0, 2, 1]] {
            let given = order.map(|k: usize| corners[k]);
            assert_eq!(read_text(&file_of(&json!(given))).unwrap(), expected, "{order:?}");
        }
    }

    #[test]
    fn what_is_written_is_read_again() {
        let found = read_text(&file_of(&json!([[10.0, 10.0], [30.0, 12.0], [29.0, 24.0], [9.0, 22.0]]))).unwrap();
        let text = serde_json::to_string(&to_file(&found)).unwrap();
        assert_eq!(read_text(&text).unwrap(), found);
    }

    #[test]
    fn what_is_no_box_is_refused_with_its_place() {
        for (text, words) in [
            (String::new(), "is not a file of boxes"),
            ("[]".to_owned(), "is not a file of boxes"),
            (file_of(&json!([[0, 0], [1, 1], [2, 2], [3, 3]])), "box 0 of a.jpg has corners that are no convex"),
            (file_of(&json!([[10, 10], [30, 10], [12, 12], [10, 30]])), "no convex quadrilateral"),
            (file_of(&json!([[10, 10], [30, 10], [30, 20]])), "is not a file of boxes"),
            (file_of(&json!([[10, 10], [30, 10], [30, 20], null])), "is not a file of boxes"),
            (file_of(&json!([[10, 10], [30, 10], [30, 20], [10, "x"]])), "is not a file of boxes"),
            (file_of(&json!([[110, 10], [130, 10], [130, 20], [110, 20]])), "lies outside of its 100 x 80 pixels"),
            (file_of(&json!([[10, 10], [30, 10], [30, 20], [10, 20]])).replace("30,10", "1e400,10"), "out of range"),
            (file_of(&json!([])).replace("100", "0"), "is not a file of boxes"),
            (file_of(&json!([])).replace("100", "-5"), "is not a file of boxes"),
            (
                json!({"images": [{"image": "a", "width": 9, "height": 9, "boxes": []}, {"image": "a", "width": 9, "height": 9, "boxes": []}]})
                    .to_string(),
                "a stands there twice",
            ),
        ] {
            let error = read_text(&text).unwrap_err().to_string();
            assert!(error.contains(words), "{error} ({text})");
        }
        let corners = [[1, 1], [2, 1], [2, 2], [1, 2]];
        let many: Vec<Value> = (0..=MAX_BOXES).map(|_| json!({"corners": corners})).collect();
        let text = json!({"images": [{"image": "a", "width": 9, "height": 9, "boxes": many}]}).to_string();
        assert!(matches!(read_text(&text), Err(BoxError::TooMany { .. })));
    }
}
