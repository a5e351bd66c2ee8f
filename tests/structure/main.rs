//! Layout, fusion and refinement on simulated plants: what comes out must be the plant that went in.

mod contract;

use heliomap::detection::ImageDetections;
use heliomap::fusion::{self, Fused, FusionOptions, View};
use heliomap::layout::{self, Layout, LayoutOptions};
use heliomap::plant::assemble::{Identity, assemble};
use heliomap::plant::{ModuleId, ModuleStatus, PlantId, PlantModel};
use heliomap::refinement::{self, Refined, RefinementOptions};
use heliomap::simulator::{
    Errors, Flight, FoundModule, LayoutKind, PlantSpec, Simulation, StructureReport, simulate, structure_report,
};
use rand::SeedableRng;
use rand::rngs::StdRng;
use rayon::prelude::*;
use std::collections::BTreeMap;

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
        let layouts = lay_out(&simulation.detections);
        let views = views(&simulation, &layouts);
        let cloud = simulation.reconstruction.dense.clone().unwrap();
        let located = fusion::locate::locate(&views, &cloud);
        let fused = fusion::fuse(&views, &located, &FusionOptions::default());
        let refined = refinement::refine(&views, &fused, &RefinementOptions::default());
        Self { simulation, layouts, fused, refined }
    }

    fn report(&self) -> StructureReport {
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
        structure_report(&self.simulation.truth, &found)
    }

    /// Modules that no photo shows cannot be found.
    fn never_seen(&self) -> usize {
        self.simulation.sightings().iter().filter(|count| **count == 0).count()
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

/// How many of the seeds come out exactly, and how many of the others are told of by no doubt.
fn survey(name: &str, seeds: u64, make: impl Fn(u64) -> Simulation + Sync) -> (usize, usize) {
    let outcomes: Vec<(bool, bool, String)> = (0..seeds)
        .into_par_iter()
        .map(|seed| {
            let mapped = Mapped::new(make(seed));
            let report = mapped.report();
            let exact = report.false_modules.is_empty()
                && report.wrong_structure.is_empty()
                && report.missing.len() <= mapped.never_seen();
            let told = format!(
                "{name} seed {seed}: {} missing ({} never seen), {} false, {} wrong ({:?}), {} doubts",
                report.missing.len(),
                mapped.never_seen(),
                report.false_modules.len(),
                report.wrong_structure.len(),
                report.wrong_structure.first(),
                mapped.fused.doubts.len(),
            );
            (exact, !exact && mapped.fused.doubts.is_empty(), told)
        })
        .collect();
    for (_, _, told) in outcomes.iter().filter(|(exact, _, _)| !exact) {
        println!("{told}");
    }
    let exact = outcomes.iter().filter(|(exact, _, _)| *exact).count();
    let silent = outcomes.iter().filter(|(_, silent, _)| *silent).count();
    println!("{name}: {exact} of {seeds} exact, {silent} wrong without a doubt");
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
