//! How well the adjustment knows what it estimates.
//!
//! Errors of neighbouring modules go together, for their views err together: the covariance of a bench holds what its
//! boxes leave open and what the corrections of its views leave open, these with all their correlations. For each view
//! the views that share most with it are taken as a window; those outside count as known. Where the whole window stands,
//! how it is turned and what its scale is cannot be told from images (GNSS tells, and control points), so these seven are
//! taken out: what is stated is how far a module may stand off relative to the plant around it.
//!
//! Boxes err alike in all views, too: a detector sees the edge of a table otherwise than a seam, from wherever it looks.
//! Of that residuals tell nothing. It is taken to be half as large as what differs from view to view.

use super::lattice::{BenchMatrix, Lattice, PARAMS};
use super::normal::{Normal, Spreads};
use super::views::AdjustedView;
use nalgebra::{DMatrix, Matrix6, Vector3, Vector6};
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Most views in a window.
const WINDOW: usize = 20;
/// Up to this many views the variance of their corrections is taken exactly.
const EXACT_VIEWS: usize = 60;

/// How well a bench is known: covariances of its lattice (origin, steps, bend).
pub(super) struct Uncertainty {
    /// In all, but for what its boxes have in common in all views.
    pub(super) whole: BenchMatrix,
    /// If all views were known.
    pub(super) boxes: BenchMatrix,
    /// What its boxes may have in common, metres on the ground.
    pub(super) shared_m: f64,
}

/// How well each bench is known.
pub(super) fn of_benches(
    normal: &Normal,
    lattices: &[Lattice],
    views: &[AdjustedView],
    spreads: &Spreads,
) -> Vec<Uncertainty> {
    let mut benches_of: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
    for bench in 0..lattices.len() {
        benches_of.entry(normal.main_view(bench)).or_default().push(bench);
    }
    let found: Vec<Vec<(usize, Uncertainty)>> = benches_of
        .into_par_iter()
        .map(|(main, benches)| {
            let window = normal.window(main, WINDOW);
            let middle = benches.iter().map(|bench| lattices[*bench].terms[0]).sum::<Vector3<f64>>();
            let poses = pose_covariance(normal, &window, views, spreads, &(middle / benches.len() as f64));
            let shared_m = 0.5 * spreads.group_px / views[main].px_per_m();
            benches
                .into_iter()
                .map(|bench| {
                    let boxes = *normal.bench_alone(bench);
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
pub(super) fn pose_variances(normal: &Normal, views: usize) -> Vec<Vector6<f64>> {
    if views > EXACT_VIEWS {
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
