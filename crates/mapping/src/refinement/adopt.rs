//! After the adjustment, what no bench took is tested against it.
//!
//! The association leaves out pieces whose place was not sure when cameras and heights were. Now the places of all modules are
//! known to centimetres: a piece whose boxes nearly all lie on modules of one bench shows that bench.

use super::verify::pitches;
use super::{Refined, RefinementParams};
use crate::fusion::{Fused, FusedBench, Observation, View};
use nalgebra::{Matrix2, Vector2};
use rayon::prelude::*;
use rstar::RTree;
use rstar::primitives::GeomWithData;
use std::collections::{BTreeMap, BTreeSet, HashSet};

/// A module as a view shows it: its place in the image, and columns and rows per pixel about it.
struct Shown {
    bench: usize,
    module: usize,
    steps_per_px: Matrix2<f64>,
}

type ShownAt = GeomWithData<[f64; 2], Shown>;

/// A box on a module that has none of its view.
struct Adopted {
    bench: usize,
    module: usize,
    seen: Observation,
}

/// Gives pieces that no bench took to the one that they show, and drops the doubts about them. Returns how many boxes found
/// their module.
pub(super) fn adopt(views: &[View<'_>], fused: &mut Fused, refined: &Refined, params: &RefinementParams) -> usize {
    let used: HashSet<(usize, usize)> = fused.benches.iter().flat_map(FusedBench::sightings).collect();
    let adopted: Vec<Adopted> = {
        let benches = &fused.benches;
        let of_view = |view: usize| of_view(view, views, benches, refined, &used, params);
        (0..views.len()).into_par_iter().flat_map_iter(of_view).collect()
    };
    let count = adopted.len();
    for Adopted { bench, module, seen } in adopted {
        let observations = &mut fused.benches[bench].modules[module].observations;
        if observations.iter().all(|other| other.view != seen.view) {
            observations.push(seen);
            observations.sort_by_key(|seen| (seen.view, seen.detection));
        }
    }
    if count > 0 {
        let used: HashSet<(usize, usize)> = fused.benches.iter().flat_map(FusedBench::sightings).collect();
        fused.doubts.retain(|doubt| {
            let settled = doubt.sightings.iter().filter(|seen| used.contains(seen)).count() as f64;
            doubt.sightings.is_empty() || settled < params.adopted_share * doubt.sightings.len() as f64
        });
    }
    count
}

fn of_view(
    view: usize,
    views: &[View<'_>],
    benches: &[FusedBench],
    refined: &Refined,
    used: &HashSet<(usize, usize)>,
    params: &RefinementParams,
) -> Vec<Adopted> {
    let View { detections, layout, .. } = views[view];
    let free: Vec<Vec<usize>> = layout
        .pieces
        .iter()
        .map(|piece| piece.detected().map(|(_, box_)| box_).filter(|box_| !used.contains(&(view, *box_))).collect())
        .filter(|free: &Vec<usize>| free.len() >= params.least_moved)
        .collect();
    if free.is_empty() {
        return Vec::new();
    }
    let tree = RTree::bulk_load(shown_in(view, views, benches, refined));
    let mut adopted = Vec::new();
    for piece in free {
        let mut of_bench: BTreeMap<usize, BTreeMap<usize, usize>> = BTreeMap::new();
        for &box_ in &piece {
            let center = detections.detections[box_].quad.center();
            let Some(near) = tree.nearest_neighbor([center.x, center.y]) else { continue };
            let steps = near.data.steps_per_px * (center - Vector2::from(*near.geom()));
            if steps.amax() < params.most_rest_pitches {
                of_bench.entry(near.data.bench).or_default().insert(near.data.module, box_);
            }
        }
        let Some((bench, found)) = of_bench.into_iter().max_by_key(|(_, found)| found.len()) else { continue };
        if found.len() < params.least_moved || (found.len() as f64) < params.adopted_share * piece.len() as f64 {
            continue;
        }
        adopted.extend(found.into_iter().map(|(module, detection)| {
            let position_m = refined.benches[bench].modules[module].center_m;
            Adopted { bench, module, seen: Observation { view, detection, position_m, cloud_m: None } }
        }));
    }
    adopted
}

/// All modules that a view shows or nearly shows and has no box of, of benches that it shows elsewhere or not.
fn shown_in(view: usize, views: &[View<'_>], benches: &[FusedBench], refined: &Refined) -> Vec<ShownAt> {
    let (camera, pose) = (&views[view].shot.camera, &refined.poses[view]);
    let size = Vector2::new(f64::from(camera.width_px), f64::from(camera.height_px));
    let mut shown = Vec::new();
    for (index, bench) in benches.iter().enumerate() {
        let lattice = &refined.benches[index];
        let pitch = pitches(bench, refined, index);
        let has_box: BTreeSet<usize> = (0..bench.modules.len())
            .filter(|module| bench.modules[*module].observations.iter().any(|seen| seen.view == view))
            .collect();
        for (module, place) in lattice.modules.iter().enumerate().filter(|(module, _)| !has_box.contains(module)) {
            let at = |east: f64, south: f64| {
                let point = place.center_m + lattice.along * (east * pitch[0]) + lattice.across * (south * pitch[1]);
                camera.project(&pose.to_camera(&point))
            };
            let Some(here) = at(0.0, 0.0).filter(|p| p.x > 0.0 && p.y > 0.0 && p.x < size.x && p.y < size.y) else {
                continue;
            };
            let (Some(east), Some(south)) = (at(1.0, 0.0), at(0.0, 1.0)) else { continue };
            let Some(steps_per_px) = Matrix2::from_columns(&[east - here, south - here]).try_inverse() else {
                continue;
            };
            shown.push(GeomWithData::new([here.x, here.y], Shown { bench: index, module, steps_per_px }));
        }
    }
    shown
}
