//! The semantic segmentation network (paper, 3.2): photo to masks, tile by tile, and masks to modules.

use super::mask_to_boxes::{self, ModuleBox};
use super::probability::ProbabilityMap;
use super::runtime::{self, SegmentationModel};
use super::{Detection, DetectionError, Detector, Source, filter};
use crate::geometry::Quad;
use fast_image_resize as fir;
use image::RgbImage;
use nalgebra::Vector2;
use ort::session::Session;
use ort::value::TensorRef;
use rayon::prelude::*;
use std::ops::RangeInclusive;
use std::path::Path;
use std::sync::{Mutex, PoisonError};

/// The network's input has a size that is a multiple of this many pixels.
const STRIDE: usize = 32;
/// The longest side of a tile. Memory is bounded by its square: about 0.1 kB per pixel.
const TILE: usize = 1408;
/// What a tile has beyond the part that is kept, at every seam: there the network sees too little around it.
const MARGIN: usize = 64;
/// Most of an image's output that may be no number before the model is taken for damaged.
const MAX_NOT_FINITE: f64 = 0.001;
/// Range of factors by which an image is ever scaled.
const SCALES: RangeInclusive<f64> = 1.0 / 16.0..=4.0;

/// A U-Net in ONNX: input float32 [N, 3, H, W], RGB in 0..1; output float32 [N, C, sH, sW] with s = 1 or 2, probabilities.
/// What the channels are is told by the model's metadata (`heliomap.channels`); a model without it has one channel, the
/// mask of modules.
pub struct Unet {
    session: Mutex<Session>,
    name: String,
    version: String,
    threads: usize,
    input: String,
    output: String,
    fixed_size: [Option<u32>; 2],
    channels: usize,
    module_channel: usize,
    /// Channel of the faces shrunk by a factor about their centres, and this factor.
    core: Option<(usize, f64)>,
    /// Pixels of the output per pixel of the input, along each side.
    upscale: usize,
    /// Ground sampling distances that the network likes, and the one it likes best, metres per pixel.
    gsd_m: Option<(RangeInclusive<f64>, f64)>,
}

/// Probabilities of a whole image, in pixels of the network's output.
struct Masks {
    module: ProbabilityMap,
    core: Option<ProbabilityMap>,
}

impl Unet {
    /// Opens a model file, checks it and tries it on a small picture. `threads` run the network; 0 is one per core.
    ///
    /// # Errors
    /// No ONNX Runtime; a file that is no model, or a model of another shape.
    pub fn open(path: &Path, threads: usize) -> Result<Self, DetectionError> {
        let name = path.file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned());
        let unfit = |what: String| DetectionError::UnfitModel { name: name.clone(), what };
        let threads = if threads == 0 { runtime::available_threads() } else { threads };
        let SegmentationModel { mut session, input, output, fixed_size, metadata, digest } =
            runtime::open_segmentation(path, threads)?;
        if let Some(kind) = metadata.get("kind").filter(|kind| *kind != "unet") {
            return Err(unfit(format!("it calls itself `{kind}`; a `unet` is needed")));
        }
        let (channels, upscale) = probe(&mut session, &input, &output, fixed_size).map_err(unfit)?;
        let names: Option<Vec<&str>> = metadata.get("channels").map(|names| names.split(',').map(str::trim).collect());
        let (module_channel, core_channel) = match &names {
            Some(names) if names.len() != channels => {
                return Err(unfit(format!("its metadata names {} channels, but it has {channels}", names.len())));
            }
            Some(names) => {
                let of = |wanted: &str| names.iter().position(|name| *name == wanted);
                let module = of("module")
                    .ok_or_else(|| unfit(format!("none of its channels ({}) is `module`", names.join(", "))))?;
                (module, of("core"))
            }
            None if channels == 1 => (0, None),
            None => {
                return Err(unfit(format!(
                    "it has {channels} channels and no metadata `heliomap.channels` that names them (such as \
                     `module,core`); without metadata one channel is needed, the mask of modules"
                )));
            }
        };
        let number =
            |key: &str, text: &str| -> Result<f64, DetectionError> {
                text.trim().parse().ok().filter(|value: &f64| value.is_finite() && *value > 0.0).ok_or_else(|| {
                    unfit(format!("its metadata `heliomap.{key}` is `{text}`; a positive number is needed"))
                })
            };
        let core = match core_channel {
            Some(channel) => {
                let text = metadata.get("core_shrink").ok_or_else(|| {
                    unfit("it has a channel `core` but no metadata `heliomap.core_shrink`".to_owned())
                })?;
                let shrink = number("core_shrink", text)?;
                if !(0.2..=1.0).contains(&shrink) {
                    return Err(unfit(format!("its metadata `heliomap.core_shrink` is {shrink}; 0.2 to 1 is needed")));
                }
                Some((channel, shrink))
            }
            None => None,
        };
        let range = match metadata.get("gsd_range_m") {
            Some(text) => {
                let wrong =
                    || unfit(format!("its metadata `heliomap.gsd_range_m` is `{text}`; `least,most` is needed"));
                let (least, most) = text.split_once(',').ok_or_else(wrong)?;
                let (least, most) = (number("gsd_range_m", least)?, number("gsd_range_m", most)?);
                if least > most {
                    return Err(wrong());
                }
                Some(least..=most)
            }
            None => None,
        };
        let best = metadata.get("gsd_m").map(|text| number("gsd_m", text)).transpose()?;
        let gsd_m = match (range, best) {
            (Some(range), best) => {
                let best =
                    best.unwrap_or_else(|| (range.start() * range.end()).sqrt()).clamp(*range.start(), *range.end());
                Some((range, best))
            }
            (None, Some(best)) => Some((best / 1.6..=best * 1.6, best)),
            (None, None) => None,
        };
        let version = metadata.get("version").cloned().unwrap_or_else(|| digest[..12].to_owned());
        let session = Mutex::new(session);
        Ok(Self {
            session,
            name,
            version,
            threads,
            input,
            output,
            fixed_size,
            channels,
            module_channel,
            core,
            upscale,
            gsd_m,
        })
    }

    /// The factor by which an image of the given ground sampling distance (metres per pixel) is scaled for the network: 1
    /// where it is unknown or within the range that the network likes, else what brings it to the distance it likes best.
    pub fn working_scale(&self, image_gsd_m: Option<f64>) -> f64 {
        match (&self.gsd_m, image_gsd_m) {
            (Some((range, best)), Some(gsd_m)) if gsd_m.is_finite() && gsd_m > 0.0 && !range.contains(&gsd_m) => {
                (gsd_m / best).clamp(*SCALES.start(), *SCALES.end())
            }
            _ => 1.0,
        }
    }

    /// Masks of a whole image. The network sees it in tiles that overlap, of which the middle is kept.
    fn masks(&self, image: &RgbImage) -> Result<Masks, DetectionError> {
        let (width, height) = (image.width() as usize, image.height() as usize);
        let columns = tiles(width, self.fixed_size[1]);
        let rows = tiles(height, self.fixed_size[0]);
        let s = self.upscale;
        let mut module = ProbabilityMap::new(width * s, height * s);
        let mut core = self.core.map(|_| ProbabilityMap::new(width * s, height * s));
        let mut not_finite = 0;
        let mut pixels = Vec::new();
        for row in &rows {
            for column in &columns {
                fill(&mut pixels, image, column, row);
                let mut session = self.session.lock().unwrap_or_else(PoisonError::into_inner);
                let outputs = run(&mut session, &self.input, &pixels, row.size, column.size)?;
                let wanted = [1, self.channels, row.size * s, column.size * s];
                let (shape, values) = extract(&outputs, &self.output)?;
                if shape != wanted {
                    return Err(DetectionError::Inference {
                        what: format!("its output has the shape {shape:?} where {wanted:?} was to be expected"),
                    });
                }
                let plane = row.size * s * column.size * s;
                let mut keep = |channel: usize, map: &mut ProbabilityMap| {
                    let values = &values[channel * plane..(channel + 1) * plane];
                    for y in row.kept.start * s..row.kept.end * s {
                        let from = (y - row.start * s) * column.size * s;
                        let source = &values[from + (column.kept.start - column.start) * s..][..column.kept.len() * s];
                        let target = &mut map.row_mut(y)[column.kept.start * s..column.kept.end * s];
                        for (target, value) in target.iter_mut().zip(source) {
                            not_finite += usize::from(!value.is_finite());
                            *target = if value.is_finite() { ProbabilityMap::pack(*value) } else { 0 };
                        }
                    }
                };
                keep(self.module_channel, &mut module);
                if let (Some((channel, _)), Some(core)) = (self.core, &mut core) {
                    keep(channel, core);
                }
            }
        }
        let share = not_finite as f64 / (width * s * height * s) as f64;
        if share > MAX_NOT_FINITE {
            return Err(DetectionError::NotFinite { percent: 100.0 * share });
        }
        Ok(Masks { module, core })
    }

    /// Boxes in pixels of the network's output.
    fn boxes(&self, masks: &Masks) -> Vec<ModuleBox> {
        let boxes = match (&masks.core, self.core) {
            (Some(core), Some((_, shrink))) => mask_to_boxes::from_core(core, shrink),
            _ => mask_to_boxes::from_mask(&masks.module),
        };
        filter::plausible(boxes, &masks.module)
    }
}

impl Detector for Unet {
    fn detect(&self, image: &RgbImage, gsd_m: Option<f64>) -> Result<Vec<Detection>, DetectionError> {
        let (width, height) = image.dimensions();
        if width == 0 || height == 0 {
            return Ok(Vec::new());
        }
        let scaled = resample(image, self.working_scale(gsd_m))?;
        let working = scaled.as_ref().unwrap_or(image);
        let masks = self.masks(working)?;
        // Pixels of the output are `pixel` pixels of the photo wide; centres of pixels are at whole numbers in both.
        let pixel = Vector2::new(
            f64::from(width) / masks.module.width() as f64,
            f64::from(height) / masks.module.height() as f64,
        );
        let half = Vector2::repeat(0.5);
        Ok(self
            .boxes(&masks)
            .into_iter()
            .filter_map(|b| {
                let quad = b.quad().map(|corner| (corner + half).component_mul(&pixel) - half);
                let quad = Quad::from_unordered(quad.corners)?;
                filter::is_inside_frame(&quad.corners, width, height).then_some(Detection {
                    quad,
                    score: b.score,
                    source: Source::Unet,
                })
            })
            .collect())
    }

    fn describe(&self) -> String {
        format!(
            "U-Net {} ({}), ONNX Runtime on {} with {} threads",
            self.version,
            self.name,
            runtime::EXECUTION_PROVIDER,
            self.threads
        )
    }
}

/// The image scaled by a factor, averaged where it shrinks and bicubic where it grows; `None` where nothing changes.
fn resample(image: &RgbImage, scale: f64) -> Result<Option<RgbImage>, DetectionError> {
    let size = |pixels: u32| ((f64::from(pixels) * scale).round() as u32).max(1);
    let (width, height) = (size(image.width()), size(image.height()));
    if (width, height) == image.dimensions() {
        return Ok(None);
    }
    let kernel = if scale < 1.0 { fir::FilterType::Hamming } else { fir::FilterType::CatmullRom };
    let options = fir::ResizeOptions::new().resize_alg(fir::ResizeAlg::Convolution(kernel));
    let mut target = RgbImage::new(width, height);
    fir::Resizer::new()
        .resize(image, &mut target, Some(&options))
        .map_err(|error| DetectionError::Inference { what: error.to_string() })?;
    Ok(Some(target))
}

/// A stretch of a row or column of pixels that the network sees at once.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Tile {
    /// First pixel.
    start: usize,
    /// Pixels that the network sees; may reach beyond the image.
    size: usize,
    /// Pixels of the image that are kept.
    kept: std::ops::Range<usize>,
}

/// Cuts `length` pixels into tiles of one size (a multiple of [`STRIDE`], or `fixed`). The kept parts join without gap,
/// each at least half a margin from its tile's seams.
fn tiles(length: usize, fixed: Option<u32>) -> Vec<Tile> {
    let limit = fixed.map_or(TILE, |size| size as usize);
    let margin = MARGIN.min(limit / 8);
    let round_up = |pixels: usize| fixed.map_or_else(|| pixels.next_multiple_of(STRIDE), |size| size as usize);
    if length <= limit {
        return vec![Tile { start: 0, size: round_up(length), kept: 0..length }];
    }
    let count = (length - 2 * margin).div_ceil(limit - 2 * margin);
    let size = round_up((length - 2 * margin).div_ceil(count) + 2 * margin);
    // Evenly spread, the first at the start and the last at the end of the image.
    let start = |index: usize| (length - size) * index / (count - 1);
    let seam = |index: usize| (start(index) + start(index - 1) + size) / 2;
    (0..count)
        .map(|index| {
            let from = if index == 0 { 0 } else { seam(index) };
            let to = if index + 1 == count { length } else { seam(index + 1) };
            Tile { start: start(index), size, kept: from..to }
        })
        .collect()
}

/// A tile of the image as the network takes it: planes of red, green and blue, 0 to 1, mirrored beyond the image's edge.
fn fill(pixels: &mut Vec<f32>, image: &RgbImage, column: &Tile, row: &Tile) {
    let (width, height) = (image.width() as usize, image.height() as usize);
    let plane = row.size * column.size;
    pixels.resize(3 * plane, 0.0);
    let source = image.as_raw();
    let columns: Vec<usize> = (0..column.size).map(|x| 3 * mirrored(column.start + x, width)).collect();
    let (red, rest) = pixels.split_at_mut(plane);
    let (green, blue) = rest.split_at_mut(plane);
    red.par_chunks_exact_mut(column.size)
        .zip(green.par_chunks_exact_mut(column.size))
        .zip(blue.par_chunks_exact_mut(column.size))
        .enumerate()
        .for_each(|(y, ((red, green), blue))| {
            let line = &source[3 * width * mirrored(row.start + y, height)..][..3 * width];
            for (x, &at) in columns.iter().enumerate() {
                red[x] = f32::from(line[at]) / 255.0;
                green[x] = f32::from(line[at + 1]) / 255.0;
                blue[x] = f32::from(line[at + 2]) / 255.0;
            }
        });
}

/// The pixel that is seen at `index` where an image of `length` pixels is mirrored at the centres of its last pixels.
fn mirrored(index: usize, length: usize) -> usize {
    let period = (2 * length - 2).max(1);
    let within = index % period;
    within.min(period - within)
}

fn run<'s>(
    session: &'s mut Session,
    input: &str,
    pixels: &[f32],
    height: usize,
    width: usize,
) -> Result<ort::session::SessionOutputs<'s>, DetectionError> {
    let failed = |error: ort::Error| DetectionError::Inference { what: error.message().to_owned() };
    let tensor = TensorRef::from_array_view(([1, 3, height, width], pixels)).map_err(failed)?;
    session.run(ort::inputs![input => tensor]).map_err(failed)
}

fn extract<'o>(
    outputs: &'o ort::session::SessionOutputs<'_>,
    name: &str,
) -> Result<(Vec<usize>, &'o [f32]), DetectionError> {
    let failed = |what: String| DetectionError::Inference { what };
    let value = outputs.get(name).ok_or_else(|| failed(format!("it gave no output `{name}`")))?;
    let (shape, values) = value.try_extract_tensor::<f32>().map_err(|error| failed(error.message().to_owned()))?;
    Ok((shape.iter().map(|dim| usize::try_from(*dim).unwrap_or(0)).collect(), values))
}

/// Tries the network on a small picture: its number of channels, and the pixels of its output per pixel of its input. What
/// is wrong, else.
fn probe(
    session: &mut Session,
    input: &str,
    output: &str,
    fixed_size: [Option<u32>; 2],
) -> Result<(usize, usize), String> {
    let [height, width] = [fixed_size[0].unwrap_or(64) as usize, fixed_size[1].unwrap_or(96) as usize];
    let pixels: Vec<f32> = (0..3 * height * width).map(|i| (i * 7919 % 256) as f32 / 255.0).collect();
    let outputs = run(session, input, &pixels, height, width).map_err(|error| error.to_string())?;
    let (shape, values) = extract(&outputs, output).map_err(|error| error.to_string())?;
    let [1, channels @ 1..=64, out_height, out_width] = shape[..] else {
        return Err(format!("its output has the shape {shape:?}; [1, C, H, W] is needed"));
    };
    let upscale = out_height / height;
    if !(1..=2).contains(&upscale) || (out_height, out_width) != (height * upscale, width * upscale) {
        return Err(format!(
            "a picture of {width} x {height} pixels gives masks of {out_width} x {out_height}; the same size or twice as \
             many pixels each way are needed"
        ));
    }
    let finite = values.iter().copied().filter(|value| value.is_finite());
    let (least, most) = finite.fold((f32::INFINITY, f32::NEG_INFINITY), |(a, b), value| (a.min(value), b.max(value)));
    if least < -0.01 || most > 1.01 {
        return Err(format!(
            "its masks hold values from {least:.2} to {most:.2}; probabilities of 0 to 1 are needed (export it with a sigmoid)"
        ));
    }
    Ok((channels, upscale))
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::Rgb;
    use std::path::PathBuf;

    fn fixture(name: &str) -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/detection").join(name)
    }

    /// The model, or `None`, with the reason printed, where ONNX Runtime is not installed.
    fn open(path: &Path) -> Option<Result<Unet, DetectionError>> {
        match Unet::open(path, 1) {
            Err(DetectionError::RuntimeMissing) => {
                eprintln!("skipped: {}", DetectionError::RuntimeMissing);
                None
            }
            opened => Some(opened),
        }
    }

    /// Bright upright rectangles of 24 x 16 pixels on dark ground, with their centres; anti-aliased.
    fn picture(width: u32, height: u32, centers: &[(f64, f64)]) -> RgbImage {
        let reach = |at: u32, center: f64, half: f64| (half + 0.5 - (f64::from(at) - center).abs()).clamp(0.0, 1.0);
        RgbImage::from_fn(width, height, |x, y| {
            let covers = |(cx, cy): &(f64, f64)| reach(x, *cx, 12.0) * reach(y, *cy, 8.0);
            Rgb([(centers.iter().map(covers).sum::<f64>() * 255.0).round() as u8; 3])
        })
    }

    fn lattice(from_x: f64, from_y: f64, columns: u32, rows: u32) -> Vec<(f64, f64)> {
        (0..rows * columns)
            .map(|i| (from_x + 27.3 * f64::from(i % columns), from_y + 19.4 * f64::from(i / columns)))
            .collect()
    }

    fn assert_found(found: &[Detection], centers: &[(f64, f64)], tolerance_px: f64) {
        assert_eq!(found.len(), centers.len());
        let mut sum = Vector2::zeros();
        for &(x, y) in centers {
            let off = |d: &Detection| d.quad.center() - Vector2::new(x, y);
            let nearest = found.iter().map(off).min_by(|a, b| a.norm().total_cmp(&b.norm())).unwrap();
            assert!(nearest.norm() < tolerance_px, "({x}, {y}) is off by ({}, {}) px", nearest.x, nearest.y);
            sum += nearest;
        }
        let mean = sum / centers.len() as f64;
        assert!(mean.norm() < 0.6 * tolerance_px, "all are off by ({}, {}) px", mean.x, mean.y);
        for detection in found {
            let (short, long) = detection.quad.extent_px();
            assert!((short - 16.0).abs() < 0.7 && (long - 24.0).abs() < 0.7, "{short} x {long} px");
        }
    }

    #[test]
    fn a_network_of_one_channel_needs_no_metadata() {
        let Some(unet) = open(&fixture("one_channel.onnx")) else { return };
        let unet = unet.unwrap();
        let centers = lattice(20.2, 15.6, 5, 4);
        assert_found(&unet.detect(&picture(170, 100, &centers), None).unwrap(), &centers, 0.5);
        assert_eq!(unet.working_scale(Some(0.3)), 1.0);
    }

    #[test]
    fn masks_of_twice_the_size_are_put_where_the_photo_shows_them() {
        let Some(unet) = open(&fixture("double_size.onnx")) else { return };
        let unet = unet.unwrap();
        let centers = lattice(20.2, 15.6, 5, 4);
        assert_found(&unet.detect(&picture(170, 100, &centers), None).unwrap(), &centers, 0.2);
    }

    #[test]
    fn a_photo_outside_of_the_liked_distances_is_scaled_and_its_boxes_are_not() {
        let Some(unet) = open(&fixture("double_size.onnx")) else { return };
        let unet = unet.unwrap();
        assert_eq!(unet.working_scale(Some(0.03)), 1.0);
        assert_eq!(unet.working_scale(None), 1.0);
        assert_eq!(unet.working_scale(Some(f64::NAN)), 1.0);
        let centers = lattice(20.2, 15.6, 5, 4);
        for gsd_m in [0.023, 0.1] {
            assert!(unet.working_scale(Some(gsd_m)) != 1.0);
            assert_found(&unet.detect(&picture(170, 100, &centers), Some(gsd_m)).unwrap(), &centers, 0.3);
        }
    }

    #[test]
    fn a_photo_of_many_tiles_has_each_module_once() {
        let Some(unet) = open(&fixture("double_size.onnx")) else { return };
        let centers = lattice(20.2, 15.6, 52, 3);
        let found = unet.unwrap().detect(&picture(1460, 75, &centers), None).unwrap();
        assert_found(&found, &centers, 0.2);
        let Some(fixed) = open(&fixture("fixed_size.onnx")) else { return };
        let found = fixed.unwrap().detect(&picture(1460, 75, &centers), None).unwrap();
        assert_found(&found, &centers, 0.5);
    }

    #[test]
    fn modules_cut_by_the_frame_are_left_out() {
        let Some(unet) = open(&fixture("double_size.onnx")) else { return };
        let centers = lattice(11.9, 30.0, 4, 2);
        let found = unet.unwrap().detect(&picture(118, 70, &centers), None).unwrap();
        assert_found(&found, &centers, 0.2);
        let Some(unet) = open(&fixture("double_size.onnx")) else { return };
        let mut cut = lattice(5.0, 30.0, 4, 2);
        let photo = picture(118, 70, &cut);
        cut.retain(|(x, _)| *x > 12.0);
        assert_found(&unet.unwrap().detect(&photo, None).unwrap(), &cut, 0.2);
    }

    #[test]
    fn a_network_that_gives_no_numbers_is_an_error() {
        let Some(unet) = open(&fixture("nan.onnx")) else { return };
        let unet = unet.unwrap();
        let centers = lattice(20.0, 15.0, 4, 3);
        let error = unet.detect(&picture(150, 90, &centers), None).unwrap_err();
        assert!(matches!(error, DetectionError::NotFinite { .. }), "{error}");
        // A single pixel counts as nought.
        let mut photo = RgbImage::from_pixel(150, 90, Rgb([90; 3]));
        photo.put_pixel(70, 40, Rgb([0; 3]));
        assert!(unet.detect(&photo, None).is_ok());
    }

    #[test]
    fn photos_of_a_few_pixels_have_no_modules() {
        let Some(unet) = open(&fixture("one_channel.onnx")) else { return };
        let unet = unet.unwrap();
        for (width, height) in [(0, 0), (1, 1), (1, 200), (3, 2)] {
            assert!(unet.detect(&RgbImage::new(width, height), Some(0.5)).unwrap().is_empty());
        }
    }

    #[test]
    fn models_that_do_not_fit_are_refused_with_the_reason() {
        for (name, code, words) in [
            ("unnamed_channels.onnx", "model_unfit", "2 channels and no metadata"),
            ("wrong_count.onnx", "model_unfit", "names 1 channels, but it has 2"),
            ("no_module.onnx", "model_unfit", "(core, edge) is `module`"),
            ("bad_shrink.onnx", "model_unfit", "`heliomap.core_shrink` is `nan`"),
            ("other_kind.onnx", "model_unfit", "calls itself `yolo`"),
            ("logits.onnx", "model_unfit", "with a sigmoid"),
            ("classifier.onnx", "model_unfit", "masks of 1 x 1"),
            ("grey.onnx", "model_unfit", "float32 [N, 3, H, W] is needed"),
            ("two_inputs.onnx", "model_unfit", "one is needed"),
            ("missing.onnx", "model_unreadable", "cannot be read"),
        ] {
            let Some(opened) = open(&fixture(name)) else { return };
            let error = opened.err().unwrap_or_else(|| panic!("{name} was accepted"));
            assert_eq!(error.code(), code, "{error}");
            let text = error.to_string();
            assert!(text.contains(name) && text.contains(words), "{text}");
        }
    }

    #[test]
    fn files_that_are_no_models_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let whole = std::fs::read(fixture("one_channel.onnx")).unwrap();
        let noise: Vec<u8> = (0..4000_u32).map(|i| (i * i % 251) as u8).collect();
        let contents: [(&str, &[u8]); 4] = [
            ("empty.onnx", b""),
            ("text.onnx", b"This is no model, but a letter.\n"),
            ("noise.onnx", &noise),
            ("cut.onnx", &whole[..whole.len() / 2]),
        ];
        for (name, bytes) in contents {
            let path = folder.path().join(name);
            std::fs::write(&path, bytes).unwrap();
            let Some(opened) = open(&path) else { return };
            let error = opened.err().unwrap_or_else(|| panic!("{name} was accepted"));
            assert!(matches!(error, DetectionError::NotAModel { .. }), "{error}");
            assert!(error.to_string().contains(name), "{error}");
        }
        let Some(opened) = open(folder.path()) else { return };
        assert!(matches!(opened, Err(DetectionError::NotAModel { .. })));
    }

    #[test]
    fn the_shipped_model_opens_and_sees_nothing_on_bare_ground() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("models/unet.onnx");
        let Some(unet) = open(&path) else { return };
        let unet = unet.unwrap();
        assert!(unet.describe().contains("unet.onnx"));
        assert!(unet.core.is_some() && unet.gsd_m.is_some());
        let ground = RgbImage::from_fn(320, 200, |x, y| {
            let grain = (x.wrapping_mul(7919) ^ y.wrapping_mul(104_729)) % 17;
            Rgb([120 + grain as u8, 110 + grain as u8, 80 + grain as u8])
        });
        assert!(unet.detect(&ground, Some(0.04)).unwrap().is_empty());
    }

    #[test]
    fn tiles_keep_every_pixel_once_away_from_seams() {
        for (length, fixed) in
            [(1, None), (31, None), (1408, None), (1409, None), (1500, None), (2736, None), (30_000, None)]
                .into_iter()
                .chain([(50, Some(96)), (97, Some(96)), (1460, Some(96)), (5000, Some(640))])
        {
            let tiles = tiles(length, fixed);
            let mut next = 0;
            for (index, tile) in tiles.iter().enumerate() {
                assert_eq!(tile.kept.start, next);
                next = tile.kept.end;
                assert_eq!(tile.size, tiles[0].size);
                match fixed {
                    Some(size) => assert_eq!(tile.size, size as usize),
                    None => assert!(tile.size % STRIDE == 0 && tile.size <= TILE),
                }
                let margin = MARGIN.min(fixed.map_or(TILE, |size| size as usize) / 8);
                assert!(tile.start <= tile.kept.start && tile.kept.end <= tile.start + tile.size);
                assert!(index == 0 || tile.kept.start - tile.start >= margin);
                assert!(index + 1 == tiles.len() || tile.start + tile.size - tile.kept.end >= margin);
            }
            assert_eq!(next, length);
        }
    }

    #[test]
    fn beyond_the_edge_the_image_is_mirrored() {
        let seen: Vec<usize> = (0..9).map(|index| mirrored(index, 4)).collect();
        assert_eq!(seen, [0, 1, 2, 3, 2, 1, 0, 1, 2]);
        assert_eq!(mirrored(7, 1), 0);
    }
}
