//! Modules stand in lattices: what a network sees of each module alone is made better by what it sees of its neighbours.
//!
//! Boxes that stand where the lattice of others has a place are linked; what is linked gets whole columns and rows. Around
//! each place a smooth lattice is fitted robustly: one offset per row, a pitch and a bend in common. From it follow the
//! centre and the edges of each module, more exact than its own blob tells. Places without a box, where the masks show a
//! module if weakly, are taken in; boxes that lie across places of the lattice are dropped.

use super::Source;
use super::mask_to_boxes::ModuleBox;
use super::neighbours::Grid;
use crate::geometry::Quad;
use nalgebra::{DMatrix, Matrix2, Vector2};
use rayon::prelude::*;
use std::collections::{HashMap, VecDeque};

/// Distance of neighbours, in modules.
const PITCH: f64 = 1.03;
/// How far a neighbour may be off its place, in modules.
const TOLERANCE: f64 = 0.2;
/// Neighbours have the same size: largest difference of the logarithm of areas.
const ALIKE: f64 = 0.4;
/// Cosine of the largest angle between the long edges of neighbours.
const ALIGNED: f64 = 0.94;
/// A lattice of fewer boxes tells nothing about its neighbours.
const LEAST_MEMBERS: usize = 6;
/// Columns, then rows, that a fit looks at on each side of a place; its weights fall off half as far.
const REACH: (i32, i32) = (6, 3);
/// A transition between columns is a gap from this deviation of the pitch on, in parts of it.
const GAP: f64 = 0.06;
/// Columns on each side of a transition that tell the usual pitch there.
const AROUND: i32 = 3;
/// How many times as large as its own uncertainty the deviation of a gap must be.
const SIGNIFICANT: f64 = 3.0;
/// Usual noise of a centre, in parts of the shorter edge.
const NOISE: f64 = 0.04;
/// Trust in a box that a lattice added itself.
const ADDED: f64 = 0.02;
/// Weight of the expectation that rows are evenly spaced, and that the lattice is straight, against that of one box.
const EVEN: f64 = 0.5;
const STRAIGHT: f64 = 2.0;
/// Rounds of weighting in a fit.
const ITERATIONS: usize = 5;
/// How far from the middle between two modules a seam is looked for, in parts of their distance.
const SEAM: f64 = 0.2;
/// Least mean `module` where a hole has neighbours on opposite sides, and where it has none.
const HOLE: f64 = 0.5;
const END: f64 = 0.7;
/// Least mean `module` along each side of a place, in parts of what the whole must have.
const SIDE: f64 = 0.8;
/// Rounds of completion: a lattice grows by one place beyond its ends in each.
const ROUNDS: usize = 16;
/// The largest share of a box that may overlap a place of the lattice without being dropped for it.
const OVERLAP: f64 = 0.2;

/// What the networks' masks say, in pixels of the image.
pub(super) trait Evidence: Sync {
    /// Probability that a module's face is seen there.
    fn module(&self, at: Vector2<f64>) -> f64;
}

/// Boxes by whole columns and rows.
struct Lattice {
    cells: HashMap<(i32, i32), usize>,
}

/// What a fit says of a place.
#[derive(Clone, Copy)]
struct Place {
    center: Vector2<f64>,
    /// Step to the next column.
    along: Vector2<f64>,
    /// Step to the next row, where other rows tell it.
    across: Option<Vector2<f64>>,
}

/// The boxes made better by their lattices; within a frame of `size` pixels, those missing added. The others stay as they
/// are, but where they lie across a lattice.
pub(super) fn complete(boxes: Vec<ModuleBox>, evidence: Option<&dyn Evidence>, size: Vector2<f64>) -> Vec<ModuleBox> {
    let mut seen: Vec<Seen> = boxes.into_iter().map(|b| Seen { b, is_added: false }).collect();
    if let Some(evidence) = evidence {
        for _ in 0..ROUNDS {
            let added: Vec<ModuleBox> =
                lattices(&seen).par_iter().flat_map_iter(|lattice| lattice.missing(&seen, evidence, size)).collect();
            let before = seen.len();
            add(&mut seen, added);
            if seen.len() == before {
                break;
            }
        }
    }
    let mut is_member = vec![false; seen.len()];
    let mut regular = Vec::new();
    for lattice in lattices(&seen) {
        regular.extend(lattice.regular(&seen, evidence));
        for &index in lattice.cells.values() {
            is_member[index] = true;
        }
    }
    let others = seen.iter().zip(is_member).filter(|(_, member)| !member).map(|(seen, _)| seen.b);
    joined(regular, others)
}

/// A box and whether a network found it, or a lattice has a place there.
struct Seen {
    b: ModuleBox,
    is_added: bool,
}

/// Takes in boxes of places; what lies across one without being of a lattice itself gives way.
fn add(seen: &mut Vec<Seen>, mut added: Vec<ModuleBox>) {
    added.sort_by(|a, b| b.score.total_cmp(&a.score));
    let longest = seen.iter().map(|s| &s.b).chain(&added).map(|b| b.u.norm()).fold(0.0, f64::max);
    let mut is_in_lattice = vec![false; seen.len()];
    for lattice in lattices(seen) {
        for &index in lattice.cells.values() {
            is_in_lattice[index] = true;
        }
    }
    let mut taken: Vec<ModuleBox> = Vec::new();
    let mut gives_way = vec![false; seen.len()];
    let grid = Grid::new(seen.iter().map(|s| s.b.center).collect(), longest);
    for b in added {
        let quad = b.quad();
        let crosses = |other: &ModuleBox| {
            (other.center - b.center).norm() < longest
                && quad.overlap_px2(&other.quad()) > OVERLAP * b.area_px2().min(other.area_px2())
        };
        let rivals: Vec<usize> =
            grid.within(b.center, longest).map(|(index, _)| index).filter(|&index| crosses(&seen[index].b)).collect();
        if rivals.iter().any(|&index| is_in_lattice[index]) || taken.iter().any(crosses) {
            continue;
        }
        for index in rivals {
            gives_way[index] = true;
        }
        taken.push(b);
    }
    let mut index = 0;
    seen.retain(|_| {
        index += 1;
        !gives_way[index - 1]
    });
    seen.extend(taken.into_iter().map(|b| Seen { b, is_added: true }));
}

/// Boxes of lattices and those others that do not lie across one; where two lattices claim a place, the stronger box stays.
fn joined(mut regular: Vec<ModuleBox>, others: impl Iterator<Item = ModuleBox>) -> Vec<ModuleBox> {
    regular.sort_by(|a, b| b.score.total_cmp(&a.score));
    let count = regular.len();
    let all: Vec<ModuleBox> = regular.into_iter().chain(others).collect();
    let longest = all.iter().map(|b| b.u.norm()).fold(0.0, f64::max);
    let grid = Grid::new(all.iter().map(|b| b.center).collect(), longest);
    let mut is_kept = vec![false; all.len()];
    for (index, b) in all.iter().enumerate() {
        let quad = b.quad();
        let rivals = if index < count { index } else { count };
        is_kept[index] =
            grid.within(b.center, longest).filter(|&(other, _)| other < rivals && is_kept[other]).all(|(other, _)| {
                let better = &all[other];
                quad.overlap_px2(&better.quad()) < OVERLAP * b.area_px2().min(better.area_px2())
            });
    }
    all.into_iter().zip(is_kept).filter(|(_, kept)| *kept).map(|(b, _)| b).collect()
}

/// The four neighbours of each box, by the direction of its own edges: +u, -u, +v, -v. Only pairs that choose each other.
fn links(seen: &[Seen]) -> Vec<[Option<usize>; 4]> {
    let boxes: Vec<&ModuleBox> = seen.iter().map(|seen| &seen.b).collect();
    let longest = boxes.iter().map(|b| b.u.norm()).fold(0.0, f64::max);
    let grid = Grid::new(boxes.iter().map(|b| b.center).collect(), longest);
    let chosen: Vec<[Option<usize>; 4]> = boxes
        .par_iter()
        .map(|b| {
            let Some(modules_from_px) = Matrix2::from_columns(&[b.u, b.v]).try_inverse() else { return [None; 4] };
            [Vector2::x(), -Vector2::x(), Vector2::y(), -Vector2::y()].map(|direction: Vector2<f64>| {
                let place = b.center + (b.u * direction.x + b.v * direction.y) * PITCH;
                let off = |other: usize| modules_from_px * (boxes[other].center - b.center) - direction * PITCH;
                grid.within(place, TOLERANCE * (b.u.norm() + b.v.norm()))
                    .map(|(other, _)| other)
                    .filter(|&other| off(other).amax() < TOLERANCE && is_alike(b, boxes[other]))
                    .min_by(|&p, &q| off(p).norm().total_cmp(&off(q).norm()))
            })
        })
        .collect();
    chosen
        .iter()
        .enumerate()
        .map(|(index, near)| near.map(|other| other.filter(|&other| chosen[other].contains(&Some(index)))))
        .collect()
}

fn is_alike(a: &ModuleBox, b: &ModuleBox) -> bool {
    (a.area_px2() / b.area_px2()).ln().abs() < ALIKE && a.u.dot(&b.u).abs() > ALIGNED * a.u.norm() * b.u.norm()
}

/// A link between places of one lattice, by the step from the one to the other.
struct Step {
    from: (i32, i32),
    px: Vector2<f64>,
}

/// Indices of boxes by column and row of the lattices that they form, in order; columns run along the longer extent.
pub(super) fn grouped(boxes: &[ModuleBox]) -> Vec<Vec<((i32, i32), usize)>> {
    let seen: Vec<Seen> = boxes.iter().map(|b| Seen { b: *b, is_added: false }).collect();
    lattices(&seen).iter().map(Lattice::sorted).collect()
}

/// Groups of linked boxes, each with columns along its longer extent.
fn lattices(seen: &[Seen]) -> Vec<Lattice> {
    let links = links(seen);
    let mut is_placed = vec![false; seen.len()];
    let mut found = Vec::new();
    let mut order: Vec<usize> = (0..seen.len()).collect();
    order.sort_by(|&a, &b| seen[b].b.score.total_cmp(&seen[a].b.score));
    for start in order {
        if is_placed[start] {
            continue;
        }
        // Edges turned as those of the first box, so that steps add up.
        let mut cells: HashMap<(i32, i32), usize> = HashMap::from([((0, 0), start)]);
        let mut queue = VecDeque::from([(start, (0, 0), seen[start].b.u, seen[start].b.v)]);
        is_placed[start] = true;
        while let Some((index, (col, row), u, v)) = queue.pop_front() {
            let b = &seen[index].b;
            let (u_sign, v_sign) = (b.u.dot(&u).signum() as i32, b.v.dot(&v).signum() as i32);
            let steps = [(u_sign, 0), (-u_sign, 0), (0, v_sign), (0, -v_sign)];
            for (other, step) in links[index].iter().zip(steps) {
                let Some(other) = *other else { continue };
                let place = (col + step.0, row + step.1);
                if is_placed[other] || cells.contains_key(&place) {
                    continue;
                }
                is_placed[other] = true;
                cells.insert(place, other);
                let (own_u, own_v) = (b.u * f64::from(u_sign), b.v * f64::from(v_sign));
                queue.push_back((other, place, own_u, own_v));
            }
        }
        found.extend(Lattice { cells }.lengthwise().parted(seen));
    }
    found.retain(|lattice| lattice.cells.len() >= LEAST_MEMBERS);
    found
}

impl Lattice {
    /// With columns along the longer extent.
    fn lengthwise(self) -> Self {
        let extent = |axis: fn(&(i32, i32)) -> i32| {
            let values = || self.cells.keys().map(axis);
            values().max().unwrap_or(0) - values().min().unwrap_or(0)
        };
        if extent(|cell| cell.0) >= extent(|cell| cell.1) {
            return self;
        }
        Self { cells: self.cells.into_iter().map(|((col, row), index)| ((row, col), index)).collect() }
    }

    /// Cells in order: hash maps have none.
    fn sorted(&self) -> Vec<((i32, i32), usize)> {
        let mut cells: Vec<_> = self.cells.iter().map(|(cell, index)| (*cell, *index)).collect();
        cells.sort_unstable();
        cells
    }

    fn steps(&self, seen: &[Seen]) -> Vec<Step> {
        self.sorted()
            .into_iter()
            .filter_map(|(cell, index)| {
                let to = (cell.0 + 1, cell.1);
                let other = *self.cells.get(&to)?;
                Some(Step { from: cell, px: seen[other].b.center - seen[index].b.center })
            })
            .collect()
    }

    /// Cut where columns are further apart, or stand aside, by more than chance explains: a gap between benches, over which
    /// no fit may smooth.
    fn parted(self, seen: &[Seen]) -> Vec<Self> {
        let steps = self.steps(seen);
        if self.cells.len() < LEAST_MEMBERS || steps.is_empty() {
            return vec![self];
        }
        // What the pitch is around a step: the median of those on both sides, so that perspective cancels.
        let usual: Vec<Vector2<f64>> = steps
            .iter()
            .map(|step| {
                let near = steps.iter().filter(|s| (1..=AROUND).contains(&(s.from.0 - step.from.0).abs()));
                let (mut xs, mut ys): (Vec<f64>, Vec<f64>) = near.map(|s| (s.px.x, s.px.y)).unzip();
                if xs.is_empty() { step.px } else { Vector2::new(median(&mut xs), median(&mut ys)) }
            })
            .collect();
        let mut columns: HashMap<i32, Vec<Vector2<f64>>> = HashMap::new();
        for (step, usual) in steps.iter().zip(&usual) {
            let length = usual.norm();
            let off = step.px - usual;
            let parts = Vector2::new(off.dot(usual), usual.perp(&off)) / (length * length);
            columns.entry(step.from.0).or_default().push(parts);
        }
        let mut spread: Vec<f64> = steps.iter().zip(&usual).map(|(s, u)| (s.px - u).norm() / u.norm()).collect();
        let spread = median(&mut spread);
        let is_gap = |column: i32| {
            columns.get(&column).is_some_and(|parts| {
                let (mut along, mut aside): (Vec<f64>, Vec<f64>) = parts.iter().map(|p| (p.x, p.y)).unzip();
                let limit = GAP.max(SIGNIFICANT * spread / (parts.len() as f64).sqrt());
                median(&mut along).abs() > limit || median(&mut aside).abs() > limit
            })
        };
        let mut gaps: Vec<i32> = columns.keys().copied().filter(|&column| is_gap(column)).collect();
        if gaps.is_empty() {
            return vec![self];
        }
        gaps.sort_unstable();
        let mut parts: HashMap<usize, HashMap<(i32, i32), usize>> = HashMap::new();
        for (cell, index) in self.cells {
            let part = gaps.partition_point(|&gap| gap < cell.0);
            parts.entry(part).or_default().insert(cell, index);
        }
        let mut parts: Vec<_> = parts.into_iter().collect();
        parts.sort_by_key(|(part, _)| *part);
        parts.into_iter().map(|(_, cells)| Self { cells }).collect()
    }

    /// The modules of this lattice, regular, in the order of their places.
    fn regular(&self, seen: &[Seen], evidence: Option<&dyn Evidence>) -> Vec<ModuleBox> {
        let shape = Shape::of(self, seen, evidence);
        self.sorted()
            .par_iter()
            .map(|&(cell, index)| {
                let own = seen[index].b;
                self.place(cell, seen).map_or(own, |place| shape.at(&place, own))
            })
            .collect()
    }

    /// Modules at places without a box, where the masks show one.
    fn missing(&self, seen: &[Seen], evidence: &dyn Evidence, size: Vector2<f64>) -> Vec<ModuleBox> {
        let shape = Shape::of(self, seen, Some(evidence));
        self.candidates()
            .into_iter()
            .filter_map(|cell| {
                let place = self.place(cell, seen)?;
                let candidate = shape.at(&place, seen[self.nearest(cell)].b);
                let least = if self.has_opposite_neighbours(cell) { HOLE } else { END };
                let score = shown(&candidate, evidence, size, least)?;
                Some(ModuleBox { score, source: Source::Unet, ..candidate })
            })
            .collect()
    }

    /// Empty places beside a box.
    fn candidates(&self) -> Vec<(i32, i32)> {
        let mut places: Vec<(i32, i32)> = self
            .cells
            .keys()
            .flat_map(|&(col, row)| [(col + 1, row), (col - 1, row), (col, row + 1), (col, row - 1)])
            .filter(|cell| !self.cells.contains_key(cell))
            .collect();
        places.sort_unstable();
        places.dedup();
        places
    }

    fn has_opposite_neighbours(&self, (col, row): (i32, i32)) -> bool {
        let has = |col: i32, row: i32| self.cells.contains_key(&(col, row));
        has(col - 1, row) && has(col + 1, row) || has(col, row - 1) && has(col, row + 1)
    }

    /// The box nearest to a place, by columns and rows.
    fn nearest(&self, (col, row): (i32, i32)) -> usize {
        let distance = |(c, r): (i32, i32)| (c - col).abs() + 2 * (r - row).abs();
        self.sorted().into_iter().min_by_key(|(cell, _)| distance(*cell)).map_or(0, |(_, index)| index)
    }

    /// The lattice around a place, fitted robustly; `None` where too few boxes tell it.
    fn place(&self, (col, row): (i32, i32), seen: &[Seen]) -> Option<Place> {
        let mut near: Vec<Near> = Vec::new();
        let mut short_px = f64::INFINITY;
        for r in row - REACH.1..=row + REACH.1 {
            for c in col - REACH.0..=col + REACH.0 {
                let Some(&index) = self.cells.get(&(c, r)) else { continue };
                let (b, x, y) = (&seen[index].b, f64::from(c - col), f64::from(r - row));
                let spread = |value: f64, reach: i32| (-0.5 * (2.0 * value / f64::from(reach)).powi(2)).exp();
                let trust = if seen[index].is_added { ADDED } else { f64::from(b.score.max(0.1)) };
                short_px = short_px.min(b.v.norm());
                near.push(Near {
                    x,
                    row: r - row,
                    px: b.center,
                    weight: spread(x, REACH.0) * spread(y, REACH.1) * trust,
                });
            }
        }
        if near.len() < LEAST_MEMBERS || !near.iter().any(|n| n.row == 0) {
            return None;
        }
        fit(&near, NOISE * short_px)
    }
}

/// A box near a place.
struct Near {
    /// Columns from the place.
    x: f64,
    /// Rows from the place.
    row: i32,
    px: Vector2<f64>,
    weight: f64,
}

/// One offset per row, with pitch, bend and twist in common: weighted least squares, with weights that fall for what does not
/// fit.
fn fit(near: &[Near], noise_px: f64) -> Option<Place> {
    let mut rows: Vec<i32> = near.iter().map(|n| n.row).collect();
    rows.sort_unstable();
    rows.dedup();
    let count = rows.len();
    let (pitch, bend, twist, unknowns) = (count, count + 1, count + 2, count + 3);
    let row_of = |row: i32| rows.binary_search(&row).unwrap_or(0);
    let terms = |n: &Near| [(row_of(n.row), 1.0), (pitch, n.x), (bend, n.x * n.x), (twist, n.x * f64::from(n.row))];
    let mut robust = vec![1.0; near.len()];
    let mut found = DMatrix::<f64>::zeros(unknowns, 2);
    let value = |found: &DMatrix<f64>, k: usize| Vector2::new(found[(k, 0)], found[(k, 1)]);
    for _ in 0..ITERATIONS {
        let mut matrix = DMatrix::<f64>::zeros(unknowns, unknowns);
        let mut right = DMatrix::<f64>::zeros(unknowns, 2);
        let mut add = |terms: &[(usize, f64)], value: Vector2<f64>, weight: f64| {
            for &(i, a) in terms {
                for &(j, b) in terms {
                    matrix[(i, j)] += weight * a * b;
                }
                right[(i, 0)] += weight * a * value.x;
                right[(i, 1)] += weight * a * value.y;
            }
        };
        for (n, robust) in near.iter().zip(&robust) {
            add(&terms(n), n.px, n.weight * robust);
        }
        // Rows are about evenly spaced, the lattice about straight.
        for k in 1..count.saturating_sub(1) {
            let (before, after) = (f64::from(rows[k] - rows[k - 1]), f64::from(rows[k + 1] - rows[k]));
            let share = before / (before + after);
            add(&[(k - 1, 1.0 - share), (k, -1.0), (k + 1, share)], Vector2::zeros(), EVEN);
        }
        for unknown in [bend, twist] {
            add(&[(unknown, 1.0)], Vector2::zeros(), STRAIGHT);
        }
        for k in 0..unknowns {
            matrix[(k, k)] += 1e-9;
        }
        found = matrix.cholesky()?.solve(&right);
        for (n, robust) in near.iter().zip(&mut robust) {
            let fitted: Vector2<f64> = terms(n).iter().map(|&(k, factor)| value(&found, k) * factor).sum();
            let off = (n.px - fitted).norm() / noise_px;
            *robust = (1.0 + (off / 2.0).powi(2)).powi(-2);
        }
    }
    let own = rows.binary_search(&0).ok()?;
    let (before, after) = (own.saturating_sub(1), (own + 1).min(count - 1));
    let across = (after > before)
        .then(|| (value(&found, after) - value(&found, before)) / f64::from(rows[after] - rows[before]));
    let place = Place { center: value(&found, own), along: value(&found, pitch), across };
    place.center.iter().chain(&place.along).all(|v| v.is_finite()).then_some(place)
}

/// How much of its cell a module fills, over a whole lattice.
struct Shape {
    /// Whether columns run along the longer edge.
    is_long_along: bool,
    /// Edge in parts of the pitch, along and across.
    filled: [f64; 2],
}

impl Shape {
    fn of(lattice: &Lattice, seen: &[Seen], evidence: Option<&dyn Evidence>) -> Self {
        let mut long_steps = 0_i32;
        let mut filled = [Vec::new(), Vec::new()];
        for (cell, index) in lattice.sorted() {
            let b = &seen[index].b;
            for (axis, to) in [(0, (cell.0 + 1, cell.1)), (1, (cell.0, cell.1 + 1))] {
                let Some(&other) = lattice.cells.get(&to) else { continue };
                let step = seen[other].b.center - b.center;
                let is_long = step.dot(&b.u).abs() / b.u.norm() > step.dot(&b.v).abs() / b.v.norm();
                if axis == 0 {
                    long_steps += if is_long { 1 } else { -1 };
                }
                let (edge, aside) = if is_long { (b.u, b.v) } else { (b.v, b.u) };
                filled[axis].push(match evidence {
                    Some(evidence) => 1.0 - seam(b.center + step / 2.0, step, aside, evidence),
                    None => edge.norm() / step.norm(),
                });
            }
        }
        let filled = filled.map(|mut shares| if shares.is_empty() { 1.0 } else { median(&mut shares).clamp(0.8, 1.0) });
        Self { is_long_along: long_steps >= 0, filled }
    }

    /// The module at a place, like `own`.
    fn at(&self, place: &Place, own: ModuleBox) -> ModuleBox {
        let turned = |edge: Vector2<f64>, like: Vector2<f64>| if edge.dot(&like) < 0.0 { -edge } else { edge };
        let (along_like, across_like) = if self.is_long_along { (own.u, own.v) } else { (own.v, own.u) };
        let along = turned(place.along * self.filled[0], along_like);
        let across = place.across.map_or(across_like, |across| turned(across * self.filled[1], across_like));
        let (u, v) = if self.is_long_along { (along, across) } else { (across, along) };
        ModuleBox { center: place.center, u, v, ..own }
    }
}

/// Width of the seam between two modules, in parts of the step from the one to the other: what the mask of faces lacks there.
fn seam(middle: Vector2<f64>, step: Vector2<f64>, aside: Vector2<f64>, evidence: &dyn Evidence) -> f64 {
    const SAMPLES: i32 = 12;
    let mut lacking = 0.0;
    for side in -2..=2 {
        for along in -SAMPLES..=SAMPLES {
            let at = middle + aside * (f64::from(side) * 0.15) + step * (SEAM * f64::from(along) / f64::from(SAMPLES));
            lacking += 1.0 - evidence.module(at);
        }
    }
    2.0 * SEAM * lacking / (5.0 * f64::from(2 * SAMPLES + 1))
}

/// The score of a module that the masks show at a place, if weakly; `None` where they show none, or the frame cuts it.
fn shown(candidate: &ModuleBox, evidence: &dyn Evidence, size: Vector2<f64>, least: f64) -> Option<f32> {
    let quad = candidate.quad();
    if !is_inside(&quad, size) {
        return None;
    }
    // Over each of the four sides, too: a box half on bare ground has none on one side.
    let mean = |from: Vector2<f64>, to: Vector2<f64>| mean_within(candidate, evidence, from, to);
    let (low, high) = (Vector2::repeat(-0.42), Vector2::repeat(0.42));
    let sides = [
        mean(low, Vector2::new(-0.25, 0.42)),
        mean(Vector2::new(0.25, -0.42), high),
        mean(low, Vector2::new(0.42, -0.25)),
        mean(Vector2::new(-0.42, 0.25), high),
    ];
    let module = mean(low, high);
    let is_whole = sides.iter().all(|side| *side > SIDE * least);
    (module > least && is_whole).then_some(module as f32)
}

/// Mean probability of a face within a box.
pub(super) fn face(b: &ModuleBox, evidence: &dyn Evidence) -> f64 {
    mean_within(b, evidence, Vector2::repeat(-0.42), Vector2::repeat(0.42))
}

/// Mean probability of a face in a part of a box, whose corners are given in parts of its edges from its centre.
fn mean_within(b: &ModuleBox, evidence: &dyn Evidence, from: Vector2<f64>, to: Vector2<f64>) -> f64 {
    let mut sum = 0.0;
    for i in 0..5 {
        for j in 0..5 {
            let at = from + (to - from).component_mul(&Vector2::new(f64::from(i), f64::from(j))) / 4.0;
            sum += evidence.module(b.center + b.u * at.x + b.v * at.y);
        }
    }
    sum / 25.0
}

fn is_inside(quad: &Quad, size: Vector2<f64>) -> bool {
    quad.corners.iter().all(|c| c.x >= -0.5 && c.y >= -0.5 && c.x <= size.x - 0.5 && c.y <= size.y - 0.5)
}

pub(super) fn median(values: &mut [f64]) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::rngs::StdRng;
    use rand::{RngExt, SeedableRng};

    /// A mask of faces that knows where the modules are.
    struct Faces(Vec<Quad>);

    impl Evidence for Faces {
        fn module(&self, at: Vector2<f64>) -> f64 {
            f64::from(u8::from(self.0.iter().any(|quad| quad.contains(at))))
        }
    }

    const SIZE: Vector2<f64> = Vector2::new(1200.0, 800.0);

    /// Modules of a bench, seen in perspective, each in a step of `pitch`; a gap of `gap` pixels after the sixth column.
    fn bench(columns: usize, rows: usize, gap: f64) -> Vec<ModuleBox> {
        let seen = |x: f64, y: f64| {
            let far = 1.0 + 0.0002 * x + 0.0004 * y;
            Vector2::new(80.0 + (0.95 * x - 0.2 * y) / far, 120.0 + (0.25 * x + 0.9 * y) / far)
        };
        (0..rows * columns)
            .map(|k| {
                let (column, row) = (k % columns, k / columns);
                let x = 41.0 * column as f64 + if column >= 6 { gap } else { 0.0 };
                let y = 25.0 * row as f64;
                let corner = |i: f64, j: f64| seen(x + 20.0 * i, y + 12.0 * j);
                ModuleBox {
                    center: (corner(-1.0, -1.0) + corner(1.0, -1.0) + corner(1.0, 1.0) + corner(-1.0, 1.0)) / 4.0,
                    u: corner(1.0, 0.0) - corner(-1.0, 0.0),
                    v: corner(0.0, 1.0) - corner(0.0, -1.0),
                    score: 0.9,
                    source: Source::Unet,
                }
            })
            .collect()
    }

    fn shaken(truth: &[ModuleBox], noise_px: f64, seed: u64) -> Vec<ModuleBox> {
        let mut rng = StdRng::seed_from_u64(seed);
        let mut noise = || Vector2::new(rng.random_range(-1.0..1.0), rng.random_range(-1.0..1.0)) * noise_px * 1.73;
        truth
            .iter()
            .map(|b| ModuleBox { center: b.center + noise(), u: b.u + noise(), v: b.v + noise(), ..*b })
            .collect()
    }

    /// Root mean square distance of the centres to the truth, each of which must have one.
    fn error_px(found: &[ModuleBox], truth: &[ModuleBox]) -> f64 {
        let nearest =
            |b: &ModuleBox| found.iter().map(|f| (f.center - b.center).norm_squared()).fold(f64::INFINITY, f64::min);
        (truth.iter().map(nearest).sum::<f64>() / truth.len() as f64).sqrt()
    }

    /// By how much the boxes' IoU with the truth falls short of 1, on average.
    fn lost(found: &[ModuleBox], truth: &[ModuleBox]) -> f64 {
        let best = |b: &ModuleBox| found.iter().map(|f| f.quad().iou(&b.quad())).fold(0.0, f64::max);
        truth.iter().map(|b| 1.0 - best(b)).sum::<f64>() / truth.len() as f64
    }

    fn faces(truth: &[ModuleBox]) -> Faces {
        Faces(truth.iter().map(ModuleBox::quad).collect())
    }

    #[test]
    fn neighbours_steady_each_other() {
        let truth = bench(14, 4, 0.0);
        let boxes = shaken(&truth, 1.0, 1);
        let before = error_px(&boxes, &truth);
        let before_lost = lost(&boxes, &truth);
        let found = complete(boxes, Some(&faces(&truth)), SIZE);
        assert_eq!(found.len(), truth.len());
        let after = error_px(&found, &truth);
        assert!(after < 0.7 * before, "{before} px before, {after} px after");
        let after_lost = lost(&found, &truth);
        assert!(after_lost < 0.8 * before_lost, "IoU short of 1 by {before_lost} before, by {after_lost} after");
    }

    #[test]
    fn no_fit_smooths_over_a_gap() {
        let truth = bench(14, 3, 7.0);
        let found = complete(shaken(&truth, 0.3, 2), Some(&faces(&truth)), SIZE);
        assert_eq!(found.len(), truth.len());
        let after = error_px(&found, &truth);
        assert!(after < 0.4, "{after} px");
    }

    #[test]
    fn places_that_the_mask_shows_are_taken_in_and_what_lies_across_gives_way() {
        let truth = bench(12, 3, 0.0);
        let mut boxes = shaken(&truth, 0.3, 3);
        // Two merged in one box, one split in two halves, one missing in the middle, two at the end.
        let (merged, split) = (boxes[16], boxes[20]);
        let half = |sign: f64| ModuleBox {
            center: split.center + split.u * (0.25 * sign),
            u: split.v,
            v: split.u * 0.48,
            ..split
        };
        let gone = [7, 16, 17, 20, 34, 35];
        let mut index = 0;
        boxes.retain(|_| {
            index += 1;
            !gone.contains(&(index - 1))
        });
        boxes.push(ModuleBox { center: merged.center + merged.u * 0.5, u: merged.u * 2.0, ..merged });
        boxes.extend([half(-1.0), half(1.0)]);
        let found = complete(boxes, Some(&faces(&truth)), SIZE);
        assert_eq!(found.len(), truth.len());
        assert!(error_px(&found, &truth) < 0.5, "{} px", error_px(&found, &truth));
    }

    #[test]
    fn where_the_mask_shows_ground_nothing_is_added() {
        let truth = bench(12, 3, 0.0);
        let mut seen = truth.clone();
        seen.remove(18);
        let found = complete(seen.clone(), Some(&faces(&seen)), SIZE);
        assert_eq!(found.len(), seen.len());
        assert_eq!(complete(seen.clone(), None, SIZE).len(), seen.len());
    }

    #[test]
    fn too_few_boxes_stay_as_they_are() {
        let few = bench(2, 2, 0.0);
        assert_eq!(complete(few.clone(), Some(&faces(&few)), SIZE), few);
        assert!(complete(Vec::new(), None, SIZE).is_empty());
    }
}
