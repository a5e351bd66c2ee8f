//! Which module of the plant is which module of the truth, found from positions alone.
//!
//! A plant may be shifted by metres and scaled by a percent against the truth, and modules repeat every metre, so that
//! the nearest module is often the wrong one. Offsets are voted for where small patches of both overlap, each of the
//! best is refined and grown over the plant, and the alignment that pairs the most modules wins: one that is off by a
//! whole module leaves the ends of the benches unpaired. Among equals the smallest move wins.

use heliomap_mapping::geometry::Similarity;
use nalgebra::{Rotation3, Vector2, Vector3};
use rayon::prelude::*;
use rstar::RTree;
use rstar::primitives::GeomWithData;

/// Modules of a patch in which offsets are voted for.
const PATCH: usize = 600;
/// Horizontal offsets are sought this far around nought and around the difference of the centroids, metres.
const REACH_M: f64 = 12.0;
/// Offsets are voted for in cells of this part of the gate, so that those of neighbouring modules stay apart, and of at
/// least and at most so many metres.
const CELL_OF_GATE: f64 = 0.5;
const CELL_M: (f64, f64) = (0.06, 0.25);
/// Scales and rotations (radians) tried where votes are counted; between them the refinement takes over.
const SCALES: [f64; 5] = [0.98, 0.99, 1.0, 1.01, 1.02];
const ROTATIONS_RAD: [f64; 5] = [-0.0175, -0.00875, 0.0, 0.00875, 0.0175];
/// An alignment beyond these is none.
const SCALE_BOUNDS: std::ops::RangeInclusive<f64> = 0.94..=1.06;
const MAX_ROTATION_RAD: f64 = 0.1;
/// Neighbours looked at, so that modules heaped on one spot cost no more than others.
const MAX_NEIGHBOURS: usize = 1000;
const MAX_RIVALS: usize = 6;
/// Modules by which an alignment is refined while it grows.
const SAMPLE: usize = 6_000;
/// Modules on which grown alignments are compared.
const COUNTED: usize = 20_000;
/// Alignments that are grown over the whole plant, shared among the anchors.
const MAX_GROWN: usize = 24;

/// A point of the plant and its partner in the truth, metres.
type PlanePair = (Vector2<f64>, Vector2<f64>);
type Tree = RTree<GeomWithData<[f64; 2], usize>>;

/// Pairs module centres (metres, z up) of a plant with those of a truth. A module of the truth pairs with the nearest
/// one of the plant whose horizontal distance after the alignment is at most its `gates_m`; the pairs are indices into
/// both, in the order of the truth. `None` where either side is empty or not even one module pairs.
pub fn pair(plant_m: &[Vector3<f64>], truth_m: &[Vector3<f64>], gates_m: &[f64]) -> Option<Vec<(usize, usize)>> {
    if plant_m.is_empty() || truth_m.is_empty() {
        return None;
    }
    // About the truth's centroid, so that nothing is lost to large coordinates.
    let origin = truth_m.iter().sum::<Vector3<f64>>() / truth_m.len() as f64;
    let plant: Vec<Vector3<f64>> = plant_m.iter().map(|p| p - origin).collect();
    let truth: Vec<Vector3<f64>> = truth_m.iter().map(|t| t - origin).collect();
    let tree = tree_of(&truth);
    let gate_m = median(gates_m.to_vec())?;
    let search = Search {
        plant: plant.iter().map(|p| p.xy()).collect(),
        tree: &tree,
        gate_m,
        cell_m: (CELL_OF_GATE * gate_m).clamp(CELL_M.0, CELL_M.1),
    };
    let coarse = search.best()?;

    let start = level(coarse, &plant, &truth, &one_to_one(&plant, |p| coarse.apply(p), &tree, gates_m))?;
    let mut pairs = one_to_one(&plant, |p| start.apply(p).xy(), &tree, gates_m);
    for _ in 0..8 {
        let Some(finer) = fit_robustly(&plant, &truth, &pairs) else { break };
        let finer_pairs = one_to_one(&plant, |p| finer.apply(p).xy(), &tree, gates_m);
        if finer_pairs.len() < pairs.len() {
            break;
        }
        let settled = finer_pairs == pairs;
        pairs = finer_pairs;
        if settled {
            break;
        }
    }
    (!pairs.is_empty()).then_some(pairs)
}

/// Turning about the vertical, scaling and moving in the horizontal plane.
#[derive(Debug, Clone, Copy)]
struct PlaneSimilarity {
    /// Scale times cosine and sine of the rotation.
    cos: f64,
    sin: f64,
    translation_m: Vector2<f64>,
}

impl PlaneSimilarity {
    /// Turns and scales about `pivot_m`, then moves.
    fn about(pivot_m: Vector2<f64>, scale: f64, rotation_rad: f64, offset_m: Vector2<f64>) -> Self {
        let (sin, cos) = (scale * rotation_rad.sin(), scale * rotation_rad.cos());
        let turned = Vector2::new(cos * pivot_m.x - sin * pivot_m.y, sin * pivot_m.x + cos * pivot_m.y);
        Self { cos, sin, translation_m: pivot_m - turned + offset_m }
    }

    fn apply_xy(&self, p: Vector2<f64>) -> Vector2<f64> {
        Vector2::new(self.cos * p.x - self.sin * p.y, self.sin * p.x + self.cos * p.y) + self.translation_m
    }

    fn apply(&self, p: &Vector3<f64>) -> Vector2<f64> {
        self.apply_xy(p.xy())
    }

    fn is_plausible(&self) -> bool {
        SCALE_BOUNDS.contains(&self.cos.hypot(self.sin)) && self.sin.atan2(self.cos).abs() <= MAX_ROTATION_RAD
    }

    /// Least squares; `None` where the points do not fix it or it is out of bounds.
    fn fit(pairs: &[PlanePair]) -> Option<Self> {
        let count = pairs.len() as f64;
        let (source_mean, target_mean) = pairs
            .iter()
            .fold((Vector2::zeros(), Vector2::zeros()), |(s, t), pair| (s + pair.0 / count, t + pair.1 / count));
        let (mut dot, mut cross, mut variance) = (0.0, 0.0, 0.0);
        for (source, target) in pairs {
            let (s, t) = (source - source_mean, target - target_mean);
            dot += s.dot(&t);
            cross += s.perp(&t);
            variance += s.norm_squared();
        }
        if pairs.len() < 2 || variance < 1e-9 {
            return None;
        }
        let (cos, sin) = (dot / variance, cross / variance);
        let turned = Vector2::new(cos * source_mean.x - sin * source_mean.y, sin * source_mean.x + cos * source_mean.y);
        let fit = Self { cos, sin, translation_m: target_mean - turned };
        fit.is_plausible().then_some(fit)
    }
}

/// The search for the horizontal alignment.
struct Search<'a> {
    plant: Vec<Vector2<f64>>,
    tree: &'a Tree,
    gate_m: f64,
    cell_m: f64,
}

impl Search<'_> {
    /// The alignment under which the most modules of the plant lie on one of the truth.
    fn best(&self) -> Option<PlaneSimilarity> {
        let count = self.plant.len();
        let plant_mean = self.plant.iter().sum::<Vector2<f64>>() / count as f64;
        let mut windows = vec![Vector2::zeros()];
        if plant_mean.norm() > 3.0 {
            // The truth's own centroid is the origin.
            windows.push(-plant_mean);
        }
        let plant_tree =
            RTree::bulk_load(self.plant.iter().zip(0..).map(|(p, k)| GeomWithData::new([p.x, p.y], k)).collect());
        let anchors = anchors(&self.plant);
        let quota = (MAX_GROWN / anchors.len()).max(3);
        let grown: Vec<(usize, f64, PlaneSimilarity)> = anchors
            .into_par_iter()
            .flat_map_iter(|anchor| {
                let at = self.plant[anchor];
                let patch: Vec<Vector2<f64>> =
                    nearest(&plant_tree, at).take(PATCH).map(|(k, ..)| self.plant[k]).collect();
                let votes = windows.iter().flat_map(|&window| self.vote(at, &patch, window));
                let mut seeds: Vec<(usize, f64, PlaneSimilarity)> = votes
                    .filter_map(|seed| self.refine(seed, &patch, 6))
                    .map(|seed| (self.count(&seed, &patch), (seed.apply_xy(at) - at).norm(), seed))
                    .collect();
                // A patch that knows no better still speaks for the smallest move.
                seeds.sort_by(|a, b| b.0.cmp(&a.0).then(a.1.total_cmp(&b.1)));
                seeds.truncate(quota);
                let mut by_distance = self.plant.clone();
                by_distance.sort_by(|a, b| (a - at).norm_squared().total_cmp(&(b - at).norm_squared()));
                let grown = seeds.into_iter().filter_map(|(_, _, seed)| {
                    let (hits, grown) = self.grow(seed, &by_distance)?;
                    Some((hits, (grown.apply_xy(plant_mean) - plant_mean).norm(), grown))
                });
                grown.collect::<Vec<_>>()
            })
            .collect();
        let most = grown.iter().map(|g| g.0).max()?;
        let enough = most - most / 1000;
        grown.into_iter().filter(|g| g.0 >= enough).min_by(|a, b| a.1.total_cmp(&b.1)).map(|g| g.2)
    }

    /// The offsets of a patch, and the scale and rotation about its anchor, that most of its modules agree on.
    fn vote(&self, anchor: Vector2<f64>, patch: &[Vector2<f64>], window: Vector2<f64>) -> Vec<PlaneSimilarity> {
        let cells = (2.0 * REACH_M / self.cell_m) as usize;
        let hypotheses: Vec<(f64, f64)> =
            SCALES.iter().flat_map(|&scale| ROTATIONS_RAD.map(|rotation| (scale, rotation))).collect();
        let mut grids = vec![vec![0_u32; cells * cells]; hypotheses.len()];
        for &point in patch {
            let reach_m = REACH_M + 0.04 * (point - anchor).norm();
            let around = nearest(self.tree, point + window)
                .take_while(|(_, distance_m, _)| *distance_m <= reach_m)
                .take(MAX_NEIGHBOURS)
                .map(|(.., target)| target)
                .collect::<Vec<_>>();
            for (grid, &(scale, rotation_rad)) in grids.iter_mut().zip(&hypotheses) {
                let moved = PlaneSimilarity::about(anchor, scale, rotation_rad, window).apply_xy(point);
                for target in &around {
                    let cell = (target - moved + Vector2::repeat(REACH_M)) / self.cell_m;
                    if cell.x >= 0.0 && cell.y >= 0.0 && cell.x < cells as f64 && cell.y < cells as f64 {
                        grid[cell.y as usize * cells + cell.x as usize] += 1;
                    }
                }
            }
        }
        let mut peaks: Vec<(u32, f64, usize, Vector2<f64>)> = Vec::new();
        for (hypothesis, grid) in grids.iter().enumerate() {
            let blurred = blur(grid, cells);
            for y in 1..cells - 1 {
                for x in 1..cells - 1 {
                    let votes = blurred[y * cells + x];
                    let around = [(0, 0), (1, 0), (2, 0), (0, 1), (2, 1), (0, 2), (1, 2), (2, 2)];
                    if (votes as usize) * 4 >= patch.len()
                        && around.iter().all(|(dx, dy)| blurred[(y + dy - 1) * cells + x + dx - 1] <= votes)
                    {
                        let offset = window + Vector2::new(x as f64 + 0.5, y as f64 + 0.5) * self.cell_m
                            - Vector2::repeat(REACH_M);
                        peaks.push((votes, offset.norm(), hypothesis, offset));
                    }
                }
            }
        }
        peaks.sort_by(|a, b| b.0.cmp(&a.0).then(a.1.total_cmp(&b.1)).then(a.2.cmp(&b.2)));
        let mut kept: Vec<(usize, Vector2<f64>)> = Vec::new();
        for (_, _, hypothesis, offset) in peaks {
            if kept.iter().all(|(_, other)| (other - offset).norm() > 2.0 * self.cell_m) {
                kept.push((hypothesis, offset));
            }
            if kept.len() == 24 {
                break;
            }
        }
        let alignment = |(hypothesis, offset): (usize, Vector2<f64>)| {
            let (scale, rotation_rad) = hypotheses[hypothesis];
            PlaneSimilarity::about(anchor, scale, rotation_rad, offset)
        };
        kept.into_iter().map(alignment).collect()
    }

    /// Nearest neighbours and least squares in turn, outliers trimmed.
    fn refine(&self, mut seed: PlaneSimilarity, points: &[Vector2<f64>], rounds: usize) -> Option<PlaneSimilarity> {
        if points.len() < 2 {
            return Some(seed);
        }
        for _ in 0..rounds {
            let pairs: Vec<(f64, PlanePair)> = points
                .iter()
                .filter_map(|&p| {
                    let (_, distance_m, target) = nearest(self.tree, seed.apply_xy(p)).next()?;
                    (distance_m <= 1.2 * self.gate_m).then_some((distance_m, (p, target)))
                })
                .collect();
            let typical_m = median(pairs.iter().map(|pair| pair.0).collect())?;
            let kept: Vec<_> =
                pairs.into_iter().filter(|pair| pair.0 <= (3.0 * typical_m).max(0.02)).map(|pair| pair.1).collect();
            seed = PlaneSimilarity::fit(&kept)?;
        }
        Some(seed)
    }

    /// Refines over an ever larger part of the plant, so that the alignment is always nearly right where it is used.
    fn grow(&self, seed: PlaneSimilarity, by_distance: &[Vector2<f64>]) -> Option<(usize, PlaneSimilarity)> {
        let sample = |size: usize, most: usize| -> Vec<Vector2<f64>> {
            by_distance[..size].iter().step_by(size.div_ceil(most)).copied().collect()
        };
        let (mut grown, mut size) = (seed, PATCH);
        while size < by_distance.len() {
            size = by_distance.len().min(size * 2);
            grown = self.refine(grown, &sample(size, SAMPLE), 3)?;
        }
        let all = sample(by_distance.len(), COUNTED);
        grown = self.refine(grown, &all, 4)?;
        Some((self.count(&grown, &all), grown))
    }

    /// How many points have a module of the truth within reach.
    fn count(&self, alignment: &PlaneSimilarity, points: &[Vector2<f64>]) -> usize {
        let is_near = |p: &&Vector2<f64>| {
            nearest(self.tree, alignment.apply_xy(**p))
                .next()
                .is_some_and(|(_, distance_m, _)| distance_m <= self.gate_m)
        };
        points.iter().filter(is_near).count()
    }
}

/// Modules whose surroundings differ: the middle, the corners and edges of the plant, where benches end, and some
/// between.
fn anchors(plant: &[Vector2<f64>]) -> Vec<usize> {
    let mean = plant.iter().sum::<Vector2<f64>>() / plant.len() as f64;
    let best = |score: &dyn Fn(&Vector2<f64>) -> f64| {
        (0..plant.len()).max_by(|&i, &j| score(&plant[i]).total_cmp(&score(&plant[j]))).unwrap_or(0)
    };
    let mut anchors = vec![best(&|p| -(p - mean).norm())];
    if plant.len() > PATCH {
        for (x, y) in [(1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (1, -1), (-1, 1), (-1, -1)] {
            anchors.push(best(&|p| p.dot(&Vector2::new(f64::from(x), f64::from(y)))));
        }
        anchors.extend([1, 3, 5, 7].map(|eighth| plant.len() * eighth / 8));
        anchors.sort_unstable();
        anchors.dedup();
    }
    anchors
}

/// Sums over 3 x 3 cells.
fn blur(grid: &[u32], cells: usize) -> Vec<u32> {
    let mut blurred = vec![0; grid.len()];
    for y in 1..cells - 1 {
        for x in 1..cells - 1 {
            blurred[y * cells + x] =
                (0..3).map(|dy| grid[(y + dy - 1) * cells + x - 1..][..3].iter().sum::<u32>()).sum();
        }
    }
    blurred
}

/// A planar alignment with the heights' median difference: what a first 3D transform is taken from.
fn level(
    plane: PlaneSimilarity,
    plant: &[Vector3<f64>],
    truth: &[Vector3<f64>],
    pairs: &[(usize, usize)],
) -> Option<Similarity> {
    let scale = plane.cos.hypot(plane.sin);
    let rise_m = median(pairs.iter().map(|&(p, t)| truth[t].z - scale * plant[p].z).collect())?;
    Some(Similarity {
        scale,
        rotation: Rotation3::from_axis_angle(&Vector3::z_axis(), plane.sin.atan2(plane.cos)),
        translation_m: plane.translation_m.push(rise_m),
    })
}

/// The similarity of the pairs without those that lie far off the others. Where the points do not fix one (a single
/// row), the planar one.
fn fit_robustly(plant: &[Vector3<f64>], truth: &[Vector3<f64>], pairs: &[(usize, usize)]) -> Option<Similarity> {
    let first = fit_of_pairs(plant, truth, pairs, true)?;
    let residual_m = |&(p, t): &(usize, usize)| (first.apply(&plant[p]) - truth[t]).norm();
    let typical_m = median(pairs.iter().map(residual_m).collect())?;
    let kept: Vec<(usize, usize)> =
        pairs.iter().copied().filter(|pair| residual_m(pair) <= (4.0 * typical_m).max(0.02)).collect();
    fit_of_pairs(plant, truth, &kept, true)
}

/// The rigid motion or similarity that brings the plant's paired points onto the truth's. Where they lie on one line it
/// keeps the vertical, where there is but one it only moves. `None` without pairs.
pub fn fit_of_pairs(
    plant: &[Vector3<f64>],
    truth: &[Vector3<f64>],
    pairs: &[(usize, usize)],
    with_scale: bool,
) -> Option<Similarity> {
    let (source, target): (Vec<_>, Vec<_>) = pairs.iter().map(|&(p, t)| (plant[p], truth[t])).unzip();
    let is_plausible = |fit: &Similarity| SCALE_BOUNDS.contains(&fit.scale) && fit.rotation.angle() <= 0.2;
    if let Some(fit) = Similarity::fit(&source, &target, with_scale).filter(is_plausible) {
        return Some(fit);
    }
    let planar: Vec<_> = source.iter().zip(&target).map(|(s, t)| (s.xy(), t.xy())).collect();
    let Some(mut plane) = PlaneSimilarity::fit(&planar) else {
        let translation_m = source.iter().zip(&target).map(|(s, t)| t - s).sum::<Vector3<f64>>() / pairs.len() as f64;
        return (!pairs.is_empty()).then_some(Similarity { translation_m, ..Similarity::identity() });
    };
    if !with_scale {
        let scale = plane.cos.hypot(plane.sin);
        (plane.cos, plane.sin) = (plane.cos / scale, plane.sin / scale);
        let count = planar.len() as f64;
        plane.translation_m = Vector2::zeros();
        plane.translation_m = planar.iter().map(|(s, t)| t - plane.apply_xy(*s)).sum::<Vector2<f64>>() / count;
    }
    level(plane, plant, truth, pairs)
}

/// Pairs within the gates, the nearest first, each module once, in the order of the truth.
fn one_to_one(
    plant: &[Vector3<f64>],
    truth_from_plant: impl Fn(&Vector3<f64>) -> Vector2<f64> + Sync,
    tree: &Tree,
    gates_m: &[f64],
) -> Vec<(usize, usize)> {
    let widest_m = gates_m.iter().copied().fold(0.0, f64::max);
    let mut rivals: Vec<(f64, usize, usize)> = plant
        .par_iter()
        .enumerate()
        .flat_map_iter(|(p, point)| {
            nearest(tree, truth_from_plant(point))
                .take_while(|(_, distance_m, _)| *distance_m <= widest_m)
                .take(MAX_RIVALS)
                .filter(|(t, distance_m, _)| *distance_m <= gates_m[*t])
                .map(move |(t, distance_m, _)| (distance_m, p, t))
                .collect::<Vec<_>>()
        })
        .collect();
    rivals.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)).then(a.2.cmp(&b.2)));
    let (mut plant_taken, mut truth_taken) = (vec![false; plant.len()], vec![false; gates_m.len()]);
    let mut pairs = Vec::new();
    for (_, p, t) in rivals {
        if !plant_taken[p] && !truth_taken[t] {
            (plant_taken[p], truth_taken[t]) = (true, true);
            pairs.push((p, t));
        }
    }
    pairs.sort_unstable_by_key(|&(p, t)| (t, p));
    pairs
}

fn tree_of(points: &[Vector3<f64>]) -> Tree {
    RTree::bulk_load(points.iter().zip(0..).map(|(p, k)| GeomWithData::new([p.x, p.y], k)).collect())
}

/// Index, distance in metres and position of the points of a tree, the nearest first.
fn nearest(tree: &Tree, at: Vector2<f64>) -> impl Iterator<Item = (usize, f64, Vector2<f64>)> + '_ {
    tree.nearest_neighbor_iter_with_distance_2([at.x, at.y])
        .map(|(found, squared)| (found.data, squared.sqrt(), Vector2::from(*found.geom())))
}

fn median(mut values: Vec<f64>) -> Option<f64> {
    if values.is_empty() {
        return None;
    }
    let middle = values.len() / 2;
    Some(*values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn narrow_modules_pair_with_themselves() {
        // Thin film of 0.6 x 1.2 m, four rows, benches one behind the other.
        let plant: Vec<Vector3<f64>> = (0..320)
            .map(|k| {
                let (bench, column, row) = (k / 80, k % 20, k / 20 % 4);
                Vector3::new(0.62 * f64::from(column) + 13.5 * f64::from(bench), -1.22 * f64::from(row), 0.0)
            })
            .collect();
        let itself: Vec<(usize, usize)> = (0..plant.len()).map(|k| (k, k)).collect();
        for shift in [Vector3::zeros(), Vector3::new(0.9, -0.4, 1.0)] {
            let moved: Vec<Vector3<f64>> = plant.iter().map(|p| p + shift).collect();
            assert_eq!(pair(&moved, &plant, &[0.3; 320]).as_deref(), Some(&itself[..]), "moved by {shift:?}");
        }
    }
}
