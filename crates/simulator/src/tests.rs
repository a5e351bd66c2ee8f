//! The simulator keeps what it promises.

use super::*;
use nalgebra::{Vector2, Vector3};
use rand::{SeedableRng, rngs::StdRng};
use std::collections::BTreeMap;

fn rng(seed: u64) -> StdRng {
    StdRng::seed_from_u64(seed)
}

/// The truth as a perfect mapping would report it, moved by `place`.
fn perfect(truth: &PlantTruth, place: impl Fn(Vector3<f64>) -> Vector3<f64>) -> Vec<FoundModule> {
    let found = truth.modules.iter().map(|module| FoundModule {
        center_enu_m: place(module.center_enu_m),
        line: format!("L{}", module.line + 1),
        bench: format!("B{}", truth.benches[module.bench as usize].index + 1),
        row: module.row + 1,
        number: module.col + 1,
    });
    found.collect()
}

#[test]
fn the_papers_plants_have_the_papers_numbers() {
    for seed in 0..5 {
        let first = PlantSpec::paper_pp1(&mut rng(seed)).build();
        assert_eq!((first.lines.len(), first.benches.len(), first.modules.len()), (13, 106, 4974));
        assert!(first.benches.iter().all(|bench| bench.rows == 2));
        let second = PlantSpec::paper_pp2(&mut rng(seed)).build();
        assert_eq!((second.lines.len(), second.benches.len(), second.modules.len()), (9, 27, 5400));
        assert!(second.benches.iter().all(|bench| bench.rows == 6));
        for (truth, size_m) in [(first, [275.0, 140.0]), (second, [160.0, 110.0])] {
            let (low, high) = truth.bounds_m();
            for k in 0..2 {
                let extent_m = high[k] - low[k];
                assert!((extent_m - size_m[k]).abs() < 0.06 * size_m[k], "{extent_m} for {}", size_m[k]);
            }
        }
    }
}

#[test]
fn flights_over_the_papers_plants_take_about_as_many_photos() {
    for (spec, flight, photos) in [
        (PlantSpec::paper_pp1(&mut rng(1)), Flight::paper_pp1(), 17..=22),
        (PlantSpec::paper_pp2(&mut rng(1)), Flight::paper_pp2(), 15..=19),
    ] {
        let count = flight.shots(&spec.build(), &mut rng(1)).len();
        assert!(photos.contains(&count), "{count} photos");
        let denser = flight.denser(2.0).shots(&spec.build(), &mut rng(1)).len();
        assert!(denser as f64 > 1.5 * count as f64, "{denser} photos");
    }
}

#[test]
fn any_number_of_modules_can_be_had() {
    for modules in [1, 2, 3, 434, 5001, 20_000] {
        let spec = PlantSpec::sized(modules);
        assert_eq!(spec.modules(), modules);
        assert_eq!(spec.build().modules.len(), modules);
    }
}

#[test]
fn modules_stand_side_by_side_on_their_bench() {
    let truth = PlantSpec::random_plain(&mut rng(3)).build();
    for bench in &truth.benches {
        for row in 0..bench.rows {
            for col in 0..bench.columns {
                let module = &truth.modules[bench.module(row, col).unwrap()];
                assert_eq!((module.row, module.col, module.line), (row, col, bench.line));
                assert!(module.normal_enu().z > 0.8);
                let [south_west, _, north_east, north_west] = module.corners_enu_m();
                assert!(north_west.y > south_west.y && north_east.x > north_west.x);
                if let Some(next) = bench.module(row, col + 1) {
                    let distance = (truth.modules[next].center_enu_m - module.center_enu_m).norm();
                    assert!((distance - 1.02).abs() < 1e-9);
                    assert!(truth.modules[next].center_enu_m.x > module.center_enu_m.x);
                }
                if let Some(below) = bench.module(row + 1, col) {
                    assert!(truth.modules[below].center_enu_m.y < module.center_enu_m.y);
                }
            }
        }
    }
}

#[test]
fn without_errors_every_detection_is_where_the_camera_sees_its_module() {
    let spec = PlantSpec::random_plain(&mut rng(5));
    let simulation = simulate(&spec, &Flight { tilt_rad: 0.35, ..Flight::plain() }, &Errors::none(), 5);
    assert!(simulation.sightings().iter().all(|count| *count >= 1));
    for (index, shot) in simulation.reconstruction.shots.iter().enumerate() {
        assert!((shot.pose.center() - simulation.true_shots[index].pose.center()).norm() < 1e-9);
        assert_eq!(shot.name, simulation.detections[index].image);
        for (detection, owner) in simulation.detections[index].detections.iter().zip(&simulation.owners[index]) {
            let module = &simulation.truth.modules[owner.unwrap()];
            for corner in module.corners_enu_m() {
                let pixel = shot.camera.project(&shot.pose.to_camera(&corner)).unwrap();
                let nearest = detection.quad.corners.iter().map(|c| (c - pixel).norm()).fold(f64::INFINITY, f64::min);
                assert!(nearest < 1e-6);
                assert!(pixel.x >= -0.5 && pixel.x <= 2735.5 && pixel.y >= -0.5 && pixel.y <= 1823.5);
            }
        }
        // And nothing that lies wholly in the frame is left out.
        let expected = simulation.truth.modules.iter().filter(|module| {
            module.corners_enu_m().iter().all(|corner| {
                shot.camera
                    .project(&shot.pose.to_camera(corner))
                    .is_some_and(|p| p.x >= -0.5 && p.x <= 2735.5 && p.y >= -0.5 && p.y <= 1823.5)
            })
        });
        assert_eq!(expected.count(), simulation.owners[index].len());
    }
    let names: Vec<_> = simulation.reconstruction.shots.iter().map(|shot| shot.name.clone()).collect();
    assert!(names.is_sorted());
}

#[test]
fn without_errors_the_cloud_lies_on_modules_and_ground() {
    let spec = PlantSpec::random_plain(&mut rng(6));
    let simulation = simulate(&spec, &Flight::plain(), &Errors::none(), 6);
    let truth = &simulation.truth;
    let grid = ModuleGrid::new(truth, 3.0);
    let cloud = simulation.reconstruction.dense.unwrap();
    assert_eq!(cloud.positions_m.len(), cloud.normals.len());
    let mut on_modules = 0;
    for point in &cloud.positions_m {
        let point = Vector3::from(*point).cast::<f64>();
        let ground_m = point.z - truth.terrain.height_m(point.xy());
        if let Some(module) = grid.at(truth, point.xy()) {
            on_modules += 1;
            let module = &truth.modules[module];
            assert!((point - module.center_enu_m).dot(&module.normal_enu()).abs() < 1e-3);
        } else {
            assert!(ground_m.abs() < 1e-3 || ground_m > 0.5, "{ground_m} above the ground");
        }
    }
    let density = on_modules as f64 / (truth.modules.len() as f64 * 1.65);
    assert!((density - 8.0).abs() < 0.3, "{density} points on a square metre");
    assert!(simulation.reconstruction.sparse_points_m.len() > 100);
}

#[test]
fn misses_and_false_detections_have_the_stated_rates() {
    let errors = Errors { glare_per_image: 0.0, ..Errors::paper().without_cloud() };
    let (mut modules, mut found, mut gaps, mut whole, mut false_ones, mut photos) = (0, 0, 0, 0, 0, 0);
    for seed in 0..8 {
        let spec = PlantSpec::paper_pp1(&mut rng(seed));
        let simulation = simulate(&spec, &Flight::paper_pp1(), &errors, seed);
        let truth = &simulation.truth;
        let grid = ModuleGrid::new(truth, 6.0);
        let (low, high) = truth.bounds_m();
        for (shot, owners) in simulation.true_shots.iter().zip(&simulation.owners) {
            photos += 1;
            false_ones += owners.iter().filter(|owner| owner.is_none()).count();
            let kept: std::collections::HashSet<usize> = owners.iter().flatten().copied().collect();
            let visible = observe::in_frame(truth, &grid, [low.z - 2.0, high.z + 2.0], shot, errors.frame_margin_px);
            let visible: std::collections::HashSet<usize> = visible.into_iter().map(|(module, _)| module).collect();
            for index in &visible {
                let module = &truth.modules[*index];
                let bench = &truth.benches[module.bench as usize];
                if module.col > 0 && module.col + 1 < bench.columns {
                    modules += 1;
                    found += usize::from(kept.contains(index));
                }
                if module.col == 0 && bench.index > 0 {
                    let before = &truth.benches[module.bench as usize - 1];
                    let neighbour = before.module(module.row, before.columns - 1).unwrap();
                    if visible.contains(&neighbour) {
                        gaps += 1;
                        whole += usize::from(kept.contains(index) && kept.contains(&neighbour));
                    }
                }
            }
        }
    }
    let rate = found as f64 / modules as f64;
    assert!((rate - 0.985).abs() < 0.002, "{rate} of {modules} modules");
    let rate = whole as f64 / gaps as f64;
    assert!((rate - 0.93).abs() < 0.015, "{rate} of {gaps} gaps");
    let rate = false_ones as f64 / photos as f64;
    assert!((rate - 0.5).abs() < 0.2, "{rate} in each of {photos} photos");
}

#[test]
fn jitter_has_the_stated_size() {
    let errors = Errors { size_jitter: 0.0, ..Errors::paper().without_cloud() };
    let spec = PlantSpec::random_plain(&mut rng(8));
    let simulation = simulate(&spec, &Flight::plain(), &errors, 8);
    let (mut sum, mut count) = (0.0, 0.0);
    for ((shot, image), owners) in simulation.true_shots.iter().zip(&simulation.detections).zip(&simulation.owners) {
        for (detection, owner) in image.detections.iter().zip(owners) {
            let Some(owner) = owner else { continue };
            let corners = simulation.truth.modules[*owner].corners_enu_m();
            let pixels = corners.map(|corner| shot.camera.project(&shot.pose.to_camera(&corner)).unwrap());
            for corner in detection.quad.corners {
                let nearest = pixels.iter().map(|p| (p - corner).norm_squared()).fold(f64::INFINITY, f64::min);
                sum += nearest;
                count += 2.0;
            }
        }
    }
    let sigma: f64 = (sum / count).sqrt();
    assert!((sigma - 0.5_f64.hypot(0.5)).abs() < 0.02, "{sigma} pixels");
}

#[test]
fn glare_hides_patches_of_modules_and_cloud() {
    let errors = Errors { detection_rate: 1.0, gap_detection_rate: 1.0, glare_per_image: 2.0, ..Errors::paper() };
    let spec = PlantSpec::random_plain(&mut rng(9));
    let simulation = simulate(&spec, &Flight::plain(), &errors, 9);
    let clear = simulate(&spec, &Flight::plain(), &Errors { glare_per_image: 0.0, ..errors }, 9);
    let count = |simulation: &Simulation| simulation.owners.iter().flatten().flatten().count();
    assert!(count(&simulation) < count(&clear));
    let points = |simulation: &Simulation| simulation.reconstruction.dense.as_ref().unwrap().positions_m.len();
    assert!(points(&simulation) < points(&clear));
    let photos = simulation.glare.len() as f64;
    let patches = simulation.glare.iter().flatten().count() as f64 / photos;
    assert!((patches - 2.0).abs() < 5.0 * (2.0 / photos).sqrt(), "{patches} in a photo");
    for (glare, image) in simulation.glare.iter().zip(&simulation.detections) {
        for (patch, detection) in glare.iter().flat_map(|g| image.detections.iter().map(move |d| (g, d))) {
            let inner = Glare { radii_px: patch.radii_px.map(|r| (r - 4.0).max(0.1)), ..*patch };
            assert!(
                detection.source != heliomap_mapping::detection::Source::Unet
                    || !inner.contains(detection.quad.center())
            );
        }
    }
}

#[test]
fn views_disagree_by_as_much_as_stated() {
    let spec = PlantSpec::paper_pp1(&mut rng(11));
    // Rays are followed by their true length: so without an error of scale.
    let errors = Errors {
        corner_jitter_px: 0.0,
        center_jitter_px: 0.0,
        size_jitter: 0.0,
        scale_error: 0.0,
        ..Errors::paper().without_cloud()
    };
    let simulation = simulate(&spec, &Flight::paper_pp1(), &errors, 11);
    // Every detection as far along its estimated ray as its module truly is: where this view alone would put it.
    let mut places: BTreeMap<usize, Vec<Vector2<f64>>> = BTreeMap::new();
    for (index, shot) in simulation.reconstruction.shots.iter().enumerate() {
        let pose = &simulation.true_shots[index].pose;
        for (detection, owner) in simulation.detections[index].detections.iter().zip(&simulation.owners[index]) {
            let Some(owner) = owner else { continue };
            let center = shot.pose.center();
            let ray = shot.pose.direction_to_world(&shot.camera.bearing(detection.quad.center()));
            let depth_m = (simulation.truth.modules[*owner].center_enu_m - pose.center()).norm();
            places.entry(*owner).or_default().push((center + ray * depth_m).xy());
        }
    }
    let mut largest: f64 = 0.0;
    let mut disagreements = Vec::new();
    for places in places.values() {
        for (k, a) in places.iter().enumerate() {
            for b in &places[..k] {
                largest = largest.max((a - b).norm());
                disagreements.push((a - b).norm());
            }
        }
    }
    disagreements.sort_by(f64::total_cmp);
    let median = disagreements[disagreements.len() / 2];
    assert!(largest > 0.4 && largest < 0.7, "views disagree by up to {largest} m, median {median} m");
    assert!(median > 0.1 && median < 0.3, "median disagreement {median} m");
}

#[test]
fn a_seed_gives_the_same_plant_on_any_number_of_threads() {
    let run = |seed| {
        let spec = PlantSpec::random_plain(&mut rng(seed));
        simulate(&spec, &Flight::plain(), &Errors::paper(), seed)
    };
    let one = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap().install(|| run(4));
    let four = rayon::ThreadPoolBuilder::new().num_threads(4).build().unwrap().install(|| run(4));
    assert_eq!(one.truth, four.truth);
    assert_eq!(one.detections, four.detections);
    assert_eq!(one.owners, four.owners);
    let (a, b) = (one.reconstruction, four.reconstruction);
    assert_eq!(a.dense.unwrap().positions_m, b.dense.unwrap().positions_m);
    assert_eq!(a.sparse_points_m, b.sparse_points_m);
    assert!(a.shots.iter().zip(&b.shots).all(|(a, b)| a.pose == b.pose));
    assert_ne!(run(5).detections, four.detections);
}

#[test]
fn the_truth_is_exact_however_it_is_named_shifted_and_scaled() {
    for seed in 0..4 {
        for spec in [PlantSpec::paper_pp1(&mut rng(seed)), PlantSpec::paper_pp2(&mut rng(seed))] {
            let truth = spec.build();
            let report = structure_report(&truth, &perfect(&truth, |p| p));
            assert!(report.exact, "{:?}", report.wrong_structure);
            let shift = Vector3::new(0.7, -0.7, 2.0);
            for scale in [0.99, 1.01] {
                let mut found = perfect(&truth, |p| p * scale + shift + Vector3::x() * 0.2 * (p.y / 20.0).sin());
                for module in &mut found {
                    let bench = truth.benches.iter().find(|b| {
                        format!("L{}", b.line + 1) == module.line && format!("B{}", b.index + 1) == module.bench
                    });
                    module.number = bench.unwrap().columns - module.number;
                    module.line = format!("{}th from the top", module.line);
                }
                let report = structure_report(&truth, &found);
                assert!(
                    report.exact,
                    "{} {} {:?}",
                    report.missing.len(),
                    report.false_modules.len(),
                    report.wrong_structure
                );
            }
        }
    }
}

#[test]
fn what_is_wrong_is_named() {
    let truth = PlantSpec::random_plain(&mut rng(2)).build();
    let found = perfect(&truth, |p| p);

    let mut one_less = found.clone();
    one_less.remove(17);
    let report = structure_report(&truth, &one_less);
    assert_eq!((report.missing, report.false_modules.len(), report.wrong_structure.len()), (vec![17], 0, 0));

    let mut one_more = found.clone();
    one_more.push(FoundModule { center_enu_m: found[0].center_enu_m - Vector3::x() * 6.0, ..found[0].clone() });
    let report = structure_report(&truth, &one_more);
    assert_eq!((report.missing.len(), report.false_modules), (0, vec![found.len()]));
    one_more[found.len()].center_enu_m = found[0].center_enu_m + Vector3::x() * 0.1;
    assert_eq!(structure_report(&truth, &one_more).false_modules, vec![found.len()]);

    let mut joined = found.clone();
    joined.iter_mut().filter(|m| m.line == "L1" && m.bench == "B2").for_each(|m| "B1".clone_into(&mut m.bench));
    let report = structure_report(&truth, &joined);
    assert!(report.missing.is_empty() && report.false_modules.is_empty() && !report.exact);
    assert!(report.wrong_structure[0].message.contains("joins line 0 bench 0"), "{:?}", report.wrong_structure);

    let mut shifted = found.clone();
    shifted.iter_mut().filter(|m| m.line == "L2" && m.bench == "B1").for_each(|m| m.number += 1);
    let report = structure_report(&truth, &shifted);
    assert_eq!(report.wrong_structure.len(), 1);
    assert!(report.wrong_structure[0].message.starts_with("line 1 bench 0"), "{:?}", report.wrong_structure);

    let mut crossed = found;
    crossed.iter_mut().filter(|m| m.line == "L2").for_each(|m| m.line = String::from("L1"));
    assert!(!structure_report(&truth, &crossed).exact);
}

#[test]
fn plants_of_every_kind_stand_free_and_compare_equal_to_themselves() {
    for kind in LayoutKind::ALL {
        for seed in 0..20 {
            let spec = PlantSpec::random(kind, &mut rng(seed));
            let truth = spec.build();
            assert!((60..2500).contains(&truth.modules.len()), "{kind:?} has {} modules", truth.modules.len());
            assert_eq!(truth.modules.len(), spec.modules());
            let grid = ModuleGrid::new(&truth, 3.0);
            for (index, module) in truth.modules.iter().enumerate() {
                assert!(module.normal_enu().z > 0.7);
                // No other module over or under its corners or its middle.
                for place in module.corners_enu_m().iter().chain([&module.center_enu_m]) {
                    let place = (place + (module.center_enu_m - place) * 0.02).xy();
                    let near = grid.within(place - Vector2::repeat(3.0), place + Vector2::repeat(3.0));
                    for other in near.filter(|other| *other != index) {
                        assert!(
                            truth.modules[other].place_on_face(place).amax() > 1.0,
                            "{kind:?} {seed}: {other} {index}"
                        );
                    }
                }
                for corner in module.corners_enu_m() {
                    let above_m = corner.z - truth.terrain.height_m(corner.xy());
                    assert!(above_m > 0.0, "{kind:?} {seed}: {index} is {above_m} m above the ground");
                }
            }
            let bent = |p: Vector3<f64>| p * 1.006 + Vector3::new(0.5, 0.5, 3.0);
            let report = structure_report(&truth, &perfect(&truth, bent));
            assert!(report.exact, "{kind:?} {seed}: {} {:?}", report.missing.len(), report.wrong_structure);
        }
    }
}

#[test]
fn tables_look_south_and_trackers_to_either_side() {
    for kind in LayoutKind::ALL {
        let truth = PlantSpec::random(kind, &mut rng(1)).build();
        for bench in &truth.benches {
            let first = &truth.modules[bench.modules.start];
            let last = &truth.modules[bench.modules.end - 1];
            if kind == LayoutKind::Trackers {
                assert!(first.center_enu_m.y > last.center_enu_m.y && first.normal_enu().y.abs() < 0.2);
            } else {
                assert!(first.center_enu_m.x < last.center_enu_m.x + 2.0 && first.normal_enu().y < -0.2);
            }
        }
    }
}

#[test]
fn curved_benches_bend_and_stepped_ones_are_level() {
    let curved = PlantSpec::random_curved(&mut rng(3)).build();
    let bends = curved.benches.iter().filter(|bench| {
        let along = |col| curved.modules[bench.module(0, col).unwrap()].half_along_m.normalize();
        along(0).angle(&along(bench.columns - 1)) > 0.01
    });
    assert!(bends.count() > curved.benches.len() / 2);
    let stepped = PlantSpec::random_stepped(&mut rng(3)).build();
    for bench in &stepped.benches {
        let height = |col| stepped.modules[bench.module(0, col).unwrap()].center_enu_m.z;
        assert!((height(0) - height(bench.columns - 1)).abs() < 1e-9);
    }
}

#[test]
fn every_module_of_every_kind_is_seen_from_any_flight() {
    for kind in LayoutKind::ALL {
        for seed in 0..3 {
            let mut rng = rng(seed);
            let spec = PlantSpec::random(kind, &mut rng);
            let flight = Flight::random(&mut rng);
            let simulation = simulate(&spec, &flight, &Errors::none().without_cloud(), seed);
            let sightings = simulation.sightings();
            let few = sightings.iter().filter(|count| **count < 2).count();
            assert!(few * 100 < sightings.len(), "{kind:?} {seed}: {few} of {} seen less than twice", sightings.len());
            assert!(sightings.iter().all(|count| *count > 0), "{kind:?} {seed}");
        }
    }
}

#[test]
fn a_bent_and_noisy_mapping_is_still_paired_right() {
    for kind in LayoutKind::ALL {
        for seed in 0..8 {
            let mut rng = rng(seed);
            let truth = PlantSpec::random(kind, &mut rng).build();
            let scale = 1.0 + 0.01 * noise::signed(&mut rng);
            let shift = noise::horizontal(&mut rng, 1.0);
            let shifts: Vec<_> = truth.benches.iter().map(|_| noise::horizontal(&mut rng, 0.4)).collect();
            let mut found = perfect(&truth, |p| p * scale + shift);
            for (found, module) in found.iter_mut().zip(&truth.modules) {
                found.center_enu_m += shifts[module.bench as usize] + noise::horizontal(&mut rng, 0.1);
            }
            let report = structure_report(&truth, &found);
            assert!(report.exact, "{kind:?} {seed}: {:?} {:?}", report.missing, report.wrong_structure);
            // A whole bench less is that bench less.
            let bench = &truth.benches[truth.benches.len() / 2];
            if truth.benches.len() > 5 {
                found.drain(bench.modules.clone());
                let report = structure_report(&truth, &found);
                assert_eq!(report.missing, bench.modules.clone().collect::<Vec<_>>(), "{kind:?} {seed}");
                assert!(report.false_modules.is_empty() && report.wrong_structure.is_empty());
            }
        }
    }
}
