//! The semantic segmentation network (paper, 3.2): photo to masks, tile by tile, and masks to modules.

use super::lattice::Evidence;
use super::mask_to_boxes::{self, ModuleBox};
use super::periodicity::View;
use super::probability::ProbabilityMap;
use super::runtime::{self, ImageModel, RuntimeSettings, extract, run};
use super::tiles::{Beyond, Tile, WorkingRange, fill, resample, tiles};
use super::{Detection, DetectionError, Detector, detectors, filter};
use image::RgbImage;
use nalgebra::Vector2;
use ort::session::Session;
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};

/// Most of an image's output that may be no number before the model is taken for damaged.
const MAX_NOT_FINITE: f64 = 0.001;
/// A U-Net in ONNX: input float32 [N, 3, H, W], RGB in 0..1; output float32 [N, C, sH, sW] with s = 1 or 2, probabilities.
/// What the channels are is told by the model's metadata (`heliomap.channels`); a model without it has one channel, the
/// mask of modules.
pub struct Unet {
    model: ImageModel,
    version: String,
    output: String,
    channels: usize,
    module_channel: usize,
    /// Channel of the faces shrunk by a factor about their centres, and this factor.
    core: Option<(usize, f64)>,
    /// Pixels of the output per pixel of the input, along each side.
    upscale: usize,
    working_range: WorkingRange,
}

/// Probabilities of a whole image, in pixels of the network's output.
struct Masks {
    module: ProbabilityMap,
    core: Option<ProbabilityMap>,
    /// How many values were no numbers.
    not_finite: usize,
}

/// The masks of an image, to be asked in its pixels.
pub(super) struct Seen {
    masks: Masks,
    /// Pixels of the image per pixel of the masks.
    pixel: Vector2<f64>,
}

impl Seen {
    fn sample(&self, map: &ProbabilityMap, at: Vector2<f64>) -> f64 {
        let half = Vector2::repeat(0.5);
        map.at((at + half).component_div(&self.pixel) - half)
    }
}

impl Seen {
    /// The image beside what was said of it.
    pub(super) fn view<'a>(&'a self, image: &'a RgbImage, gsd_m: Option<f64>) -> View<'a> {
        View { image, module: &self.masks.module, core: self.masks.core.as_ref(), pixel: self.pixel, gsd_m }
    }
}

impl Evidence for Seen {
    fn module(&self, at: Vector2<f64>) -> f64 {
        self.sample(&self.masks.module, at)
    }
}

impl Unet {
    /// Opens a model file, checks it and tries it on a small picture.
    ///
    /// # Errors
    /// No ONNX Runtime; a file that is no model, or a model of another kind.
    pub fn open(path: &Path, settings: RuntimeSettings) -> Result<Self, DetectionError> {
        Self::of_model(runtime::open_model(path, settings)?)
    }

    /// Checks an opened model and tries it on a small picture.
    pub(super) fn of_model(model: ImageModel) -> Result<Self, DetectionError> {
        if let Some(kind) = model.ours("kind").filter(|kind| *kind != "unet") {
            return Err(model.unfit(format!("it calls itself `{kind}`; a `unet` is needed")));
        }
        let fits = |dim: i64, wanted: i64| dim == wanted || dim < 0;
        let output = match &model.outputs[..] {
            [only] => Some(only),
            several => several.iter().find(|outlet| outlet.name == "masks"),
        };
        let output = output
            .filter(|outlet| {
                outlet.shape.as_ref().is_some_and(|shape| {
                    shape.len() == 4 && fits(shape[0], 1) && (shape[1] < 0 || (1..=64).contains(&shape[1]))
                })
            })
            .map(|outlet| outlet.name.clone())
            .ok_or_else(|| {
                model.unfit(format!(
                    "its output is {}; one of float32 [N, C, H, W] is needed, named `masks`",
                    model.outputs_text
                ))
            })?;
        let (channels, upscale) = model
            .sessions
            .with(|session| probe(session, &model.input, &output, model.fixed_size))
            .map_err(|what| model.unfit(what))?;
        let names: Option<Vec<&str>> = model.ours("channels").map(|names| names.split(',').map(str::trim).collect());
        let (module_channel, core_channel) = match &names {
            Some(names) if names.len() != channels => {
                return Err(model.unfit(format!("its metadata names {} channels, but it has {channels}", names.len())));
            }
            Some(names) => {
                let of = |wanted: &str| names.iter().position(|name| *name == wanted);
                let module = of("module")
                    .ok_or_else(|| model.unfit(format!("none of its channels ({}) is `module`", names.join(", "))))?;
                (module, of("core"))
            }
            None if channels == 1 => (0, None),
            None => {
                return Err(model.unfit(format!(
                    "it has {channels} channels and no metadata `heliomap.channels` that names them (such as \
                     `module,core`); without metadata one channel is needed, the mask of modules"
                )));
            }
        };
        let core = match core_channel {
            Some(channel) => {
                let text = model
                    .ours("core_shrink")
                    .ok_or_else(|| model.unfit("it has a channel `core` but no metadata `heliomap.core_shrink`"))?;
                let shrink = model.number("core_shrink", text)?;
                if !(0.2..=1.0).contains(&shrink) {
                    return Err(
                        model.unfit(format!("its metadata `heliomap.core_shrink` is {shrink}; 0.2 to 1 is needed"))
                    );
                }
                Some((channel, shrink))
            }
            None => None,
        };
        let working_range = WorkingRange::of_model(&model)?;
        Ok(Self { version: model.version(), output, channels, module_channel, core, upscale, working_range, model })
    }

    /// Masks of a whole image. The network sees it in tiles that overlap, of which the middle is kept.
    fn masks(&self, image: &RgbImage) -> Result<Masks, DetectionError> {
        let (width, height) = (image.width() as usize, image.height() as usize);
        let tiles = tiles(width, height, self.model.fixed_size);
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
                fill(&mut pixels, image, tile, Beyond::Mirrored);
                self.model.sessions.with(|session| self.run_tile(session, &pixels, tile, &masks))?;
            }
            Ok(())
        };
        std::thread::scope(|scope| {
            let others: Vec<_> = (1..self.model.sessions.count().min(tiles.len())).map(|_| scope.spawn(work)).collect();
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
        let outputs = run(session, &self.model.input, pixels, tile.rows.size, tile.columns.size)?;
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

    /// Whether an image of the given ground sampling distance (metres per pixel) is too coarse for the network as it is.
    pub(super) fn enlarges(&self, gsd_m: Option<f64>) -> bool {
        self.working_range.scale(gsd_m) > 1.0
    }

    /// The modules of an image as boxes in its pixels; those that the frame cuts are among them.
    pub(super) fn search(
        &self,
        image: &RgbImage,
        gsd_m: Option<f64>,
    ) -> Result<(Vec<ModuleBox>, Seen), DetectionError> {
        let (width, height) = image.dimensions();
        let scaled = resample(image, self.working_range.scale(gsd_m))?;
        let masks = self.masks(scaled.as_ref().unwrap_or(image))?;
        let boxes = match (&masks.core, self.core) {
            (Some(core), Some((_, shrink))) => mask_to_boxes::from_core(core, shrink),
            _ => mask_to_boxes::from_mask(&masks.module),
        };
        let pixel = Vector2::new(
            f64::from(width) / masks.module.width() as f64,
            f64::from(height) / masks.module.height() as f64,
        );
        let boxes = filter::plausible(boxes, &masks.module).into_iter().map(|b| b.scaled(pixel)).collect();
        Ok((boxes, Seen { masks, pixel }))
    }
}

impl Detector for Unet {
    fn detect(&self, image: &RgbImage, gsd_m: Option<f64>) -> Result<Vec<Detection>, DetectionError> {
        detectors::detect(Some(self), None, image, gsd_m)
    }

    fn describe(&self) -> String {
        format!("U-Net {} ({}), {}", self.version, self.model.name, self.model.settings.describe())
    }

    fn identity(&self) -> String {
        format!("U-Net {}", self.model.identity())
    }
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
        match Unet::open(path, RuntimeSettings::with_threads(1)) {
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
        assert_eq!(unet.working_range.scale(Some(0.3)), 1.0);
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
        assert_eq!(unet.working_range.scale(Some(0.03)), 1.0);
        assert_eq!(unet.working_range.scale(None), 1.0);
        assert_eq!(unet.working_range.scale(Some(f64::NAN)), 1.0);
        let centers = lattice(20.2, 15.6, 5, 4);
        for gsd_m in [0.023, 0.1] {
            assert!(unet.working_range.scale(Some(gsd_m)) != 1.0);
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
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../models/unet.onnx");
        let Some(unet) = open(&path) else { return };
        let unet = unet.unwrap();
        assert!(unet.describe().contains("unet.onnx"));
        assert!(unet.core.is_some() && unet.working_range.scale(Some(0.3)) > 2.0);
        let ground = RgbImage::from_fn(320, 200, |x, y| {
            let grain = (x.wrapping_mul(7919) ^ y.wrapping_mul(104_729)) % 17;
            Rgb([120 + grain as u8, 110 + grain as u8, 80 + grain as u8])
        });
        assert!(unet.detect(&ground, Some(0.04)).unwrap().is_empty());
    }
}
