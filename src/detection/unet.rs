//! The semantic segmentation network (paper, 3.2): photo to masks, tile by tile, and masks to modules.

use super::mask_to_boxes::{self, ModuleBox};
use super::probability::ProbabilityMap;
use super::runtime::{self, SegmentationModel, Sessions};
use super::{Detection, DetectionError, Detector, Source, filter};
use crate::geometry::Quad;
use fast_image_resize as fir;
use image::RgbImage;
use nalgebra::Vector2;
use ort::session::Session;
use ort::value::TensorRef;
use std::ops::{Range, RangeInclusive};
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};

/// The network's input has a size that is a multiple of this many pixels.
const STRIDE: usize = 32;
/// The most pixels of a tile. It bounds the memory of each session, to about 0.1 kB per pixel.
const TILE_PX2: usize = 1 << 20;
/// What a tile has beyond the part that is kept, at every seam: there the network sees too little around it.
const MARGIN: usize = 48;
/// Most of an image's output that may be no number before the model is taken for damaged.
const MAX_NOT_FINITE: f64 = 0.001;
/// Range of factors by which an image is ever scaled.
const SCALES: RangeInclusive<f64> = 1.0 / 16.0..=4.0;

/// A U-Net in ONNX: input float32 [N, 3, H, W], RGB in 0..1; output float32 [N, C, sH, sW] with s = 1 or 2, probabilities.
/// What the channels are is told by the model's metadata (`heliomap.channels`); a model without it has one channel, the
/// mask of modules.
pub struct Unet {
    sessions: Sessions,
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
    /// How many values were no numbers.
    not_finite: usize,
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
        let SegmentationModel { sessions, input, output, fixed_size, metadata, digest } =
            runtime::open_segmentation(path, threads)?;
        if let Some(kind) = metadata.get("kind").filter(|kind| *kind != "unet") {
            return Err(unfit(format!("it calls itself `{kind}`; a `unet` is needed")));
        }
        let (channels, upscale) =
            sessions.with(|session| probe(session, &input, &output, fixed_size)).map_err(unfit)?;
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
        Ok(Self {
            sessions,
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
        let tiles = tiles(width, height, self.fixed_size);
        let s = self.upscale;
        let masks = Mutex::new(Masks {
            module: ProbabilityMap::new(width * s, height * s),
            core: self.core.map(|_| ProbabilityMap::new(width * s, height * s)),
            not_finite: 0,
        });
        let next = AtomicUsize::new(0);
        let work = || -> Result<(), DetectionError> {
            let mut pixels = Vec::new();
            while let Some(tile) = tiles.get(next.fetch_add(1, Ordering::Relaxed)) {
                fill(&mut pixels, image, tile);
                self.sessions.with(|session| self.run_tile(session, &pixels, tile, &masks))?;
            }
            Ok(())
        };
        std::thread::scope(|scope| {
            let others: Vec<_> = (1..self.sessions.count().min(tiles.len())).map(|_| scope.spawn(work)).collect();
            let own = work();
            others.into_iter().fold(own, |result, other| result.and(other.join().expect("a worker does not panic")))
        })?;
        let masks = masks.into_inner().unwrap_or_else(PoisonError::into_inner);
        let share = masks.not_finite as f64 / (width * s * height * s) as f64;
        if share > MAX_NOT_FINITE {
            return Err(DetectionError::NotFinite { percent: 100.0 * share });
        }
        Ok(masks)
    }

    /// Runs the network on a tile and puts what is kept of it into the masks.
    fn run_tile(
        &self,
        session: &mut Session,
        pixels: &[f32],
        tile: &Tile,
        masks: &Mutex<Masks>,
    ) -> Result<(), DetectionError> {
        let s = self.upscale;
        let outputs = run(session, &self.input, pixels, tile.rows.size, tile.columns.size)?;
        let (shape, values) = extract(&outputs, &self.output)?;
        let wanted = [1, self.channels, tile.rows.size * s, tile.columns.size * s];
        if shape != wanted {
            return Err(DetectionError::Inference {
                what: format!("its output has the shape {shape:?} where {wanted:?} was to be expected"),
            });
        }
        let masks = &mut *masks.lock().unwrap_or_else(PoisonError::into_inner);
        let channels =
            [(Some(self.module_channel), Some(&mut masks.module)), (self.core.map(|c| c.0), masks.core.as_mut())];
        for (channel, map) in channels {
            let (Some(channel), Some(map)) = (channel, map) else { continue };
            let (columns, rows) = (&tile.columns, &tile.rows);
            let stride = columns.size * s;
            let plane = &values[channel * rows.size * s * stride..];
            for y in rows.kept.start * s..rows.kept.end * s {
                let from = (y - rows.start * s) * stride + (columns.kept.start - columns.start) * s;
                let target = &mut map.row_mut(y)[columns.kept.start * s..columns.kept.end * s];
                for (target, value) in target.iter_mut().zip(&plane[from..]) {
                    masks.not_finite += usize::from(!value.is_finite());
                    *target = if value.is_finite() { ProbabilityMap::pack(*value) } else { 0 };
                }
            }
        }
        Ok(())
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

/// A part of the image that the network sees at once.
#[derive(Debug, Clone)]
struct Tile {
    columns: Stretch,
    rows: Stretch,
}

/// The rows or the columns of a tile.
#[derive(Debug, Clone)]
struct Stretch {
    /// First pixel.
    start: usize,
    /// Pixels that the network sees; may reach beyond the image.
    size: usize,
    /// Pixels of the image that are kept.
    kept: Range<usize>,
}

/// Cuts an image into tiles of one size, bounded by [`TILE_PX2`] or `fixed` (height and width), so that the network has the
/// least to do. The kept parts join without gap, each at least a margin from its tile's seams. Depends on nothing but the
/// sizes, so that the result is the same whatever runs it.
fn tiles(width: usize, height: usize, fixed: [Option<u32>; 2]) -> Vec<Tile> {
    let [fixed_height, fixed_width] = fixed.map(|size| size.map(|size| size as usize));
    let choices = |length: usize, fixed: Option<usize>| -> Vec<(usize, usize)> {
        if let Some(size) = fixed {
            let margin = MARGIN.min(size / 8);
            let count = if length <= size { 1 } else { (length - 2 * margin).div_ceil(size - 2 * margin) };
            return vec![(count, size)];
        }
        let size = |count: usize| (length + (count - 1) * 2 * MARGIN).div_ceil(count).next_multiple_of(STRIDE);
        // More tiles than this would be narrower than their margins are worth.
        (1..=length.div_ceil(4 * MARGIN)).map(|count| (count, size(count))).collect()
    };
    let (columns, rows) = (choices(width, fixed_width), choices(height, fixed_height));
    let pairs = columns.iter().flat_map(|column| rows.iter().map(move |row| (*column, *row)));
    let (column, row) = pairs
        .min_by_key(|((columns, width), (rows, height))| {
            let is_large = fixed_width.is_none() && width * height > TILE_PX2;
            (is_large, columns * width * rows * height)
        })
        .expect("there is at least one choice");
    let columns = stretches(width, column);
    stretches(height, row)
        .into_iter()
        .flat_map(|rows| columns.iter().map(move |columns| Tile { columns: columns.clone(), rows: rows.clone() }))
        .collect()
}

/// `count` stretches of `size` pixels, evenly spread over `length` pixels, the first at the start and the last at the end.
fn stretches(length: usize, (count, size): (usize, usize)) -> Vec<Stretch> {
    if count == 1 {
        return vec![Stretch { start: 0, size, kept: 0..length }];
    }
    let start = |index: usize| (length - size) * index / (count - 1);
    let seam = |index: usize| (start(index) + start(index - 1) + size) / 2;
    (0..count)
        .map(|index| {
            let from = if index == 0 { 0 } else { seam(index) };
            let to = if index + 1 == count { length } else { seam(index + 1) };
            Stretch { start: start(index), size, kept: from..to }
        })
        .collect()
}

/// A tile of the image as the network takes it: planes of red, green and blue, 0 to 1, mirrored beyond the image's edge.
fn fill(pixels: &mut Vec<f32>, image: &RgbImage, tile: &Tile) {
    let (width, height) = (image.width() as usize, image.height() as usize);
    let (columns, rows) = (&tile.columns, &tile.rows);
    let plane = rows.size * columns.size;
    pixels.resize(3 * plane, 0.0);
    let places: Vec<usize> = (0..columns.size).map(|x| 3 * mirrored(columns.start + x, width)).collect();
    let (red, rest) = pixels.split_at_mut(plane);
    let (green, blue) = rest.split_at_mut(plane);
    for y in 0..rows.size {
        let line = &image.as_raw()[3 * width * mirrored(rows.start + y, height)..][..3 * width];
        let row = y * columns.size..(y + 1) * columns.size;
        let (red, green, blue) = (&mut red[row.clone()], &mut green[row.clone()], &mut blue[row]);
        for (x, &at) in places.iter().enumerate() {
            red[x] = f32::from(line[at]) / 255.0;
            green[x] = f32::from(line[at + 1]) / 255.0;
            blue[x] = f32::from(line[at + 2]) / 255.0;
        }
    }
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
        let free = [None; 2];
        for (width, height, fixed) in [
            (1, 1, free),
            (31, 900, free),
            (1368, 912, free),
            (2736, 1824, free),
            (1_000_000, 7, free),
            (12_000, 8000, free),
            (97, 50, [Some(64), Some(96)]),
            (5000, 641, [Some(640), Some(640)]),
        ] {
            let tiles = tiles(width, height, fixed);
            let mut kept = 0;
            for tile in &tiles {
                kept += tile.columns.kept.len() * tile.rows.kept.len();
                if fixed == free {
                    assert!(tile.columns.size % STRIDE == 0 && tile.rows.size % STRIDE == 0);
                    assert!(tile.columns.size * tile.rows.size <= TILE_PX2);
                }
                for (stretch, length) in [(&tile.columns, width), (&tile.rows, height)] {
                    let margin = if fixed == free { MARGIN } else { 8 };
                    let end = stretch.start + stretch.size;
                    assert!(
                        stretch.start == 0 && stretch.kept.start == 0 || stretch.kept.start >= stretch.start + margin
                    );
                    assert!(end >= length && stretch.kept.end == length || stretch.kept.end + margin <= end);
                    assert!(stretch.start == 0 || end <= length);
                }
            }
            assert_eq!(kept, width * height);
            let mut starts: Vec<_> = tiles.iter().map(|tile| (tile.rows.kept.start, tile.columns.kept.start)).collect();
            starts.dedup();
            assert_eq!(starts.len(), tiles.len());
        }
        // Half a photo at a time, with little to see twice.
        let seen: usize = tiles(1368, 912, free).iter().map(|tile| tile.columns.size * tile.rows.size).sum();
        assert!((seen as f64) < 1.1 * 1368.0 * 912.0);
    }

    #[test]
    fn beyond_the_edge_the_image_is_mirrored() {
        let seen: Vec<usize> = (0..9).map(|index| mirrored(index, 4)).collect();
        assert_eq!(seen, [0, 1, 2, 3, 2, 1, 0, 1, 2]);
        assert_eq!(mirrored(7, 1), 0);
    }
}
