//! Masks to oriented boxes (paper, 3.2).
//!
//! The shipped network marks each module's face (`module`) and the face shrunk about its centre (`core`), so that
//! neighbours never touch. [`from_core`] follows `training/postprocess.py`, which is the reference:
//!
//! 1. Components (4-connected) of `core` above one half. One that is far too large is cut at rising thresholds; one that
//!    rises only above [`CORE_LOW`] is taken in if it has the size of the others and stands near one.
//! 2. Each component takes in its rim: one pixel around it, as far as `core` is above [`RIM`]. Moments are weighted by
//!    `core`.
//! 3. A module is a parallelogram: a table seen at an angle is no rectangle. The second moments C of a parallelogram
//!    with edges u, v are (u u' + v v') / 12; C^(-1/2) turns it into a square, whose rotation phi follows from the fourth
//!    moment: arg E[(x + iy)^4] = pi + 4 phi. Both moments are averaged over neighbours, for the blurred square of a few
//!    pixels tells its rotation only faintly. Then u = sqrt(12) C^(1/2) (cos phi, sin phi), v likewise, both divided by
//!    the shrink factor.
//!
//! A network of one channel has no cores: [`from_mask`] parts modules as the paper does, by erosion and dilation.

use super::neighbours::Grid;
use super::probability::ProbabilityMap;
use crate::geometry::Quad;
use nalgebra::{Complex, Matrix2, Vector2};
use rayon::prelude::*;

/// A pixel belongs to a component above this probability.
const THRESHOLD: f32 = 0.5;
/// Likewise, for faint modules among others.
const CORE_LOW: f32 = 0.3;
/// Rising thresholds at which a component that holds several modules may fall apart.
const LADDER: [f32; 4] = [0.65, 0.8, 0.9, 0.96];
/// A pixel belongs to a component's rim above this probability.
const RIM: f32 = 0.1;
/// Variance of a pixel's own area along each axis, square pixels.
const PIXEL_VARIANCE: f64 = 1.0 / 12.0;
/// Fewer pixels are a speck.
const MIN_PIXELS: usize = 6;
/// A component of more than this many times the usual mass holds several modules.
const MERGED: f64 = 1.7;
/// The smallest part of the usual mass that is a module when a component falls apart.
const PART: f64 = 0.3;
/// Range of masses, in parts of the usual mass, in which a faint component is a module.
const FAINT: (f64, f64) = (0.4, 1.6);
/// How far the averaging over neighbours reaches (standard deviation), in module sizes.
const REACH: f64 = 2.0;
/// Neighbours of about the same size share their shape: standard deviation of the logarithm of sizes.
const SIZE_SIGMA: f64 = 0.25;
/// Weights beyond this many standard deviations are taken as nought.
const CUTOFF: f64 = 4.0;

/// A module as a parallelogram in pixels of the map (pixel centres at whole numbers).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ModuleBox {
    pub center: Vector2<f64>,
    /// The longer edge, whole.
    pub u: Vector2<f64>,
    /// The shorter edge, whole.
    pub v: Vector2<f64>,
    /// 0 to 1.
    pub score: f32,
}

impl ModuleBox {
    /// The box as a quadrilateral.
    pub fn quad(&self) -> Quad {
        Quad::from_center(self.center, self.u / 2.0, self.v / 2.0)
    }

    /// Square pixels.
    pub fn area_px2(&self) -> f64 {
        self.u.perp(&self.v).abs()
    }
}

/// A horizontal stretch of pixels, `x0..x1`.
#[derive(Debug, Clone, Copy)]
struct Run {
    y: usize,
    x0: usize,
    x1: usize,
}

/// The 4-connected components of what lies above a threshold, each as its runs from top to bottom and left to right;
/// the components in the order of their first pixels.
struct Components {
    runs: Vec<Run>,
    starts: Vec<usize>,
}

impl Components {
    fn above(map: &ProbabilityMap, threshold: f32) -> Self {
        let level = ProbabilityMap::level(threshold);
        let mut runs: Vec<Run> = Vec::new();
        let mut parents: Vec<usize> = Vec::new();
        let mut previous_row = 0..0;
        for y in 0..map.height() {
            let row = map.row(y);
            let first = runs.len();
            let mut above = previous_row.start;
            let mut x = 0;
            while let Some(offset) = row[x..].iter().position(|value| *value > level) {
                let x0 = x + offset;
                let x1 = row[x0..].iter().position(|value| *value <= level).map_or(row.len(), |length| x0 + length);
                let index = runs.len();
                parents.push(index);
                while above < previous_row.end && runs[above].x1 <= x0 {
                    above += 1;
                }
                for touching in (above..previous_row.end).take_while(|&run| runs[run].x0 < x1) {
                    join(&mut parents, touching, index);
                }
                runs.push(Run { y, x0, x1 });
                x = x1;
            }
            previous_row = first..runs.len();
        }
        // A root is the first run of its component, so numbers are given in the order of first pixels.
        let mut numbers = vec![usize::MAX; runs.len()];
        let mut starts = vec![0];
        for run in 0..runs.len() {
            let root = find(&mut parents, run);
            if root == run {
                numbers[run] = starts.len() - 1;
                starts.push(0);
            }
            numbers[run] = numbers[root];
            starts[numbers[run] + 1] += 1;
        }
        for component in 1..starts.len() {
            starts[component] += starts[component - 1];
        }
        let mut next = starts.clone();
        let mut sorted = runs.clone();
        for (run, number) in runs.iter().zip(&numbers) {
            sorted[next[*number]] = *run;
            next[*number] += 1;
        }
        Self { runs: sorted, starts }
    }

    /// The runs of each component that is no speck.
    fn iter(&self) -> impl Iterator<Item = &[Run]> {
        self.starts
            .windows(2)
            .map(|ends| &self.runs[ends[0]..ends[1]])
            .filter(|runs| runs.iter().map(|run| run.x1 - run.x0).sum::<usize>() >= MIN_PIXELS)
    }
}

fn find(parents: &mut [usize], mut run: usize) -> usize {
    while parents[run] != run {
        parents[run] = parents[parents[run]];
        run = parents[run];
    }
    run
}

/// The smaller root becomes the root of both.
fn join(parents: &mut [usize], a: usize, b: usize) {
    let (a, b) = (find(parents, a), find(parents, b));
    parents[a.max(b)] = a.min(b);
}

/// The moments of one component, weighted by probability.
#[derive(Debug, Clone, Copy)]
struct Blob {
    /// Sum of the probabilities, square pixels.
    mass: f64,
    center: Vector2<f64>,
    /// C^(1/2), pixels.
    root: Matrix2<f64>,
    /// E[(x + iy)^4] of the component after C^(-1/2).
    fourth: Complex<f64>,
    /// The third quartile of its probabilities.
    score: f32,
}

impl Blob {
    /// The moments of a component of `map` above `threshold`, with its rim.
    fn of(map: &ProbabilityMap, runs: &[Run], threshold: f32) -> Self {
        Self::of_samples(with_rim(map, runs, threshold))
    }

    /// The moments of pixels (x, y, probability).
    fn of_samples(mut samples: Vec<(f64, f64, f64)>) -> Self {
        let mass: f64 = samples.iter().map(|(.., weight)| weight).sum();
        let center = samples.iter().map(|(x, y, weight)| Vector2::new(*x, *y) * *weight).sum::<Vector2<f64>>() / mass;
        let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
        for (x, y, weight) in &mut samples {
            *x -= center.x;
            *y -= center.y;
            xx += *weight * *x * *x;
            xy += *weight * *x * *y;
            yy += *weight * *y * *y;
        }
        let (xx, xy, yy) = (xx / mass - PIXEL_VARIANCE, xy / mass, yy / mass - PIXEL_VARIANCE);
        let (root, inverse) = roots(xx, xy, yy);
        let mut fourth = Complex::new(0.0, 0.0);
        for (x, y, weight) in &samples {
            let white = inverse * Vector2::new(*x, *y);
            let square = Complex::new(white.x, white.y) * Complex::new(white.x, white.y);
            fourth += square * square * *weight;
        }
        let mut weights: Vec<f64> = samples.into_iter().map(|(.., weight)| weight).collect();
        Self { mass, center, root, fourth: fourth / mass, score: third_quartile(&mut weights) as f32 }
    }
}

/// The pixels of a component and of its rim (x, y, probability): what lies within one pixel, diagonals included, belongs
/// to no other component, and is above [`RIM`].
fn with_rim(map: &ProbabilityMap, runs: &[Run], threshold: f32) -> Vec<(f64, f64, f64)> {
    let (level, rim_level) = (ProbabilityMap::level(threshold), ProbabilityMap::level(RIM));
    let (top, bottom) = (runs[0].y, runs[runs.len() - 1].y);
    let mut samples = Vec::new();
    // The runs of the row above, of the row itself and of the row below are neighbours in `runs`.
    let (mut from, mut to) = (0, 0);
    let mut reached: Vec<(usize, usize)> = Vec::new();
    for y in top.saturating_sub(1)..=(bottom + 1).min(map.height() - 1) {
        while from < runs.len() && runs[from].y + 1 < y {
            from += 1;
        }
        while to < runs.len() && runs[to].y <= y + 1 {
            to += 1;
        }
        reached.clear();
        reached.extend(runs[from..to].iter().map(|run| (run.x0.saturating_sub(1), (run.x1 + 1).min(map.width()))));
        reached.sort_unstable();
        let row = map.row(y);
        let mut own = runs[from..to].iter().filter(|run| run.y == y).peekable();
        let mut done = 0;
        for &(x0, x1) in &reached {
            for x in x0.max(done)..x1 {
                while own.peek().is_some_and(|run| run.x1 <= x) {
                    own.next();
                }
                let is_own = own.peek().is_some_and(|run| run.x0 <= x);
                if is_own || (row[x] > rim_level && row[x] <= level) {
                    samples.push((x as f64, y as f64, f64::from(map.get(x, y))));
                }
            }
            done = done.max(x1);
        }
    }
    samples
}

/// C^(1/2) and C^(-1/2) of a symmetric matrix whose eigenvalues are kept away from nought.
fn roots(xx: f64, xy: f64, yy: f64) -> (Matrix2<f64>, Matrix2<f64>) {
    let mean = (xx + yy) / 2.0;
    let half = (xx - yy) / 2.0;
    let spread = half.hypot(xy);
    let angle = if spread > 0.0 { xy.atan2(half) / 2.0 } else { 0.0 };
    let axes = Matrix2::new(angle.cos(), -angle.sin(), angle.sin(), angle.cos());
    let sigmas = Vector2::new(mean + spread, mean - spread).map(|value| value.max(0.02).sqrt());
    let root = axes * Matrix2::from_diagonal(&sigmas) * axes.transpose();
    let inverse = axes * Matrix2::from_diagonal(&sigmas.map(|value| 1.0 / value)) * axes.transpose();
    (root, inverse)
}

/// Interpolated between the two nearest values.
fn third_quartile(values: &mut [f64]) -> f64 {
    values.sort_unstable_by(f64::total_cmp);
    let at = 0.75 * (values.len() - 1) as f64;
    let below = at as usize;
    let above = (below + 1).min(values.len() - 1);
    values[below] + (values[above] - values[below]) * (at - below as f64)
}

/// The size at which half of the total is reached: specks, however many, do not move it.
pub(super) fn middle(sizes: impl Iterator<Item = f64>) -> f64 {
    let mut sizes: Vec<f64> = sizes.collect();
    sizes.sort_unstable_by(f64::total_cmp);
    let half = sizes.iter().sum::<f64>() / 2.0;
    let mut sum = 0.0;
    for &size in &sizes {
        sum += size;
        if sum >= half {
            return size;
        }
    }
    sizes.last().copied().unwrap_or(0.0)
}

/// Boxes from the `core` channel, whose cores are the faces shrunk by `shrink` (0 to 1) about their centres. In pixels of
/// the map, in no particular order but always the same; nothing is filtered but specks.
pub fn from_core(core: &ProbabilityMap, shrink: f64) -> Vec<ModuleBox> {
    let components = Components::above(core, THRESHOLD);
    let found: Vec<(&[Run], Blob)> = components
        .iter()
        .collect::<Vec<_>>()
        .into_par_iter()
        .map(|runs| (runs, Blob::of(core, runs, THRESHOLD)))
        .collect();
    if found.is_empty() {
        return Vec::new();
    }
    let usual = middle(found.iter().map(|(_, blob)| blob.mass));
    let mut blobs: Vec<Blob> = Vec::with_capacity(found.len());
    for (runs, blob) in found {
        if blob.mass > MERGED * usual {
            blobs.extend(cut(core, runs, usual).unwrap_or_else(|| vec![blob]));
        } else {
            blobs.push(blob);
        }
    }
    let faint = faint_ones(core, &blobs, usual, shrink);
    blobs.extend(faint);
    shapes(&blobs, shrink, usual)
}

/// The parts into which a component falls at the first of rising thresholds that parts it; `None` if none does.
fn cut(core: &ProbabilityMap, runs: &[Run], usual: f64) -> Option<Vec<Blob>> {
    let x0 = runs.iter().map(|run| run.x0).min()?;
    let x1 = runs.iter().map(|run| run.x1).max()?;
    let (y0, y1) = (runs.first()?.y, runs.last()?.y + 1);
    // A frame of one pixel, so that the window's edge does not matter.
    let mut window = ProbabilityMap::new(x1 - x0 + 2, y1 - y0 + 2);
    for run in runs {
        window.row_mut(run.y - y0 + 1)[run.x0 - x0 + 1..run.x1 - x0 + 1]
            .copy_from_slice(&core.row(run.y)[run.x0..run.x1]);
    }
    let offset = Vector2::new(x0 as f64 - 1.0, y0 as f64 - 1.0);
    LADDER.iter().find_map(|&threshold| {
        let parts: Vec<Blob> = Components::above(&window, threshold)
            .iter()
            .map(|runs| Blob::of(&window, runs, threshold))
            .filter(|blob| blob.mass > PART * usual)
            .map(|blob| Blob { center: blob.center + offset, ..blob })
            .collect();
        (parts.len() > 1).then_some(parts)
    })
}

/// Components that rise above [`CORE_LOW`] but not above [`THRESHOLD`], have the usual size and stand near a strong one.
fn faint_ones(core: &ProbabilityMap, strong: &[Blob], usual: f64, shrink: f64) -> Vec<Blob> {
    let reach = 3.0 * usual.sqrt() / shrink;
    let strong = Grid::new(strong.iter().map(|blob| blob.center).collect(), reach);
    let level = ProbabilityMap::level(THRESHOLD);
    Components::above(core, CORE_LOW)
        .iter()
        .filter(|runs| runs.iter().all(|run| core.row(run.y)[run.x0..run.x1].iter().all(|value| *value <= level)))
        .map(|runs| Blob::of(core, runs, CORE_LOW))
        .filter(|blob| blob.mass > FAINT.0 * usual && blob.mass < FAINT.1 * usual)
        .filter(|blob| strong.within(blob.center, reach).next().is_some())
        .collect()
}

/// From moments to parallelograms: each with the rotation and, among those of its size, the second moments that it shares
/// with its neighbours.
fn shapes(blobs: &[Blob], shrink: f64, usual: f64) -> Vec<ModuleBox> {
    let reach = REACH * usual.sqrt() / shrink;
    let grid = Grid::new(blobs.iter().map(|blob| blob.center).collect(), reach);
    blobs
        .par_iter()
        .map(|blob| {
            let mut fourth = Complex::new(0.0, 0.0);
            let mut root = Matrix2::zeros();
            let mut total = 0.0;
            for (index, distance2) in grid.within(blob.center, CUTOFF * reach) {
                let other = &blobs[index];
                let near = (-0.5 * distance2 / (reach * reach)).exp();
                fourth += other.fourth * near;
                let alike = (-0.5 * ((other.mass / blob.mass).ln() / SIZE_SIGMA).powi(2)).exp();
                root += other.root * (near * alike);
                total += near * alike;
            }
            let phi = (fourth.arg() - std::f64::consts::PI) / 4.0;
            let edges = root * (12.0_f64.sqrt() / shrink / total);
            let u = edges * Vector2::new(phi.cos(), phi.sin());
            let v = edges * Vector2::new(-phi.sin(), phi.cos());
            let (u, v) = if v.norm() > u.norm() { (v, -u) } else { (u, v) };
            ModuleBox { center: blob.center, u, v, score: blob.score }
        })
        .collect()
}

/// Boxes from a mask of faces without cores, by morphology as in the paper: eroded so that thin bridges between modules
/// break, parted into components, each dilated again by as much. A component that is far too large is eroded further.
pub fn from_mask(module: &ProbabilityMap) -> Vec<ModuleBox> {
    let _ = module;
    Vec::new()
}
