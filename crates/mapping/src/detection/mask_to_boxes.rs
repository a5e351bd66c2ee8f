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

use super::Source;
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
/// Pixels of erosion and dilation of a mask without cores.
const EROSION: u16 = 1;
/// Variance of a pixel's own area along each axis, square pixels.
const PIXEL_VARIANCE: f64 = 1.0 / 12.0;
/// Fewer pixels are a speck.
const MIN_PIXELS: usize = 6;
/// Half the side of a module after C^(-1/2): sqrt(12) / 2.
const HALF: f64 = 1.732;
/// A component of more than this many times the usual mass holds several modules.
const MERGED: f64 = 1.7;
/// The smallest part of the usual mass that is a module when a component falls apart.
const PART: f64 = 0.3;
/// Range of masses, in parts of the usual mass, in which a faint component is a module.
const FAINT: (f64, f64) = (0.4, 1.6);
/// How far the averaging over neighbours reaches (standard deviation), in module sizes.
const REACH: f64 = 2.0;
/// Neighbours of about the same size share their shape: standard deviation of the logarithm of sizes.
const SIZE_SIGMA: f64 = 0.35;
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
    /// Which detector found it.
    pub source: Source,
}

impl ModuleBox {
    /// The box as a quadrilateral.
    pub fn quad(&self) -> Quad {
        Quad::from_center(self.center, self.u / 2.0, self.v / 2.0)
    }

    /// The box on a raster whose pixels are `1 / pixel` as large along each axis: centres of pixels are at whole numbers in
    /// both.
    pub fn scaled(&self, pixel: Vector2<f64>) -> Self {
        let half = Vector2::repeat(0.5);
        Self {
            center: (self.center + half).component_mul(&pixel) - half,
            u: self.u.component_mul(&pixel),
            v: self.v.component_mul(&pixel),
            ..*self
        }
    }

    /// Square pixels.
    pub fn area_px2(&self) -> f64 {
        self.u.perp(&self.v).abs()
    }
}

/// A horizontal stretch of pixels, `x0..x1`.
#[derive(Debug, Clone, Copy)]
pub(super) struct Run {
    pub y: usize,
    pub x0: usize,
    pub x1: usize,
}

/// The 4-connected components of what lies above a threshold, each as its runs from top to bottom and left to right;
/// the components in the order of their first pixels.
pub(super) struct Components {
    runs: Vec<Run>,
    starts: Vec<usize>,
}

impl Components {
    /// Of the pixels whose stored value is above `level`.
    pub fn above(map: &ProbabilityMap, level: u16) -> Self {
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
    pub fn iter(&self) -> impl Iterator<Item = &[Run]> {
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

/// The moments of one component.
#[derive(Debug, Clone, Copy)]
struct Blob {
    /// Sum of the weights, square pixels.
    mass: f64,
    center: Vector2<f64>,
    /// C^(1/2), pixels.
    root: Matrix2<f64>,
    /// E[(x + iy)^4] of the component after C^(-1/2).
    fourth: Complex<f64>,
    /// 0 to 1.
    score: f32,
    /// Whether it touches the map's edge, and so shows but a part of a module.
    is_cut: bool,
}

impl Blob {
    /// The moments of a component of `core` above `level`, with its rim, weighted by probability.
    fn of_core(core: &ProbabilityMap, runs: &[Run], level: u16) -> Self {
        let mut samples = Vec::new();
        for_each_around(core, runs, 1, |x, y, is_own| {
            let value = core.row(y)[x];
            if is_own || (value > ProbabilityMap::level(RIM) && value <= level) {
                samples.push((x as f64, y as f64, f64::from(core.get(x, y))));
            }
        });
        let mut weights: Vec<f64> = samples.iter().map(|(.., weight)| *weight).collect();
        let score = third_quartile(&mut weights) as f32;
        Self { score, is_cut: touches_edge(core, runs), ..Self::of_samples(samples, PIXEL_VARIANCE) }
    }

    /// The moments of pixels (x, y, weight), whose own variance along each axis is taken off.
    fn of_samples(mut samples: Vec<(f64, f64, f64)>, pixel_variance: f64) -> Self {
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
        let (xx, xy, yy) = (xx / mass - pixel_variance, xy / mass, yy / mass - pixel_variance);
        let (root, inverse) = roots(xx, xy, yy);
        let mut fourth = Complex::new(0.0, 0.0);
        for (x, y, weight) in &samples {
            let white = inverse * Vector2::new(*x, *y);
            let square = Complex::new(white.x, white.y) * Complex::new(white.x, white.y);
            fourth += square * square * *weight;
        }
        Self { mass, center, root, fourth: fourth / mass, score: 1.0, is_cut: false }
    }
}

/// Calls `visit(x, y, is_own)` for every pixel of a component and within `reach` pixels of it, diagonals included.
fn for_each_around(map: &ProbabilityMap, runs: &[Run], reach: usize, mut visit: impl FnMut(usize, usize, bool)) {
    let (top, bottom) = (runs[0].y, runs[runs.len() - 1].y);
    // The runs of the rows within reach are neighbours in `runs`.
    let (mut from, mut to) = (0, 0);
    let mut reached: Vec<(usize, usize)> = Vec::new();
    for y in top.saturating_sub(reach)..=(bottom + reach).min(map.height() - 1) {
        while from < runs.len() && runs[from].y + reach < y {
            from += 1;
        }
        while to < runs.len() && runs[to].y <= y + reach {
            to += 1;
        }
        reached.clear();
        reached
            .extend(runs[from..to].iter().map(|run| (run.x0.saturating_sub(reach), (run.x1 + reach).min(map.width()))));
        reached.sort_unstable();
        let mut own = runs[from..to].iter().filter(|run| run.y == y).peekable();
        let mut done = 0;
        for &(x0, x1) in &reached {
            for x in x0.max(done)..x1 {
                while own.peek().is_some_and(|run| run.x1 <= x) {
                    own.next();
                }
                visit(x, y, own.peek().is_some_and(|run| run.x0 <= x));
            }
            done = done.max(x1);
        }
    }
}

fn touches_edge(map: &ProbabilityMap, runs: &[Run]) -> bool {
    let vertically = runs[0].y == 0 || runs[runs.len() - 1].y + 1 == map.height();
    vertically || runs.iter().any(|run| run.x0 == 0 || run.x1 == map.width())
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
    let level = ProbabilityMap::level(THRESHOLD);
    let (blobs, usual) = parted(
        Components::above(core, level),
        |runs| Blob::of_core(core, runs, level),
        |runs, usual| cut_core(core, runs, usual),
    );
    let faint = faint_ones(core, &blobs, usual, shrink);
    shapes(&[blobs, faint].concat(), shrink, usual)
}

/// The blobs of all components, those that are far too large cut where `cut` can; and the usual mass.
fn parted(
    components: Components,
    measure: impl Fn(&[Run]) -> Blob + Sync,
    cut: impl Fn(&[Run], f64) -> Option<Vec<Blob>> + Sync,
) -> (Vec<Blob>, f64) {
    let components: Vec<&[Run]> = components.iter().collect();
    let blobs: Vec<Blob> = components.par_iter().map(|runs| measure(runs)).collect();
    let usual = middle(blobs.iter().map(|blob| blob.mass));
    let parts: Vec<Vec<Blob>> = components
        .par_iter()
        .zip(blobs)
        .map(|(runs, blob)| {
            let parts = if blob.mass > MERGED * usual { cut(runs, usual) } else { None };
            parts.unwrap_or_else(|| vec![blob])
        })
        .collect();
    (parts.concat(), usual)
}

/// A component's part of a map, in a frame of one pixel of nought, so that its edge does not matter; and the place of its
/// first pixel.
fn window(map: &ProbabilityMap, runs: &[Run]) -> (ProbabilityMap, Vector2<f64>) {
    let x0 = runs.iter().map(|run| run.x0).min().unwrap_or(0);
    let x1 = runs.iter().map(|run| run.x1).max().unwrap_or(0);
    let (y0, y1) = (runs[0].y, runs[runs.len() - 1].y + 1);
    let mut window = ProbabilityMap::new(x1 - x0 + 2, y1 - y0 + 2);
    for run in runs {
        window.row_mut(run.y - y0 + 1)[run.x0 - x0 + 1..run.x1 - x0 + 1]
            .copy_from_slice(&map.row(run.y)[run.x0..run.x1]);
    }
    (window, Vector2::new(x0 as f64 - 1.0, y0 as f64 - 1.0))
}

/// The parts into which a component falls at the first of rising thresholds that parts it; `None` if none does.
fn cut_core(core: &ProbabilityMap, runs: &[Run], usual: f64) -> Option<Vec<Blob>> {
    let (window, offset) = window(core, runs);
    LADDER.iter().map(|&threshold| ProbabilityMap::level(threshold)).find_map(|level| {
        let parts = Components::above(&window, level);
        several(parts.iter().map(|runs| Blob::of_core(&window, runs, level)), usual, offset)
    })
}

/// The parts that are large enough for modules, moved by `offset`; `None` where there is but one.
fn several(parts: impl Iterator<Item = Blob>, usual: f64, offset: Vector2<f64>) -> Option<Vec<Blob>> {
    let parts: Vec<Blob> = parts
        .filter(|blob| blob.mass > PART * usual)
        .map(|blob| Blob { center: blob.center + offset, ..blob })
        .collect();
    (parts.len() > 1).then_some(parts)
}

/// Components that rise above [`CORE_LOW`] but not above [`THRESHOLD`], have the usual size and stand near a strong one.
fn faint_ones(core: &ProbabilityMap, strong: &[Blob], usual: f64, shrink: f64) -> Vec<Blob> {
    let reach = 3.0 * usual.sqrt() / shrink;
    let strong = Grid::new(strong.iter().map(|blob| blob.center).collect(), reach);
    let (low, high) = (ProbabilityMap::level(CORE_LOW), ProbabilityMap::level(THRESHOLD));
    Components::above(core, low)
        .iter()
        .filter(|runs| runs.iter().all(|run| core.row(run.y)[run.x0..run.x1].iter().all(|value| *value <= high)))
        .map(|runs| Blob::of_core(core, runs, low))
        .filter(|blob| blob.mass > FAINT.0 * usual && blob.mass < FAINT.1 * usual)
        .filter(|blob| strong.within(blob.center, reach).next().is_some())
        .collect()
}

/// From moments to parallelograms: each with the rotation and, among those of its size, the second moments that it shares
/// with its neighbours, as far as these are whole.
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
                if other.is_cut && !std::ptr::eq(other, blob) {
                    continue;
                }
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
            ModuleBox { center: blob.center, u, v, score: blob.score, source: Source::Unet }
        })
        .collect()
}

/// Boxes from a mask of faces without cores, by morphology as in the paper: eroded by [`EROSION`] pixels, so that noise
/// vanishes and thin bridges between modules break, parted into components, each dilated again by as much within the mask.
/// A component that is far too large is eroded further. In pixels of the map, always in the same order.
pub fn from_mask(module: &ProbabilityMap) -> Vec<ModuleBox> {
    let depth = depths(module, ProbabilityMap::level(THRESHOLD));
    let (blobs, usual) = parted(
        Components::above(&depth, EROSION),
        |runs| dilated(module, &depth, runs, EROSION),
        |runs, usual| {
            let (own_depth, offset) = window(&depth, runs);
            let (own, _) = window(module, runs);
            // Deeper than half the side of a module there is nothing left to part.
            let most = (usual.sqrt() / 2.0) as u16;
            (EROSION + 1..=most).find_map(|erosion| {
                let parts = Components::above(&own_depth, erosion);
                several(parts.iter().map(|runs| dilated(&own, &own_depth, runs, erosion)), usual, offset)
            })
        },
    );
    shapes(&blobs, 1.0, usual)
}

/// One module of an instance segmentation, measured on its own mask.
pub(super) struct Instance(Blob);

impl Instance {
    /// Eroded and dilated, so that noise and thin bridges vanish (paper, 3.2); the largest component counts. `mask` has a
    /// frame of one pixel of nought, and its first pixel stands at `offset`. `None` where nothing is left.
    pub fn measure(mask: &ProbabilityMap, offset: Vector2<f64>, score: f32) -> Option<Self> {
        let depth = depths(mask, ProbabilityMap::level(THRESHOLD));
        let largest = |level: u16| -> Option<Blob> {
            let components = Components::above(&depth, level);
            let runs = components.iter().max_by_key(|runs| runs.iter().map(|run| run.x1 - run.x0).sum::<usize>())?;
            Some(dilated(mask, &depth, runs, level))
        };
        // Modules of few pixels would be eroded to nothing.
        let blob = largest(EROSION).or_else(|| largest(0))?;
        Some(Self(Blob { center: blob.center + offset, score, is_cut: false, ..blob }))
    }
}

/// The best instance of each place: one whose centre lies in a better one, or that holds a better one's centre, is the same
/// module. Unlike overlaps of boxes along the pixel axes, this parts the neighbours of a turned lattice.
pub(super) fn without_doubles(mut instances: Vec<Instance>) -> Vec<Instance> {
    instances.sort_by(|a, b| b.0.score.total_cmp(&a.0.score));
    let reach = instances.iter().map(|instance| instance.0.root.norm()).fold(0.0, f64::max) * HALF;
    let grid = Grid::new(instances.iter().map(|instance| instance.0.center).collect(), reach);
    let holds = |a: &Blob, b: &Blob| {
        a.root.try_inverse().is_some_and(|inverse| (inverse * (b.center - a.center)).norm() < HALF)
    };
    let mut is_kept = vec![false; instances.len()];
    for (index, Instance(blob)) in instances.iter().enumerate() {
        is_kept[index] = !grid.within(blob.center, reach).any(|(other, _)| {
            let better = &instances[other].0;
            is_kept[other] && (holds(better, blob) || holds(blob, better))
        });
    }
    instances.into_iter().zip(is_kept).filter(|(_, kept)| *kept).map(|(instance, _)| instance).collect()
}

/// Boxes of instances, each with the rotation and the moments that it shares with its neighbours.
pub(super) fn from_instances(instances: &[Instance]) -> Vec<ModuleBox> {
    let blobs: Vec<Blob> = instances.iter().map(|instance| instance.0).collect();
    let usual = middle(blobs.iter().map(|blob| blob.mass));
    shapes(&blobs, 1.0, usual)
}

/// The moments of a component that was eroded by `erosion` pixels, after dilation by as much: all pixels of the mask that
/// are as near and are no other component's.
fn dilated(module: &ProbabilityMap, depth: &ProbabilityMap, runs: &[Run], erosion: u16) -> Blob {
    let mut samples = Vec::new();
    let mut sum = 0.0;
    for_each_around(module, runs, usize::from(erosion), |x, y, is_own| {
        if is_own || (1..=erosion).contains(&depth.row(y)[x]) {
            samples.push((x as f64, y as f64, 1.0));
            sum += module.get(x, y);
        }
    });
    let score = sum / samples.len() as f32;
    Blob { score, is_cut: touches_edge(module, runs), ..Blob::of_samples(samples, 0.0) }
}

/// How deep each pixel lies in what is above `level`, in steps (diagonal ones too) to the nearest pixel that is not: erosion
/// by n pixels leaves what is deeper than n. The map's edge does not erode.
fn depths(map: &ProbabilityMap, level: u16) -> ProbabilityMap {
    let (width, height) = (map.width(), map.height());
    let mut depth = ProbabilityMap::new(width, height);
    for y in 0..height {
        for x in 0..width {
            if map.row(y)[x] > level {
                let above =
                    if y > 0 { least(&depth.row(y - 1)[x.saturating_sub(1)..(x + 2).min(width)]) } else { u16::MAX };
                let before = if x > 0 { depth.row(y)[x - 1] } else { u16::MAX };
                depth.row_mut(y)[x] = above.min(before).saturating_add(1);
            }
        }
    }
    for y in (0..height).rev() {
        for x in (0..width).rev() {
            let below = if y + 1 < height {
                least(&depth.row(y + 1)[x.saturating_sub(1)..(x + 2).min(width)])
            } else {
                u16::MAX
            };
            let after = if x + 1 < width { depth.row(y)[x + 1] } else { u16::MAX };
            let value = &mut depth.row_mut(y)[x];
            *value = (*value).min(below.min(after).saturating_add(1));
        }
    }
    depth
}

fn least(values: &[u16]) -> u16 {
    values.iter().copied().min().unwrap_or(u16::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::detection::filter;

    /// Area coverage of quadrilaterals, each shrunk about its centre.
    fn drawn(width: usize, height: usize, quads: &[Quad], shrink: f64) -> ProbabilityMap {
        const FINE: usize = 6;
        let shrunk: Vec<Quad> =
            quads.iter().map(|quad| quad.map(|c| quad.center() + (c - quad.center()) * shrink)).collect();
        let mut coverage = vec![0.0_f32; width * height];
        for quad in &shrunk {
            let low = quad.corners.iter().copied().reduce(|a, b| a.inf(&b)).unwrap();
            let high = quad.corners.iter().copied().reduce(|a, b| a.sup(&b)).unwrap();
            let range =
                |low: f64, high: f64, limit: usize| (low - 1.0).max(0.0) as usize..((high + 2.0) as usize).min(limit);
            for y in range(low.y, high.y, height) {
                for x in range(low.x, high.x, width) {
                    for i in 0..FINE * FINE {
                        let fine = |i: usize| (i as f64 + 0.5) / FINE as f64 - 0.5;
                        let at = Vector2::new(x as f64 + fine(i % FINE), y as f64 + fine(i / FINE));
                        coverage[y * width + x] += f32::from(u8::from(quad.contains(at))) / (FINE * FINE) as f32;
                    }
                }
            }
        }
        ProbabilityMap::from_fn(width, height, |x, y| coverage[y * width + x])
    }

    fn vector(length: f64, angle_deg: f64) -> Vector2<f64> {
        let angle = angle_deg.to_radians();
        Vector2::new(length * angle.cos(), length * angle.sin())
    }

    /// A bench of parallelograms with edges `u` and `v`, a thin seam apart.
    fn bench(origin: Vector2<f64>, u: Vector2<f64>, v: Vector2<f64>, columns: usize, rows: usize) -> Vec<Quad> {
        let mut quads = Vec::new();
        for row in 0..rows {
            for column in 0..columns {
                let center = origin + u * (1.02 * column as f64) + v * (1.02 * row as f64);
                quads.push(Quad::from_center(center, u / 2.0, v / 2.0));
            }
        }
        quads
    }

    /// Largest distance of a centre, and of a corner, to the truth; every module has exactly one box.
    fn worst(boxes: &[ModuleBox], truth: &[Quad]) -> (f64, f64) {
        assert_eq!(boxes.len(), truth.len());
        let mut worst = (0.0_f64, 0.0_f64);
        for quad in truth {
            let b = boxes
                .iter()
                .min_by(|a, b| (a.center - quad.center()).norm().total_cmp(&(b.center - quad.center()).norm()))
                .unwrap();
            worst.0 = worst.0.max((b.center - quad.center()).norm());
            for corner in b.quad().corners {
                let nearest = quad.corners.iter().map(|c| (c - corner).norm()).fold(f64::INFINITY, f64::min);
                worst.1 = worst.1.max(nearest);
            }
        }
        worst
    }

    #[test]
    fn rotated_and_sheared_modules_get_their_centres_and_corners() {
        for (u, v) in [
            (vector(40.0, 0.0), vector(24.0, 90.0)),
            (vector(40.0, 17.0), vector(24.0, 107.0)),
            (vector(38.0, 33.0), vector(24.0, 111.0)),
            (vector(30.0, -40.0), vector(28.0, 62.0)),
        ] {
            let truth = bench(Vector2::new(90.3, 130.7), u, v, 4, 3);
            let boxes = from_core(&drawn(300, 340, &truth, 0.62), 0.62);
            let (center, corner) = worst(&boxes, &truth);
            assert!(center < 0.1, "centre off by {center}");
            assert!(corner < 0.3, "corner off by {corner}");
        }
    }

    #[test]
    fn a_mask_without_cores_is_parted_by_erosion() {
        for (u, v) in [(vector(40.0, 0.0), vector(24.0, 90.0)), (vector(38.0, 33.0), vector(24.0, 111.0))] {
            let mut truth = bench(Vector2::new(100.0, 120.0), u * 1.05, v * 1.05, 4, 3);
            for quad in &mut truth {
                *quad = quad.map(|c| quad.center() + (c - quad.center()) / 1.05);
            }
            let mask = drawn(300, 340, &truth, 1.0);
            // A bridge over a seam, and specks.
            let mask = ProbabilityMap::from_fn(300, 340, |x, y| {
                let between = (truth[0].center() + truth[1].center()) / 2.0;
                let at = Vector2::new(x as f64, y as f64);
                let speck = x % 50 < 2 && y % 60 < 2 && y > 280;
                if (at - between).norm() < 1.5 || speck { 0.9 } else { mask.get(x, y) }
            });
            let (center, corner) = worst(&from_mask(&mask), &truth);
            assert!(center < 0.5, "centre off by {center}");
            assert!(corner < 1.0, "corner off by {corner}");
        }
    }

    #[test]
    fn a_merged_blob_is_cut_at_a_higher_threshold() {
        let truth = bench(Vector2::new(40.0, 40.0), vector(30.0, 5.0), vector(18.0, 95.0), 4, 2);
        let core = drawn(170, 100, &truth, 0.62);
        let bridge = (truth[1].center() + truth[2].center()) / 2.0;
        let merged = ProbabilityMap::from_fn(170, 100, |x, y| {
            let near = (x as f64 - bridge.x).abs() < 9.0 && (y as f64 - bridge.y).abs() < 2.5;
            if near { core.get(x, y).max(0.7) } else { core.get(x, y) }
        });
        let level = ProbabilityMap::level(THRESHOLD);
        assert_eq!(Components::above(&merged, level).iter().count(), 7);
        let (center, _) = worst(&from_core(&merged, 0.62), &truth);
        assert!(center < 1.0, "centre off by {center}");
    }

    #[test]
    fn a_faint_module_among_others_is_taken_in_and_a_faint_stain_is_not() {
        let truth = bench(Vector2::new(40.0, 40.0), vector(30.0, 0.0), vector(18.0, 90.0), 4, 2);
        let core = drawn(400, 300, &truth, 0.62);
        let faint = truth[5];
        let stain = Quad::from_center(Vector2::new(330.0, 250.0), vector(9.0, 0.0), vector(6.0, 90.0));
        let map = ProbabilityMap::from_fn(400, 300, |x, y| {
            let at = Vector2::new(x as f64, y as f64);
            if faint.contains(at) {
                0.45 * core.get(x, y)
            } else if stain.contains(at) {
                0.45
            } else {
                core.get(x, y)
            }
        });
        assert_eq!(worst(&from_core(&map, 0.62), &truth).0.floor(), 0.0);
    }

    #[test]
    fn specks_are_nothing_and_an_empty_map_has_no_boxes() {
        let specks = ProbabilityMap::from_fn(60, 60, |x, y| if x % 7 < 2 && y % 9 < 2 { 1.0 } else { 0.0 });
        assert!(from_core(&specks, 0.62).is_empty());
        assert!(from_core(&ProbabilityMap::new(40, 30), 0.62).is_empty());
        assert!(from_mask(&ProbabilityMap::new(40, 30)).is_empty());
        assert!(from_core(&ProbabilityMap::new(0, 0), 0.62).is_empty());
    }

    #[test]
    fn a_map_that_is_full_has_one_box_at_most() {
        let full = ProbabilityMap::from_fn(80, 50, |_, _| 1.0);
        assert_eq!(from_core(&full, 0.62).len(), 1);
        assert_eq!(from_mask(&full).len(), 1);
    }

    #[test]
    fn components_are_those_of_a_flood_fill() {
        // A spiral and dots: runs that join late.
        let picture = [
            "##########.#",
            "#........#.#",
            "#.######.#..",
            "#.#....#.#.#",
            "#.#.####.#.#",
            "#.#......#.#",
            "#.########.#",
            "#..........#",
            "############",
        ];
        let map = ProbabilityMap::from_fn(12, 9, |x, y| f32::from(u8::from(picture[y].as_bytes()[x] == b'#')));
        let sizes: Vec<usize> =
            Components::above(&map, 0).iter().map(|runs| runs.iter().map(|run| run.x1 - run.x0).sum()).collect();
        assert_eq!(sizes, [picture.iter().flat_map(|row| row.bytes()).filter(|b| *b == b'#').count() - 2]);
    }

    #[test]
    fn weighted_by_area_the_middle_ignores_specks() {
        let sizes = [1.0; 50].into_iter().chain([100.0, 101.0, 102.0]);
        assert_eq!(middle(sizes), 101.0);
        assert_eq!(middle([].into_iter()), 0.0);
    }

    #[test]
    fn what_no_module_can_be_is_dropped() {
        let truth = bench(Vector2::new(40.0, 40.0), vector(30.0, 0.0), vector(18.0, 90.0), 6, 3);
        let module = drawn(400, 200, &truth, 1.0);
        let mut boxes = from_core(&drawn(400, 200, &truth, 0.62), 0.62);
        let first = boxes[0];
        // A weaker box half over another, one twice as long, one on bare ground, a weak one that stands alone.
        boxes.push(ModuleBox { center: first.center + first.u / 2.0, score: 0.6, ..first });
        boxes.push(ModuleBox { u: first.u * 2.5, score: 0.99, ..first });
        boxes.push(ModuleBox { center: Vector2::new(300.0, 150.0), score: 0.99, ..first });
        assert_eq!(worst(&filter::plausible(boxes, &module), &truth).0.floor(), 0.0);
    }
}
