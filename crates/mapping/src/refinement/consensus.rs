//! Before the adjustment: views that show a bench some whole columns or rows off all others are moved to where those have it.
//!
//! Where cameras are good, every view alone knows the place of what it shows to a fraction of a module. The views that most
//! others agree with are right; an adjustment of all together would look for a compromise instead.

use super::RefinementParams;
use super::verify::{Verdict, replace};
use crate::fusion::FusedBench;
use nalgebra::{Matrix2, Vector2};
use std::collections::BTreeMap;

/// Places of what each view shows, by row and column, metres east and north.
type Shown = BTreeMap<usize, BTreeMap<(i32, i32), Vector2<f64>>>;

/// Moves what views show of a bench to where most have it. Returns how many sightings moved.
pub(super) fn agree(bench: &mut FusedBench, params: &RefinementParams) -> usize {
    let most_rest = params.most_rest_pitches;
    let [u, v] = bench.pitch_m;
    let Some(steps) = Matrix2::from_columns(&[u, v]).try_inverse() else { return 0 };
    let mut shown = Shown::new();
    for module in &bench.modules {
        for seen in &module.observations {
            shown.entry(seen.view).or_default().insert((module.row, module.col), steps * seen.position_m.xy());
        }
    }
    let views: Vec<usize> = shown.keys().copied().collect();
    // By how many columns and rows each view lies off each other, where both show the same modules.
    let mut off: BTreeMap<(usize, usize), Vector2<f64>> = BTreeMap::new();
    for &from in &views {
        for &to in &views {
            if let Some(between) = median_off(&shown[&from], &shown[&to], params.least_common).filter(|_| from != to) {
                off.insert((from, to), between);
            }
        }
    }
    let agrees = |from: usize, to: usize| off.get(&(from, to)).is_some_and(|off| off.amax() < most_rest);
    let support = |view: usize| -> usize {
        views.iter().filter(|other| **other == view || agrees(view, **other)).map(|other| shown[other].len()).sum()
    };
    let Some(&reference) = views.iter().max_by_key(|view| (support(**view), std::cmp::Reverse(**view))) else {
        return 0;
    };
    let sound: Vec<usize> =
        views.iter().copied().filter(|view| *view == reference || agrees(reference, *view)).collect();
    let mut moves: BTreeMap<usize, (i32, i32)> = BTreeMap::new();
    for &view in views.iter().filter(|view| !sound.contains(view)) {
        // All sound views that can tell must tell the same.
        let told: Vec<Vector2<f64>> = sound.iter().filter_map(|other| off.get(&(*other, view)).copied()).collect();
        let Some(whole) = told.first().map(|off| off.map(f64::round)) else { continue };
        if whole.amax() >= 1.0 && told.iter().all(|off| (off - whole).amax() < most_rest) {
            moves.insert(view, (whole.x as i32, whole.y as i32));
        }
    }
    let mut verdicts = BTreeMap::new();
    for (m, module) in bench.modules.iter().enumerate() {
        for (k, seen) in module.observations.iter().enumerate() {
            if let Some(shift) = moves.get(&seen.view) {
                verdicts.insert((m, k), Verdict::At(*shift));
            }
        }
    }
    if verdicts.is_empty() { 0 } else { replace(bench, &verdicts) }
}

/// Median of where one view has the modules that another shows too, less where that has them, in columns and rows.
fn median_off(
    from: &BTreeMap<(i32, i32), Vector2<f64>>,
    to: &BTreeMap<(i32, i32), Vector2<f64>>,
    least_common: usize,
) -> Option<Vector2<f64>> {
    let common: Vec<Vector2<f64>> = to.iter().filter_map(|(place, at)| Some(at - from.get(place)?)).collect();
    if common.len() < least_common {
        return None;
    }
    let median = |axis: usize| super::lattice::median(common.iter().map(|off| off[axis]).collect());
    Some(Vector2::new(median(0)?, median(1)?))
}
