//! The pitch of each type of bench, measured without trusting any match.
//!
//! Two pieces that show the same bench, triangulated under the true shift, give the true pitch; a shift that is wrong by
//! `s` columns puts the bench at another height and changes the pitch by about `s` times pitch over base. Over many pairs
//! with bases of different lengths the true pitches agree and the wrong ones scatter: the mode is the pitch.

use super::piece_lattice::{Lattice, LatticeNormal, middle, normal_of};
use super::{FusionParams, LocatedPiece, View};
use nalgebra::Vector3;
use rayon::prelude::*;

/// Modules side by side in rows, all with the same pitch: one type of bench.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct BenchType {
    /// Distance of neighbouring columns and rows in the reconstruction's scale, metres; that of rows is `None` where the
    /// benches have one row.
    pub(super) pitch_m: [Option<f64>; 2],
    /// Relative standard deviation of either.
    pub(super) sigma: f64,
    /// Height of the next row above this one, as the sine of the tilt, and its standard deviation from bench to bench.
    pub(super) rise: f64,
    pub(super) rise_sigma: f64,
    /// Pairs of pieces that agree with it.
    pub(super) pairs: usize,
}

/// What one pair gives under one shift.
#[derive(Debug, Clone, Copy)]
struct Vote {
    pair: usize,
    pitch_m: [f64; 2],
    /// Whether the pieces have rows enough to show the pitch across.
    rows: bool,
    rise: f64,
    weight: f64,
    /// Pitch by the positions of `locate`, metres.
    roughly_m: f64,
}

/// The types of bench, the most frequent first; empty where cameras or boxes are too poor for pitches to agree.
pub(super) fn types(
    views: &[View<'_>],
    pieces: &[LocatedPiece],
    near: &[(usize, usize)],
    params: &FusionParams,
) -> Vec<BenchType> {
    let chosen = pairs_with_base(views, pieces, near, params);
    let normals: Vec<Option<LatticeNormal>> = {
        let mut wanted = vec![false; pieces.len()];
        for &(a, b) in &chosen {
            wanted[a] = true;
            wanted[b] = true;
        }
        pieces
            .par_iter()
            .zip(wanted)
            .map(|(piece, wanted)| {
                wanted.then(|| normal_of(piece, views[piece.view].shot, None, params.box_sigma_px, 0.0))
            })
            .collect()
    };
    let votes: Vec<Vote> = chosen
        .par_iter()
        .enumerate()
        .flat_map_iter(|(pair, &(a, b))| match (&normals[a], &normals[b]) {
            (Some(first), Some(second)) => votes_of(pair, &pieces[a], first, &pieces[b], second, params),
            _ => Vec::new(),
        })
        .collect();
    let mut voters: Vec<usize> = votes.iter().map(|vote| vote.pair).collect();
    voters.dedup();
    modes(votes, voters.len(), params)
}

/// Pairs of long pieces of different views whose rays meet at an angle, spread evenly over all there are.
fn pairs_with_base(
    views: &[View<'_>],
    pieces: &[LocatedPiece],
    near: &[(usize, usize)],
    params: &FusionParams,
) -> Vec<(usize, usize)> {
    let long = |piece: &LocatedPiece| {
        piece.cells.iter().filter(|c| c.detection.is_some()).count() >= params.pitch_least_boxes && piece.cols >= 4
    };
    let good: Vec<(usize, usize)> = near
        .iter()
        .copied()
        .filter(|&(a, b)| {
            let (first, second) = (&pieces[a], &pieces[b]);
            let at = first.cells[first.cells.len() / 2].position_m;
            let ray = |piece: &LocatedPiece| at - views[piece.view].shot.pose.center();
            first.view != second.view
                && long(first)
                && long(second)
                && ray(first).angle(&ray(second)) > params.pitch_least_angle_rad
        })
        .collect();
    let stride = good.len().div_ceil(params.pitch_most_pairs).max(1);
    good.into_iter().step_by(stride).collect()
}

/// Triangulates a pair under every shift that is possible.
fn votes_of(
    pair: usize,
    a: &LocatedPiece,
    first: &LatticeNormal,
    b: &LocatedPiece,
    second: &LatticeNormal,
    params: &FusionParams,
) -> Vec<Vote> {
    let (from, to) = (middle(a), middle(b));
    let [u, v] = a.pitch_m();
    let Some(at) = b.ground.coordinate(a.middle()) else { return Vec::new() };
    // Coordinates of `b` less those of `a`, both counted from the middle of the piece.
    let float = [at.x - to[0], at.y - to[1]];
    let reach = [params.pitch_reach_m / u.norm(), (params.pitch_reach_m / v.norm()).min(2.0)];
    let span = |axis: usize| {
        // Whole shifts of columns are whole numbers plus what the two middles differ by.
        let rest = (from[axis] - to[axis]).rem_euclid(1.0);
        let low = (float[axis] - reach[axis] - rest).ceil() as i32;
        let high = (float[axis] + reach[axis] - rest).floor() as i32;
        (low..=high).map(move |k| f64::from(k) + rest)
    };
    let middle_cell = a.cells[a.cells.len() / 2].position_m;
    let start = Lattice::new(middle_cell, Vector3::new(u.x, u.y, 0.0), Vector3::new(v.x, v.y, 0.0));
    let mut votes = Vec::new();
    for cols in span(0) {
        let overlap = (0.5 * f64::from(a.cols)).min(0.5 * f64::from(b.cols) - cols)
            - (-0.5 * f64::from(a.cols)).max(-0.5 * f64::from(b.cols) - cols);
        if overlap < 0.4 * f64::from(a.cols.min(b.cols)) {
            continue;
        }
        for rows in span(1) {
            let mut sum = first.clone();
            sum.add_shifted(second, cols, rows);
            priors(&mut sum, &start, a.rows.max(b.rows) == 1, params);
            let Some((lattice, left)) = sum.solve_alone() else { continue };
            let per_equation = left / (sum.count as f64 - 9.0).max(1.0);
            if per_equation > params.pitch_most_residual {
                continue;
            }
            let (step_col, step_row) = (lattice.step_col(0.0), lattice.step_row());
            votes.push(Vote {
                pair,
                pitch_m: [step_col.norm(), step_row.norm()],
                rows: a.rows.min(b.rows) > 1,
                rise: step_row.z / step_row.norm(),
                weight: 1.0 / (1.0 + per_equation),
                roughly_m: u.norm(),
            });
        }
    }
    votes
}

/// What keeps a lattice of two views determined: it is straight, its steps are at right angles, and it stands within
/// metres of where the cloud says.
fn priors(normal: &mut LatticeNormal, start: &Lattice, one_row: bool, params: &FusionParams) {
    let origin = start.position(0.0, 0.0);
    normal.add_vector(0, &origin, params.depth_sigma_m.powi(-2));
    normal.add_vector(3, &Vector3::zeros(), 1e6);
    let (u, v) = (start.step_col(0.0), start.step_row());
    if one_row {
        normal.add_vector(2, &v, 1e4);
    } else {
        normal.add_vector(2, &v, 1.0);
    }
    normal.add_vector(1, &u, 1e-2);
}

/// The pitches at which votes pile up.
fn modes(mut votes: Vec<Vote>, pairs: usize, params: &FusionParams) -> Vec<BenchType> {
    let mut found = Vec::new();
    let mut left = pairs;
    let least = params.pitch_least_pairs.max((params.pitch_least_share * pairs as f64) as usize);
    while found.len() < params.most_types {
        votes.sort_by(|p, q| p.pitch_m[0].total_cmp(&q.pitch_m[0]).then(p.pair.cmp(&q.pair)));
        let Some((kind, explained)) = mode(&votes, params) else { break };
        if kind.pairs < least || (kind.pairs as f64) < params.pitch_agreeing_share * left as f64 {
            break;
        }
        left -= explained.len().min(left);
        votes.retain(|vote| explained.binary_search(&vote.pair).is_err());
        found.push(kind);
    }
    found
}

/// The densest pitch, with the pairs near it.
fn mode(votes: &[Vote], params: &FusionParams) -> Option<(BenchType, Vec<usize>)> {
    let width = params.pitch_window;
    let mut best: Option<(f64, usize, usize)> = None;
    let mut end = 0;
    let mut weight = 0.0;
    // How far a pitch lies from that by the cloud says which of two equal piles is real.
    let value = |vote: &Vote| {
        let off = (vote.pitch_m[0] / vote.roughly_m).ln() / params.pitch_rough_sigma;
        vote.weight / (1.0 + off * off)
    };
    for start in 0..votes.len() {
        while end < votes.len() && votes[end].pitch_m[0] <= votes[start].pitch_m[0] * (1.0 + width) {
            weight += value(&votes[end]);
            end += 1;
        }
        if best.is_none_or(|(most, _, _)| weight > most) {
            best = Some((weight, start, end));
        }
        weight -= value(&votes[start]);
    }
    let (_, start, end) = best?;
    let members = &votes[start..end];
    let along = weighted_median(members.iter().map(|vote| (vote.pitch_m[0], vote.weight)))?;
    let with_rows: Vec<&Vote> = members.iter().filter(|vote| vote.rows).collect();
    let across = densest(with_rows.iter().map(|vote| vote.pitch_m[1]).collect(), 2.0 * width);
    let agree: Vec<&&Vote> = with_rows
        .iter()
        .filter(|vote| across.is_some_and(|m| (vote.pitch_m[1] / m - 1.0).abs() < 4.0 * width))
        .collect();
    let rise = weighted_median(agree.iter().map(|vote| (vote.rise, vote.weight))).unwrap_or(0.0);
    let spread = weighted_median(agree.iter().map(|vote| ((vote.rise - rise).abs(), vote.weight))).unwrap_or(0.3);
    let off = weighted_median(members.iter().map(|vote| ((vote.pitch_m[0] / along - 1.0).abs(), vote.weight)))?;
    let mut explained: Vec<usize> =
        votes.iter().filter(|vote| (vote.pitch_m[0] / along - 1.0).abs() < 2.0 * width).map(|vote| vote.pair).collect();
    explained.sort_unstable();
    explained.dedup();
    let mut pairs: Vec<usize> = members.iter().map(|vote| vote.pair).collect();
    pairs.sort_unstable();
    pairs.dedup();
    let kind = BenchType {
        pitch_m: [Some(along), across],
        sigma: (1.4826 * off).max(params.pitch_least_sigma),
        rise,
        rise_sigma: (1.4826 * spread).max(params.rise_least_sigma),
        pairs: pairs.len(),
    };
    Some((kind, explained))
}

/// The middle of the densest window of a relative width.
fn densest(mut values: Vec<f64>, width: f64) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    let mut best = (0, 0.0);
    let mut end = 0;
    for start in 0..values.len() {
        while end < values.len() && values[end] <= values[start] * (1.0 + width) {
            end += 1;
        }
        if end - start > best.0 {
            best = (end - start, values[usize::midpoint(start, end - 1)]);
        }
    }
    (best.0 > 0).then_some(best.1)
}

/// The value below which half of the weight lies.
pub(super) fn weighted_median(values: impl Iterator<Item = (f64, f64)>) -> Option<f64> {
    let mut values: Vec<(f64, f64)> = values.filter(|(value, _)| value.is_finite()).collect();
    values.sort_by(|p, q| p.0.total_cmp(&q.0));
    let total: f64 = values.iter().map(|(_, weight)| weight).sum();
    let mut sum = 0.0;
    values.into_iter().find_map(|(value, weight)| {
        sum += weight;
        (2.0 * sum >= total).then_some(value)
    })
}
