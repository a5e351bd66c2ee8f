//! Benches whose seams no network sees, parted by what repeats in the photo.
//!
//! The bright cell grid of some modules is stronger than the seams between them: the mask of faces then covers a bench well,
//! but no core falls out of it. Yet modules are alike, so that the bench repeats itself from module to module and from row to
//! row: of all periods that a bench may have by its outline, the true one explains most of what is seen, cells, busbars, seams
//! and all. Benches of one photo hold the same modules, and decide together which periods these are.

use super::Source;
use super::filter::{OVERLAP, inside_mean};
use super::mask_to_boxes::{Components, ModuleBox, middle};
use super::outline::{FACE, Outline};
use super::probability::ProbabilityMap;
use super::profile::{ELONGATION, Period, Profile, SHORT_PX};
use super::registration::{blurred, grey};
use crate::geometry::Quad;
use image::RgbImage;
use imageproc::geometric_transformations::Projection;
use nalgebra::{Vector2, Vector3};
use rayon::prelude::*;

/// Fewest pixels of an area that is looked at, and the least length and width of its outline.
const LEAST_AREA: usize = 1000;
const LEAST_SIZE: (usize, usize) = (20, 8);
/// Part of a bench that boxes must cover for it to be left to them.
const COVERED: f64 = 0.85;
/// Least part of an outline that is covered by faces.
const FILLED: f64 = 0.85;
/// Sides of a module as seen from above, metres.
const SHORT_M: (f64, f64) = (0.45, 1.45);
const LONG_M: (f64, f64) = (0.85, 2.65);
/// Half the length, in pixels, over which light and colour are taken out.
const COARSE_PX: usize = 15;
/// How far, in which steps, the end that the frame cuts off is turned against the other.
const TURN_RAD: f64 = 0.02;
const MOST_TURNS: i32 = 3;
/// The best pairs of periods of both axes that are weighed.
const MOST_PATTERNS: usize = 400;
/// Twice the period explains as much: what a period must explain more for each doubling of the module's area.
const DOUBLING: f64 = 0.06;
/// Area in square pixels that neither gains nor loses by that.
const USUAL_AREA_PX2: f64 = 600.0;
/// Largest difference of the logarithms of sides of modules of one photo that are taken for the same, and that perspective
/// leaves between benches.
const SAME: f64 = 0.12;
const ALIKE: f64 = 0.15;
/// What a pattern explains beyond this speaks for it, and what a bench well covered by boxes says for theirs.
const NOTHING: f64 = 0.1;
const BY_BOXES: f64 = 1.0;
/// How many of a bench's patterns are put forward for the photo.
const PUT_FORWARD: usize = 20;
/// Least explained share per axis; of the only axis where a bench has one row; and least lead over another count.
const EXPLAINED: f64 = 0.2;
const EXPLAINED_ALONE: f64 = 0.4;
const LEAD: f64 = 0.15;
/// The same once other benches of the photo have told the sides, and how far these may then differ.
const CLOSE: f64 = 0.08;
const CLOSE_LEAD: f64 = 0.08;
/// Fewest columns of a bench of one row.
const LEAST_COLUMNS: f64 = 6.0;
/// Difference of counts at which the end of a bench is another module's.
const OTHER_COUNT: f64 = 0.6;
/// A module of which the mask covers less of the middle is a hole.
const PRESENT: f64 = 0.6;
/// Edge of a module in parts of the pitch.
const FACE_OF_PITCH: f64 = 0.985;

/// The photo and what the network said of it.
pub(super) struct View<'a> {
    pub image: &'a RgbImage,
    pub module: &'a ProbabilityMap,
    pub core: Option<&'a ProbabilityMap>,
    /// Pixels of the image per pixel of the maps.
    pub pixel: Vector2<f64>,
    /// Ground sampling distance of the image in metres per pixel, where it is known.
    pub gsd_m: Option<f64>,
}

#[derive(Debug, Clone, Copy)]
struct Pattern {
    along: Period,
    across: Period,
    score: f64,
}

impl Pattern {
    /// Logarithms of the shorter and the longer side.
    fn sides(&self) -> Vector2<f64> {
        let (along, across) = (self.along.px.ln(), self.across.px.ln());
        Vector2::new(along.min(across), along.max(across))
    }
}

/// A bench that boxes do not cover.
struct Bench {
    outline: Outline,
    raster: Raster,
    area_px2: f64,
    patterns: Vec<Pattern>,
}

/// The boxes, in pixels of the image; those of benches that they cover badly replaced by what repeats there, where that is
/// plain.
pub(super) fn part_benches(boxes: Vec<ModuleBox>, view: &View) -> Vec<ModuleBox> {
    let to_map = view.pixel.map(|pixel| 1.0 / pixel);
    let scaled: Vec<ModuleBox> = boxes.iter().map(|b| b.scaled(to_map)).collect();
    let components = Components::above(view.module, ProbabilityMap::level(FACE));
    let areas: Vec<_> = components
        .iter()
        .map(|runs| (runs, runs.iter().map(|run| run.x1 - run.x0).sum::<usize>()))
        .filter(|(_, area)| *area >= LEAST_AREA)
        .collect();
    let mut votes: Vec<(Vector2<f64>, f64)> = Vec::new();
    let mut open: Vec<(Outline, f64)> = Vec::new();
    for (runs, area) in areas {
        let Some(outline) = Outline::of(view.module, runs) else { continue };
        let quad = Quad { corners: outline.corners };
        let own: Vec<&ModuleBox> = scaled.iter().filter(|b| quad.contains(b.center)).collect();
        let area_px2 = area as f64;
        if own.iter().map(|b| b.area_px2()).sum::<f64>() > COVERED * area_px2 {
            let side = |of: fn(&ModuleBox) -> Vector2<f64>| middle(own.iter().map(|b| of(b).norm())).ln();
            votes.push((Vector2::new(side(|b| b.v), side(|b| b.u)), BY_BOXES * area_px2.sqrt()));
        } else {
            open.push((outline, area_px2));
        }
    }
    let benches: Vec<Bench> =
        open.into_par_iter().filter_map(|(outline, area_px2)| Bench::of(outline, area_px2, view)).collect();
    let Some(sides) = elect(&benches, &votes) else { return boxes };
    let mut kept = boxes;
    for (bench, pattern) in decided(&benches, sides) {
        let found: Vec<ModuleBox> = bench.modules(&pattern, view).into_iter().map(|b| b.scaled(view.pixel)).collect();
        let crosses = |b: &ModuleBox| {
            let quad = b.quad();
            found.iter().any(|own| {
                (own.center - b.center).norm() < own.u.norm().max(b.u.norm())
                    && quad.overlap_px2(&own.quad()) > OVERLAP * own.area_px2().min(b.area_px2())
            })
        };
        kept.retain(|b| !crosses(b));
        kept.extend(found);
    }
    kept
}

/// The logarithms of the sides that most of the photo speaks for.
fn elect(benches: &[Bench], votes: &[(Vector2<f64>, f64)]) -> Option<Vector2<f64>> {
    let is_same = |a: Vector2<f64>, b: Vector2<f64>| (a - b).amax() < SAME;
    let put_forward = benches.iter().flat_map(|bench| bench.patterns.iter().take(PUT_FORWARD).map(Pattern::sides));
    let mut best: Option<(f64, Vector2<f64>)> = None;
    for sides in put_forward.chain(votes.iter().map(|(sides, _)| *sides)) {
        let from_benches = benches.iter().filter_map(|bench| {
            let own = bench.patterns.iter().find(|pattern| is_same(pattern.sides(), sides))?;
            Some((own.score - NOTHING).max(0.0) * bench.area_px2.sqrt())
        });
        let from_boxes = votes.iter().filter(|(voted, _)| is_same(*voted, sides)).map(|(_, weight)| *weight);
        let total: f64 = from_benches.chain(from_boxes).sum();
        if best.is_none_or(|(most, _)| total > most) {
            best = Some((total, sides));
        }
    }
    best.map(|(_, sides)| sides)
}

/// The benches whose pattern is plain by itself, and those that are plain once the sides of modules are known closely.
fn decided(benches: &[Bench], sides: Vector2<f64>) -> Vec<(&Bench, Pattern)> {
    let plain = |bench: &Bench| bench.plain(sides, ALIKE, LEAD);
    let known: Vec<Vector2<f64>> = benches.iter().filter_map(|bench| Some(plain(bench)?.sides())).collect();
    let side = |k: usize| middle(known.iter().map(|sides| sides[k]));
    let closely = Vector2::new(side(0), side(1));
    let decide =
        |bench| plain(bench).or_else(|| if known.is_empty() { None } else { bench.plain(closely, CLOSE, CLOSE_LEAD) });
    benches.iter().filter_map(|bench| Some((bench, decide(bench)?))).collect()
}

impl Bench {
    fn of(outline: Outline, area_px2: f64, view: &View) -> Option<Self> {
        let (outline, raster, along) = Self::straightened(outline, view)?;
        let across = raster.profile(false).periods(true);
        let mut patterns = Vec::new();
        for &along in &along {
            for &across in &across {
                let (short, long) = (along.px.min(across.px), along.px.max(across.px));
                let is_module = (SHORT_PX.0..=SHORT_PX.1).contains(&short)
                    && (ELONGATION.0..=ELONGATION.1).contains(&(long / short))
                    && view.allows(short, long);
                if is_module && (across.count > 1.0 || along.count >= LEAST_COLUMNS) {
                    let doublings = (short * long / USUAL_AREA_PX2).log2();
                    let score = along.explained + across.explained - DOUBLING * doublings;
                    patterns.push(Pattern { along, across, score });
                }
            }
        }
        patterns.sort_by(|a, b| b.score.total_cmp(&a.score));
        patterns.truncate(MOST_PATTERNS);
        Some(Self { outline, raster, area_px2, patterns })
    }

    /// The outline with its cut end turned so that the columns repeat best, for perspective turns them from the end that is
    /// seen to the one that is not; its raster, and its periods along.
    fn straightened(outline: Outline, view: &View) -> Option<(Outline, Raster, Vec<Period>)> {
        let raster = Raster::of(&outline, view)?;
        let periods = raster.profile(true).periods(outline.is_whole);
        let best = periods.first()?.explained;
        if outline.is_whole {
            return Some((outline, raster, periods));
        }
        let turned = (-MOST_TURNS..=MOST_TURNS).filter(|turn| *turn != 0).filter_map(|turn| {
            let outline = outline.turned(f64::from(turn) * TURN_RAD)?;
            let raster = Raster::of(&outline, view)?;
            let explained = raster.profile(true).explained_near(&periods);
            Some((outline, raster, explained))
        });
        match turned.max_by(|a, b| a.2.total_cmp(&b.2)) {
            Some((outline, raster, explained)) if explained > best => {
                let periods = raster.profile(true).periods(false);
                Some((outline, raster, periods))
            }
            _ => Some((outline, raster, periods)),
        }
    }

    /// The best pattern of modules with these sides, but for `tolerance`, where it leads by `lead`.
    fn plain(&self, sides: Vector2<f64>, tolerance: f64, lead: f64) -> Option<Pattern> {
        let alike = || self.patterns.iter().filter(|pattern| (pattern.sides() - sides).amax() < tolerance);
        let best = alike().next()?;
        let is_other = |other: &&Pattern| {
            other.across.count != best.across.count || (other.along.count - best.along.count).abs() > OTHER_COUNT
        };
        let rival = alike().find(is_other).map_or(NOTHING, |rival| rival.score);
        let is_explained = if best.across.count > 1.0 {
            best.along.explained > EXPLAINED && best.across.explained > EXPLAINED
        } else {
            best.along.explained > EXPLAINED_ALONE
        };
        (is_explained && best.score - rival > lead).then_some(*best)
    }

    /// The modules of a pattern that the mask shows, in pixels of the maps.
    fn modules(&self, pattern: &Pattern, view: &View) -> Vec<ModuleBox> {
        let columns = self.raster.profile(true).places(&pattern.along, self.outline.is_whole);
        let rows = self.raster.profile(false).places(&pattern.across, true);
        let mut found = Vec::new();
        for column in columns.windows(2) {
            for row in rows.windows(2) {
                let corner = |x: f64, y: f64| self.raster.place(Vector2::new(x, y));
                let [a, b, c, d] = [
                    corner(column[0], row[0]),
                    corner(column[1], row[0]),
                    corner(column[1], row[1]),
                    corner(column[0], row[1]),
                ];
                let (along, across) =
                    ((b - a + c - d) * (FACE_OF_PITCH / 2.0), (d - a + c - b) * (FACE_OF_PITCH / 2.0));
                let (u, v) = if along.norm() > across.norm() { (along, across) } else { (across, along) };
                let center = (a + b + c + d) / 4.0;
                let module = ModuleBox { center, u, v, score: 1.0, source: Source::Unet };
                let score = inside_mean(view.module, &module);
                if score > PRESENT {
                    found.push(ModuleBox { score: score as f32, ..module });
                }
            }
        }
        found
    }
}

/// A bench made upright: about one sample per pixel of the maps.
struct Raster {
    columns: usize,
    rows: usize,
    from_raster: Projection,
    /// Grey value and core probability (nought where the network knows no cores); `None` where no face or no photo is.
    samples: Vec<Option<Vector2<f64>>>,
    has_cores: bool,
}

impl Raster {
    fn of(outline: &Outline, view: &View) -> Option<Self> {
        let [a, b, c, d] = outline.corners;
        let columns = (((b - a).norm() + (c - d).norm()) / 2.0).round() as usize;
        let rows = (((d - a).norm() + (c - b).norm()) / 2.0).round() as usize;
        let most = view.module.width() + view.module.height();
        if columns < LEAST_SIZE.0 || rows < LEAST_SIZE.1 || columns > most || rows > most {
            return None;
        }
        let from_raster = projection(columns as f64, rows as f64, &outline.corners)?;
        let mut raster = Self {
            columns,
            rows,
            from_raster,
            samples: Vec::with_capacity(columns * rows),
            has_cores: view.core.is_some(),
        };
        let size = Vector2::new(view.module.width() as f64, view.module.height() as f64);
        let mut in_view = 0_usize;
        for row in 0..rows {
            for column in 0..columns {
                let at = raster.place(Vector2::new(column as f64 + 0.5, row as f64 + 0.5));
                let is_in_view = at.x >= 0.0 && at.y >= 0.0 && at.x <= size.x - 1.0 && at.y <= size.y - 1.0;
                in_view += usize::from(is_in_view);
                let is_face = is_in_view && view.module.at(at) > f64::from(FACE);
                let core = || view.core.map_or(0.0, |core| core.at(at));
                let sample = if is_face { view.grey(at).map(|grey| Vector2::new(grey, core())) } else { None };
                raster.samples.push(sample);
            }
        }
        let faces = raster.samples.iter().flatten().count();
        (faces as f64 > FILLED * in_view as f64).then_some(raster)
    }

    /// A place of the raster in pixels of the maps.
    fn place(&self, at: Vector2<f64>) -> Vector2<f64> {
        project(&self.from_raster, at)
    }

    /// Means over the rows (`along`) or over the columns, less what changes slowly.
    fn profile(&self, along: bool) -> Profile {
        let length = if along { self.columns } else { self.rows };
        let mut sums = vec![Vector3::zeros(); length];
        for (index, sample) in self.samples.iter().enumerate() {
            if let Some(sample) = sample {
                sums[if along { index % self.columns } else { index / self.columns }] += sample.push(1.0);
            }
        }
        let most = sums.iter().map(|sum| sum.z).fold(0.0, f64::max);
        // The ends show the edge of the bench.
        let is_seen: Vec<bool> = (0..length).map(|k| sums[k].z > 0.3 * most && (2..length - 2).contains(&k)).collect();
        let channel = |k: usize| {
            let known = sums.iter().filter(|sum| sum.z > 0.0);
            let mean = known.clone().map(|sum| sum[k] / sum.z).sum::<f64>() / known.count().max(1) as f64;
            let values: Vec<f64> = sums.iter().map(|sum| if sum.z > 0.0 { sum[k] / sum.z } else { mean }).collect();
            let slow = blurred(&values, length, COARSE_PX, 1);
            values.iter().zip(slow).map(|(value, slow)| value - slow).collect()
        };
        let mut channels = vec![channel(0)];
        if self.has_cores {
            channels.push(channel(1));
        }
        Profile { is_seen, channels }
    }
}

impl View<'_> {
    /// Whether sides of so many pixels of the maps can be a module's on the ground.
    fn allows(&self, short: f64, long: f64) -> bool {
        let Some(gsd_m) = self.gsd_m else { return true };
        let metres = gsd_m * (self.pixel.x + self.pixel.y) / 2.0;
        (SHORT_M.0..=SHORT_M.1).contains(&(short * metres)) && (LONG_M.0..=LONG_M.1).contains(&(long * metres))
    }

    /// Grey value at a place of the maps: the mean over the pixel of the map; `None` outside of the photo.
    fn grey(&self, at: Vector2<f64>) -> Option<f64> {
        let half = Vector2::repeat(0.5);
        let fine = self.pixel.x.max(self.pixel.y).ceil().clamp(1.0, 4.0) as usize;
        let part = |k: usize| (k as f64 + 0.5) / fine as f64 - 0.5;
        let mut sum = 0.0;
        for k in 0..fine * fine {
            let at = at + Vector2::new(part(k % fine), part(k / fine));
            sum += grey(self.image, (at + half).component_mul(&self.pixel) - half)?;
        }
        Some(sum / (fine * fine) as f64)
    }
}

/// The projection from a rectangle of the given size, its first corner at the origin, to a quadrilateral.
fn projection(width: f64, height: f64, corners: &[Vector2<f64>; 4]) -> Option<Projection> {
    let from = [(0.0, 0.0), (width, 0.0), (width, height), (0.0, height)].map(|(x, y)| (x as f32, y as f32));
    Projection::from_control_points(from, corners.map(|corner| (corner.x as f32, corner.y as f32)))
}

/// A place projected.
fn project(projection: &Projection, at: Vector2<f64>) -> Vector2<f64> {
    let (x, y) = *projection * (at.x as f32, at.y as f32);
    Vector2::new(f64::from(x), f64::from(y))
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: (u32, u32) = (520, 300);
    const COLUMNS: usize = 14;
    const ROWS: usize = 3;

    /// The modules of a bench in perspective, portrait, with all their corners.
    fn modules() -> Vec<Quad> {
        let seen = |x: f64, y: f64| {
            let far = 1.0 + 0.0002 * x + 0.0003 * y;
            Vector2::new(40.3 + (0.96 * x - 0.25 * y) / far, 30.2 + (0.27 * x + 0.93 * y) / far)
        };
        (0..ROWS * COLUMNS)
            .map(|k| {
                let (x, y) = (30.0 * (k % COLUMNS) as f64, 51.0 * (k / COLUMNS) as f64);
                Quad { corners: [seen(x, y), seen(x + 30.0, y), seen(x + 30.0, y + 51.0), seen(x, y + 51.0)] }
            })
            .collect()
    }

    fn mean_of_9(x: usize, y: usize, value: impl Fn(Vector2<f64>) -> f64) -> f64 {
        let fine = |k: usize| (k as f64 - 1.0) / 3.0;
        (0..9).map(|k| value(Vector2::new(x as f64 + fine(k % 3), y as f64 + fine(k / 3)))).sum::<f64>() / 9.0
    }

    /// A mask that covers all modules and shows no seam.
    fn mask(modules: &[Quad], width: u32) -> ProbabilityMap {
        ProbabilityMap::from_fn(width as usize, SIZE.1 as usize, |x, y| {
            mean_of_9(x, y, |at| f64::from(u8::from(modules.iter().any(|quad| quad.contains(at))))) as f32
        })
    }

    /// A photo of modules whose cell grid is far brighter than their dark seams.
    fn photo(modules: &[Quad], width: u32, grid: f64) -> RgbImage {
        let inverse: Vec<Projection> =
            modules.iter().map(|quad| projection(4.0, 6.0, &quad.corners).unwrap().invert()).collect();
        RgbImage::from_fn(width, SIZE.1, |x, y| {
            let value = mean_of_9(x as usize, y as usize, |at| {
                let Some(index) = modules.iter().position(|quad| quad.contains(at)) else { return 130.0 };
                let cell = project(&inverse[index], at);
                let border = cell.x.min(4.0 - cell.x).min(cell.y).min(6.0 - cell.y);
                // Frames and the margins within push the cells together.
                let line = |value: f64, count: f64| {
                    let cell = (value - 0.25) * count / (count - 0.5);
                    (cell - cell.round()).abs() < 0.12
                };
                match border {
                    b if b < 0.2 => 40.0,
                    _ if line(cell.x, 4.0) || line(cell.y, 6.0) => 60.0 + grid,
                    _ => 60.0,
                }
            });
            image::Rgb([value.round() as u8; 3])
        })
    }

    fn parted(boxes: Vec<ModuleBox>, modules: &[Quad], width: u32, grid: f64) -> Vec<ModuleBox> {
        let (image, module) = (photo(modules, width, grid), mask(modules, width));
        part_benches(
            boxes,
            &View { image: &image, module: &module, core: None, pixel: Vector2::repeat(1.0), gsd_m: None },
        )
    }

    fn assert_found(found: &[ModuleBox], expected: &[Quad]) {
        assert_eq!(found.len(), expected.len());
        for quad in expected {
            let best = found.iter().map(|b| b.quad().iou(quad)).fold(0.0, f64::max);
            assert!(best > 0.85, "a module at {:?} has an IoU of {best}", quad.center());
        }
    }

    #[test]
    fn a_bench_without_seams_is_parted_by_what_repeats() {
        let truth = modules();
        assert_found(&parted(Vec::new(), &truth, SIZE.0, 110.0), &truth);
        // Its boxes go that lie across.
        let b = ModuleBox {
            center: truth[4].corners[1],
            u: Vector2::new(0.0, 40.0),
            v: Vector2::new(25.0, 0.0),
            score: 0.9,
            source: Source::Unet,
        };
        assert_found(&parted(vec![b], &truth, SIZE.0, 110.0), &truth);
    }

    #[test]
    fn benches_that_boxes_cover_tell_the_sides() {
        let truth = modules();
        let (wide, high) = (27.1_f64.ln(), 45.9_f64.ln());
        let (image, module) = (photo(&truth, SIZE.0, 110.0), mask(&truth, SIZE.0));
        let view = View { image: &image, module: &module, core: None, pixel: Vector2::repeat(1.0), gsd_m: None };
        let components = Components::above(&module, ProbabilityMap::level(FACE));
        let outline = Outline::of(&module, components.iter().next().unwrap()).unwrap();
        let bench = Bench::of(outline, 6e4, &view).unwrap();
        let alone = elect(std::slice::from_ref(&bench), &[]).unwrap();
        assert!((alone - Vector2::new(wide, high)).amax() < SAME, "{alone:?}");
        let other = Vector2::new(wide + 0.5, high + 0.5);
        let told = elect(&[bench], &[(other, 300.0), (other, 300.0)]).unwrap();
        assert!((told - other).amax() < SAME, "{told:?}");
    }

    #[test]
    fn a_bench_that_the_frame_cuts_is_parted_from_its_end() {
        let truth = modules();
        let width = 300;
        let found = parted(Vec::new(), &truth, width, 110.0);
        let is_inside = |quad: &Quad| quad.corners.iter().all(|corner| corner.x <= f64::from(width) - 1.0);
        let inside: Vec<Quad> = truth.iter().filter(|quad| is_inside(quad)).copied().collect();
        let found: Vec<ModuleBox> = found.into_iter().filter(|b| is_inside(&b.quad())).collect();
        assert!(inside.len() > 18 && found.len() <= inside.len() + 1);
        for quad in &inside {
            let best = found.iter().map(|b| b.quad().iou(quad)).fold(0.0, f64::max);
            assert!(best > 0.75, "a module at {:?} has an IoU of {best}", quad.center());
        }
    }

    #[test]
    fn a_missing_module_stays_a_hole() {
        let mut truth = modules();
        truth.remove(COLUMNS + 5);
        assert_found(&parted(Vec::new(), &truth, SIZE.0, 110.0), &truth);
    }

    #[test]
    fn what_no_module_measures_on_the_ground_is_no_module() {
        let (image, module) = (RgbImage::new(1, 1), ProbabilityMap::new(1, 1));
        let view = |gsd_m| View { image: &image, module: &module, core: None, pixel: Vector2::repeat(2.0), gsd_m };
        // 1.0 x 1.6 m, then two rows in one, then half a module.
        assert!(view(Some(0.02)).allows(25.0, 40.0));
        assert!(!view(Some(0.02)).allows(25.0, 80.0));
        assert!(!view(Some(0.02)).allows(12.5, 20.0) && !view(Some(0.02)).allows(10.0, 40.0));
        assert!(view(None).allows(25.0, 80.0));
    }

    #[test]
    fn without_anything_that_repeats_boxes_stay() {
        let truth = modules();
        let roof = Quad {
            corners: [
                truth[0].corners[0],
                truth[COLUMNS - 1].corners[1],
                truth[ROWS * COLUMNS - 1].corners[2],
                truth[(ROWS - 1) * COLUMNS].corners[3],
            ],
        };
        assert_eq!(parted(Vec::new(), &[roof], SIZE.0, 0.0), Vec::new());
        // A bench that boxes cover is left to them.
        let boxes: Vec<ModuleBox> = truth
            .iter()
            .map(|quad| {
                let [along, across] = quad.sides();
                ModuleBox { center: quad.center(), u: across * 0.98, v: along * 0.98, score: 0.9, source: Source::Unet }
            })
            .collect();
        assert_eq!(parted(boxes.clone(), &truth, SIZE.0, 110.0), boxes);
    }
}
