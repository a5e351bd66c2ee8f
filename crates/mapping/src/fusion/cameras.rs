//! How well the cameras agree, measured without trusting any match.
//!
//! Where two views show one bench, its lattice by the one and by the other disagree by whole columns and rows, which a match
//! may get wrong, and by a rest, which is the error of the cameras. Only the rest is looked at here (a phase, as in GNSS).

use super::pitch::weighted_median;
use super::{FusionParams, LocatedPiece};
use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Standard deviations of what the cameras displace on the ground.
#[derive(Debug, Clone)]
pub(super) struct CameraQuality {
    /// One per view, metres.
    pub(super) sigma_m: Vec<f64>,
    /// The typical view's, metres.
    pub(super) typical_m: f64,
    /// Shares of a pitch that the rests of all pairs take, one standard deviation: 0.29 where they are mere chance.
    pub(super) pitches: f64,
}

impl CameraQuality {
    /// Standard deviation of the disagreement of two views, metres.
    pub(super) fn between(&self, a: usize, b: usize) -> f64 {
        self.sigma_m[a].hypot(self.sigma_m[b])
    }
}

/// The disagreement of two pieces up to whole columns and rows.
struct Rest {
    views: (usize, usize),
    /// Length in the plane of the bench, less what boxes and pitch explain, squared metres; and as a share of the pitch.
    square_m2: f64,
    pitches: f64,
}

/// Measures all views; `None` where no two show the same ground.
pub(super) fn measure(
    views: usize,
    pieces: &[LocatedPiece],
    near: &[(usize, usize)],
    params: &FusionParams,
) -> Option<CameraQuality> {
    let rests: Vec<Rest> = near.par_iter().filter_map(|&(a, b)| rest(&pieces[a], &pieces[b])).collect();
    let mut by_views: BTreeMap<(usize, usize), Vec<f64>> = BTreeMap::new();
    for rest in &rests {
        by_views.entry(rest.views).or_default().push(rest.square_m2);
    }
    // Half of the squared lengths of a normal deviation in the plane are below 1.386 variances.
    let median = |values: &[f64]| weighted_median(values.iter().map(|value| (*value, 1.0))).unwrap_or(0.0) / 1.386;
    let least = params.camera_least_m * params.camera_least_m;
    let squares: BTreeMap<(usize, usize), f64> = by_views
        .iter()
        .filter(|(_, squares)| squares.len() >= params.camera_least_pairs)
        .map(|(views, squares)| (*views, median(squares).max(2.0 * least)))
        .collect();
    let all: Vec<f64> = rests.iter().map(|rest| rest.square_m2).collect();
    let pitches: Vec<f64> = rests.iter().map(|rest| rest.pitches * rest.pitches).collect();
    if rests.is_empty() {
        return None;
    }
    let typical = (median(&all) / 2.0).max(least);
    let mut partners: Vec<Vec<(usize, f64)>> = vec![Vec::new(); views];
    for (&(a, b), &square) in &squares {
        partners[a].push((b, square));
        partners[b].push((a, square));
    }
    let mut variances = vec![typical; views];
    for _ in 0..6 {
        variances = (0..views)
            .map(|view| {
                let own = partners[view].iter().map(|&(other, square)| ((square - variances[other]).max(least), 1.0));
                let prior = std::iter::once((typical, params.camera_prior_pairs));
                weighted_median(own.chain(prior)).unwrap_or(typical)
            })
            .collect();
    }
    Some(CameraQuality {
        sigma_m: variances.into_iter().map(f64::sqrt).collect(),
        typical_m: typical.sqrt(),
        pitches: (median(&pitches) / 2.0).sqrt(),
    })
}

/// Compares two pieces at the middle of the first.
fn rest(a: &LocatedPiece, b: &LocatedPiece) -> Option<Rest> {
    let (first, second) = (a.lattice.as_ref()?, b.lattice.as_ref()?);
    if a.view == b.view || first.kind != second.kind || a.rows != b.rows {
        return None;
    }
    let at = [f64::from(a.cols / 2), f64::from(a.rows / 2)];
    let position = first.position(at[0], at[1]);
    let place = b.ground.coordinate(position.xy())?;
    let (col, row) = (place.x.round(), place.y.round());
    if !(0.0..=f64::from(b.cols - 1)).contains(&col) || !(-0.5..=f64::from(b.rows) - 0.5).contains(&place.y) {
        return None;
    }
    let off: Vector3<f64> = second.position(col, row) - position;
    let known: Matrix3<f64> = first.covariance(at[0], at[1]) + second.covariance(col, row);
    let [u, _] = b.pitch_m();
    let square_m2 = (off.xy().norm_squared() - known[(0, 0)] - known[(1, 1)]).max(0.0);
    let along = off.xy().dot(&u) / u.norm_squared();
    Some(Rest { views: (a.view.min(b.view), a.view.max(b.view)), square_m2, pitches: along.abs() * 1.177 / 0.6745 })
}
