//! Boxes made by another program or corrected by a person: the form that `heliomap detect` writes.

use super::{Detection, ImageDetections, Source};
use crate::geometry::Quad;
use nalgebra::Vector2;
use rstar::RTree;
use rstar::primitives::GeomWithData;
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

/// What a file of boxes holds.
#[derive(Debug, Clone, PartialEq)]
pub struct BoxesRead {
    pub images: Vec<ImageDetections>,
    /// Names of images of which some boxes cannot be used, and how many.
    pub left_out: Vec<(String, usize)>,
}

/// Reads a file of boxes. Those that lie outside of their image and those without area are left out, unless there are no
/// others: then the file as a whole is not what it should be.
///
/// # Errors
/// A file that is not of this form, or holds boxes none of which can be used.
pub fn read(path: &Path) -> Result<BoxesRead, BoxError> {
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
    let (mut images, mut left_out) = (Vec::with_capacity(boxes.images.len()), Vec::new());
    let mut first_fault = None;
    for image in boxes.images {
        if !names.insert(image.image.clone()) {
            return Err(BoxError::Repeated { name, image: image.image });
        }
        if image.boxes.len() > MAX_BOXES {
            return Err(BoxError::TooMany { name, count: image.boxes.len(), image: image.image });
        }
        if image.width == 0 || image.height == 0 {
            return Err(BoxError::Malformed { name, what: format!("{} has no size", image.image) });
        }
        let mut detections = Vec::with_capacity(image.boxes.len());
        for (index, given) in image.boxes.iter().enumerate() {
            match detection(given, &image, &name, index) {
                Ok(detection) => detections.push(detection),
                Err(fault) => first_fault = first_fault.or(Some(fault)),
            }
        }
        let unusable = image.boxes.len() - detections.len();
        if unusable > 0 {
            left_out.push((image.image.clone(), unusable));
        }
        images.push(ImageDetections { image: image.image, width_px: image.width, height_px: image.height, detections });
    }
    match first_fault {
        Some(fault) if images.iter().all(|image| image.detections.is_empty()) => Err(fault),
        _ => Ok(BoxesRead { images, left_out }),
    }
}

/// The boxes of an image that do not lie on a better one: of two of like size, neither has its centre in the other. Lattices need one box to
/// a module, and heaps of boxes would cost without end.
pub fn without_doubles(detections: Vec<Detection>) -> Vec<Detection> {
    /// Areas within this factor are of like size; how far off a double's centre is at most, in roots of the area.
    const LIKE: f64 = 3.0;
    const NEAR: f64 = 2.5;
    let mut order: Vec<usize> = (0..detections.len()).collect();
    order.sort_by(|a, b| detections[*b].score.total_cmp(&detections[*a].score).then(a.cmp(b)));
    let mut better: RTree<GeomWithData<[f64; 2], usize>> = RTree::new();
    let mut kept = vec![false; detections.len()];
    for index in order {
        let (own, center) = (&detections[index].quad, detections[index].quad.center());
        let is_double = better.locate_within_distance([center.x, center.y], NEAR * NEAR * own.area_px2()).any(|near| {
            let other = &detections[near.data].quad;
            (1.0 / LIKE..LIKE).contains(&(own.area_px2() / other.area_px2()))
                && (other.contains(center) || own.contains(other.center()))
        });
        if !is_double {
            kept[index] = true;
            better.insert(GeomWithData::new([center.x, center.y], index));
        }
    }
    detections.into_iter().zip(kept).filter(|(_, kept)| *kept).map(|(detection, _)| detection).collect()
}

/// The module that a box tells of.
fn detection(given: &OrientedBox, image: &BoxImage, name: &str, index: usize) -> Result<Detection, BoxError> {
    let no_quad = || BoxError::NoQuad { name: name.to_owned(), image: image.image.clone(), index };
    let (width, height) = (f64::from(image.width), f64::from(image.height));
    let quad = Quad::from_unordered(given.corners.map(Into::into)).ok_or_else(no_quad)?;
    // A module that the frame cuts may reach out of it, but not lie outside.
    let center = quad.center();
    let is_inside = (0.0..width).contains(&center.x) && (0.0..height).contains(&center.y);
    let is_near = |corner: &Vector2<f64>| {
        (-width..2.0 * width).contains(&corner.x) && (-height..2.0 * height).contains(&corner.y)
    };
    if !is_inside || !quad.corners.iter().all(is_near) {
        let (name, image, width, height) = (name.to_owned(), image.image.clone(), image.width, image.height);
        return Err(BoxError::Outside { name, image, index, width, height });
    }
    if !quad.is_convex() || !given.score.is_finite() {
        return Err(no_quad());
    }
    Ok(Detection { quad, score: given.score.clamp(0.0, 1.0), source: given.source })
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

    fn read_file(text: &str) -> Result<BoxesRead, BoxError> {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), text).unwrap();
        read(file.path())
    }

    fn read_text(text: &str) -> Result<Vec<ImageDetections>, BoxError> {
        let read = read_file(text)?;
        assert!(read.left_out.is_empty(), "{:?}", read.left_out);
        Ok(read.images)
    }

    fn file_of(corners: &Value) -> String {
        json!({"images": [{"image": "a.jpg", "width": 100, "height": 80, "boxes": [{"corners": corners}]}]}).to_string()
    }

    #[test]
    fn boxes_on_better_ones_are_left_out() {
        let at = |x: f64, side: f64, score: f64| {
            let (right, bottom) = (x + side, 20.0 + side);
            json!({"corners": [[x, 20.0], [right, 20.0], [right, bottom], [x, bottom]], "score": score})
        };
        // A module, the same again, its neighbour, and something far larger around all of them.
        let boxes = [at(10.0, 12.0, 0.8), at(11.0, 12.0, 0.9), at(23.5, 12.0, 0.7), at(2.0, 50.0, 1.0)];
        let image = json!({"image": "a.jpg", "width": 100, "height": 80, "boxes": boxes});
        let mut read = read_text(&json!({"images": [image]}).to_string()).unwrap();
        let kept = without_doubles(read.remove(0).detections);
        assert_eq!(kept.iter().map(|detection| detection.score).collect::<Vec<_>>(), [0.9, 0.7, 1.0]);
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
    fn single_boxes_that_cannot_be_used_are_left_out() {
        let good = json!({"corners": [[10, 10], [30, 10], [30, 20], [10, 20]]});
        let outside = json!({"corners": [[-10.1, 10], [9.9, 10], [9.9, 20], [-10.1, 20]]});
        let thin = json!({"corners": [[10, 10], [30, 10], [30, 10], [10, 10]]});
        let endless = json!({"corners": [[-1e300, -1e300], [1e300, -1e300], [1e300, 1e300], [-1e300, 1e300]]});
        let images = json!({"images": [
            {"image": "a.jpg", "width": 100, "height": 80, "boxes": [outside, good, thin, endless]},
            {"image": "b.jpg", "width": 100, "height": 80, "boxes": [good]},
        ]});
        let read = read_file(&images.to_string()).unwrap();
        assert_eq!(read.left_out, [("a.jpg".to_owned(), 3)]);
        assert_eq!(read.images.iter().map(|image| image.detections.len()).collect::<Vec<_>>(), [1, 1]);
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
