//! After the adjustment every sighting is tested again in its result.
//!
//! A sighting that lies a whole number of columns and rows off the module that it was matched to belongs to that neighbour;
//! if all the sightings of a view on a bench (or of one of its pieces there) do, they are moved there together and the plant
//! is adjusted again. What lies off by no whole number shows no module of this bench and is left out.

use super::adopt::adopt;
use super::consensus::agree;
use super::exclusion::exclude;
use super::{Refined, RefinementOptions, refine};
use crate::fusion::{Fused, FusedBench, FusedModule, Observation, View};
use nalgebra::{Matrix2, Vector2};
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Columns and rows.
type Shift = (i32, i32);

/// A sighting: the index of its module in the bench, and its own among the module's observations.
type Sighting = (usize, usize);

/// Where a sighting belongs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Verdict {
    At(Shift),
    Nowhere,
}

/// Adjusts, tests every sighting in the result, moves those that belong elsewhere, and adjusts again, until nothing moves.
pub fn refine_verified(views: &[View<'_>], fused: &mut Fused, options: &RefinementOptions) -> Refined {
    if fused.camera_sigma_m.is_empty() {
        return refine(views, fused, options);
    }
    fused.benches.par_iter_mut().for_each(|bench| {
        agree(bench, &options.params);
    });
    let mut refined = refine(views, fused, options);
    for _ in 0..options.params.most_verifications {
        let moved: usize = fused
            .benches
            .par_iter_mut()
            .enumerate()
            .map(|(index, bench)| {
                let verdicts = verdicts(views, bench, &refined, index, options);
                if verdicts.is_empty() { 0 } else { replace(bench, &verdicts) }
            })
            .sum();
        if moved + adopt(views, fused, &refined, &options.params) == 0 {
            break;
        }
        refined = refine(views, fused, options);
    }
    exclude(views, fused, &mut refined, &options.params);
    refined
}

/// Sightings that do not belong where they are.
fn verdicts(
    views: &[View<'_>],
    bench: &FusedBench,
    refined: &Refined,
    index: usize,
    options: &RefinementOptions,
) -> BTreeMap<Sighting, Verdict> {
    let params = &options.params;
    let lattice = &refined.benches[index];
    let pitch = pitches(bench, refined, index);
    let mut off: BTreeMap<usize, Vec<(Sighting, Vector2<f64>)>> = BTreeMap::new();
    for (m, (module, place)) in bench.modules.iter().zip(&lattice.modules).enumerate() {
        for (k, seen) in module.observations.iter().enumerate() {
            let (camera, pose) = (&views[seen.view].shot.camera, &refined.poses[seen.view]);
            let at = |east: f64, south: f64| {
                let point = place.center_m + lattice.along * (east * pitch[0]) + lattice.across * (south * pitch[1]);
                camera.project(&pose.to_camera(&point))
            };
            let (Some(here), Some(east), Some(south)) = (at(0.0, 0.0), at(1.0, 0.0), at(0.0, 1.0)) else { continue };
            let Some(steps) = Matrix2::from_columns(&[east - here, south - here]).try_inverse() else { continue };
            let center = views[seen.view].detections.detections[seen.detection].quad.center();
            off.entry(seen.view).or_default().push(((m, k), steps * (center - here)));
        }
    }
    let mut verdicts = BTreeMap::new();
    for sightings in off.values() {
        let mut by_shift: BTreeMap<Shift, Vec<(Sighting, f64)>> = BTreeMap::new();
        for (sighting, steps) in sightings {
            let whole = steps.map(f64::round);
            by_shift.entry((whole.x as i32, whole.y as i32)).or_default().push((*sighting, (steps - whole).amax()));
        }
        for (shift, members) in by_shift {
            // One box alone may be anything; what is left of a wrong shift is left out anyway.
            let fits = members.iter().filter(|(_, rest)| *rest < params.most_rest_pitches).count() * 2 > members.len();
            if fits && shift == (0, 0) {
                continue;
            }
            let verdict =
                if fits && members.len() >= params.least_moved { Verdict::At(shift) } else { Verdict::Nowhere };
            verdicts.extend(members.iter().map(|(sighting, _)| (*sighting, verdict)));
        }
    }
    verdicts
}

/// Metres per column and per row.
pub(super) fn pitches(bench: &FusedBench, refined: &Refined, index: usize) -> [f64; 2] {
    let lattice = &refined.benches[index];
    let mut best = [None::<(i32, f64)>; 2];
    let (Some(first), Some(origin)) = (bench.modules.first(), lattice.modules.first()) else { return [1.0; 2] };
    for (module, place) in bench.modules.iter().zip(&lattice.modules) {
        let offset = place.center_m - origin.center_m;
        let steps = [module.col - first.col, module.row - first.row];
        let others = [steps[1], steps[0]];
        for axis in 0..2 {
            if others[axis] == 0 && steps[axis].abs() > best[axis].map_or(0, |(most, _)| most) {
                best[axis] = Some((steps[axis].abs(), offset.norm() / f64::from(steps[axis].abs())));
            }
        }
    }
    let fallback = lattice.module_size_m;
    [0, 1].map(|axis| best[axis].map_or(fallback[axis], |(_, pitch)| pitch))
}

/// Moves sightings to the modules that they show. Returns how many did not stay.
pub(super) fn replace(bench: &mut FusedBench, verdicts: &BTreeMap<Sighting, Verdict>) -> usize {
    let mut places: BTreeMap<(i32, i32), FusedModule> = BTreeMap::new();
    let mut moved: Vec<((i32, i32), Observation)> = Vec::new();
    for (m, module) in bench.modules.iter().enumerate() {
        let mut kept = module.clone();
        kept.observations.clear();
        for (k, seen) in module.observations.iter().enumerate() {
            match verdicts.get(&(m, k)) {
                None => kept.observations.push(*seen),
                Some(Verdict::At((cols, rows))) => moved.push(((module.row + rows, module.col + cols), *seen)),
                Some(Verdict::Nowhere) => {}
            }
        }
        places.insert((module.row, module.col), kept);
    }
    for ((row, col), seen) in moved {
        let module = places.entry((row, col)).or_insert_with(|| FusedModule {
            row,
            col,
            observations: Vec::new(),
            inferred_in: Vec::new(),
        });
        // A photo shows a module once: what stayed was right.
        if module.observations.iter().all(|other| other.view != seen.view) {
            module.observations.push(seen);
            module.observations.sort_by_key(|seen| (seen.view, seen.detection));
        }
    }
    places.retain(|_, module| !module.observations.is_empty());
    if places.len() < 2 {
        return 0;
    }
    let low = |f: fn(&(i32, i32)) -> i32| places.keys().map(f).min().unwrap_or(0);
    let (low_row, low_col) = (low(|place| place.0), low(|place| place.1));
    bench.modules = places
        .into_values()
        .map(|module| FusedModule { row: module.row - low_row, col: module.col - low_col, ..module })
        .collect();
    bench.rows = bench.modules.iter().map(|module| module.row).max().unwrap_or(0) + 1;
    bench.cols = bench.modules.iter().map(|module| module.col).max().unwrap_or(0) + 1;
    verdicts.len()
}
