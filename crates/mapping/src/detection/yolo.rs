//! The instance segmentation network that complements the U-Net (paper, 3.2), in the layout in which the YOLOv8-seg family
//! is exported: `output0` float32 [1, 4 + classes + coefficients, N] with boxes (middle, width and height, in pixels of the
//! input), class scores and mask coefficients, and `output1` float32 [1, coefficients, H/4, W/4] with the prototypes of which
//! the coefficients mix each mask.
//!
//! The boxes along the pixel axes serve only to find the masks: those of a turned lattice overlap far too much to part
//! neighbours. Masks are eroded and dilated, and oriented boxes are measured on them, as the paper does it.

use super::mask_to_boxes::{self, Instance, ModuleBox};
use super::neighbours::Grid;
use super::probability::ProbabilityMap;
use super::runtime::{self, ImageModel, RuntimeSettings, extract, run};
use super::tiles::{Beyond, Tile, WorkingRange, fill, resample, tiles};
use super::{Detection, DetectionError, Detector, Source, detectors, filter};
use image::RgbImage;
use nalgebra::Vector2;
use rayon::prelude::*;
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};

/// Least score of a module.
const CONFIDENCE: f32 = 0.25;
/// Two candidates whose boxes along the pixel axes overlap by so much (intersection over union) mean the same module:
/// neighbours of a lattice, however turned, stay below one half, for modules up to three times as long as wide.
const SAME: f64 = 0.65;
/// A mask may reach beyond its box by so many pixels: the box is the less exact of both.
const GROWN: f64 = 2.0;
/// The most candidates of a tile of which masks are made, the best first.
const MOST_CANDIDATES: usize = 6000;
/// The most pixels of all masks of a tile: a network that sees modules everywhere, as large as the tile, costs no more.
const MOST_MASK_PX2: f64 = 6.4e7;
/// Most of the scores that may be no number before the model is taken for damaged.
const MAX_NOT_FINITE: f64 = 0.001;
/// Words by which classes of modules go.
const MODULE_WORDS: [&str; 5] = ["module", "panel", "solar", "photovolt", "pv"];

/// A network in the YOLOv8-seg layout.
pub struct Yolo {
    model: ImageModel,
    version: String,
    /// Name of the output with boxes, scores and coefficients.
    boxes: String,
    /// Name of the output with prototypes.
    prototypes: String,
    classes: usize,
    coefficients: usize,
    /// Classes that are modules.
    wanted: Vec<usize>,
    working_range: WorkingRange,
}

/// What the network says of one place, in pixels of the tile.
struct Candidate {
    /// Pixel edges: the first pixel of the tile begins at 0.
    low: Vector2<f64>,
    high: Vector2<f64>,
    score: f32,
    coefficients: Vec<f32>,
}

impl Candidate {
    fn area(&self) -> f64 {
        let size = self.high - self.low;
        size.x * size.y
    }

    /// Intersection over union of the boxes along the pixel axes.
    fn iou(&self, other: &Self) -> f64 {
        let shared = self.high.inf(&other.high) - self.low.sup(&other.low);
        let shared = shared.x.max(0.0) * shared.y.max(0.0);
        shared / (self.area() + other.area() - shared)
    }
}

/// The modules of all tiles, and how many scores were no numbers.
#[derive(Default)]
struct Harvest {
    instances: Vec<(usize, Vec<Instance>)>,
    not_finite: usize,
    scores: usize,
}

impl Yolo {
    /// Opens a model file, checks it and tries it on a small picture.
    ///
    /// # Errors
    /// No ONNX Runtime; a file that is no model, or a model of another kind.
    pub fn open(path: &Path, settings: RuntimeSettings) -> Result<Self, DetectionError> {
        Self::of_model(runtime::open_model(path, settings)?)
    }

    /// Checks an opened model and tries it on a small picture.
    pub(super) fn of_model(model: ImageModel) -> Result<Self, DetectionError> {
        if let Some(kind) = model.ours("kind").filter(|kind| *kind != "yolo") {
            return Err(model.unfit(format!("it calls itself `{kind}`; a `yolo` is needed")));
        }
        let of_rank = |rank: usize| {
            let mut fitting =
                model.outputs.iter().filter(|outlet| outlet.shape.as_ref().is_some_and(|shape| shape.len() == rank));
            fitting.next().filter(|_| fitting.next().is_none()).map(|outlet| outlet.name.clone())
        };
        let (Some(boxes), Some(prototypes)) = (of_rank(3), of_rank(4)) else {
            return Err(model.unfit(format!(
                "its outputs are {}; those of a YOLOv8-seg export are needed: float32 [1, 4 + classes + coefficients, N] and \
                 [1, coefficients, H/4, W/4] (a model that only detects has no masks; export a segmentation model, without \
                 `nms`)",
                model.outputs_text
            )));
        };
        let (rows, coefficients) = model
            .sessions
            .with(|session| probe(session, &model.input, &boxes, &prototypes, model.fixed_size))
            .map_err(|what| model.unfit(what))?;
        let classes = rows - 4 - coefficients;
        let wanted = wanted_classes(&model, classes)?;
        let working_range = WorkingRange::of_model(&model)?;
        Ok(Self { version: model.version(), boxes, prototypes, classes, coefficients, wanted, working_range, model })
    }

    /// Whether an image of the given ground sampling distance (metres per pixel) is too coarse for the network as it is.
    pub(super) fn enlarges(&self, gsd_m: Option<f64>) -> bool {
        self.working_range.scale(gsd_m) > 1.0
    }

    /// The modules of an image as boxes in its pixels, the best first; those that the frame cuts are among them.
    pub(super) fn search(&self, image: &RgbImage, gsd_m: Option<f64>) -> Result<Vec<ModuleBox>, DetectionError> {
        let (width, height) = image.dimensions();
        if width == 0 || height == 0 {
            return Ok(Vec::new());
        }
        let scaled = resample(image, self.working_range.scale(gsd_m))?;
        let working = scaled.as_ref().unwrap_or(image);
        let boxes = mask_to_boxes::from_instances(&mask_to_boxes::without_doubles(self.instances(working)?));
        let pixel = Vector2::new(
            f64::from(width) / f64::from(working.width()),
            f64::from(height) / f64::from(working.height()),
        );
        let boxes = boxes.into_iter().map(|b| ModuleBox { source: Source::Yolo, ..b.scaled(pixel) }).collect();
        Ok(filter::without_overlaps(boxes))
    }

    fn instances(&self, image: &RgbImage) -> Result<Vec<Instance>, DetectionError> {
        let tiles = tiles(image.width() as usize, image.height() as usize, self.model.fixed_size);
        let harvest = Mutex::new(Harvest::default());
        let next = AtomicUsize::new(0);
        let work = || -> Result<(), DetectionError> {
            let mut pixels = Vec::new();
            loop {
                let index = next.fetch_add(1, Ordering::Relaxed);
                let Some(tile) = tiles.get(index) else { return Ok(()) };
                fill(&mut pixels, image, tile, Beyond::Grey);
                self.model.sessions.with(|session| self.run_tile(session, &pixels, tile, index, &harvest))?;
            }
        };
        std::thread::scope(|scope| {
            let others: Vec<_> = (1..self.model.sessions.count().min(tiles.len())).map(|_| scope.spawn(work)).collect();
            let own = work();
            others.into_iter().fold(own, |result, other| result.and(other.join().expect("a worker does not panic")))
        })?;
        let mut harvest = harvest.into_inner().unwrap_or_else(PoisonError::into_inner);
        let share = harvest.not_finite as f64 / harvest.scores.max(1) as f64;
        if share > MAX_NOT_FINITE {
            return Err(DetectionError::NotFinite { percent: 100.0 * share });
        }
        // In the order of tiles, whichever was done first.
        harvest.instances.sort_by_key(|(tile, _)| *tile);
        Ok(harvest.instances.into_iter().flat_map(|(_, instances)| instances).collect())
    }

    /// Runs the network on a tile and keeps the modules whose middles lie in what is kept of it.
    fn run_tile(
        &self,
        session: &mut ort::session::Session,
        pixels: &[f32],
        tile: &Tile,
        index: usize,
        harvest: &Mutex<Harvest>,
    ) -> Result<(), DetectionError> {
        let outputs = run(session, &self.model.input, pixels, tile.rows.size, tile.columns.size)?;
        let (shape, boxes) = extract(&outputs, &self.boxes)?;
        let rows = 4 + self.classes + self.coefficients;
        let failed = |shape: &[usize], wanted: String| DetectionError::Inference {
            what: format!("its output has the shape {shape:?} where {wanted} was to be expected"),
        };
        let [1, found_rows, count] = shape[..] else { return Err(failed(&shape, format!("[1, {rows}, N]"))) };
        if found_rows != rows {
            return Err(failed(&shape, format!("[1, {rows}, N]")));
        }
        let (shape, values) = extract(&outputs, &self.prototypes)?;
        let prototypes = match shape[..] {
            [1, found, height, width] if found == self.coefficients && height * width > 0 => {
                Prototypes { values, width, height, stride: tile.columns.size as f64 / width as f64 }
            }
            _ => return Err(failed(&shape, format!("[1, {}, H/4, W/4]", self.coefficients))),
        };
        let (candidates, not_finite) = self.candidates(boxes, count, tile);
        let candidates = without_twins(candidates);
        let corner = Vector2::new(tile.columns.start as f64, tile.rows.start as f64);
        let size = Vector2::new(tile.columns.size as f64, tile.rows.size as f64);
        let instances: Vec<Instance> = candidates
            .par_iter()
            .filter_map(|candidate| {
                let (mask, offset) = prototypes.mask(candidate, size);
                Instance::measure(&mask, offset + corner, candidate.score)
            })
            .collect();
        let mut harvest = harvest.lock().unwrap_or_else(PoisonError::into_inner);
        harvest.not_finite += not_finite;
        harvest.scores += count * self.classes;
        harvest.instances.push((index, instances));
        Ok(())
    }

    /// What scores enough and has its middle in the kept part of the tile; and how many scores were no numbers.
    fn candidates(&self, values: &[f32], count: usize, tile: &Tile) -> (Vec<Candidate>, usize) {
        let at = |row: usize, index: usize| values[row * count + index];
        let not_finite = values[4 * count..(4 + self.classes) * count].iter().filter(|v| !v.is_finite()).count();
        let size = Vector2::new(tile.columns.size as f64, tile.rows.size as f64);
        let kept = |value: f64, stretch: &super::tiles::Stretch| {
            let at = value + stretch.start as f64;
            at >= stretch.kept.start as f64 && at < stretch.kept.end as f64
        };
        let candidates = (0..count)
            .filter_map(|index| {
                let score = self.wanted.iter().map(|class| at(4 + class, index)).fold(0.0, f32::max);
                if !score.is_finite() || score < CONFIDENCE {
                    return None;
                }
                let [x, y, width, height] = [0, 1, 2, 3].map(|row| f64::from(at(row, index)));
                let (middle, half) = (Vector2::new(x, y), Vector2::new(width, height) / 2.0);
                let coefficients: Vec<f32> =
                    (4 + self.classes..4 + self.classes + self.coefficients).map(|row| at(row, index)).collect();
                let is_sound = [x, y, width, height].iter().all(|v| v.is_finite())
                    && coefficients.iter().all(|v| v.is_finite())
                    && half.min() > 1.0
                    && kept(x, &tile.columns)
                    && kept(y, &tile.rows);
                let (low, high) = ((middle - half).sup(&Vector2::zeros()), (middle + half).inf(&size));
                is_sound.then_some(Candidate { low, high, score: score.min(1.0), coefficients })
            })
            .collect();
        (candidates, not_finite)
    }
}

/// The best candidate of each place. Only near twins are dropped: what remains of one module is told by the masks.
fn without_twins(mut candidates: Vec<Candidate>) -> Vec<Candidate> {
    candidates.sort_by(|a, b| b.score.total_cmp(&a.score));
    candidates.truncate(MOST_CANDIDATES);
    let centers: Vec<Vector2<f64>> = candidates.iter().map(|c| (c.low + c.high) / 2.0).collect();
    let sizes: Vec<f64> = candidates.iter().map(|c| (c.high - c.low).max()).collect();
    let longest = sizes.iter().copied().fold(1.0, f64::max);
    let cell = sizes.iter().sum::<f64>() / sizes.len().max(1) as f64;
    let grid = Grid::new(centers.clone(), cell);
    let mut is_kept = vec![false; candidates.len()];
    let mut pixels = 0.0;
    for (index, candidate) in candidates.iter().enumerate() {
        if pixels > MOST_MASK_PX2 {
            break;
        }
        // Boxes that overlap by more than a half have their middles closer than half their size.
        let reach = (sizes[index] / 2.0).min(longest);
        is_kept[index] = !grid
            .within(centers[index], reach)
            .any(|(other, _)| is_kept[other] && candidates[other].iou(candidate) > SAME);
        if is_kept[index] {
            pixels += candidate.area();
        }
    }
    candidates.into_iter().zip(is_kept).filter(|(_, kept)| *kept).map(|(candidate, _)| candidate).collect()
}

/// Pictures of which the coefficients of a candidate mix its mask.
struct Prototypes<'a> {
    /// [coefficients, height, width].
    values: &'a [f32],
    width: usize,
    height: usize,
    /// Pixels of the tile per pixel of the prototypes.
    stride: f64,
}

impl Prototypes<'_> {
    /// Probabilities of a candidate's mask within its box, pixel by pixel of the tile, in a frame of one pixel of nought; and
    /// the place of the first pixel in the tile.
    fn mask(&self, candidate: &Candidate, tile: Vector2<f64>) -> (ProbabilityMap, Vector2<f64>) {
        let from = candidate.low.map(|v| (v - GROWN).floor().max(0.0));
        let to = candidate.high.map(|v| (v + GROWN).ceil()).inf(&tile);
        // Pixels of the prototypes that these lie between.
        let cell = |v: f64, length: usize| (((v + 0.5) / self.stride - 0.5).max(0.0) as usize).min(length - 1);
        let (left, right) = (cell(from.x, self.width), (cell(to.x, self.width) + 1).min(self.width - 1));
        let (top, bottom) = (cell(from.y, self.height), (cell(to.y, self.height) + 1).min(self.height - 1));
        let columns = right - left + 1;
        // Large terms may cancel: summed in twice the precision, always in the same order.
        let mut logits = vec![0.0_f64; columns * (bottom - top + 1)];
        for (plane, &coefficient) in self.values.chunks_exact(self.width * self.height).zip(&candidate.coefficients) {
            for y in top..=bottom {
                let row = &plane[y * self.width + left..=y * self.width + right];
                for (sum, value) in logits[(y - top) * columns..].iter_mut().zip(row) {
                    *sum += f64::from(coefficient) * f64::from(*value);
                }
            }
        }
        let last = Vector2::new((right - left) as f64, (bottom - top) as f64);
        let place = |v: f64, first: usize, last: f64| {
            let at = ((v + 0.5) / self.stride - 0.5 - first as f64).clamp(0.0, last);
            let below = at.floor().min((last - 1.0).max(0.0));
            (below as usize, at - below)
        };
        let size = to - from;
        let (width, height) = (size.x.max(0.0) as usize, size.y.max(0.0) as usize);
        let xs: Vec<(usize, f64)> = (0..width).map(|x| place(from.x + x as f64, left, last.x)).collect();
        let mut mask = ProbabilityMap::new(width + 2, height + 2);
        for y in 0..height {
            let (below, fy) = place(from.y + y as f64, top, last.y);
            let above = (below + 1).min(last.y as usize);
            let row = &mut mask.row_mut(y + 1)[1..=width];
            for (value, &(x, fx)) in row.iter_mut().zip(&xs) {
                let next = (x + 1).min(last.x as usize);
                let mix = |row: usize| logits[row * columns + x] * (1.0 - fx) + logits[row * columns + next] * fx;
                let logit = mix(below) * (1.0 - fy) + mix(above) * fy;
                *value = ProbabilityMap::pack((1.0 / (1.0 + (-logit).exp())) as f32);
            }
        }
        (mask, from - Vector2::repeat(1.0))
    }
}

/// Classes that are modules: by their names (metadata `names`, as the family writes it), else all of them.
fn wanted_classes(model: &ImageModel, classes: usize) -> Result<Vec<usize>, DetectionError> {
    let names = model.metadata.get("names").map(|text| class_names(text)).unwrap_or_default();
    let of_modules: Vec<usize> = (0..classes)
        .filter(|class| {
            let name = names.iter().find(|(index, _)| index == class).map_or("", |(_, name)| name.as_str());
            MODULE_WORDS.iter().any(|word| name.contains(word))
        })
        .collect();
    if !of_modules.is_empty() {
        return Ok(of_modules);
    }
    let is_unnamed = names.iter().all(|(_, name)| name.chars().all(|c| c.is_ascii_digit()));
    if classes == 1 || is_unnamed {
        return Ok((0..classes).collect());
    }
    let first: Vec<&str> = names.iter().take(5).map(|(_, name)| name.as_str()).collect();
    Err(model.unfit(format!(
        "none of its {classes} classes ({}, ...) is a module by its name ({}); train it on modules, or name their class so",
        first.join(", "),
        MODULE_WORDS.join(", ")
    )))
}

/// The pairs of `{0: 'panel', 1: 'tree'}`, names in lower case.
fn class_names(text: &str) -> Vec<(usize, String)> {
    text.trim()
        .trim_start_matches('{')
        .trim_end_matches('}')
        .split(',')
        .filter_map(|pair| {
            let (index, name) = pair.split_once(':')?;
            Some((index.trim().parse().ok()?, name.trim().trim_matches(['\'', '"']).to_lowercase()))
        })
        .collect()
}

/// Tries the network on a small picture: rows of its boxes, and mask coefficients. What is wrong, else.
fn probe(
    session: &mut ort::session::Session,
    input: &str,
    boxes: &str,
    prototypes: &str,
    fixed_size: [Option<u32>; 2],
) -> Result<(usize, usize), String> {
    let [height, width] = [fixed_size[0].unwrap_or(64) as usize, fixed_size[1].unwrap_or(96) as usize];
    let pixels: Vec<f32> = (0..3 * height * width).map(|i| (i * 7919 % 256) as f32 / 255.0).collect();
    let outputs = run(session, input, &pixels, height, width).map_err(|error| error.to_string())?;
    let (shape, _) = extract(&outputs, prototypes).map_err(|error| error.to_string())?;
    let [1, coefficients @ 1..=256, mask_height, mask_width] = shape[..] else {
        return Err(format!("its prototypes have the shape {shape:?}; [1, 1 to 256, H/4, W/4] is needed"));
    };
    let stride = height / mask_height.max(1);
    if !(1..=16).contains(&stride) || (mask_height * stride, mask_width * stride) != (height, width) {
        return Err(format!(
            "a picture of {width} x {height} pixels gives prototypes of {mask_width} x {mask_height}; a quarter of the \
             size, or another whole part of it, is needed"
        ));
    }
    let (shape, values) = extract(&outputs, boxes).map_err(|error| error.to_string())?;
    let [1, rows, count] = shape[..] else {
        return Err(format!("its boxes have the shape {shape:?}; [1, 4 + classes + {coefficients}, N] is needed"));
    };
    let hint = if rows > count {
        "; it seems turned over, as YOLOv5 has it: export it in the layout of YOLOv8, without `nms`"
    } else {
        ""
    };
    if !(5 + coefficients..=2000).contains(&rows) {
        return Err(format!(
            "its boxes have the shape {shape:?}; [1, 4 + classes + {coefficients}, N] is needed, with 1 to 1000 classes{hint}"
        ));
    }
    let scores = values[4 * count..(rows - coefficients) * count].iter().copied().filter(|value| value.is_finite());
    let (least, most) = scores.fold((f32::INFINITY, f32::NEG_INFINITY), |(a, b), value| (a.min(value), b.max(value)));
    if least < -0.01 || most > 1.01 {
        return Err(format!(
            "its class scores go from {least:.2} to {most:.2}; probabilities of 0 to 1 are needed (export it with a \
             sigmoid){hint}"
        ));
    }
    Ok((rows, coefficients))
}

impl Detector for Yolo {
    fn detect(&self, image: &RgbImage, gsd_m: Option<f64>) -> Result<Vec<Detection>, DetectionError> {
        detectors::detect(None, Some(self), image, gsd_m)
    }

    fn describe(&self) -> String {
        format!("YOLO {} ({}), {}", self.version, self.model.name, self.model.settings.describe())
    }

    fn identity(&self) -> String {
        format!("YOLO {}", self.model.identity())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Quad;
    use image::Rgb;
    use std::path::PathBuf;

    fn fixture(name: &str) -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/detection").join(name)
    }

    /// The model, or `None`, with the reason printed, where ONNX Runtime is not installed.
    fn open(name: &str) -> Option<Result<Yolo, DetectionError>> {
        match Yolo::open(&fixture(name), RuntimeSettings::with_threads(1)) {
            Err(DetectionError::RuntimeMissing) => {
                eprintln!("skipped: {}", DetectionError::RuntimeMissing);
                None
            }
            opened => Some(opened),
        }
    }

    /// Bright modules of 24 x 16 pixels in a lattice turned by an angle, on dark ground; and their quads.
    fn picture(width: u32, height: u32, columns: u32, rows: u32, angle_deg: f64) -> (RgbImage, Vec<Quad>) {
        let (sin, cos) = angle_deg.to_radians().sin_cos();
        let (x, y) = (Vector2::new(cos, sin), Vector2::new(-sin, cos));
        let middle = Vector2::new(f64::from(width), f64::from(height)) / 2.0;
        let quads: Vec<Quad> = (0..columns * rows)
            .map(|k| {
                let column = f64::from(k % columns) - f64::from(columns - 1) / 2.0;
                let row = f64::from(k / columns) - f64::from(rows - 1) / 2.0;
                Quad::from_center(middle + x * (34.0 * column) + y * (26.0 * row), x * 12.0, y * 8.0)
            })
            .collect();
        let image = RgbImage::from_fn(width, height, |px, py| {
            let covered: u32 = (0..16)
                .map(|i| {
                    let fine = |i: u32| (f64::from(i) + 0.5) / 4.0 - 0.5;
                    let at = Vector2::new(f64::from(px) + fine(i % 4), f64::from(py) + fine(i / 4));
                    u32::from(quads.iter().any(|quad| quad.contains(at)))
                })
                .sum();
            Rgb([(covered * 255 / 16) as u8; 3])
        });
        (image, quads)
    }

    fn assert_found(found: &[Detection], quads: &[Quad]) {
        assert_eq!(found.len(), quads.len());
        for quad in quads {
            let best = found.iter().map(|d| d.quad.iou(quad)).fold(0.0, f64::max);
            assert!(best > 0.75, "{:?}: IoU {best}", quad.center());
        }
        assert!(found.iter().all(|d| d.source == Source::Yolo));
    }

    #[test]
    fn neighbours_of_a_turned_lattice_are_all_found() {
        let Some(yolo) = open("yolo_any_size.onnx") else { return };
        let yolo = yolo.unwrap();
        for angle_deg in [0.0, 20.0, 45.0, -70.0] {
            let (photo, quads) = picture(260, 250, 4, 5, angle_deg);
            assert_found(&yolo.detect(&photo, None).unwrap(), &quads);
        }
    }

    #[test]
    fn a_network_bound_to_a_size_sees_any_photo_in_tiles() {
        let Some(yolo) = open("yolo_fixed_size.onnx") else { return };
        let yolo = yolo.unwrap();
        assert_eq!(yolo.wanted, [1], "the class of modules is known by its name");
        for (width, height, columns, rows) in [(660, 250, 18, 7), (90, 70, 2, 2)] {
            let (photo, quads) = picture(width, height, columns, rows, 5.0);
            assert_found(&yolo.detect(&photo, None).unwrap(), &quads);
        }
    }

    #[test]
    fn photos_without_anything_have_no_modules() {
        let Some(yolo) = open("yolo_any_size.onnx") else { return };
        let yolo = yolo.unwrap();
        for (width, height) in [(0, 0), (1, 1), (3, 200), (100, 80)] {
            assert!(yolo.detect(&RgbImage::new(width, height), None).unwrap().is_empty());
        }
    }

    #[test]
    fn a_network_that_gives_no_numbers_is_an_error() {
        let Some(yolo) = open("yolo_nan.onnx") else { return };
        let error = yolo.unwrap().detect(&RgbImage::new(100, 80), None).unwrap_err();
        assert!(matches!(error, DetectionError::NotFinite { .. }), "{error}");
    }

    #[test]
    fn models_that_do_not_fit_are_refused_with_the_reason() {
        for (name, words) in [
            ("yolo_other_classes.onnx", "none of its 2 classes (person, car, ...) is a module"),
            ("yolo_turned.onnx", "turned over"),
            ("yolo_logits.onnx", "with a sigmoid"),
            ("yolo_boxes_alone.onnx", "has no masks"),
            ("one_channel.onnx", "YOLOv8-seg"),
            ("double_size.onnx", "calls itself `unet`"),
        ] {
            let Some(opened) = open(name) else { return };
            let error = opened.err().unwrap_or_else(|| panic!("{name} was accepted"));
            assert_eq!(error.code(), "model_unfit", "{error}");
            let text = error.to_string();
            assert!(text.contains(name) && text.contains(words), "{text}");
        }
    }

    #[test]
    fn class_names_are_read_as_the_family_writes_them() {
        let names = class_names("{0: 'person', 1: \"PV Module\", 7: '3'}");
        assert_eq!(names, [(0, "person".to_owned()), (1, "pv module".to_owned()), (7, "3".to_owned())]);
        assert!(class_names("nonsense").is_empty());
    }
}
