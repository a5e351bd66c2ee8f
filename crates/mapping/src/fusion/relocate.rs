//! Pieces stand where their boxes and the pitch of their type put them, not where cloud or ground seem to.
//!
//! With its pitch known a piece of some columns tells its own depth: sparse points on the ground below the tables, or none
//! at all, do no harm. What neither boxes nor pitch tell is filled by weak knowledge: rows are nearly level, tables of one
//! type rise alike.

use super::piece_lattice::{Lattice, LatticeNormal, LatticeVector, PieceLattice, middle, normal_of};
use super::pitch::{BenchType, weighted_median};
use super::{FusionParams, LocatedPiece, View};
use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;

/// Puts every piece of a known type where its boxes and its pitch say.
pub(super) fn relocate(views: &[View<'_>], pieces: &mut [LocatedPiece], types: &[BenchType], params: &FusionParams) {
    let stride = pieces.len().div_ceil(params.most_sampled_pieces).max(1);
    let residuals: Vec<f64> = pieces
        .par_iter()
        .step_by(stride)
        .filter(|piece| piece.cells.len() >= 8)
        .flat_map_iter(|piece| {
            let fitted = fit(views, piece, types, params.box_sigma_px, params);
            fitted.map_or_else(Vec::new, |fitted| residuals_px(views, piece, &fitted))
        })
        .collect();
    // Half of the lengths of a normal deviation in the plane are below 1.18 sigma.
    let box_sigma_px = weighted_median(residuals.into_iter().map(|rest| (rest, 1.0)))
        .map_or(params.box_sigma_px, |rest| (rest / 1.1774).clamp(0.1, 5.0));
    pieces.par_iter_mut().for_each(|piece| {
        if let Some(fitted) = fit(views, piece, types, box_sigma_px, params) {
            settle(views, piece, fitted);
        }
    });
}

/// Lengths of what is left between boxes and lattice, pixels.
fn residuals_px(views: &[View<'_>], piece: &LocatedPiece, fitted: &PieceLattice) -> Vec<f64> {
    let shot = views[piece.view].shot;
    piece
        .cells
        .iter()
        .filter(|cell| cell.detection.is_some())
        .filter_map(|cell| {
            let position = fitted.position(f64::from(cell.col), f64::from(cell.row));
            Some((shot.camera.project(&shot.pose.to_camera(&position))? - cell.center_px).norm())
        })
        .collect()
}

/// Moves the cells along their rays to the depth of the lattice.
fn settle(views: &[View<'_>], piece: &mut LocatedPiece, fitted: PieceLattice) {
    let shot = views[piece.view].shot;
    let (center, fallback) = (shot.pose.center(), piece.pitch_m());
    for cell in &mut piece.cells {
        let position = fitted.position(f64::from(cell.col), f64::from(cell.row));
        let depth = shot.pose.to_camera(&position).z;
        let seen = shot.camera.normalised_from_pixel(cell.center_px);
        if depth > 0.1 {
            cell.position_m = center + shot.pose.direction_to_world(&Vector3::new(seen.x, seen.y, 1.0)) * depth;
        }
    }
    piece.refit(fallback);
    piece.lattice = Some(Box::new(fitted));
}

/// The lattice of a piece by its boxes, and by what else is known of its type; `None` where it is of none.
fn fit(
    views: &[View<'_>],
    piece: &LocatedPiece,
    types: &[BenchType],
    box_sigma_px: f64,
    params: &FusionParams,
) -> Option<PieceLattice> {
    if piece.cols < 2 || piece.cells.iter().filter(|cell| cell.detection.is_some()).count() < 2 {
        return None;
    }
    let shot = views[piece.view].shot;
    let by_cloud = by_positions(piece)?;
    let length = by_cloud.step_col(0.0).norm();
    let aspect = (piece.rows > 1).then(|| by_cloud.step_row().norm() / length);
    let off = |kind: &BenchType| {
        let along = (kind.pitch_m[0].unwrap_or(length) / length).ln().abs();
        let across = aspect.zip(kind.pitch_m[1]).zip(kind.pitch_m[0]);
        // Tables rise: from above their rows are nearer to each other.
        along + across.map_or(0.0, |((seen, across), along)| 0.3 * (seen * along / across).ln().abs())
    };
    let (index, kind) = types.iter().enumerate().min_by(|p, q| off(p.1).total_cmp(&off(q.1)))?;
    let pitch = kind.pitch_m[0]?;
    if (pitch / length).ln().abs() > params.type_most_off {
        return None;
    }
    let mut lattice = start(&by_cloud, pitch / length, kind, piece.rows, &shot.pose.center());
    let depth_m = shot.pose.to_camera(&by_cloud.position(0.0, 0.0)).z;
    let shared_m = params.shared_sigma_px * depth_m / shot.camera.focal_px();
    let mut covariance = None;
    for _ in 0..params.fit_rounds {
        let mut normal = normal_of(piece, shot, Some(&lattice), box_sigma_px, params.shared_sigma_px);
        add_knowledge(&mut normal, &lattice, &by_cloud, kind, piece, params);
        let (solved, of_it, _) = normal.solve()?;
        lattice = solved;
        covariance = Some(of_it);
    }
    let mut covariance = covariance?;
    let mut block = covariance.fixed_view_mut::<3, 3>(0, 0);
    block += Matrix3::identity() * (shared_m * shared_m);
    Some(PieceLattice::new(lattice, covariance, middle(piece), index))
}

/// The plane lattice through the positions of the cells.
fn by_positions(piece: &LocatedPiece) -> Option<Lattice> {
    let origin = middle(piece);
    let mut normal = Matrix3::from_diagonal(&Vector3::new(1e-9, 1e-6, 1e-6));
    let [u, v] = piece.pitch_m();
    let mut rhs = [Vector3::zeros(), Vector3::new(u.x, u.y, 0.0) * 1e-6, Vector3::new(v.x, v.y, 0.0) * 1e-6];
    for cell in &piece.cells {
        let row = Vector3::new(1.0, f64::from(cell.col) - origin[0], f64::from(cell.row) - origin[1]);
        normal += row * row.transpose();
        for (slot, factor) in rhs.iter_mut().zip(row.iter()) {
            *slot += cell.position_m * *factor;
        }
    }
    let inverse = normal.try_inverse()?;
    let term = |k: usize| rhs[0] * inverse[(k, 0)] + rhs[1] * inverse[(k, 1)] + rhs[2] * inverse[(k, 2)];
    Some(Lattice::new(term(0), term(1), term(2)))
}

/// The lattice as the cloud has it, moved along the rays until its pitch is right, its rows rising as those of its type.
fn start(by_cloud: &Lattice, scale: f64, kind: &BenchType, rows: i32, camera: &Vector3<f64>) -> Lattice {
    let origin = camera + (by_cloud.position(0.0, 0.0) - camera) * scale;
    let along = by_cloud.step_col(0.0) * scale;
    let mut across = by_cloud.step_row() * scale;
    if let Some(pitch) = kind.pitch_m[1].filter(|_| rows > 1) {
        let level = Vector3::new(along.y, -along.x, 0.0).try_normalize(1e-9).unwrap_or(-Vector3::y());
        let level = if level.dot(&across) < 0.0 { -level } else { level };
        across = level * (pitch * (1.0 - kind.rise * kind.rise).max(0.0).sqrt()) + Vector3::z() * (kind.rise * pitch);
    }
    Lattice::new(origin, along, across)
}

/// Adds what is known besides the boxes, about the present estimate.
fn add_knowledge(
    normal: &mut LatticeNormal,
    lattice: &Lattice,
    by_cloud: &Lattice,
    kind: &BenchType,
    piece: &LocatedPiece,
    params: &FusionParams,
) {
    let (u, v) = (lattice.step_col(0.0), lattice.step_row());
    let Some(pitch) = kind.pitch_m[0] else { return };
    length(normal, 3, &u, pitch, kind.sigma * pitch);
    vertical(normal, 3, by_cloud.step_col(0.0).z, params.slope_sigma * pitch);
    normal.add_vector(0, &by_cloud.position(0.0, 0.0), params.depth_sigma_m.powi(-2));
    match kind.pitch_m[1].filter(|_| piece.rows > 1) {
        Some(across) => {
            length(normal, 6, &v, across, 2.0 * kind.sigma * across);
            vertical(normal, 6, kind.rise * across, kind.rise_sigma * across);
            square(normal, &u, &v, params.square_sigma);
        }
        // One row does not show where the next would be.
        None => normal.add_vector(2, &v, 1e2),
    }
    let half = f64::from(piece.cols) / 2.0;
    let bend_m = if piece.cols >= 10 { params.bend_sigma_m } else { 1e-4 };
    normal.add_vector(3, &Vector3::zeros(), (0.01 * half * half / bend_m).powi(2));
}

/// The length of a vector of the lattice that begins at a place in its numbers.
fn length(normal: &mut LatticeNormal, at: usize, vector: &Vector3<f64>, length_m: f64, sigma_m: f64) {
    if let Some(direction) = vector.try_normalize(1e-9) {
        let mut gradient = LatticeVector::zeros();
        gradient.fixed_rows_mut::<3>(at).copy_from(&direction);
        normal.add_equation(&gradient, length_m, sigma_m.powi(-2));
    }
}

fn vertical(normal: &mut LatticeNormal, at: usize, rise_m: f64, sigma_m: f64) {
    let mut gradient = LatticeVector::zeros();
    gradient[at + 2] = 1.0;
    normal.add_equation(&gradient, rise_m, sigma_m.powi(-2));
}

fn square(normal: &mut LatticeNormal, u: &Vector3<f64>, v: &Vector3<f64>, sigma: f64) {
    let lengths = (u.norm() * v.norm()).max(1e-9);
    let mut gradient = LatticeVector::zeros();
    gradient.fixed_rows_mut::<3>(3).copy_from(&(v / lengths));
    gradient.fixed_rows_mut::<3>(6).copy_from(&(u / lengths));
    // u.v about (u0, v0) is u0.v + v0.u - u0.v0.
    normal.add_equation(&gradient, u.dot(v) / lengths, sigma.powi(-2));
}
