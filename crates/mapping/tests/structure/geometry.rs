//! Where cameras are good, geometry decides which modules are the same, whatever boxes are missing and wherever the cloud has
//! the ground; and what is matched wrongly all the same is put right after the adjustment.

use super::{Mapped, plant, views};
use heliomap_mapping::geometry::PointCloud;
use heliomap_mapping::refinement::{self, RefinementOptions};
use heliomap_simulator::{Errors, Flight, Simulation, simulate};
use nalgebra::Vector2;
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use std::collections::{BTreeMap, BTreeSet};

/// As a bundle adjustment with many tie points leaves it: cameras right to centimetres, sparse points alone.
fn good_cameras() -> Errors {
    Errors { view_disagreement_m: 0.03, drift_m: 0.05, ..Errors::paper() }.without_cloud()
}

fn flown(seed: u64) -> Simulation {
    simulate(&plant(None, seed), &Flight::plain(), &good_cameras(), seed)
}

/// Takes out all boxes in circles of some modules' width, as glare or a detector's blind spots do.
fn without_clusters(mut simulation: Simulation, seed: u64, per_view: usize, radius_px: f64) -> Simulation {
    let mut rng = StdRng::seed_from_u64(seed);
    for (image, owners) in simulation.detections.iter_mut().zip(&mut simulation.owners) {
        for _ in 0..per_view {
            if image.detections.is_empty() {
                continue;
            }
            let center = image.detections[rng.random_range(0..image.detections.len())].quad.center();
            let kept: Vec<bool> =
                image.detections.iter().map(|d| (d.quad.center() - center).norm() > radius_px).collect();
            let mut keep = kept.iter();
            image.detections.retain(|_| *keep.next().unwrap());
            let mut keep = kept.iter();
            owners.retain(|_| *keep.next().unwrap());
        }
    }
    simulation
}

/// Nothing but what no photo shows is missing, nothing is false, all stands where it should.
#[track_caller]
fn assert_exact(mapped: &Mapped, what: &str) {
    let report = mapped.report();
    let sightings = mapped.simulation.sightings();
    let missing = report.missing.iter().filter(|module| sightings[**module] > 1).count();
    assert_eq!((missing, report.false_modules.len()), (0, 0), "{what}: missing and false");
    assert!(report.wrong_structure.is_empty(), "{what}: {:?}", report.wrong_structure);
}

#[test]
fn boxes_missing_in_clusters_bend_nothing() {
    for seed in 0..4 {
        let mapped = Mapped::new(without_clusters(flown(seed), seed, 3, 90.0));
        assert!(!mapped.fused.camera_sigma_m.is_empty(), "seed {seed}: cameras were not measured");
        assert_exact(&mapped, &format!("seed {seed}"));
    }
}

#[test]
fn points_on_the_ground_or_below_it_change_nothing() {
    let simulation = flown(3);
    let points = simulation.reconstruction.sparse_points_m.clone();
    let lowered = |by_m: f32| PointCloud {
        positions_m: points.iter().map(|p| [p.x as f32, p.y as f32, p.z as f32 - by_m]).collect(),
        normals: Vec::new(),
    };
    for by_m in [0.0, 1.0, 2.0] {
        assert_exact(&Mapped::with_cloud(flown(3), &lowered(by_m)), &format!("lowered by {by_m} m"));
    }
}

/// Whether a bench is matched wrongly in a view, by their indices.
type Sabotage<'a> = Box<dyn Fn(usize, usize) -> bool + 'a>;

/// Moves what some views show of a bench by a column, as a wrong match does.
fn move_by_a_column(mapped: &mut Mapped, bench: usize, moved: impl Fn(usize) -> bool) {
    let bench = &mut mapped.fused.benches[bench];
    let mut taken = BTreeMap::new();
    for module in &mut bench.modules {
        for seen in module.observations.iter().filter(|seen| moved(seen.view)) {
            taken.insert((module.row, module.col + 1, seen.view), *seen);
        }
        module.observations.retain(|seen| !moved(seen.view));
    }
    for ((row, col, _), seen) in taken {
        if let Some(module) = bench.modules.iter_mut().find(|module| (module.row, module.col) == (row, col)) {
            module.observations.push(seen);
            module.observations.sort_by_key(|seen| seen.view);
        }
    }
    bench.modules.retain(|module| !module.observations.is_empty());
}

#[test]
fn wrong_matches_are_put_right_after_the_adjustment() {
    let sound = Mapped::new(flown(2));
    assert_exact(&sound, "before");
    let seen_in = |bench: usize| -> Vec<usize> {
        let seen = sound.fused.benches[bench].modules.iter().flat_map(|m| m.observations.iter().map(|o| o.view));
        seen.collect::<BTreeSet<usize>>().into_iter().collect()
    };
    let benches: Vec<usize> =
        (0..sound.fused.benches.len()).filter(|bench| seen_in(*bench).len() >= 5).take(4).collect();
    assert!(benches.len() >= 2);
    let whole_view = seen_in(benches[0])[1];
    let sabotages: Vec<(&str, Sabotage<'_>)> = vec![
        ("one view on one bench", Box::new(|bench, view| bench == benches[0] && view == whole_view)),
        ("one view", Box::new(|_, view| view == whole_view)),
        (
            "nearly half the views",
            Box::new(|bench, view| {
                let views = seen_in(bench);
                views.iter().position(|v| *v == view).is_some_and(|k| k < (views.len() - 1) / 2)
            }),
        ),
    ];
    for (name, moved) in sabotages {
        let mut wrong = Mapped::new(flown(2));
        for &bench in &benches {
            move_by_a_column(&mut wrong, bench, |view| moved(bench, view));
        }
        let views = views(&wrong.simulation, &wrong.layouts);
        let refined = refinement::refine_verified(&views, &mut wrong.fused, &RefinementOptions::default());
        for (view, (one, other)) in sound.refined.poses.iter().zip(&refined.poses).enumerate() {
            let moved_m = (one.center() - other.center()).norm();
            assert!(moved_m < 0.05, "{name}: view {view} moved by {moved_m} m");
        }
        for &bench in &benches {
            let middle = |mapped: &refinement::Refined| {
                let modules = &mapped.benches[bench].modules;
                modules.iter().map(|m| m.center_m.xy()).sum::<Vector2<f64>>() / modules.len() as f64
            };
            let off_m = (middle(&sound.refined) - middle(&refined)).norm();
            assert!(off_m < 0.7, "{name}: bench {bench} is {off_m} m off");
            let again = |fused: &heliomap_mapping::fusion::Fused| {
                fused.benches[bench].modules.iter().map(|m| m.observations.len()).sum::<usize>()
            };
            let (before, after) = (again(&sound.fused), again(&wrong.fused));
            assert!(after * 20 >= before * 19, "{name}: bench {bench} keeps {after} of {before} sightings");
        }
    }
}
