//! Half-cut modules: two fields of cells in one frame, with a gap between them that is as bright as a seam or brighter. The
//! networks, which know whole fields of cells, give a box for each half.
//!
//! Boxes of one lattice are halves where they are about as long as wide, as no module is, and where the seams along one
//! direction alternate: every second one, the seam between frames, looks different from those within modules. The photo
//! shows by how much; that halves come in pairs tells which seams are which.

use super::lattice::{self, median};
use super::mask_to_boxes::ModuleBox;
use super::registration::grey;
use image::RgbImage;
use nalgebra::Vector2;
use std::collections::{BTreeMap, HashMap};

/// Length of a half along the module over its width, as photos show it: halves have 0.84 to 1.03 (modules of 1.69 to 2.05),
/// seen 45 degrees off upright down to 0.7 or up to 1.2.
const RATIO: std::ops::RangeInclusive<f64> = 0.68..=1.2;
/// Sides of half-cut modules (1.04 x 1.76 to 1.30 x 2.38 m) as seen from above, metres, with room for tilt and for an error
/// of the ground sampling distance.
const WIDTH_M: std::ops::RangeInclusive<f64> = 0.8..=1.5;
const LENGTH_M: std::ops::RangeInclusive<f64> = 1.3..=2.7;
/// Fewest pairs of neighbouring seams that show an alternation, and its least mean over its own uncertainty: by chance one
/// lattice in many thousands has as much.
const MIN_PAIRS: usize = 8;
const MIN_SIGNIFICANCE: f64 = 5.0;
/// Least difference of neighbouring seams in parts of what seams deviate from the glass: how pixels fall on a regular lattice
/// alternates, too, but little.
const MIN_CONTRAST: f64 = 0.15;
/// Largest difference of the logarithms of sizes that perspective and tilt leave between lattices of a photo.
const SAME_SIZE: f64 = 0.25;
/// Least share of runs of an even number of halves in a lattice that does not alternate.
const MIN_EVEN: f64 = 0.8;
/// Where a seam is looked at: so far on both sides of it, and along it, in parts of the step and of the box.
const SEAM_REACH: f64 = 0.14;
const SEAM_WIDTH: f64 = 0.35;
/// Samples along and across a seam.
const SAMPLES: (i32, i32) = (5, 4);
/// Where the glass beside a seam is looked at, in parts of the step.
const GLASS_AT: f64 = 0.22;

type Cell = (i32, i32);

/// The boxes, with those of halves joined to modules. A half without its other is left out.
pub(super) fn join_halves(boxes: Vec<ModuleBox>, image: &RgbImage, gsd_m: Option<f64>) -> Vec<ModuleBox> {
    let lattices: Vec<Vec<Direction>> = lattice::grouped(&boxes)
        .into_iter()
        .map(|cells| {
            let cells: HashMap<Cell, usize> = cells.into_iter().collect();
            [(1, 0), (0, 1)].iter().filter_map(|step| Direction::of(&cells, *step, &boxes, image, gsd_m)).collect()
        })
        .collect();
    let by_seams: Vec<Option<&Direction>> = lattices
        .iter()
        .map(|directions| {
            let clear = directions.iter().filter_map(|direction| Some((direction, direction.significance()?)));
            let clear = clear.filter(|(_, significance)| *significance >= MIN_SIGNIFICANCE);
            clear.max_by(|a, b| a.1.total_cmp(&b.1)).map(|(direction, _)| direction)
        })
        .collect();
    let sizes: Vec<[f64; 2]> = by_seams.iter().flatten().map(|direction| direction.size_px).collect();
    let mut is_half = vec![false; boxes.len()];
    let mut joined = Vec::new();
    for (directions, by_seams) in lattices.iter().zip(&by_seams) {
        let by_others = || directions.iter().find(|direction| direction.is_like(&sizes));
        let Some(direction) = by_seams.or_else(by_others) else { continue };
        let Some(pairs) = direction.pairs() else { continue };
        for (first, second) in pairs {
            joined.extend(join(&boxes[first], &boxes[second]));
        }
        for &index in direction.runs.iter().flat_map(|(_, run)| run) {
            is_half[index] = true;
        }
    }
    let whole = boxes.into_iter().zip(is_half).filter(|(_, is_half)| !is_half).map(|(b, _)| b);
    whole.chain(joined).collect()
}

/// A direction of a lattice along which its boxes may be halves.
struct Direction {
    /// Runs of neighbouring boxes, each with the place of its first box along the direction.
    runs: Vec<(i32, Vec<usize>)>,
    /// How far the seams behind even places differ from those behind odd ones; `None` where too few are seen.
    alternation: Option<Look>,
    /// Of a box with its seam, along the direction and across it.
    size_px: [f64; 2],
}

/// How a seam looks: its grey against the glass beside it, summed with and without its sign. Of an alternation, the mean
/// differences of both over their uncertainties.
#[derive(Clone, Copy)]
struct Look {
    signed: f64,
    strength: f64,
}

impl Direction {
    /// `None` where boxes of this shape are no halves along `step`, or where too few seams are seen.
    fn of(
        cells: &HashMap<Cell, usize>,
        step: Cell,
        boxes: &[ModuleBox],
        image: &RgbImage,
        gsd_m: Option<f64>,
    ) -> Option<Self> {
        let runs = runs(cells, step);
        let neighbours = || runs.iter().flat_map(|(_, run)| run.windows(2).map(|pair| (pair[0], pair[1])));
        let mut lengths: Vec<f64> = neighbours().map(|(a, b)| (boxes[b].center - boxes[a].center).norm()).collect();
        let mut widths: Vec<f64> = neighbours().map(|(a, b)| edges(&boxes[a], &boxes[b]).1.norm()).collect();
        if lengths.is_empty() {
            return None;
        }
        let (length_px, width_px) = (median(&mut lengths), median(&mut widths));
        let fits = gsd_m
            .is_none_or(|gsd_m| LENGTH_M.contains(&(2.0 * length_px * gsd_m)) && WIDTH_M.contains(&(width_px * gsd_m)));
        if !fits || !RATIO.contains(&(length_px / width_px)) {
            return None;
        }
        let mut signed = Vec::new();
        let mut strength = Vec::new();
        let mut strengths = Vec::new();
        for (start, run) in &runs {
            let looks: Vec<Option<Look>> =
                run.windows(2).map(|pair| look(&boxes[pair[0]], &boxes[pair[1]], image)).collect();
            for (place, pair) in looks.windows(2).enumerate() {
                let [Some(first), Some(second)] = [pair[0], pair[1]] else { continue };
                let sign = if (start + place as i32).rem_euclid(2) == 0 { 1.0 } else { -1.0 };
                signed.push(sign * (first.signed - second.signed));
                strength.push(sign * (first.strength - second.strength));
                strengths.push(first.strength);
            }
        }
        let alternation = (signed.len() >= MIN_PAIRS).then(|| {
            let least = MIN_CONTRAST * median(&mut strengths);
            Look { signed: significance(&signed, least), strength: significance(&strength, least) }
        });
        Some(Self { runs, alternation, size_px: [length_px, width_px] })
    }

    /// Of the look that differs most.
    fn significance(&self) -> Option<f64> {
        self.alternation.map(|look| look.signed.abs().max(look.strength.abs()))
    }

    /// Whether this lattice, too short to alternate, is of halves because others of the photo with boxes of the same size are,
    /// and nearly all its runs are whole pairs.
    fn is_like(&self, sizes: &[[f64; 2]]) -> bool {
        let same = |a: f64, b: f64| (a / b).ln().abs() < SAME_SIZE;
        let even = self.runs.iter().filter(|(_, run)| run.len() % 2 == 0).count();
        self.alternation.is_none()
            && even as f64 >= MIN_EVEN * self.runs.len() as f64
            && sizes.iter().any(|[length, width]| same(*length, self.size_px[0]) && same(*width, self.size_px[1]))
    }

    /// Pairs of boxes that make a module: whole runs of pairs where the ends of runs tell, else with the stronger seams
    /// between modules. `None` where neither tells: half a module to the side all would be wrong.
    fn pairs(&self) -> Option<Vec<(usize, usize)>> {
        let paired = |first: i32| -> Vec<(usize, usize)> {
            let of_run = |(start, run): &(i32, Vec<usize>)| {
                let skipped = (first - start).rem_euclid(2) as usize;
                run[skipped.min(run.len())..].chunks_exact(2).map(|pair| (pair[0], pair[1])).collect::<Vec<_>>()
            };
            self.runs.iter().flat_map(of_run).collect()
        };
        let (even, odd) = (paired(0), paired(1));
        // Runs that begin and end with whole modules leave no half over one way, and two the other way.
        let decisive = self.runs.len().div_ceil(3).max(1);
        if even.len().abs_diff(odd.len()) >= decisive {
            return Some(if even.len() > odd.len() { even } else { odd });
        }
        let strength = self.alternation?.strength;
        // Pairs that begin at even places have the seam behind an even place within.
        (strength.abs() >= MIN_SIGNIFICANCE).then_some(if strength > 0.0 { odd } else { even })
    }
}

/// Unbroken runs of cells along `step`, in order.
fn runs(cells: &HashMap<Cell, usize>, step: Cell) -> Vec<(i32, Vec<usize>)> {
    let mut lines: BTreeMap<i32, BTreeMap<i32, usize>> = BTreeMap::new();
    for (&(column, row), &index) in cells {
        let (along, line) = if step == (1, 0) { (column, row) } else { (row, column) };
        lines.entry(line).or_default().insert(along, index);
    }
    let mut runs: Vec<(i32, Vec<usize>)> = Vec::new();
    for line in lines.values() {
        let mut last = None;
        for (&along, &index) in line {
            match runs.last_mut().filter(|_| last == Some(along - 1)) {
                Some((_, run)) => run.push(index),
                None => runs.push((along, vec![index])),
            }
            last = Some(along);
        }
    }
    runs
}

/// Edge of `a` along the step to `b`, and the one across it.
fn edges(a: &ModuleBox, b: &ModuleBox) -> (Vector2<f64>, Vector2<f64>) {
    let step = b.center - a.center;
    let along = |edge: &Vector2<f64>| edge.dot(&step).abs() / edge.norm().max(f64::EPSILON);
    if along(&a.u) >= along(&a.v) { (a.u, a.v) } else { (a.v, a.u) }
}

/// The seam between two boxes; `None` where it is not in the image.
fn look(a: &ModuleBox, b: &ModuleBox, image: &RgbImage) -> Option<Look> {
    let step = b.center - a.center;
    let across = edges(a, b).1;
    let middle = (a.center + b.center) / 2.0;
    let mean_at = |t: f64| {
        let mut sum = 0.0;
        for k in -SAMPLES.1..=SAMPLES.1 {
            sum += grey(image, middle + step * t + across * (SEAM_WIDTH * f64::from(k) / f64::from(SAMPLES.1)))?;
        }
        Some(sum / f64::from(2 * SAMPLES.1 + 1))
    };
    let glass = (mean_at(-GLASS_AT)? + mean_at(GLASS_AT)?) / 2.0;
    let mut look = Look { signed: 0.0, strength: 0.0 };
    for k in -SAMPLES.0..=SAMPLES.0 {
        let off = mean_at(SEAM_REACH * f64::from(k) / f64::from(SAMPLES.0))? - glass;
        look.signed += off;
        look.strength += off.abs();
    }
    Some(look)
}

/// Mean over its standard error, with outliers clipped to three times the median deviation; 0 where the median is below `least`.
fn significance(values: &[f64], least: f64) -> f64 {
    let middle = median(&mut values.to_vec());
    if middle.abs() < least {
        return 0.0;
    }
    let mut deviations: Vec<f64> = values.iter().map(|value| (value - middle).abs()).collect();
    let reach = 3.0 * 1.4826 * median(&mut deviations);
    let clipped: Vec<f64> = values.iter().map(|value| value.clamp(middle - reach, middle + reach)).collect();
    let count = clipped.len() as f64;
    let mean = clipped.iter().sum::<f64>() / count;
    let variance = clipped.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / (count - 1.0).max(1.0);
    if variance <= 0.0 { 0.0 } else { mean / (variance / count).sqrt() }
}

/// The module of two halves.
fn join(a: &ModuleBox, b: &ModuleBox) -> Option<ModuleBox> {
    let step = b.center - a.center;
    let ((along_a, across_a), (along_b, across_b)) = (edges(a, b), edges(b, a));
    let length = step.norm() + (along_a.norm() + along_b.norm()) / 2.0;
    let along = step.try_normalize(f64::EPSILON)? * length;
    let across = (across_a + across_b * across_a.dot(&across_b).signum()) / 2.0;
    let (u, v) = if along.norm() >= across.norm() { (along, across) } else { (across, along) };
    let score = (a.score + b.score) / 2.0;
    Some(ModuleBox { center: (a.center + b.center) / 2.0, u, v, score, source: a.source })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::detection::Source;

    const SIDE: f64 = 24.0;

    /// A lattice of halves with rows of `columns`, and its photo: seams of `grey` behind even and odd rows of halves.
    fn bench(columns: usize, rows: usize, seams: [u8; 2]) -> (Vec<ModuleBox>, RgbImage) {
        let boxes = (0..columns * rows).map(|k| ModuleBox {
            center: Vector2::new(30.0 + SIDE * (k % columns) as f64, 30.0 + SIDE * (k / columns) as f64),
            u: Vector2::new(SIDE - 1.0, 0.0),
            v: Vector2::new(0.0, SIDE - 1.5),
            score: 0.9,
            source: Source::Unet,
        });
        let (width, height) = (60 + 24 * columns as u32, 60 + 24 * rows as u32);
        let image = RgbImage::from_fn(width, height, |x, y| {
            let (row, column) = ((f64::from(y) - 18.0) / SIDE, (f64::from(x) - 18.0) / SIDE);
            let is_near = |value: f64| (value - value.round()).abs() < 1.2 / SIDE;
            // Light that falls off, and noise.
            let noise = (x.wrapping_mul(2_654_435_761) ^ y.wrapping_mul(40_503)).wrapping_mul(2_246_822_519) >> 28;
            let glass = 50 + (x / 20) as u8 + noise as u8;
            let value = match (is_near(row), is_near(column)) {
                // The seam behind row k is at k + 1.
                (true, _) => seams[(row.round() as i32 - 1).rem_euclid(2) as usize],
                (_, true) => 150,
                _ => glass,
            };
            image::Rgb([value; 3])
        });
        (boxes.collect(), image)
    }

    #[test]
    fn halves_become_modules() {
        // Mid gaps behind even rows, frames with their seam behind odd ones.
        let (boxes, image) = bench(8, 4, [120, 210]);
        let found = join_halves(boxes, &image, Some(0.045));
        assert_eq!(found.len(), 16);
        for module in &found {
            let (long, short) = (module.u.norm(), module.v.norm());
            assert!((long - 46.5).abs() < 0.1 && (short - 23.0).abs() < 0.1, "{long} x {short}");
            let row = (module.center.y - 30.0) / SIDE;
            assert!((row - 0.5).abs() < 0.01 || (row - 2.5).abs() < 0.01, "{row}");
        }
    }

    #[test]
    fn stronger_seams_tell_where_runs_end_with_halves() {
        // The frame cuts the bench: a half is left over at either end.
        let (boxes, image) = bench(8, 5, [120, 210]);
        let found = join_halves(boxes, &image, None);
        let rows: Vec<f64> = found.iter().map(|module| (module.center.y - 30.0) / SIDE).collect();
        assert_eq!(found.len(), 16);
        assert!(rows.iter().all(|row| (row - 0.5).abs() < 0.01 || (row - 2.5).abs() < 0.01), "{rows:?}");
    }

    #[test]
    fn modules_with_equal_seams_stay() {
        let (boxes, image) = bench(8, 4, [150, 150]);
        assert_eq!(join_halves(boxes.clone(), &image, Some(0.045)), boxes);
        // Far larger or smaller than any half.
        let (boxes, image) = bench(8, 4, [120, 210]);
        assert_eq!(join_halves(boxes.clone(), &image, Some(0.09)), boxes);
        assert_eq!(join_halves(boxes.clone(), &image, Some(0.02)), boxes);
    }

    #[test]
    fn lattices_that_do_not_alternate_do_not_follow_those_that_do() {
        let (mut boxes, mut image) = bench(8, 4, [120, 210]);
        let (others, beside) = bench(8, 4, [150, 150]);
        let down = image.height();
        let mut both = RgbImage::new(image.width(), 2 * down);
        image::imageops::replace(&mut both, &image, 0, 0);
        image::imageops::replace(&mut both, &beside, 0, i64::from(down));
        image = both;
        let below = |b: ModuleBox| ModuleBox { center: b.center + Vector2::new(0.0, f64::from(down)), ..b };
        boxes.extend(others.into_iter().map(below));
        // And a lattice of two rows, too short to show either.
        let (short, _) = bench(8, 2, [120, 210]);
        boxes.extend(short.iter().map(|b| ModuleBox { center: b.center + Vector2::new(400.0, 0.0), ..*b }));
        let mut wide = RgbImage::new(2 * image.width() + 200, image.height());
        image::imageops::replace(&mut wide, &image, 0, 0);
        let found = join_halves(boxes, &wide, Some(0.045));
        assert_eq!(found.len(), 16 + 32 + 8);
    }

    #[test]
    fn a_half_without_its_other_is_left_out() {
        let (mut boxes, image) = bench(8, 4, [120, 210]);
        boxes.remove(11);
        assert_eq!(join_halves(boxes, &image, None).len(), 15);
    }
}
