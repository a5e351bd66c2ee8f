//! Benches of one type share the spacing of their modules.

use super::RefinementParams;
use super::lattice::{BenchMatrix, BenchVector, Lattice, median};
use crate::fusion::FusedBench;

/// What the type of a bench says of its spacing.
#[derive(Debug, Clone)]
pub(super) struct Spacing {
    /// Which type, by number.
    kind: usize,
    /// Pitch along and across the row, metres; `None` where the bench has no second column or row, or the type no second
    /// bench.
    pitch_m: [Option<f64>; 2],
    /// How much the bench counts when its type's pitch is taken: columns and rows that it has of it.
    weight: [f64; 2],
}

impl Spacing {
    /// Adds the shared pitch as an observation of the lengths of the steps.
    pub(super) fn prior(&self, lattice: &Lattice, sigma: f64, normal: &mut BenchMatrix, right: &mut BenchVector) {
        for (axis, pitch_m) in self.pitch_m.iter().enumerate() {
            let Some(pitch_m) = pitch_m else { continue };
            let step = lattice.terms[1 + axis];
            let Some(direction) = step.try_normalize(1e-9) else { continue };
            let weight = 1.0 / (sigma * pitch_m).powi(2);
            let rest = pitch_m - step.norm();
            let at = 3 * (1 + axis);
            for i in 0..3 {
                right[at + i] += weight * direction[i] * rest;
                for j in 0..=i {
                    normal[(at + i, at + j)] += weight * direction[i] * direction[j];
                }
            }
        }
    }
}

/// Sorts benches into types by their first lattices. Nothing is shared yet.
pub(super) fn types(benches: &[FusedBench], lattices: &[Lattice], params: &RefinementParams) -> Vec<Spacing> {
    let most = 1.0 + params.type_alike;
    let pitches: Vec<[f64; 2]> =
        lattices.iter().map(|lattice| [lattice.step_col().norm(), lattice.step_row().norm()]).collect();
    let mut order: Vec<usize> = (0..benches.len()).collect();
    order.sort_by(|&i, &j| pitches[i][0].total_cmp(&pitches[j][0]).then(i.cmp(&j)));
    // Runs of alike pitches along the row, each then cut by the pitch across.
    let mut kind_of = vec![0; benches.len()];
    let mut kinds = 0;
    for run in order.chunk_by(|&i, &j| pitches[j][0] < pitches[i][0] * most) {
        for rows in [true, false] {
            let mut members: Vec<usize> = run.iter().copied().filter(|k| (benches[*k].rows > 1) == rows).collect();
            members.sort_by(|&i, &j| pitches[i][1].total_cmp(&pitches[j][1]).then(i.cmp(&j)));
            // The pitch across of a single row is a guess.
            let alike = |i: &usize, j: &usize| !rows || pitches[*j][1] < pitches[*i][1] * most;
            for group in members.chunk_by(alike) {
                for &bench in group {
                    kind_of[bench] = kinds;
                }
                kinds += 1;
            }
        }
    }
    benches
        .iter()
        .zip(kind_of)
        .map(|(bench, kind)| Spacing {
            kind,
            pitch_m: [None; 2],
            weight: [f64::from(bench.cols - 1), f64::from(bench.rows - 1)],
        })
        .collect()
}

/// Takes each type's pitch anew from the present lattices: the median of its benches.
pub(super) fn update(spacings: &mut [Spacing], lattices: &[Lattice], params: &RefinementParams) {
    let kinds = spacings.iter().map(|spacing| spacing.kind + 1).max().unwrap_or(0);
    for axis in 0..2 {
        let mut members: Vec<Vec<(f64, f64)>> = vec![Vec::new(); kinds];
        for (spacing, lattice) in spacings.iter().zip(lattices) {
            if spacing.weight[axis] > 0.0 {
                members[spacing.kind].push((lattice.terms[1 + axis].norm(), spacing.weight[axis]));
            }
        }
        let pitches: Vec<Option<f64>> =
            members.into_iter().map(|members| shared_pitch(members, params.type_alike)).collect();
        for spacing in spacings.iter_mut() {
            spacing.pitch_m[axis] = pitches[spacing.kind].filter(|_| spacing.weight[axis] > 0.0);
        }
    }
}

/// The mean pitch of a type by the number of steps of each bench squared, of those near the median; `None` for a bench
/// alone.
fn shared_pitch(members: Vec<(f64, f64)>, alike: f64) -> Option<f64> {
    if members.len() < 2 {
        return None;
    }
    let middle = median(members.iter().map(|(pitch, _)| *pitch).collect())?;
    let near: Vec<(f64, f64)> = members.into_iter().filter(|(pitch, _)| (pitch / middle - 1.0).abs() < alike).collect();
    let weight: f64 = near.iter().map(|(_, steps)| steps * steps).sum();
    Some(near.iter().map(|(pitch, steps)| pitch * steps * steps).sum::<f64>() / weight)
}
