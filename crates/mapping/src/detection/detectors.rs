//! What is made of the networks' boxes: one set of modules per image.

use super::mask_to_boxes::ModuleBox;
use super::merge::merge;
use super::{Detection, DetectionError, Detector, Unet, Yolo, filter, halves, lattice, periodicity, registration};
use crate::geometry::Quad;
use image::RgbImage;
use nalgebra::Vector2;

/// Least mean probability of a face by the U-Net where YOLO alone has a box: on shadows and trees there is little.
const TRACE: f64 = 0.5;

/// Both detectors, the one complementing the other (paper, 3.2).
pub(super) struct Both {
    pub unet: Unet,
    pub yolo: Yolo,
}

impl Detector for Both {
    fn detect(&self, image: &RgbImage, gsd_m: Option<f64>) -> Result<Vec<Detection>, DetectionError> {
        detect(Some(&self.unet), Some(&self.yolo), image, gsd_m)
    }

    fn describe(&self) -> String {
        format!("{}; complemented by {}", self.unet.describe(), self.yolo.describe())
    }

    fn identity(&self) -> String {
        format!("{}; complemented by {}", self.unet.identity(), self.yolo.identity())
    }
}

/// Searches an image with the networks that are there. Modules wholly inside it, in its pixels.
pub(super) fn detect(
    unet: Option<&Unet>,
    yolo: Option<&Yolo>,
    image: &RgbImage,
    gsd_m: Option<f64>,
) -> Result<Vec<Detection>, DetectionError> {
    let (width, height) = image.dimensions();
    if width == 0 || height == 0 {
        return Ok(Vec::new());
    }
    let mut boxes = search(unet, yolo, image, gsd_m, gsd_m)?;
    let is_enlarged = unet.is_some_and(|unet| unet.enlarges(gsd_m)) || yolo.is_some_and(|yolo| yolo.enlarges(gsd_m));
    if is_enlarged {
        // Enlarging a coarse photo helps where seams are faint, and harms where they are blurred.
        let as_taken = search(unet, yolo, image, None, gsd_m)?;
        if area_in_lattices_px2(&as_taken) > area_in_lattices_px2(&boxes) {
            boxes = as_taken;
        }
    }
    let mut boxes = halves::join_halves(boxes, image, gsd_m);
    registration::register(&mut boxes, image)?;
    Ok(boxes.iter().filter_map(detection).filter(|d| filter::is_inside_frame(&d.quad.corners, width, height)).collect())
}

/// The boxes of an image whose networks see it as if it had the ground sampling distance `working_gsd_m`; those that the
/// frame cuts are among them.
fn search(
    unet: Option<&Unet>,
    yolo: Option<&Yolo>,
    image: &RgbImage,
    working_gsd_m: Option<f64>,
    gsd_m: Option<f64>,
) -> Result<Vec<ModuleBox>, DetectionError> {
    let (foundation, seen) = match unet {
        Some(unet) => {
            let (boxes, seen) = unet.search(image, working_gsd_m)?;
            (boxes, Some(seen))
        }
        None => (Vec::new(), None),
    };
    let complement = yolo.map(|yolo| yolo.search(image, working_gsd_m)).transpose()?.unwrap_or_default();
    let evidence = seen.as_ref().map(|seen| seen as &dyn lattice::Evidence);
    let size = Vector2::new(f64::from(image.width()), f64::from(image.height()));
    // Each network's boxes in their own lattices first: the less exact must not disturb the more exact.
    let foundation = lattice::complete(foundation, evidence, size);
    let complement = lattice::complete(complement, None, size);
    let shows = |b: &ModuleBox| evidence.is_none_or(|evidence| lattice::face(b, evidence) > TRACE);
    let boxes = filter::supported(merge(foundation, complement, shows));
    Ok(match &seen {
        Some(seen) => periodicity::part_benches(boxes, &seen.view(image, gsd_m)),
        None => boxes,
    })
}

/// How much of the image the boxes cover that stand in lattices.
fn area_in_lattices_px2(boxes: &[ModuleBox]) -> f64 {
    lattice::grouped(boxes).iter().flatten().map(|&(_, index)| boxes[index].area_px2()).sum()
}

fn detection(b: &ModuleBox) -> Option<Detection> {
    let quad = Quad::from_unordered(b.quad().corners)?;
    Some(Detection { quad, score: b.score, source: b.source })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::detection::Source;

    #[test]
    fn only_what_stands_in_lattices_speaks_for_a_scale() {
        let at = |x: f64, y: f64| ModuleBox {
            center: Vector2::new(x, y),
            u: Vector2::new(0.0, 30.0),
            v: Vector2::new(20.0, 0.0),
            score: 0.9,
            source: Source::Unet,
        };
        let bench: Vec<ModuleBox> = (0..12).map(|k| at(20.4 * f64::from(k % 6), 30.6 * f64::from(k / 6))).collect();
        let strays: Vec<ModuleBox> =
            (0..20).map(|k| at(400.0 + 55.0 * f64::from(k), 37.0 * f64::from(k % 3))).collect();
        assert_eq!(area_in_lattices_px2(&strays), 0.0);
        let all: Vec<ModuleBox> = bench.iter().chain(&strays).copied().collect();
        assert!((area_in_lattices_px2(&all) - 12.0 * 600.0).abs() < 1e-6);
    }
}
