//! How well the adjustment knows what it estimates.
//!
//! Errors of neighbouring modules go together, for their views err together: the covariance of a bench holds what its
//! boxes leave open and what the corrections of its views leave open, these with all their correlations. For each view
//! the views that share most with it are taken as a window; those outside count as known. Where the whole window stands,
//! how it is turned and what its scale is cannot be told from images (GNSS tells, and control points), so these seven are
//! taken out: what is stated is how far a module may stand off relative to the plant around it.
//!
//! What boxes leave open is measured, too: the places of benches by half of their views and by the other half differ by as much
//! as they are known. Boxes that err together, or less than was feared, show in that.
//!
//! Boxes err alike in all views, too: a detector sees the edge of a table otherwise than a seam, from wherever it looks.
//! Residuals show of that what no lattice fits: the means over all views of one module scatter more than boxes that err by
//! themselves would. What a lattice does fit is taken to be as large, and besides a share of what differs from view to view.

use super::RefinementParams;
use super::lattice::{BenchMatrix, BenchVector, Lattice, PARAMS, median};
use super::normal::{Group, Normal, Spreads, bench_by};
use super::views::AdjustedView;
use nalgebra::{DMatrix, Matrix6, Vector3, Vector6};
use rayon::prelude::*;
use std::collections::BTreeMap;

/// How well a bench is known: covariances of its lattice (origin, steps, bend).
pub(super) struct Uncertainty {
    /// In all, but for what its boxes have in common in all views.
    pub(super) whole: BenchMatrix,
    /// If all views were known.
    pub(super) boxes: BenchMatrix,
    /// What its boxes may have in common, metres on the ground.
    pub(super) shared_m: f64,
}

/// What residuals say of the errors of boxes.
pub(super) struct Measured {
    /// See [`scatter`].
    pub(super) scatter: Vector3<f64>,
    /// How far the boxes of one module are off alike in all views, one standard deviation on the ground, metres.
    pub(super) common_m: f64,
}

/// How much benches are really off, in units of what their boxes say, east, north and up: how far their places by half of their
/// views and by the other half differ. One where too few benches are seen by enough views.
pub(super) fn scatter(
    (lattices, groups): (&[Lattice], &[Vec<Group>]),
    views: &[AdjustedView],
    spreads: &Spreads,
    params: &RefinementParams,
    priors: impl Fn(usize, &mut BenchMatrix, &mut BenchVector) + Sync,
) -> Vector3<f64> {
    let differences: Vec<Vector3<f64>> = lattices
        .par_iter()
        .zip(groups)
        .enumerate()
        .filter(|(_, (_, groups))| groups.len() >= params.least_halved)
        .map(|(index, (lattice, groups))| {
            let [(one, of_one), (other, of_other)] = [0, 1].map(|half| {
                let own: Vec<Group> = groups.iter().skip(half).step_by(2).cloned().collect();
                bench_by(lattice, &own, views, spreads, |normal, right| priors(index, normal, right))
            });
            Vector3::from_fn(|axis, _| {
                let variance: f64 = of_one[(axis, axis)] + of_other[(axis, axis)];
                (one[axis] - other[axis]).abs() / variance.sqrt().max(1e-9)
            })
        })
        .collect();
    let measured = |axes: &[usize]| {
        let values: Vec<f64> = axes.iter().flat_map(|axis| differences.iter().map(|d| d[*axis])).collect();
        let count = values.len() as f64;
        // Half of the sizes of normal deviations are below 0.6745 sigma.
        let square = median(values).map_or(1.0, |middle| (middle / 0.6745).powi(2));
        let prior = params.scatter_prior;
        ((square * count + prior) / (count + prior)).sqrt()
    };
    let in_plane = measured(&[0, 1]);
    Vector3::new(in_plane, in_plane, measured(&[2]))
}

/// How well each bench is known.
pub(super) fn of_benches(
    normal: &Normal,
    (lattices, views): (&[Lattice], &[AdjustedView]),
    spreads: &Spreads,
    measured: &Measured,
    params: &RefinementParams,
) -> Vec<Uncertainty> {
    let scatter = measured.scatter;
    let scaled = |boxes: &BenchMatrix| BenchMatrix::from_fn(|i, j| boxes[(i, j)] * scatter[i % 3] * scatter[j % 3]);
    let mut benches_of: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
    for bench in 0..lattices.len() {
        benches_of.entry(normal.main_view(bench)).or_default().push(bench);
    }
    let found: Vec<Vec<(usize, Uncertainty)>> = benches_of
        .into_par_iter()
        .map(|(main, benches)| {
            let window = normal.window(main, params.window_views);
            let middle = benches.iter().map(|bench| lattices[*bench].terms[0]).sum::<Vector3<f64>>();
            let poses = pose_covariance(normal, &window, views, spreads, &(middle / benches.len() as f64));
            let shared_m = (params.common_share * spreads.group_px / views[main].px_per_m()).hypot(measured.common_m);
            benches
                .into_iter()
                .map(|bench| {
                    let boxes = scaled(normal.bench_alone(bench));
                    let whole = boxes + carried_covariance(normal, bench, &window, &poses);
                    (bench, Uncertainty { whole, boxes, shared_m })
                })
                .collect()
        })
        .collect();
    let mut sorted: Vec<(usize, Uncertainty)> = found.into_iter().flatten().collect();
    sorted.sort_by_key(|(bench, _)| *bench);
    sorted.into_iter().map(|(_, uncertainty)| uncertainty).collect()
}

/// Covariance of the corrections of the views of a window, without the motion of the whole.
fn pose_covariance(
    normal: &Normal,
    window: &[usize],
    views: &[AdjustedView],
    spreads: &Spreads,
    middle: &Vector3<f64>,
) -> DMatrix<f64> {
    let size = 6 * window.len();
    // In units of what a pose may err, in which all numbers are of one kind.
    let unit: Vec<Vector6<f64>> = window.iter().map(|view| views[*view].prior_scale() * spreads.pose_m).collect();
    let mut matrix = DMatrix::<f64>::zeros(size, size);
    for (i, &view) in window.iter().enumerate() {
        for (j, &other) in window.iter().enumerate() {
            if let Some(block) = normal.block(view, other) {
                let scaled = Matrix6::from_diagonal(&unit[i]) * block * Matrix6::from_diagonal(&unit[j]);
                matrix.fixed_view_mut::<6, 6>(6 * i, 6 * j).copy_from(&scaled);
            }
        }
    }
    let Some(cholesky) = matrix.cholesky() else { return DMatrix::zeros(size, size) };
    let covariance = cholesky.inverse();
    let mut motions = DMatrix::<f64>::zeros(size, 7);
    for (i, &view) in window.iter().enumerate() {
        for (k, column) in views[view].gauge(middle).iter().enumerate() {
            motions.fixed_view_mut::<6, 1>(6 * i, k).copy_from(&column.component_div(&unit[i]));
        }
    }
    let basis = motions.qr().q();
    let without = DMatrix::<f64>::identity(size, size) - &basis * basis.transpose();
    let mut covariance = &without * covariance * &without;
    for i in 0..size {
        for j in 0..size {
            covariance[(i, j)] *= unit[i / 6][i % 6] * unit[j / 6][j % 6];
        }
    }
    covariance
}

/// Covariance of a bench that the views of the window carry into it.
fn carried_covariance(normal: &Normal, bench: usize, window: &[usize], poses: &DMatrix<f64>) -> BenchMatrix {
    let mut carried = DMatrix::<f64>::zeros(PARAMS, 6 * window.len());
    for (view, solved) in normal.solved_crosses(bench) {
        if let Ok(place) = window.binary_search(&view) {
            carried.fixed_view_mut::<PARAMS, 6>(0, 6 * place).copy_from(solved);
        }
    }
    let moved = &carried * poses * carried.transpose();
    BenchMatrix::from_iterator(moved.iter().copied())
}

/// Variance of each number of each view's correction; where there are many views, as if the others were known.
pub(super) fn pose_variances(normal: &Normal, views: usize, exact_views: usize) -> Vec<Vector6<f64>> {
    if views > exact_views {
        return (0..views).into_par_iter().map(|view| normal.alone(view).diagonal()).collect();
    }
    let mut matrix = DMatrix::<f64>::zeros(6 * views, 6 * views);
    for i in 0..views {
        for j in 0..views {
            if let Some(block) = normal.block(i, j) {
                matrix.fixed_view_mut::<6, 6>(6 * i, 6 * j).copy_from(block);
            }
        }
    }
    let Some(cholesky) = matrix.cholesky() else { return vec![Vector6::zeros(); views] };
    let covariance = cholesky.inverse();
    (0..views).map(|view| Vector6::from_fn(|k, _| covariance[(6 * view + k, 6 * view + k)])).collect()
}
