//! Plants of every kind that the mapping should master, drawn at random.

use super::noise::signed;
use super::plant::{BenchSpec, BlockSpec, LineCurve, LineSpec, PlantSpec, Terrain, TerrainWave};
use rand::seq::SliceRandom;
use rand::{RngExt, SeedableRng, rngs::StdRng};
use std::f64::consts::{FRAC_PI_2, PI, TAU};
use std::ops::RangeInclusive;

/// Kinds of plants, each with a constructor of its own.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum LayoutKind {
    Plain,
    MixedBenches,
    Alone,
    Long,
    GapsSideBySide,
    Curved,
    Stepped,
    NonParallel,
    Blocks,
    MissingModules,
    Trackers,
    MixedOrientation,
    WideGaps,
    Roads,
}

impl LayoutKind {
    /// All kinds.
    pub const ALL: [Self; 14] = [
        Self::Plain,
        Self::MixedBenches,
        Self::Alone,
        Self::Long,
        Self::GapsSideBySide,
        Self::Curved,
        Self::Stepped,
        Self::NonParallel,
        Self::Blocks,
        Self::MissingModules,
        Self::Trackers,
        Self::MixedOrientation,
        Self::WideGaps,
        Self::Roads,
    ];
}

/// A portrait module of 60 cells, metres.
const PORTRAIT_M: [f64; 2] = [1.0, 1.65];
/// The same module on its side.
const LANDSCAPE_M: [f64; 2] = [1.65, 1.0];

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

    /// A plant of the given kind.
    pub fn random(kind: LayoutKind, rng: &mut StdRng) -> Self {
        match kind {
            LayoutKind::Plain => Self::random_plain(rng),
            LayoutKind::MixedBenches => Self::random_mixed_benches(rng),
            LayoutKind::Alone => Self::random_alone(rng),
            LayoutKind::Long => Self::random_long(rng),
            LayoutKind::GapsSideBySide => Self::random_gaps_side_by_side(rng),
            LayoutKind::Curved => Self::random_curved(rng),
            LayoutKind::Stepped => Self::random_stepped(rng),
            LayoutKind::NonParallel => Self::random_non_parallel(rng),
            LayoutKind::Blocks => Self::random_blocks(rng),
            LayoutKind::MissingModules => Self::random_missing_modules(rng),
            LayoutKind::Trackers => Self::random_trackers(rng),
            LayoutKind::MixedOrientation => Self::random_mixed_orientation(rng),
            LayoutKind::WideGaps => Self::random_wide_gaps(rng),
            LayoutKind::Roads => Self::random_roads(rng),
        }
    }

    /// A few parallel lines of equal benches of two or three rows, gaps shifted from line to line.
    pub fn random_plain(rng: &mut StdRng) -> Self {
        let heading_rad = 0.5 * signed(rng);
        one_block("random_plain", gentle(rng), heading_rad, plain_lines(rng))
    }

    /// Benches of one to four rows and different lengths side by side in each line, set up along their middles or along
    /// their lower edges.
    pub fn random_mixed_benches(rng: &mut StdRng) -> Self {
        let tilt_rad: f64 = rng.random_range(0.3..0.5);
        let along_lower_edge = rng.random::<bool>();
        let lines = several(rng, 3..=5, |line, rng| {
            let benches = several(rng, 2..=4, |_, rng| {
                let bench = BenchSpec::new(rng.random_range(1..=4), rng.random_range(6..=18), PORTRAIT_M, tilt_rad);
                let lower_m = if along_lower_edge { (bench.depth_m() / 2.0 - 3.3) * tilt_rad.cos() } else { 0.0 };
                BenchSpec { gap_before_m: narrow_gap(rng), lateral_offset_m: lower_m, ..bench }
            });
            LineSpec::straight([rng.random_range(0.0..8.0), -f64::from(line) * line_pitch_m(4, 1.65)], benches)
        });
        one_block("random_mixed_benches", gentle(rng), 0.5 * signed(rng), lines)
    }

    /// Every bench alone in its line: not one gap.
    pub fn random_alone(rng: &mut StdRng) -> Self {
        let tilt_rad = rng.random_range(0.3..0.5);
        let rows = rng.random_range(1..=4);
        let lines = several(rng, 4..=7, |line, rng| {
            let bench = BenchSpec::new(rows, rng.random_range(12..=40), PORTRAIT_M, tilt_rad);
            LineSpec::straight([rng.random_range(0.0..10.0), -f64::from(line) * line_pitch_m(rows, 1.65)], vec![bench])
        });
        one_block("random_alone", gentle(rng), 0.5 * signed(rng), lines)
    }

    /// One or two benches in each line, as long as a photo is wide or longer: many photos see a bench without its ends,
    /// and the same bench from both sides.
    pub fn random_long(rng: &mut StdRng) -> Self {
        let tilt_rad = rng.random_range(0.3..0.5);
        let rows = rng.random_range(2..=3);
        let lines = several(rng, 4..=6, |line, rng| {
            let benches = several(rng, 1..=2, |_, rng| BenchSpec {
                gap_before_m: narrow_gap(rng),
                ..BenchSpec::new(rows, rng.random_range(40..=65), PORTRAIT_M, tilt_rad)
            });
            LineSpec::straight([rng.random_range(0.0..15.0), -f64::from(line) * line_pitch_m(rows, 1.65)], benches)
        });
        one_block("random_long", gentle(rng), 0.5 * signed(rng), lines)
    }

    /// Every gap of one line beside one of the next: all lines are the same.
    pub fn random_gaps_side_by_side(rng: &mut StdRng) -> Self {
        let tilt_rad = rng.random_range(0.3..0.5);
        let rows = rng.random_range(2..=3);
        let columns = rng.random_range(10..=18);
        let gap_m = narrow_gap(rng);
        let bench = BenchSpec { gap_before_m: gap_m, ..BenchSpec::new(rows, columns, PORTRAIT_M, tilt_rad) };
        let benches = vec![bench; rng.random_range(2..=4)];
        let lines = several(rng, 3..=6, |line, _| {
            LineSpec::straight([0.0, -f64::from(line) * line_pitch_m(rows, 1.65)], benches.clone())
        });
        one_block("random_gaps_side_by_side", gentle(rng), 0.5 * signed(rng), lines)
    }

    /// Rows that wind sideways and over waves of the ground, some benches bending with them, some straight.
    pub fn random_curved(rng: &mut StdRng) -> Self {
        let tilt_rad = rng.random_range(0.3..0.5);
        let rows = rng.random_range(2..=3);
        // A curvature that the seams can take up, per metre.
        let curvature = rng.random_range(0.003..0.008);
        let wavelength_m: f64 = rng.random_range(80.0..140.0);
        let curve = LineCurve {
            amplitude_m: curvature * (wavelength_m / TAU).powi(2),
            wavelength_m,
            phase_rad: PI * signed(rng),
        };
        let terrain = Terrain {
            slope: [0.02 * signed(rng), 0.02 * signed(rng)],
            waves: vec![wave(rng.random_range(0.5..1.5), rng.random_range(70.0..140.0), rng)],
        };
        let with_straight_ones = rng.random::<bool>();
        let lines = several(rng, 3..=5, |line, rng| {
            let benches = several(rng, 2..=3, |_, rng| {
                let flexible = !(with_straight_ones && rng.random_bool(0.4));
                // Straight tables in a curve are short and stand farther apart, or their corners would meet.
                let (columns, gap_m) = if with_straight_ones { (10..=15, 0.35) } else { (14..=26, 0.0) };
                BenchSpec {
                    gap_before_m: gap_m + narrow_gap(rng),
                    seam_m: [0.03, 0.02],
                    flexible,
                    ..BenchSpec::new(rows, rng.random_range(columns), PORTRAIT_M, tilt_rad)
                }
            });
            let start_m = [rng.random_range(0.0..6.0), -f64::from(line) * (line_pitch_m(rows, 1.65) + 1.5)];
            // The same wave over the ground for all lines, wherever they start.
            let phase_rad = curve.phase_rad + TAU * start_m[0] / curve.wavelength_m;
            LineSpec { curve: Some(LineCurve { phase_rad, ..curve }), ..LineSpec::straight(start_m, benches) }
        });
        one_block("random_curved", terrain, 0.4 * signed(rng), lines)
    }

    /// Level benches on a slope, each a step above or below its neighbour.
    pub fn random_stepped(rng: &mut StdRng) -> Self {
        let tilt_rad = rng.random_range(0.3..0.5);
        let rows = rng.random_range(2..=3);
        let rise = if rng.random::<bool>() { 1.0 } else { -1.0 } * rng.random_range(0.02..0.045);
        let terrain = Terrain { slope: [rise, 0.02 * signed(rng)], waves: vec![wave(0.4, 200.0, rng)] };
        let lines = several(rng, 3..=5, |line, rng| {
            let benches = several(rng, 2..=4, |_, rng| BenchSpec {
                gap_before_m: narrow_gap(rng),
                level: true,
                height_step_m: 0.25 * signed(rng),
                lateral_offset_m: 0.2 * signed(rng),
                ..BenchSpec::new(rows, rng.random_range(10..=18), PORTRAIT_M, tilt_rad)
            });
            LineSpec::straight([rng.random_range(0.0..12.0), -f64::from(line) * line_pitch_m(rows, 1.65)], benches)
        });
        one_block("random_stepped", terrain, 0.4 * signed(rng), lines)
    }

    /// Lines that turn against each other by up to 6 degrees.
    pub fn random_non_parallel(rng: &mut StdRng) -> Self {
        let tilt_rad = rng.random_range(0.3..0.5);
        let rows = rng.random_range(2..=3);
        let pitch_m = line_pitch_m(rows, 1.65);
        let longest_m = 60.0;
        // Place of the axis of the line before at the start and at the end of the longest line.
        let mut before_m: Option<[f64; 2]> = None;
        let lines = several(rng, 3..=5, |_, rng| {
            let heading_rad: f64 = 0.055 * signed(rng);
            let rise_m = longest_m * heading_rad.tan();
            let start_m = before_m.map_or(0.0, |[start, end]| (start - pitch_m).min(end - pitch_m - rise_m));
            before_m = Some([start_m, start_m + rise_m]);
            let benches = several(rng, 2..=3, |_, rng| BenchSpec {
                gap_before_m: narrow_gap(rng),
                ..BenchSpec::new(rows, rng.random_range(10..=18), PORTRAIT_M, tilt_rad)
            });
            LineSpec { heading_rad, ..LineSpec::straight([0.0, start_m], benches) }
        });
        one_block("random_non_parallel", gentle(rng), 0.4 * signed(rng), lines)
    }

    /// Two or three blocks of different azimuth.
    pub fn random_blocks(rng: &mut StdRng) -> Self {
        let mut heading_rad = 0.6 * signed(rng);
        let mut east_m = 0.0;
        let blocks = several(rng, 2..=3, |_, rng| {
            let mut other_rad = 0.6 * signed(rng);
            while (other_rad - heading_rad).abs() < 0.2 {
                other_rad = 0.6 * signed(rng);
            }
            heading_rad = other_rad;
            let lines = plain_lines(rng);
            // Turned about its own middle, as far from the block before as both may reach.
            let length_m = |line: &LineSpec| {
                line.start_m[0] + line.benches.iter().map(|b| b.gap_before_m + b.length_m()).sum::<f64>()
            };
            let half_m = [
                lines.iter().map(length_m).fold(0.0, f64::max) / 2.0,
                lines.iter().map(|line| line.start_m[1]).fold(0.0, f64::min) / 2.0,
            ];
            let (sin, cos) = heading_rad.sin_cos();
            let half_width_m = half_m[0] * cos + half_m[1].abs() * sin.abs() + 6.0;
            east_m += half_width_m;
            let middle_m = [east_m, 8.0 * signed(rng)];
            east_m += half_width_m;
            let origin_m =
                [middle_m[0] - cos * half_m[0] + sin * half_m[1], middle_m[1] - sin * half_m[0] - cos * half_m[1]];
            BlockSpec { origin_m, heading_rad, lines }
        });
        Self::new("random_blocks", gentle(rng), blocks)
    }

    /// Benches with holes: 2 to 6 % of the modules are missing, alone, in pairs and at corners, no column altogether.
    pub fn random_missing_modules(rng: &mut StdRng) -> Self {
        let heading_rad = 0.5 * signed(rng);
        let mut lines = plain_lines(rng);
        let share = rng.random_range(0.02..0.06);
        for bench in lines.iter_mut().flat_map(|line| &mut line.benches) {
            let holes = (share * f64::from(bench.rows * bench.columns)).ceil() as usize;
            for _ in 0..4 * holes {
                if bench.missing.len() >= holes {
                    break;
                }
                let (row, column) = (rng.random_range(0..bench.rows), rng.random_range(0..bench.columns));
                let width = if rng.random_bool(0.3) { 2 } else { 1 };
                for column in column..(column + width).min(bench.columns) {
                    if (0..bench.rows).all(|other| other == row || !bench.missing.contains(&(other, column))) {
                        bench.missing.insert((row, column));
                    }
                }
            }
        }
        one_block("random_missing_modules", gentle(rng), heading_rad, lines)
    }

    /// Single-axis trackers: rows from north to south, one module across, each parted by its motor's gap. All stand at
    /// the same angle but for a degree.
    pub fn random_trackers(rng: &mut StdRng) -> Self {
        let module_m = [rng.random_range(1.0..1.15), rng.random_range(1.9..2.2)];
        let tilt_rad = 0.4 * signed(rng);
        let pitch_m = module_m[1] + rng.random_range(2.5..4.0);
        let (motor_gap_m, gap_m) = (rng.random_range(0.35..0.6), rng.random_range(1.3..3.0));
        let regular = rng.random::<bool>();
        let usual = rng.random_range(10..=16);
        let trackers = rng.random_range(1..=2);
        let lines = several(rng, 5..=9, |line, rng| {
            let mut benches = Vec::new();
            for _ in 0..trackers {
                let tilt_rad = tilt_rad + 0.02 * signed(rng);
                for gap_before_m in [gap_m, motor_gap_m] {
                    let columns = if regular { usual } else { rng.random_range(usual - 3..=usual + 3) };
                    benches.push(BenchSpec { gap_before_m, ..BenchSpec::new(1, columns, module_m, tilt_rad) });
                }
            }
            let start_m = if regular { 0.0 } else { rng.random_range(0.0..5.0) };
            LineSpec::straight([start_m, -f64::from(line) * pitch_m], benches)
        });
        let heading_rad = -FRAC_PI_2 + 0.15 * signed(rng);
        one_block("random_trackers", gentle(rng), heading_rad, lines)
    }

    /// Benches of two portrait rows and benches of three landscape rows in one plant, mixed in a line or line by line.
    pub fn random_mixed_orientation(rng: &mut StdRng) -> Self {
        let tilt_rad = rng.random_range(0.3..0.5);
        let within_lines = rng.random::<bool>();
        let lines = several(rng, 3..=5, |line, rng| {
            let benches = several(rng, 2..=4, |bench, rng| {
                let landscape = if within_lines { (line + bench) % 2 == 0 } else { line % 2 == 0 };
                let bench = if landscape {
                    BenchSpec::new(3, rng.random_range(7..=12), LANDSCAPE_M, tilt_rad)
                } else {
                    BenchSpec::new(2, rng.random_range(10..=18), PORTRAIT_M, tilt_rad)
                };
                BenchSpec { gap_before_m: narrow_gap(rng), ..bench }
            });
            LineSpec::straight([rng.random_range(0.0..12.0), -f64::from(line) * line_pitch_m(2, 1.65)], benches)
        });
        one_block("random_mixed_orientation", gentle(rng), 0.5 * signed(rng), lines)
    }

    /// Gaps of two to six modules' width among narrow ones.
    pub fn random_wide_gaps(rng: &mut StdRng) -> Self {
        let heading_rad = 0.5 * signed(rng);
        let mut lines = plain_lines(rng);
        for bench in lines.iter_mut().flat_map(|line| line.benches.iter_mut().skip(1)) {
            if rng.random_bool(0.6) {
                bench.gap_before_m = rng.random_range(2.2..6.0);
            }
        }
        one_block("random_wide_gaps", gentle(rng), heading_rad, lines)
    }

    /// A road across all lines, and often another between two of them.
    pub fn random_roads(rng: &mut StdRng) -> Self {
        let tilt_rad = rng.random_range(0.3..0.5);
        let rows = rng.random_range(2..=3);
        let road_m = rng.random_range(4.5..8.0);
        let between = rng.random_range(0..6);
        let lines = several(rng, 3..=5, |line, rng| {
            let bench = |rng: &mut StdRng| BenchSpec {
                gap_before_m: narrow_gap(rng),
                ..BenchSpec::new(rows, rng.random_range(8..=16), PORTRAIT_M, tilt_rad)
            };
            let west = several(rng, 1..=2, |_, rng| bench(rng));
            let mut east = several(rng, 1..=2, |_, rng| bench(rng));
            east[0].gap_before_m = road_m + rng.random_range(0.0..1.0);
            // Its west part ends at the road wherever it starts.
            let west_m: f64 = west.iter().map(|b| b.gap_before_m + b.length_m()).sum();
            let south_m = f64::from(line) * line_pitch_m(rows, 1.65) + if line > between { road_m } else { 0.0 };
            LineSpec::straight([-west_m, -south_m], [west, east].concat())
        });
        one_block("random_roads", gentle(rng), 0.5 * signed(rng), lines)
    }
}

/// Some of `count` things, told their number.
fn several<T>(rng: &mut StdRng, count: RangeInclusive<u32>, mut thing: impl FnMut(u32, &mut StdRng) -> T) -> Vec<T> {
    (0..rng.random_range(count)).map(|index| thing(index, rng)).collect()
}

/// The lines of [`PlantSpec::random_plain`].
fn plain_lines(rng: &mut StdRng) -> Vec<LineSpec> {
    let tilt_rad = rng.random_range(0.3..0.5);
    let rows = rng.random_range(2..=3);
    let columns = rng.random_range(10..=18);
    several(rng, 3..=5, |line, rng| {
        let benches = several(rng, 2..=4, |_, rng| BenchSpec {
            gap_before_m: narrow_gap(rng),
            ..BenchSpec::new(rows, columns, PORTRAIT_M, tilt_rad)
        });
        LineSpec::straight([rng.random_range(0.0..12.0), -f64::from(line) * line_pitch_m(rows, 1.65)], benches)
    })
}

/// A gap as it is common between benches, metres.
fn narrow_gap(rng: &mut StdRng) -> f64 {
    rng.random_range(0.35..0.7)
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
