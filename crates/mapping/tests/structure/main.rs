//! Layout, fusion and refinement on simulated plants: what comes out must be the plant that went in.

mod contract;
mod detectors;
mod geometry;

use heliomap_mapping::assembly::{Identity, assemble};
use heliomap_mapping::detection::ImageDetections;
use heliomap_mapping::fusion::{self, Fused, FusionOptions, View};
use heliomap_mapping::geometry::PointCloud;
use heliomap_mapping::layout::{self, Layout, LayoutOptions};
use heliomap_mapping::refinement::{self, Refined, RefinementOptions};
use heliomap_model::{ModuleId, ModuleStatus, PlantId, PlantModel};
use heliomap_simulator::{
    Errors, Flight, FoundModule, LayoutKind, PlantSpec, Simulation, StructureReport, simulate, structure_report,
};
use nalgebra::Vector2;
use rand::SeedableRng;
use rand::rngs::StdRng;
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet};

/// A simulated plant, mapped.
struct Mapped {
    simulation: Simulation,
    layouts: Vec<Layout>,
    fused: Fused,
    refined: Refined,
}

fn lay_out(detections: &[ImageDetections]) -> Vec<Layout> {
    detections.iter().map(|detections| layout::infer(detections, None, &LayoutOptions::default())).collect()
}

fn views<'a>(simulation: &'a Simulation, layouts: &'a [Layout]) -> Vec<View<'a>> {
    simulation
        .reconstruction
        .shots
        .iter()
        .zip(&simulation.detections)
        .zip(layouts)
        .map(|((shot, detections), layout)| View { shot, detections, layout })
        .collect()
}

impl Mapped {
    fn new(simulation: Simulation) -> Self {
        let sparse = || PointCloud {
            positions_m: simulation.reconstruction.sparse_points_m.iter().map(|p| p.cast::<f32>().into()).collect(),
            normals: Vec::new(),
        };
        let cloud = simulation.reconstruction.dense.clone().unwrap_or_else(sparse);
        Self::with_cloud(simulation, &cloud)
    }

    fn with_cloud(simulation: Simulation, cloud: &PointCloud) -> Self {
        let layouts = lay_out(&simulation.detections);
        let views = views(&simulation, &layouts);
        let located = fusion::locate::locate(&views, cloud);
        let mut fused = fusion::fuse(&views, located, &FusionOptions::default());
        let refined = refinement::refine_verified(&views, &mut fused, &RefinementOptions::default());
        Self { simulation, layouts, fused, refined }
    }

    fn report(&self) -> StructureReport {
        structure_report(&self.simulation.truth, &self.found())
    }

    /// All modules, line by line and bench by bench.
    fn found(&self) -> Vec<FoundModule> {
        let mut found = Vec::new();
        for (line, members) in self.fused.lines.iter().enumerate() {
            for &bench in &members.benches {
                for (module, refined) in
                    self.fused.benches[bench].modules.iter().zip(&self.refined.benches[bench].modules)
                {
                    found.push(FoundModule {
                        center_enu_m: refined.center_m,
                        line: format!("L{line}"),
                        bench: format!("B{bench}"),
                        row: module.row as u32,
                        number: module.col as u32,
                    });
                }
            }
        }
        found
    }

    /// What differs from the truth: a sentence each, whether a doubt names the place, and what that says. Modules that no
    /// photo shows cannot be found.
    fn wrongs(&self) -> Vec<Wrong> {
        let report = self.report();
        let truth = &self.simulation.truth;
        let bench_of: Vec<usize> = self
            .fused
            .lines
            .iter()
            .flat_map(|line| &line.benches)
            .flat_map(|bench| std::iter::repeat_n(*bench, self.fused.benches[*bench].modules.len()))
            .collect();
        let mut wrongs: Vec<Wrong> = report
            .wrong_structure
            .iter()
            .map(|wrong| {
                let found = wrong.modules.iter().map(|index| bench_of[*index]).collect();
                let ours = wrong.modules.iter().filter_map(|index| report.pairs[*index]);
                let true_benches = ours.map(|module| truth.modules[module].bench).collect();
                self.wrong(wrong.message.clone(), &found, &true_benches, false)
            })
            .collect();
        for module in &report.false_modules {
            let bench = bench_of[*module];
            wrongs.push(self.wrong(format!("false module in found bench {bench}"), &[bench].into(), &[].into(), false));
        }
        let sightings = self.simulation.sightings();
        let mut missing: BTreeMap<u32, usize> = BTreeMap::new();
        for module in report.missing.iter().filter(|module| sightings[**module] > 0) {
            *missing.entry(truth.modules[*module].bench).or_default() += 1;
        }
        for (bench, count) in missing {
            let found = report.pairs.iter().zip(&bench_of);
            let found = found.filter(|(pair, _)| pair.is_some_and(|m| truth.modules[m].bench == bench));
            let found: BTreeSet<usize> = found.map(|(_, bench)| *bench).collect();
            let place = &truth.benches[bench as usize];
            let message = format!("line {} bench {} lacks {count} modules", place.line, place.index);
            wrongs.push(self.wrong(message, &found, &[bench].into(), true));
        }
        wrongs
    }

    /// Looks for a doubt that names one of the found benches, or a place on one of the true ones.
    fn wrong(
        &self,
        message: String,
        found: &BTreeSet<usize>,
        true_benches: &BTreeSet<u32>,
        about_missing: bool,
    ) -> Wrong {
        /// The frame of the reconstruction is shifted against the truth by about a metre.
        const NEAR_M: f64 = 2.5;
        let truth = &self.simulation.truth;
        let on_bench = |place: &Vector2<f64>| {
            let modules =
                true_benches.iter().flat_map(|bench| &truth.modules[truth.benches[*bench as usize].modules.clone()]);
            modules.into_iter().any(|module| (module.center_enu_m.xy() - place).norm() < NEAR_M)
        };
        let told = self.fused.doubts.iter().find(|doubt| {
            (about_missing || doubt.code != "modules_not_seen")
                && (doubt.benches.iter().any(|bench| found.contains(bench)) || doubt.places_m.iter().any(on_bench))
        });
        Wrong { message, told: told.map(|doubt| doubt.message.clone()) }
    }

    fn model(&self, previous: Option<&PlantModel>) -> PlantModel {
        let identity =
            Identity { plant: PlantId::from_name("simulated"), plant_name: "simulated", survey: "flight", previous };
        assemble(
            &views(&self.simulation, &self.layouts),
            &self.fused,
            &self.refined,
            self.simulation.reconstruction.reference,
            String::new(),
            &identity,
            Vec::new(),
        )
    }

    /// The true module of each module of the model: the owner of the detections that it was made of.
    fn owners(&self, model: &PlantModel) -> BTreeMap<ModuleId, usize> {
        let fused =
            self.fused.lines.iter().flat_map(|line| &line.benches).flat_map(|b| &self.fused.benches[*b].modules);
        model
            .modules
            .iter()
            .zip(fused)
            .map(|(module, fused)| {
                let seen = &fused.observations[0];
                (module.id, self.simulation.owners[seen.view][seen.detection].unwrap())
            })
            .collect()
    }
}

fn plant(kind: Option<LayoutKind>, seed: u64) -> PlantSpec {
    let mut rng = StdRng::seed_from_u64(seed);
    match kind {
        None => PlantSpec::random_plain(&mut rng),
        Some(kind) => PlantSpec::random(kind, &mut rng),
    }
}

/// One thing that differs from the truth.
struct Wrong {
    message: String,
    /// The doubt that names its place.
    told: Option<String>,
}

/// How many of the seeds come out exactly, and in how many of the others something is wrong that no doubt names.
fn survey(name: &str, seeds: u64, make: impl Fn(u64) -> Simulation + Sync) -> (usize, usize) {
    let outcomes: Vec<(u64, Vec<Wrong>, usize)> = (0..seeds)
        .into_par_iter()
        .map(|seed| {
            let mapped = Mapped::new(make(seed));
            (seed, mapped.wrongs(), mapped.fused.doubts.len())
        })
        .collect();
    for (seed, wrongs, doubts) in &outcomes {
        for wrong in wrongs {
            let told = wrong.told.as_deref().unwrap_or("UNTOLD");
            println!("{name} seed {seed} ({doubts} doubts): {}; {told}", wrong.message);
        }
    }
    let exact = outcomes.iter().filter(|(_, wrongs, _)| wrongs.is_empty()).count();
    let silent = outcomes.iter().filter(|(_, wrongs, _)| wrongs.iter().any(|wrong| wrong.told.is_none())).count();
    let doubts: usize = outcomes.iter().filter(|(_, wrongs, _)| wrongs.is_empty()).map(|(_, _, doubts)| doubts).sum();
    println!(
        "{name}: {exact} of {seeds} exact, with {doubts} doubts in these; {silent} wrong where no doubt names the place"
    );
    (exact, silent)
}

#[test]
fn without_errors_plain_plants_come_out_exactly() {
    let (exact, _) =
        survey("plain, no errors", 10, |seed| simulate(&plant(None, seed), &Flight::plain(), &Errors::none(), seed));
    assert_eq!(exact, 10);
}

#[test]
fn the_paper_s_plants_come_out_exactly() {
    let (first, _) = survey("PP1", 3, |seed| {
        let spec = PlantSpec::paper_pp1(&mut StdRng::seed_from_u64(seed));
        simulate(&spec, &Flight::paper_pp1(), &Errors::paper(), seed)
    });
    let (second, _) = survey("PP2", 3, |seed| {
        let spec = PlantSpec::paper_pp2(&mut StdRng::seed_from_u64(seed));
        simulate(&spec, &Flight::paper_pp2(), &Errors::paper(), seed)
    });
    assert_eq!((first, second), (3, 3));
}

#[test]
fn identifiers_live_on_in_the_next_survey_of_a_shifted_frame() {
    // Another flight of the same plant: other errors of detection, and a frame moved against the first by up to metres.
    let spec = plant(None, 4);
    let [first, second] = [11, 12]
        .map(|seed| Mapped::new(simulate(&spec, &Flight::plain(), &Errors { shift_m: 2.0, ..Errors::none() }, seed)));
    let before = first.model(None);
    let after = second.model(Some(&before));
    let moved = (before.modules[0].center_enu_m - after.modules[0].center_enu_m).norm();
    assert!(moved > 0.7, "the frames hardly differ ({moved} m), so this shows nothing");
    assert_eq!((before.version, after.version), (1, 2));
    assert_eq!(first.owners(&before), second.owners(&after));
    assert_eq!(before.serials, after.serials);
    let ids = |model: &PlantModel| {
        let benches: Vec<_> = model.benches.iter().map(|b| (b.id, b.line)).collect();
        (benches, model.sectors.iter().map(|s| s.id).collect::<Vec<_>>())
    };
    assert_eq!(ids(&before), ids(&after));
}

#[test]
fn what_is_new_gets_new_identifiers_and_what_is_gone_keeps_its_own_free() {
    let spec = plant(None, 4);
    let whole = || simulate(&spec, &Flight::plain(), &Errors::none(), 11);
    let mut partly = whole();
    let gone = partly.truth.benches[1].modules.clone();
    for (image, owners) in partly.detections.iter_mut().zip(&mut partly.owners) {
        let keep: Vec<bool> = owners.iter().map(|owner| owner.is_none_or(|o| !gone.contains(&o))).collect();
        let mut flags = keep.iter();
        image.detections.retain(|_| *flags.next().unwrap());
        let mut flags = keep.iter();
        owners.retain(|_| *flags.next().unwrap());
    }
    let (without, with) = (Mapped::new(partly), Mapped::new(whole()));
    let before = without.model(None);
    let after = with.model(Some(&before));
    assert_eq!(after.modules.len() - before.modules.len(), gone.len());
    let (old, new) = (without.owners(&before), with.owners(&after));
    assert!(old.iter().all(|(id, owner)| new.get(id) == Some(owner)));
    assert_eq!(after.serials[3] - before.serials[3], gone.len() as u64);
    // And the bench goes again: the others keep theirs.
    let again = without.model(Some(&after));
    assert_eq!(without.owners(&again), old);
}

#[test]
fn a_gap_that_one_image_missed_is_inserted_where_the_others_see_it() {
    let mut simulation = simulate(&plant(None, 2), &Flight::plain(), &Errors::none(), 2);
    // In one image the bench east of a gap is moved up to the one west of it.
    let (view, gap, east) = lay_out(&simulation.detections)
        .iter()
        .enumerate()
        .find_map(|(view, layout)| {
            let gap = layout.gaps.first()?.clone();
            let members: Vec<usize> = layout.pieces[gap.east.0].detected().map(|(_, detection)| detection).collect();
            Some((view, (layout.pieces[gap.west.0].clone(), gap), members))
        })
        .unwrap();
    let (west, gap) = gap;
    let [along, _] = west.map.pitch(f64::from(gap.west.2), f64::from(gap.west.1));
    for detection in east {
        let quad = &mut simulation.detections[view].detections[detection].quad;
        *quad = quad.map(|corner| corner - along * (gap.pitches - 1.0));
    }
    let merged = layout::infer(&simulation.detections[view], None, &LayoutOptions::default());
    assert!(merged.pieces.iter().any(|piece| piece.cols > west.cols + 1 && piece.rows >= west.rows));
    let report = Mapped::new(simulation).report();
    assert!(report.exact, "{:?}", report.wrong_structure);
}

#[test]
fn hypotheses_are_confirmed_by_other_images_or_dropped_and_told() {
    let clean = || simulate(&plant(None, 4), &Flight::plain(), &Errors::none(), 11);
    let truth = clean().truth;
    // Inside a bench: not at its ends, which would only move.
    let inner = truth.benches[0].module(0, truth.benches[0].columns / 2).unwrap();
    let sightings = clean().sightings()[inner];
    assert!(sightings >= 2);
    let without = |times: u32| {
        let mut simulation = clean();
        let mut left = times;
        for (image, owners) in simulation.detections.iter_mut().zip(&mut simulation.owners) {
            if let Some(at) = owners.iter().position(|owner| *owner == Some(inner)).filter(|_| left > 0) {
                image.detections.remove(at);
                owners.remove(at);
                left -= 1;
            }
        }
        Mapped::new(simulation)
    };
    let once = without(1);
    let model = once.model(None);
    let confirmed: Vec<_> = model.modules.iter().filter(|m| m.status == ModuleStatus::Confirmed).collect();
    assert_eq!(confirmed.len(), 1);
    assert_eq!(once.owners(&model)[&confirmed[0].id], inner);
    assert!(once.report().exact);

    let never = without(sightings);
    let model = never.model(None);
    assert!(model.modules.iter().all(|m| m.status == ModuleStatus::Detected));
    assert_eq!(model.modules.len(), truth.modules.len() - 1);
    let told: Vec<_> = model.warnings.iter().filter(|warning| warning.code == "modules_not_seen").collect();
    assert_eq!(told.len(), 1);
    // The hole keeps its number: everything else is where it was.
    let report = never.report();
    assert_eq!((report.missing.len(), report.wrong_structure.len()), (1, 0));
}

#[test]
fn the_order_of_the_images_does_not_matter() {
    let spec = plant(None, 3);
    let forwards = Mapped::new(simulate(&spec, &Flight::plain(), &Errors::paper(), 5));
    let mut reversed = simulate(&spec, &Flight::plain(), &Errors::paper(), 5);
    reversed.reconstruction.shots.reverse();
    reversed.detections.reverse();
    reversed.owners.reverse();
    let backwards = Mapped::new(reversed);
    let labels = |model: &PlantModel| model.modules.iter().map(|m| m.label.clone()).collect::<Vec<_>>();
    let (one, other) = (forwards.model(None), backwards.model(None));
    assert_eq!(labels(&one), labels(&other));
    for (a, b) in one.modules.iter().zip(&other.modules) {
        assert!((a.center_enu_m - b.center_enu_m).norm() < 1e-3, "{}", a.label);
    }
}
