//! The long survey: every kind of layout and every kind of view on many random plants, and the paper's two plants. It
//! fails where fewer come out exactly than must, or where a wrong one raises no doubt.

use super::{plant, survey};
use heliomap_mapping::geometry::Camera;
use heliomap_mapping::reconstruction::Shot;
use heliomap_simulator::{Errors, Flight, LayoutKind, PlantSpec, Simulation, simulate};
use nalgebra::Vector3;
use rand::SeedableRng;
use rand::rngs::StdRng;
use std::collections::BTreeSet;

/// Plants of each kind of layout and view.
const PLANTS: u64 = 50;
/// Seeds of each of the paper's plants.
const PAPER_PLANTS: u64 = 100;

/// One line of the table: what was surveyed, how many came out exactly, how many must, how many went wrong silently.
struct Line {
    name: String,
    exact: usize,
    needed: usize,
    of: u64,
    silent: usize,
}

/// Prints the table and fails where it falls short.
fn judge(lines: &[Line]) {
    println!("\n{:<32} {:>9} {:>7} {:>7}", "", "exact", "needed", "silent");
    for line in lines {
        println!("{:<32} {:>3} of {:>3} {:>7} {:>7}", line.name, line.exact, line.of, line.needed, line.silent);
    }
    let short: Vec<&str> =
        lines.iter().filter(|l| l.exact < l.needed || l.silent > 0).map(|l| l.name.as_str()).collect();
    assert!(short.is_empty(), "these fall short: {}", short.join(", "));
}

/// 98 % of the plants must come out exactly.
fn line(name: &str, make: impl Fn(u64) -> Simulation + Sync) -> Line {
    let (exact, silent) = survey(name, PLANTS, make);
    Line { name: name.to_owned(), exact, needed: (PLANTS as usize * 98).div_ceil(100), of: PLANTS, silent }
}

#[test]
#[ignore = "long; run it with `make structure`"]
fn every_kind_of_layout() {
    let lines: Vec<Line> = LayoutKind::ALL
        .into_iter()
        .map(|kind| {
            line(&format!("{kind:?}"), |seed| {
                let flight = Flight::random(&mut StdRng::seed_from_u64(seed ^ 0x55));
                simulate(&plant(Some(kind), seed), &flight, &Errors::paper(), seed)
            })
        })
        .collect();
    judge(&lines);
}

/// A kind of view: the plants and the flight that give it, and whether a simulation really has it.
struct Kind {
    name: &'static str,
    layout: LayoutKind,
    flight: Flight,
    is_given: fn(&Simulation) -> bool,
}

impl Kind {
    fn simulate(&self, seed: u64) -> Simulation {
        simulate(&plant(Some(self.layout), seed), &self.flight, &Errors::paper(), seed)
    }
}

fn kinds_of_view() -> [Kind; 5] {
    let close = || Flight { camera: Camera::pinhole(1800, 1200, 0.777), altitude_m: 30.0, ..Flight::plain() };
    [
        Kind {
            name: "each photo in any rotation",
            layout: LayoutKind::Plain,
            flight: Flight { yaw_jitter_rad: 3.0, ..Flight::plain() },
            is_given: |simulation| {
                // Neither along the strips nor across them.
                let aslant = |shot: &&Shot| (2.0 * top(shot)).sin().abs() > 0.5;
                simulation.true_shots.iter().filter(aslant).count() > simulation.true_shots.len() / 3
            },
        },
        Kind {
            name: "up to 20 degrees off nadir",
            layout: LayoutKind::Plain,
            flight: Flight { tilt_rad: 20.0_f64.to_radians(), ..Flight::plain() },
            is_given: |simulation| {
                let off_deg = |shot: &Shot| (-axis(shot).z).acos().to_degrees();
                simulation.true_shots.iter().map(off_deg).fold(0.0, f64::max) > 14.0
            },
        },
        Kind {
            name: "plants wider than a frame",
            layout: LayoutKind::Plain,
            flight: close(),
            is_given: |simulation| {
                let whole = simulation.truth.modules.len();
                seen(simulation).iter().all(|modules| modules.len() < whole * 9 / 10)
            },
        },
        Kind {
            name: "benches cut, no gap shared",
            layout: LayoutKind::Long,
            flight: close(),
            is_given: |simulation| {
                let seen = seen(simulation);
                let gaps: Vec<BTreeSet<(u32, u32)>> = seen.iter().map(|modules| gaps(simulation, modules)).collect();
                (0..seen.len()).flat_map(|a| (0..a).map(move |b| (a, b))).any(|(a, b)| {
                    let benches = |k: usize| -> BTreeSet<u32> {
                        seen[k].iter().map(|module| simulation.truth.modules[*module].bench).collect()
                    };
                    !benches(a).is_disjoint(&benches(b)) && gaps[a].is_disjoint(&gaps[b])
                })
            },
        },
        Kind {
            name: "one bench from both directions",
            layout: LayoutKind::Alone,
            flight: Flight { heading_rad: std::f64::consts::FRAC_PI_2, yaw_jitter_rad: 0.1, ..Flight::plain() },
            is_given: |simulation| {
                let seen = seen(simulation);
                let shots = &simulation.true_shots;
                (0..seen.len())
                    .flat_map(|a| (0..a).map(move |b| (a, b)))
                    .any(|(a, b)| (top(&shots[a]) - top(&shots[b])).cos() < -0.8 && !seen[a].is_disjoint(&seen[b]))
            },
        },
    ]
}

/// Optical axis in the world.
fn axis(shot: &Shot) -> Vector3<f64> {
    shot.pose.direction_to_world(&Vector3::z())
}

/// Direction of the top of a photo, from east.
fn top(shot: &Shot) -> f64 {
    let up = shot.pose.direction_to_world(&-Vector3::y());
    up.y.atan2(up.x)
}

/// The modules that are detected in each photo.
fn seen(simulation: &Simulation) -> Vec<BTreeSet<usize>> {
    simulation.owners.iter().map(|owners| owners.iter().flatten().copied().collect()).collect()
}

/// The gaps between benches, by line and the place of the bench before, of which both neighbours are among the modules.
fn gaps(simulation: &Simulation, modules: &BTreeSet<usize>) -> BTreeSet<(u32, u32)> {
    let truth = &simulation.truth;
    let ends = |last: bool| -> BTreeSet<(u32, u32)> {
        let places = modules.iter().map(|module| &truth.modules[*module]);
        let at_end = places.filter(|module| {
            let bench = &truth.benches[module.bench as usize];
            module.col == if last { bench.columns - 1 } else { 0 }
        });
        at_end.map(|module| (module.line, truth.benches[module.bench as usize].index)).collect()
    };
    let firsts = ends(false);
    ends(true).into_iter().filter(|(line, index)| firsts.contains(&(*line, index + 1))).collect()
}

#[test]
fn flights_give_the_views_that_they_are_named_for() {
    for kind in kinds_of_view() {
        for seed in 0..3 {
            assert!((kind.is_given)(&kind.simulate(seed)), "seed {seed} does not give: {}", kind.name);
        }
    }
    // A flight in strips one way, straight down, gives none of rotation, tilt and both directions.
    let [rotated, tilted, _, _, both_ways] = kinds_of_view();
    let flight = Flight { both_directions: false, ..Flight::plain() };
    let ordinary = simulate(&plant(Some(LayoutKind::Plain), 0), &flight, &Errors::paper(), 0);
    for kind in [rotated, tilted, both_ways] {
        assert!(!(kind.is_given)(&ordinary), "an ordinary flight gives: {}", kind.name);
    }
}

#[test]
#[ignore = "long; run it with `make structure`"]
fn every_kind_of_view() {
    judge(&kinds_of_view().map(|kind| line(kind.name, |seed| kind.simulate(seed))));
}

#[test]
#[ignore = "long; run it with `make structure`"]
fn the_paper_s_plants_in_many_seeds() {
    let paper = |name: &str, spec: fn(&mut StdRng) -> PlantSpec, flight: &Flight| {
        let (exact, silent) = survey(name, PAPER_PLANTS, |seed| {
            simulate(&spec(&mut StdRng::seed_from_u64(seed)), flight, &Errors::paper(), seed)
        });
        Line { name: name.to_owned(), exact, needed: PAPER_PLANTS as usize - 1, of: PAPER_PLANTS, silent }
    };
    judge(&[
        paper("the paper's first plant", PlantSpec::paper_pp1, &Flight::paper_pp1()),
        paper("the paper's second plant", PlantSpec::paper_pp2, &Flight::paper_pp2()),
    ]);
}
