//! Measures a detector: boxes against polygon labels, photo by photo.
//!
//! A module that lies wholly inside the frame is found where a box overlaps it with an intersection over union of at least
//! [`MATCH_IOU`] (greedy, the best pairs first). What the frame cuts, or what lies in an ignored area, counts neither way.
//! `training/evaluate.py` counts in the same way.

mod labels;
mod report;

pub use labels::{LabelledPhoto, read_labels};
pub use report::{DetectionReport, Summary};

use heliomap_mapping::detection::{Detection, Source, filter};
use heliomap_mapping::geometry::Quad;
use image::RgbImage;
use nalgebra::Vector2;
use serde::Serialize;

/// Least intersection over union of a box and the module that it finds.
pub const MATCH_IOU: f64 = 0.5;
/// A box holds a module where it covers more than this share of it.
const COVERED: f64 = 0.5;
/// A pixel is saturated from this value on in its darkest channel.
const SATURATED: u8 = 245;
/// A module is under glare where more than this share of its face is saturated.
const GLARE: f64 = 0.25;

/// How one photo came out.
#[derive(Debug, Clone, Serialize)]
pub struct PhotoScore {
    /// File name of the photo.
    pub image: String,
    /// The plant or the set that it belongs to.
    pub group: String,
    /// Words for the light, the modules and the view.
    pub conditions: Vec<String>,
    /// Modules wholly inside the frame.
    pub modules: usize,
    pub found: usize,
    /// Boxes that count: those on modules inside the frame and false ones.
    pub boxes: usize,
    pub false_boxes: usize,
    /// Modules that hold the centres of several boxes.
    pub splits: usize,
    /// Boxes that cover several modules.
    pub merges: usize,
    /// Modules whose face is saturated in part, and how many of them were found.
    pub glare_modules: usize,
    pub glare_found: usize,
    /// Boxes that count, by the detector that gave them: U-Net, YOLO, external.
    pub by_source: [usize; 3],
    /// Of each module found: intersection over union, distance of the centres in pixels, and the box's area in parts of the
    /// module's.
    #[serde(skip)]
    pub ious: Vec<f64>,
    #[serde(skip)]
    pub center_errors_px: Vec<f64>,
    #[serde(skip)]
    pub area_ratios: Vec<f64>,
    /// Corners of the modules that were missed, pixels.
    pub missed: Vec<[[f64; 2]; 4]>,
    /// Corners of the boxes that are none, pixels.
    pub wrong: Vec<[[f64; 2]; 4]>,
}

/// Compares the boxes of a photo with its labels; both in pixels of the photo as it is.
pub fn compare(labels: &LabelledPhoto, photo: &RgbImage, detections: &[Detection]) -> PhotoScore {
    let (width, height) = photo.dimensions();
    let is_whole: Vec<bool> =
        labels.modules.iter().map(|quad| filter::is_inside_frame(&quad.corners, width, height)).collect();
    let boxes: Vec<&Detection> =
        detections.iter().filter(|d| filter::is_inside_frame(&d.quad.corners, width, height)).collect();
    let mut score = PhotoScore {
        image: labels.image.clone(),
        group: labels.group.clone(),
        conditions: labels.conditions.clone(),
        modules: is_whole.iter().filter(|whole| **whole).count(),
        found: 0,
        boxes: 0,
        false_boxes: 0,
        splits: 0,
        merges: 0,
        glare_modules: 0,
        glare_found: 0,
        by_source: [0; 3],
        ious: Vec::new(),
        center_errors_px: Vec::new(),
        area_ratios: Vec::new(),
        missed: Vec::new(),
        wrong: Vec::new(),
    };
    let centers: Vec<Vector2<f64>> = labels.modules.iter().map(Quad::center).collect();
    let areas: Vec<f64> = labels.modules.iter().map(Quad::area_px2).collect();
    let mut pairs: Vec<(f64, usize, usize)> = Vec::new();
    for (j, found) in boxes.iter().enumerate() {
        let (center, area) = (found.quad.center(), found.quad.area_px2());
        let reach = 1.5 * found.quad.extent_px().1;
        let mut covered = 0;
        for i in (0..centers.len()).filter(|&i| (centers[i] - center).norm() < reach) {
            let shared = labels.modules[i].overlap_px2(&found.quad);
            covered += usize::from(shared > COVERED * areas[i]);
            pairs.push((shared / (areas[i] + area - shared), i, j));
        }
        score.merges += usize::from(covered > 1);
    }
    pairs.sort_by(|a, b| b.0.total_cmp(&a.0).then(b.1.cmp(&a.1)).then(b.2.cmp(&a.2)));
    let mut module_of = vec![None; boxes.len()];
    let mut is_matched = vec![false; centers.len()];
    for &(iou, i, j) in &pairs {
        if iou < MATCH_IOU || is_matched[i] || module_of[j].is_some() {
            continue;
        }
        is_matched[i] = true;
        module_of[j] = Some(i);
        if is_whole[i] {
            score.found += 1;
            score.boxes += 1;
            score.by_source[source_index(boxes[j].source)] += 1;
            score.ious.push(iou);
            score.center_errors_px.push((centers[i] - boxes[j].quad.center()).norm());
            score.area_ratios.push(boxes[j].quad.area_px2() / areas[i]);
        }
    }
    for (j, found) in boxes.iter().enumerate().filter(|(j, _)| module_of[*j].is_none()) {
        let center = found.quad.center();
        if labels.ignore.iter().any(|area| contains(area, center)) {
            continue;
        }
        let under = pairs.iter().find(|(_, i, k)| *k == j && labels.modules[*i].contains(center));
        if under.is_some_and(|(_, i, _)| !is_whole[*i]) {
            continue;
        }
        score.boxes += 1;
        score.false_boxes += 1;
        score.by_source[source_index(found.source)] += 1;
        score.wrong.push(found.quad.corners.map(Into::into));
    }
    for (i, quad) in labels.modules.iter().enumerate().filter(|(i, _)| is_whole[*i]) {
        score.splits += usize::from(boxes.iter().filter(|b| quad.contains(b.quad.center())).count() > 1);
        if !is_matched[i] {
            score.missed.push(quad.corners.map(Into::into));
        }
        if saturated_share(photo, quad) > GLARE {
            score.glare_modules += 1;
            score.glare_found += usize::from(is_matched[i]);
        }
    }
    score
}

fn source_index(source: Source) -> usize {
    match source {
        Source::Unet => 0,
        Source::Yolo => 1,
        Source::External => 2,
    }
}

/// Share of the inner face whose pixels are saturated in every channel.
fn saturated_share(photo: &RgbImage, quad: &Quad) -> f64 {
    const STEPS: i32 = 4;
    let ([u, v], center) = (quad.sides(), quad.center());
    let (mut saturated, mut all) = (0, 0);
    for i in -STEPS..=STEPS {
        for j in -STEPS..=STEPS {
            let at = center + (u * f64::from(i) + v * f64::from(j)) * (0.42 / f64::from(STEPS));
            let (x, y) = (at.x.round(), at.y.round());
            if x >= 0.0 && y >= 0.0 && x < f64::from(photo.width()) && y < f64::from(photo.height()) {
                let pixel = photo.get_pixel(x as u32, y as u32);
                all += 1;
                saturated += usize::from(pixel.0.iter().all(|value| *value >= SATURATED));
            }
        }
    }
    if all > 0 { saturated as f64 / f64::from(all) } else { 0.0 }
}

/// Whether a polygon holds a point (even-odd rule).
fn contains(polygon: &[Vector2<f64>], point: Vector2<f64>) -> bool {
    let mut inside = false;
    for k in 0..polygon.len() {
        let (a, b) = (polygon[k], polygon[(k + 1) % polygon.len()]);
        if (a.y > point.y) != (b.y > point.y) && point.x < a.x + (b.x - a.x) * (point.y - a.y) / (b.y - a.y) {
            inside = !inside;
        }
    }
    inside
}

#[cfg(test)]
mod tests {
    use super::*;

    fn upright(x: f64, y: f64, width: f64, height: f64) -> Quad {
        Quad::from_center(Vector2::new(x, y), Vector2::new(width / 2.0, 0.0), Vector2::new(0.0, height / 2.0))
    }

    fn labels(modules: Vec<Quad>) -> LabelledPhoto {
        LabelledPhoto {
            image: "a.jpg".to_owned(),
            group: "plant".to_owned(),
            path: "a.jpg".into(),
            modules,
            ignore: Vec::new(),
            conditions: Vec::new(),
            gsd_m: None,
        }
    }

    fn found(quads: &[Quad]) -> Vec<Detection> {
        quads.iter().map(|quad| Detection { quad: *quad, score: 1.0, source: Source::Unet }).collect()
    }

    fn bench() -> Vec<Quad> {
        (0..4).map(|i| upright(30.0 + 21.0 * f64::from(i), 40.0, 20.0, 12.0)).collect()
    }

    fn dark() -> RgbImage {
        RgbImage::from_pixel(200, 100, image::Rgb([40; 3]))
    }

    #[test]
    fn what_is_found_missed_and_false_is_counted() {
        let truth = bench();
        let boxes = [
            upright(31.0, 40.0, 20.0, 12.0),
            truth[1],
            // Over two modules: overlaps each by less than a half of the union.
            upright(82.5, 40.0, 41.0, 12.0),
            // On bare ground.
            upright(150.0, 80.0, 20.0, 12.0),
        ];
        let score = compare(&labels(truth), &dark(), &found(&boxes));
        assert_eq!((score.modules, score.found, score.boxes, score.false_boxes), (4, 2, 4, 2));
        assert_eq!((score.merges, score.splits, score.missed.len()), (1, 0, 2));
        assert!((score.center_errors_px[1] - 1.0).abs() < 1e-9 || (score.center_errors_px[0] - 1.0).abs() < 1e-9);
        assert_eq!(score.by_source, [4, 0, 0]);
    }

    #[test]
    fn a_module_with_two_boxes_is_split() {
        let boxes = [upright(24.5, 40.0, 9.0, 12.0), upright(34.0, 40.0, 11.5, 12.0)];
        let score = compare(&labels(bench()), &dark(), &found(&boxes));
        assert_eq!((score.found, score.splits, score.false_boxes), (1, 1, 1));
    }

    #[test]
    fn what_the_frame_cuts_or_an_area_hides_counts_neither_way() {
        let mut labels = labels(vec![upright(195.0, 40.0, 20.0, 12.0), upright(30.0, 40.0, 20.0, 12.0)]);
        labels.ignore = vec![[(100.0, 60.0), (180.0, 60.0), (140.0, 99.0)].map(|(x, y)| Vector2::new(x, y)).to_vec()];
        let boxes = [upright(189.0, 40.0, 20.0, 12.0), upright(140.0, 70.0, 20.0, 12.0)];
        let score = compare(&labels, &dark(), &found(&boxes));
        assert_eq!((score.modules, score.boxes, score.false_boxes), (1, 0, 0));
    }

    #[test]
    fn glare_is_told_by_saturation() {
        let mut photo = dark();
        for x in 20..34 {
            for y in 30..50 {
                photo.put_pixel(x, y, image::Rgb([255, 252, 250]));
            }
        }
        let truth = bench();
        let score = compare(&labels(truth.clone()), &photo, &found(&truth[1..]));
        assert_eq!((score.glare_modules, score.glare_found, score.found), (1, 0, 3));
    }
}
