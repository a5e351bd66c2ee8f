//! The long survey: every kind of layout and every kind of view on many random plants, and the paper's two plants. It
//! fails where fewer come out exactly than must, or where a wrong one raises no doubt.

use super::{plant, survey};
use heliomap::geometry::Camera;
use heliomap::simulator::{Errors, Flight, LayoutKind, PlantSpec, simulate};
use rand::SeedableRng;
use rand::rngs::StdRng;

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
fn line(name: &str, make: impl Fn(u64) -> heliomap::simulator::Simulation + Sync) -> Line {
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

#[test]
#[ignore = "long; run it with `make structure`"]
fn every_kind_of_view() {
    let views: [(&str, LayoutKind, Flight); 5] = [
        ("each photo in any rotation", LayoutKind::Plain, Flight { yaw_jitter_rad: 3.0, ..Flight::plain() }),
        (
            "up to 20 degrees off nadir",
            LayoutKind::Plain,
            Flight { tilt_rad: 20.0_f64.to_radians(), ..Flight::plain() },
        ),
        (
            "plants wider than a frame",
            LayoutKind::Plain,
            Flight { camera: Camera::pinhole(1800, 1200, 0.777), altitude_m: 30.0, ..Flight::plain() },
        ),
        (
            "benches cut, no gap shared",
            LayoutKind::Long,
            Flight { camera: Camera::pinhole(1800, 1200, 0.777), altitude_m: 30.0, ..Flight::plain() },
        ),
        (
            "one bench from both directions",
            LayoutKind::Alone,
            Flight { heading_rad: std::f64::consts::FRAC_PI_2, yaw_jitter_rad: 0.1, ..Flight::plain() },
        ),
    ];
    let lines: Vec<Line> = views
        .iter()
        .map(|(name, kind, flight)| {
            line(name, |seed| simulate(&plant(Some(*kind), seed), flight, &Errors::paper(), seed))
        })
        .collect();
    judge(&lines);
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
