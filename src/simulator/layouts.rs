//! Plants of every kind that the mapping should master, drawn at random.

use super::noise::signed;
use super::plant::{BenchSpec, BlockSpec, LineSpec, PlantSpec, Terrain, TerrainWave};
use rand::seq::SliceRandom;
use rand::{RngExt, SeedableRng, rngs::StdRng};
use std::f64::consts::PI;

/// A portrait module of 60 cells, metres.
const PORTRAIT_M: [f64; 2] = [1.0, 1.65];

impl PlantSpec {
    /// A plant like the first one of the paper (Table 1): 13 lines, 106 benches of 2 rows, 4974 modules of
    /// 1.0 x 1.65 m on 275 x 140 m.
    pub fn paper_pp1(rng: &mut StdRng) -> Self {
        let benches_of_lines = [5, 6, 7, 8, 9, 11, 11, 11, 10, 9, 8, 6, 5];
        let tilt_rad = rng.random_range(0.4..0.5);
        let mut columns = columns_in_total(2487, 106, 3, rng).into_iter();
        let lines = benches_of_lines.iter().enumerate().map(|(line, &count)| {
            let benches: Vec<BenchSpec> = columns
                .by_ref()
                .take(count)
                .map(|columns| BenchSpec {
                    gap_before_m: rng.random_range(0.3..0.55),
                    ..BenchSpec::new(2, columns, PORTRAIT_M, tilt_rad)
                })
                .collect();
            let length_m: f64 = benches.iter().map(|bench| bench.length_m() + bench.gap_before_m).sum();
            // The longest lines span the plant; shorter ones start anywhere in between.
            let start_m = rng.random_range(0.0..=1.0) * (275.0 - length_m).max(0.0);
            LineSpec::straight([start_m, -11.35 * line as f64], benches)
        });
        let block = BlockSpec { origin_m: [-137.0, 68.0], heading_rad: 0.0, lines: lines.collect() };
        Self::new("paper_pp1", gentle(rng), vec![block])
    }

    /// A plant like the second one of the paper (Table 1): 9 lines of 3 benches of 6 rows, 5400 modules of
    /// 1.57 x 0.79 m on 160 x 110 m.
    pub fn paper_pp2(rng: &mut StdRng) -> Self {
        let tilt_rad = rng.random_range(0.4..0.5);
        let mut columns = columns_in_total(900, 27, 1, rng).into_iter();
        let lines = (0..9).map(|line| {
            let benches = columns.by_ref().take(3).map(|columns| BenchSpec {
                gap_before_m: rng.random_range(0.4..0.8),
                ..BenchSpec::new(6, columns, [1.57, 0.79], tilt_rad)
            });
            let benches = benches.collect();
            LineSpec::straight([2.0 * signed(rng), -13.1 * f64::from(line)], benches)
        });
        let block = BlockSpec { origin_m: [-80.0, 52.0], heading_rad: 0.0, lines: lines.collect() };
        Self::new("paper_pp2", gentle(rng), vec![block])
    }

    /// A plain plant with exactly the given number of modules, for measuring time and memory over size: benches of two
    /// rows of 18 to 28, about as wide as it is deep. The same every time.
    pub fn sized(modules: usize) -> Self {
        let mut rng = StdRng::seed_from_u64(modules as u64);
        let line_pitch_m = 7.5;
        let width_m = (modules as f64 / 2.0 * 1.05 * line_pitch_m).sqrt().max(20.0);
        let mut left = modules;
        let mut lines = Vec::new();
        while left > 0 {
            let start_m = rng.random_range(0.0..8.0);
            let mut along_m = start_m;
            let mut benches = Vec::new();
            while left > 0 && along_m < width_m {
                let rows = if left == 1 { 1 } else { 2 };
                let columns = rng.random_range(18..=28).min(left.div_ceil(rows as usize) as u32);
                let mut bench = BenchSpec::new(rows, columns, PORTRAIT_M, 0.45);
                bench.gap_before_m = rng.random_range(0.35..0.75);
                if bench.modules() > left {
                    bench.missing.insert((1, columns / 2));
                }
                left -= bench.modules();
                along_m += bench.gap_before_m + bench.length_m();
                benches.push(bench);
            }
            lines.push(LineSpec::straight([start_m, -line_pitch_m * lines.len() as f64], benches));
        }
        let terrain = Terrain { slope: [0.01, 0.005], waves: vec![wave(3.0, 700.0, &mut rng)] };
        Self::new("sized", terrain, vec![BlockSpec { origin_m: [0.0, 0.0], heading_rad: 0.0, lines }])
    }

    /// A few parallel lines of equal benches of two or three rows, gaps shifted from line to line.
    pub fn random_plain(rng: &mut StdRng) -> Self {
        let rows = rng.random_range(2..=3);
        let columns = rng.random_range(10..=18);
        let tilt_rad = rng.random_range(0.3..0.5);
        let lines = (0..rng.random_range(3..=5)).map(|line| {
            let benches = (0..rng.random_range(2..=4)).map(|_| BenchSpec {
                gap_before_m: rng.random_range(0.35..0.7),
                ..BenchSpec::new(rows, columns, PORTRAIT_M, tilt_rad)
            });
            let benches = benches.collect();
            LineSpec::straight([rng.random_range(0.0..12.0), -f64::from(line) * line_pitch_m(rows, 1.65)], benches)
        });
        let lines = lines.collect();
        one_block("random_plain", gentle(rng), signed(rng) * 0.5, lines)
    }
}

/// Distance between the axes of neighbouring lines of tables with the given rows.
fn line_pitch_m(rows: u32, module_up_m: f64) -> f64 {
    f64::from(rows) * module_up_m + 3.5
}

/// Ground that falls and rises by a metre or two over a plant.
fn gentle(rng: &mut StdRng) -> Terrain {
    Terrain {
        slope: [0.02 * signed(rng), 0.02 * signed(rng)],
        waves: vec![wave(0.8, 300.0, rng), wave(0.3, 120.0, rng)],
    }
}

/// A wave in any direction.
fn wave(amplitude_m: f64, wavelength_m: f64, rng: &mut StdRng) -> TerrainWave {
    TerrainWave { amplitude_m, wavelength_m, direction_rad: PI * signed(rng), phase_rad: PI * signed(rng) }
}

/// A plant of one block.
fn one_block(name: &str, terrain: Terrain, heading_rad: f64, lines: Vec<LineSpec>) -> PlantSpec {
    PlantSpec::new(name, terrain, vec![BlockSpec { origin_m: [0.0, 0.0], heading_rad, lines }])
}

/// Columns of `benches` benches that differ by at most `spread` from the usual number and make `total` together.
fn columns_in_total(total: u32, benches: u32, spread: u32, rng: &mut StdRng) -> Vec<u32> {
    let usual = total / benches;
    let mut columns = vec![usual; benches as usize];
    for column in columns.iter_mut().take((total - usual * benches) as usize) {
        *column += 1;
    }
    // Take from one and give to another: the total stays.
    for _ in 0..(spread - 1) * benches {
        let (from, to) = (rng.random_range(0..columns.len()), rng.random_range(0..columns.len()));
        if from != to && columns[from] + spread > usual + 1 && columns[to] < usual + spread {
            columns[from] -= 1;
            columns[to] += 1;
        }
    }
    columns.shuffle(rng);
    columns
}
