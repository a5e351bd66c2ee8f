//! Layout, fusion and refinement on simulated plants: what comes out must be the plant that went in.

use heliomap::fusion::{self, Fused, FusionOptions, View};
use heliomap::layout::{self, Layout, LayoutOptions};
use heliomap::refinement::{self, Method, RefinedBench, RefinementOptions};
use heliomap::simulator::{
    Errors, Flight, FoundModule, LayoutKind, PlantSpec, Simulation, StructureReport, simulate, structure_report,
};
use rand::SeedableRng;
use rand::rngs::StdRng;

/// A simulated plant, mapped.
struct Mapped {
    simulation: Simulation,
    fused: Fused,
    refined: Vec<RefinedBench>,
}

impl Mapped {
    fn new(simulation: Simulation, method: Method) -> Self {
        let layouts: Vec<Layout> = simulation
            .detections
            .iter()
            .map(|detections| layout::infer(detections, None, &LayoutOptions::default()))
            .collect();
        let views: Vec<View<'_>> = simulation
            .reconstruction
            .shots
            .iter()
            .zip(&simulation.detections)
            .zip(&layouts)
            .map(|((shot, detections), layout)| View { shot, detections, layout })
            .collect();
        let cloud = simulation.reconstruction.dense.clone().unwrap();
        let located = fusion::locate::locate(&views, &cloud);
        let fused = fusion::fuse(&views, &located, &FusionOptions::default());
        let refined = refinement::refine(&views, &fused, &RefinementOptions { method, ..Default::default() });
        Self { simulation, fused, refined }
    }

    fn report(&self) -> StructureReport {
        let mut found = Vec::new();
        for (line, members) in self.fused.lines.iter().enumerate() {
            for &bench in &members.benches {
                for (module, refined) in self.fused.benches[bench].modules.iter().zip(&self.refined[bench].modules) {
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
}

fn plant(kind: Option<LayoutKind>, seed: u64) -> PlantSpec {
    let mut rng = StdRng::seed_from_u64(seed);
    match kind {
        None => PlantSpec::random_plain(&mut rng),
        Some(kind) => PlantSpec::random(kind, &mut rng),
    }
}

/// How many of the seeds come out exactly, and what the others say.
fn survey(name: &str, seeds: u64, make: impl Fn(u64) -> Simulation) -> (usize, usize) {
    let (mut exact, mut silent) = (0, 0);
    for seed in 0..seeds {
        let mapped = Mapped::new(make(seed), Method::Lattice);
        let report = mapped.report();
        if report.exact
            || (report.false_modules.is_empty()
                && report.wrong_structure.is_empty()
                && report.missing.len() <= mapped.never_seen())
        {
            exact += 1;
        } else {
            silent += usize::from(mapped.fused.doubts.is_empty());
            println!(
                "{name} seed {seed}: {} missing ({} never seen), {} false, {} wrong ({:?}), {} doubts",
                report.missing.len(),
                mapped.never_seen(),
                report.false_modules.len(),
                report.wrong_structure.len(),
                report.wrong_structure.first(),
                mapped.fused.doubts.len(),
            );
        }
    }
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
#[ignore = "a survey of every kind of layout; run it with `make structure`"]
fn every_kind_of_layout() {
    for kind in LayoutKind::ALL {
        survey(&format!("{kind:?}"), 20, |seed| {
            let flight = Flight::random(&mut StdRng::seed_from_u64(seed ^ 0x55));
            simulate(&plant(Some(kind), seed), &flight, &Errors::paper(), seed)
        });
    }
}
