//! The normal equations of benches and views together. Benches touch each other only through views, so each is
//! eliminated by itself; what is left couples the views that share a bench, block by block.

use super::lattice::{BenchMatrix, BenchVector, Lattice, PARAMS, TERMS};
use super::views::AdjustedView;
use nalgebra::{Matrix6, SMatrix, Vector2, Vector6};
use rayon::prelude::*;
use std::collections::BTreeMap;

/// A point of the lattice as it was seen in one view.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sight {
    /// Column and row, counted from the middle of the bench.
    pub(super) place: [f32; 2],
    pub(super) seen_px: Vector2<f64>,
    /// Its standard deviation in units of a module's centre.
    pub(super) spread: f32,
}

/// What one view shows of one bench.
#[derive(Debug, Clone)]
pub(super) struct Group {
    pub(super) view: usize,
    pub(super) sights: Vec<Sight>,
    /// By how much the view displaces this bench beyond its pose, pixels: the present estimate.
    pub(super) offset_px: Vector2<f64>,
}

impl Group {
    /// How much the group counts as one of the rest, 0 to 1.5: offsets have long tails (Student's t with four degrees of
    /// freedom), for a view whose columns were matched one off displaces a bench by a whole module.
    pub(super) fn trust(&self, spreads: &Spreads) -> f64 {
        6.0 / (4.0 + self.offset_px.norm_squared() / (spreads.group_px * spreads.group_px))
    }
}

/// How much things may deviate, one standard deviation each.
#[derive(Debug, Clone, Copy)]
pub(super) struct Spreads {
    /// Of the centre of a box, pixels.
    pub(super) center_px: f64,
    /// Of a whole bench in one view against what the view's pose says, pixels.
    pub(super) group_px: f64,
    /// Of the ground that a view shows, by the error of its pose, metres.
    pub(super) pose_m: f64,
    /// Of what the boxes of one group have in common besides its offset (they are stretched or sheared together), pixels.
    pub(super) shared_px: f64,
}

pub(super) type Cross = SMatrix<f64, PARAMS, 6>;
type OffsetByBench = SMatrix<f64, 2, PARAMS>;
type OffsetByView = SMatrix<f64, 2, 6>;

/// What one group says, its offset eliminated.
struct GroupTerms {
    of_view: usize,
    cross: Cross,
    view: Matrix6<f64>,
    view_right: Vector6<f64>,
    offset: OffsetTerms,
}

/// What it takes to find the offset again.
struct OffsetTerms {
    by_bench: OffsetByBench,
    by_view: OffsetByView,
    right: Vector2<f64>,
    /// Variance of the offset where bench and view are known, square pixels.
    variance: f64,
}

/// One bench, linearised about its present estimate.
struct BenchTerms {
    inverse: BenchMatrix,
    /// `inverse` times the right side.
    solved: BenchVector,
    groups: Vec<GroupTerms>,
    /// `inverse` times the cross block of each group.
    solved_cross: Vec<Cross>,
}

/// Where to find a group: bench, and place among its groups.
type GroupIndex = (u32, u32);

/// The whole problem, linearised.
pub(super) struct Normal {
    benches: Vec<BenchTerms>,
    /// For each view its blocks with the views that share a bench with it, itself included.
    rows: Vec<BTreeMap<usize, Matrix6<f64>>>,
    right: Vec<Vector6<f64>>,
}

/// A step of the Gauss-Newton iteration.
pub(super) struct Step {
    pub(super) views: Vec<Vector6<f64>>,
    pub(super) benches: Vec<BenchVector>,
    /// New offsets of all groups, pixels.
    pub(super) offsets_px: Vec<Vec<Vector2<f64>>>,
}

impl Normal {
    /// Linearises. `priors` adds to each bench's normal matrix and right side what else is known of it.
    pub(super) fn new(
        lattices: &[Lattice],
        groups: &[Vec<Group>],
        views: &[AdjustedView],
        spreads: &Spreads,
        priors: impl Fn(usize, &mut BenchMatrix, &mut BenchVector) + Sync,
    ) -> Self {
        let benches: Vec<BenchTerms> = lattices
            .par_iter()
            .zip(groups)
            .enumerate()
            .map(|(index, (lattice, groups))| bench_terms(lattice, groups, views, spreads, |a, b| priors(index, a, b)))
            .collect();
        let mut groups_of_view: Vec<Vec<GroupIndex>> = vec![Vec::new(); views.len()];
        for (bench, groups) in groups.iter().enumerate() {
            for (place, group) in groups.iter().enumerate() {
                groups_of_view[group.view].push((bench as u32, place as u32));
            }
        }
        let (rows, right) = (0..views.len())
            .into_par_iter()
            .map(|view| {
                let scale = views[view].prior_scale() * spreads.pose_m;
                let prior = scale.map(|sigma| 1.0 / (sigma * sigma));
                let mut right = -prior.component_mul(views[view].correction());
                let mut row: BTreeMap<usize, Matrix6<f64>> = BTreeMap::new();
                row.insert(view, Matrix6::from_diagonal(&prior));
                for &(bench, place) in &groups_of_view[view] {
                    let terms = &benches[bench as usize];
                    let own = &terms.groups[place as usize];
                    right += own.view_right - own.cross.tr_mul(&terms.solved);
                    for (group, solved) in groups[bench as usize].iter().zip(&terms.solved_cross) {
                        *row.entry(group.view).or_default() -= own.cross.tr_mul(solved);
                    }
                    *row.entry(view).or_default() += own.view;
                }
                (row, right)
            })
            .unzip();
        Self { benches, rows, right }
    }

    /// Solves for all corrections. `tolerance` is the share of the right side that may be left.
    pub(super) fn solve(&self, tolerance: f64, most_rounds: usize) -> Step {
        let views = self.conjugate_gradients(tolerance, most_rounds);
        let (benches, offsets_px) = self
            .benches
            .par_iter()
            .enumerate()
            .map(|(bench, terms)| {
                let mut step = terms.solved;
                for (solved, view) in terms.solved_cross.iter().zip(self.views_of(bench)) {
                    step -= solved * views[view];
                }
                let offsets = terms
                    .groups
                    .iter()
                    .zip(self.views_of(bench))
                    .map(|(group, view)| {
                        let terms = &group.offset;
                        (terms.right - terms.by_bench * step - terms.by_view * views[view]) * terms.variance
                    })
                    .collect();
                (step, offsets)
            })
            .unzip();
        Step { views, benches, offsets_px }
    }

    fn views_of(&self, bench: usize) -> impl Iterator<Item = usize> + '_ {
        self.benches[bench].groups.iter().map(|group| group.of_view)
    }

    fn multiply(&self, x: &[Vector6<f64>]) -> Vec<Vector6<f64>> {
        self.rows
            .par_iter()
            .with_min_len(64)
            .map(|row| row.iter().map(|(view, block)| block * x[*view]).sum())
            .collect()
    }

    /// Conjugate gradients, preconditioned by the inverse of each view's own block.
    fn conjugate_gradients(&self, tolerance: f64, most_rounds: usize) -> Vec<Vector6<f64>> {
        let inverses: Vec<Matrix6<f64>> = (0..self.rows.len()).map(|view| self.alone(view)).collect();
        let precondition = |r: &[Vector6<f64>]| -> Vec<Vector6<f64>> {
            r.iter().zip(&inverses).map(|(r, inverse)| inverse * r).collect()
        };
        let dot = |a: &[Vector6<f64>], b: &[Vector6<f64>]| a.iter().zip(b).map(|(a, b)| a.dot(b)).sum::<f64>();
        let mut x = vec![Vector6::zeros(); self.rows.len()];
        let mut rest = self.right.clone();
        let mut z = precondition(&rest);
        let mut direction = z.clone();
        let mut energy = dot(&rest, &z);
        let goal = energy * tolerance * tolerance;
        for _ in 0..most_rounds {
            if energy <= goal || energy <= 0.0 {
                break;
            }
            let image = self.multiply(&direction);
            let step = energy / dot(&direction, &image);
            if !step.is_finite() {
                break;
            }
            for k in 0..x.len() {
                x[k] += direction[k] * step;
                rest[k] -= image[k] * step;
            }
            z = precondition(&rest);
            let next = dot(&rest, &z);
            let turn = next / energy;
            energy = next;
            for k in 0..x.len() {
                direction[k] = z[k] + direction[k] * turn;
            }
        }
        x
    }

    /// How two views hang together; `None` where they share no bench.
    pub(super) fn block(&self, view: usize, other: usize) -> Option<&Matrix6<f64>> {
        self.rows[view].get(&other)
    }

    /// The view that shows most of a bench; every bench was seen.
    pub(super) fn main_view(&self, bench: usize) -> usize {
        let groups = &self.benches[bench].groups;
        let best = groups.iter().min_by(|a, b| a.offset.variance.total_cmp(&b.offset.variance));
        best.map_or(0, |group| group.of_view)
    }

    /// A view and those that share most with it, at most `size` in all, sorted.
    pub(super) fn window(&self, view: usize, size: usize) -> Vec<usize> {
        let mut others: Vec<(f64, usize)> =
            self.rows[view].iter().filter(|(k, _)| **k != view).map(|(k, block)| (block.norm(), *k)).collect();
        others.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        let mut window: Vec<usize> =
            others.into_iter().take(size - 1).map(|(_, k)| k).chain(std::iter::once(view)).collect();
        window.sort_unstable();
        window
    }

    /// For each view of a bench how its correction moves the bench, sign reversed.
    pub(super) fn solved_crosses(&self, bench: usize) -> impl Iterator<Item = (usize, &Cross)> {
        self.views_of(bench).zip(&self.benches[bench].solved_cross)
    }

    /// Covariance of a bench if all views were known.
    pub(super) fn bench_alone(&self, bench: usize) -> &BenchMatrix {
        &self.benches[bench].inverse
    }

    /// Variance of the offset of each group of a bench if all else were known, square pixels.
    pub(super) fn offset_variances(&self, bench: usize) -> impl Iterator<Item = f64> + '_ {
        self.benches[bench].groups.iter().map(|group| group.offset.variance)
    }

    /// Covariance of a view's correction if all other views were known.
    pub(super) fn alone(&self, view: usize) -> Matrix6<f64> {
        self.rows[view]
            .get(&view)
            .and_then(|block| block.cholesky())
            .map_or_else(Matrix6::zeros, |cholesky| cholesky.inverse())
    }
}

/// What some groups alone make of a bench, all views standing as they are: the change of its lattice, and its covariance.
pub(super) fn bench_by(
    lattice: &Lattice,
    groups: &[Group],
    views: &[AdjustedView],
    spreads: &Spreads,
    prior: impl Fn(&mut BenchMatrix, &mut BenchVector),
) -> (BenchVector, BenchMatrix) {
    let BenchTerms { solved, inverse, .. } = bench_terms(lattice, groups, views, spreads, prior);
    (solved, inverse)
}

/// Linearises one bench and eliminates the offsets of its groups, then the bench itself.
fn bench_terms(
    lattice: &Lattice,
    groups: &[Group],
    views: &[AdjustedView],
    spreads: &Spreads,
    prior: impl Fn(&mut BenchMatrix, &mut BenchVector),
) -> BenchTerms {
    let mut normal = BenchMatrix::zeros();
    let mut right = BenchVector::zeros();
    let terms: Vec<GroupTerms> =
        groups.iter().map(|group| group_terms(lattice, group, views, spreads, &mut normal, &mut right)).collect();
    prior(&mut normal, &mut right);
    for i in 0..PARAMS {
        normal[(i, i)] += 1e-9;
        for j in 0..i {
            normal[(j, i)] = normal[(i, j)];
        }
    }
    let inverse = normal.cholesky().map_or_else(BenchMatrix::zeros, |cholesky| cholesky.inverse());
    let solved = inverse * right;
    let solved_cross = terms.iter().map(|group| inverse * group.cross).collect();
    BenchTerms { inverse, solved, groups: terms, solved_cross }
}

/// Linearises one group; its share goes into the lower triangle of the bench's normal matrix and into its right side.
fn group_terms(
    lattice: &Lattice,
    group: &Group,
    views: &[AdjustedView],
    spreads: &Spreads,
    normal: &mut BenchMatrix,
    right: &mut BenchVector,
) -> GroupTerms {
    let view = &views[group.view];
    let mut cross = Cross::zeros();
    let mut own = Matrix6::zeros();
    let mut own_right = Vector6::zeros();
    let mut by_bench = OffsetByBench::zeros();
    let mut by_view = OffsetByView::zeros();
    let mut offset_right = Vector2::zeros();
    let mut information = group.trust(spreads) / (spreads.group_px * spreads.group_px);
    // However many boxes there are, their common errors do not average out: those of four numbers, say.
    let shared = spreads.shared_px * spreads.shared_px * group.sights.len() as f64 / 4.0;
    for sight in &group.sights {
        let [c, r] = sight.place.map(f64::from);
        let factors = lattice.factors(c, r);
        let position = lattice.position(c, r);
        let Some(look) = view.look(&position) else { continue };
        let rest = sight.seen_px - look.pixel;
        let sigma = spreads.center_px * f64::from(sight.spread);
        let weight = cauchy((rest - group.offset_px).norm_squared() / (sigma * sigma)) / (sigma * sigma + shared);
        let mut by_pose = OffsetByView::zeros();
        by_pose.fixed_columns_mut::<3>(0).copy_from(&look.by_turn);
        by_pose.fixed_columns_mut::<3>(3).copy_from(&look.by_shift);
        let square = look.by_point.tr_mul(&look.by_point) * weight;
        let mixed = look.by_point.tr_mul(&by_pose) * weight;
        let down = look.by_point.tr_mul(&rest) * weight;
        for i in 0..TERMS {
            for j in 0..=i {
                let mut block = normal.fixed_view_mut::<3, 3>(3 * i, 3 * j);
                block += square * (factors[i] * factors[j]);
            }
            let mut block = cross.fixed_view_mut::<3, 6>(3 * i, 0);
            block += mixed * factors[i];
            let mut block = right.fixed_rows_mut::<3>(3 * i);
            block += down * factors[i];
            let mut block = by_bench.fixed_columns_mut::<3>(3 * i);
            block += look.by_point * (weight * factors[i]);
        }
        own += by_pose.tr_mul(&by_pose) * weight;
        own_right += by_pose.tr_mul(&rest) * weight;
        by_view += by_pose * weight;
        offset_right += rest * weight;
        information += weight;
    }
    let variance = 1.0 / information;
    *normal -= by_bench.tr_mul(&by_bench) * variance;
    *right -= by_bench.tr_mul(&offset_right) * variance;
    cross -= by_bench.tr_mul(&by_view) * variance;
    own -= by_view.tr_mul(&by_view) * variance;
    own_right -= by_view.tr_mul(&offset_right) * variance;
    let offset = OffsetTerms { by_bench, by_view, right: offset_right, variance };
    GroupTerms { of_view: group.view, cross, view: own, view_right: own_right, offset }
}

/// Weight by Cauchy of a squared residual in units of its variance: beyond three sigma it counts less and less.
fn cauchy(squared: f64) -> f64 {
    1.0 / (1.0 + squared / 9.0)
}
