//! A plant as a designer draws it ([`PlantSpec`]) and as it then stands on the ground ([`PlantTruth`]).

use heliomap_model::{GeodeticReference, Lla};
use nalgebra::{Vector2, Vector3};
use std::collections::BTreeSet;
use std::ops::Range;

/// Smooth ground: a plane with waves on it.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Terrain {
    /// Rise towards east and north, metres per metre.
    pub slope: [f64; 2],
    pub waves: Vec<TerrainWave>,
}

/// One wave of the ground.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TerrainWave {
    pub amplitude_m: f64,
    pub wavelength_m: f64,
    /// Direction of travel, counter-clockwise from east.
    pub direction_rad: f64,
    pub phase_rad: f64,
}

impl Terrain {
    /// Height of the ground, metres, at a place in the local frame (east, north; metres).
    pub fn height_m(&self, place_m: Vector2<f64>) -> f64 {
        self.slope[0] * place_m.x
            + self.slope[1] * place_m.y
            + self
                .waves
                .iter()
                .map(|wave| {
                    let (sin, cos) = wave.direction_rad.sin_cos();
                    let along_m = cos * place_m.x + sin * place_m.y;
                    wave.amplitude_m * (std::f64::consts::TAU * along_m / wave.wavelength_m + wave.phase_rad).sin()
                })
                .sum::<f64>()
    }
}

/// One bench: a table of modules.
#[derive(Debug, Clone, PartialEq)]
pub struct BenchSpec {
    pub rows: u32,
    pub columns: u32,
    /// Module size along the row and up the table, metres: landscape where the first is the larger.
    pub module_m: [f64; 2],
    /// Clear distance between modules along the row and up the table, metres.
    pub seam_m: [f64; 2],
    /// Angle between the table and the horizontal across the row; positive looks to the right of the line's heading
    /// (south for a line that heads east).
    pub tilt_rad: f64,
    /// Clear distance along the line to the bench before it; for the first bench, to the start of the line. Metres.
    pub gap_before_m: f64,
    /// Shift to the left of the line's heading (north for a line that heads east), metres.
    pub lateral_offset_m: f64,
    /// Height above where the line's ground would have it, metres.
    pub height_step_m: f64,
    /// Whether its row is horizontal whatever the ground does.
    pub level: bool,
    /// Whether every column follows the line's curve and the ground by itself; otherwise the table is straight.
    pub flexible: bool,
    /// Places (row, column) without a module. They keep their numbers.
    pub missing: BTreeSet<(u32, u32)>,
}

impl BenchSpec {
    /// A straight, complete bench, half a metre from its neighbour, with seams of 2 cm.
    pub fn new(rows: u32, columns: u32, module_m: [f64; 2], tilt_rad: f64) -> Self {
        Self {
            rows,
            columns,
            module_m,
            seam_m: [0.02, 0.02],
            tilt_rad,
            gap_before_m: 0.5,
            lateral_offset_m: 0.0,
            height_step_m: 0.0,
            level: false,
            flexible: false,
            missing: BTreeSet::new(),
        }
    }

    /// Distance from the outer edge of its first module to that of its last, metres.
    pub fn length_m(&self) -> f64 {
        f64::from(self.columns) * (self.module_m[0] + self.seam_m[0]) - self.seam_m[0]
    }

    /// Extent up the table, metres.
    pub fn depth_m(&self) -> f64 {
        f64::from(self.rows) * (self.module_m[1] + self.seam_m[1]) - self.seam_m[1]
    }

    /// Modules in it.
    pub fn modules(&self) -> usize {
        (self.rows * self.columns) as usize - self.missing.len()
    }
}

/// A sideways wave of a line's axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LineCurve {
    pub amplitude_m: f64,
    pub wavelength_m: f64,
    pub phase_rad: f64,
}

/// Benches one behind the other.
#[derive(Debug, Clone, PartialEq)]
pub struct LineSpec {
    /// Where the line starts, in its block's frame (x along the rows, y to the left of them), metres. The line's axis
    /// runs through the middle of the tables.
    pub start_m: [f64; 2],
    /// Turn against the block's rows, counter-clockwise: other than nought in lines that are not parallel.
    pub heading_rad: f64,
    pub curve: Option<LineCurve>,
    pub benches: Vec<BenchSpec>,
}

impl LineSpec {
    /// A straight line of benches parallel to its block's rows.
    pub fn straight(start_m: [f64; 2], benches: Vec<BenchSpec>) -> Self {
        Self { start_m, heading_rad: 0.0, curve: None, benches }
    }
}

/// Lines with a common azimuth.
#[derive(Debug, Clone, PartialEq)]
pub struct BlockSpec {
    /// Origin of the block's frame in the local frame (east, north), metres.
    pub origin_m: [f64; 2],
    /// Direction of its rows, counter-clockwise from east: 0 for rows from west to east, `-PI / 2` for rows from north
    /// to south.
    pub heading_rad: f64,
    pub lines: Vec<LineSpec>,
}

/// A whole plant on paper.
#[derive(Debug, Clone, PartialEq)]
pub struct PlantSpec {
    pub name: String,
    pub reference: GeodeticReference,
    pub terrain: Terrain,
    /// Height of a table's lower edge above the ground, metres.
    pub clearance_m: f64,
    pub blocks: Vec<BlockSpec>,
}

impl PlantSpec {
    /// A plant of the given blocks.
    pub fn new(name: &str, terrain: Terrain, blocks: Vec<BlockSpec>) -> Self {
        let origin = Lla { latitude_deg: 49.8213, longitude_deg: 14.0127, height_m: 400.0 };
        Self { name: name.to_owned(), reference: GeodeticReference::new(origin), terrain, clearance_m: 0.8, blocks }
    }

    /// Every bench of the plant, in the order of [`PlantTruth::benches`].
    pub fn benches(&self) -> impl Iterator<Item = &BenchSpec> {
        self.blocks.iter().flat_map(|block| &block.lines).flat_map(|line| &line.benches)
    }

    /// Modules in the plant.
    pub fn modules(&self) -> usize {
        self.benches().map(BenchSpec::modules).sum()
    }

    /// The plant as it stands on its ground.
    pub fn build(&self) -> PlantTruth {
        let mut truth = PlantTruth {
            reference: self.reference,
            terrain: self.terrain.clone(),
            modules: Vec::with_capacity(self.modules()),
            benches: Vec::new(),
            lines: Vec::new(),
        };
        for (block_index, block) in self.blocks.iter().enumerate() {
            for line in &block.lines {
                let axis = LineAxis::new(&self.terrain, block, line);
                let first_bench = truth.benches.len();
                let line_index = truth.lines.len() as u32;
                let mut along_m = 0.0;
                for (index, bench) in line.benches.iter().enumerate() {
                    along_m = axis.advance(along_m, bench.gap_before_m);
                    let first_module = truth.modules.len();
                    along_m = self.place(bench, &axis, along_m, line_index, &mut truth);
                    truth.benches.push(TruthBench {
                        line: line_index,
                        index: index as u32,
                        rows: bench.rows,
                        columns: bench.columns,
                        modules: first_module..truth.modules.len(),
                        missing: bench.missing.iter().copied().collect(),
                    });
                }
                truth.lines.push(TruthLine { block: block_index as u32, benches: first_bench..truth.benches.len() });
            }
        }
        truth
    }

    /// Appends the modules of one bench that starts at `start_m` along the line and returns where it ends.
    fn place(&self, bench: &BenchSpec, axis: &LineAxis, start_m: f64, line: u32, truth: &mut PlantTruth) -> f64 {
        let pitch_m = [bench.module_m[0] + bench.seam_m[0], bench.module_m[1] + bench.seam_m[1]];
        let mut end_m = axis.advance(start_m, bench.length_m());
        // One frame for each column: its middle on the line's axis and its direction along the row.
        let columns: Vec<(Vector3<f64>, Vector3<f64>)> = if bench.flexible {
            let mut here_m = start_m;
            (0..bench.columns)
                .map(|_| {
                    let there_m = axis.advance(here_m, bench.module_m[0]);
                    let (a, b) = (axis.ground(here_m), axis.ground(there_m));
                    end_m = there_m;
                    here_m = axis.advance(there_m, bench.seam_m[0]);
                    ((a + b) / 2.0, (b - a).normalize())
                })
                .collect()
        } else {
            let (a, b) = (axis.ground(start_m), axis.ground(end_m));
            let middle = (a + b) / 2.0;
            let mut direction = b - a;
            if bench.level {
                direction.z = 0.0;
            }
            let direction = direction.normalize();
            (0..bench.columns)
                .map(|column| {
                    let offset_m = (f64::from(column) - (f64::from(bench.columns) - 1.0) / 2.0) * pitch_m[0];
                    (middle + direction * offset_m, direction)
                })
                .collect()
        };
        let rise_m = self.clearance_m + bench.depth_m() / 2.0 * bench.tilt_rad.sin().abs() + bench.height_step_m;
        let (sin_tilt, cos_tilt) = bench.tilt_rad.sin_cos();
        let bench_index = truth.benches.len() as u32;
        for row in 0..bench.rows {
            let up_m = ((f64::from(bench.rows) - 1.0) / 2.0 - f64::from(row)) * pitch_m[1];
            for (column, (middle, along)) in (0..).zip(&columns) {
                if bench.missing.contains(&(row, column)) {
                    continue;
                }
                let left = Vector3::new(-along.y, along.x, 0.0).normalize();
                let up_table = left * cos_tilt + along.cross(&left) * sin_tilt;
                truth.modules.push(TruthModule {
                    line,
                    bench: bench_index,
                    row,
                    col: column,
                    center_enu_m: middle + left * bench.lateral_offset_m + Vector3::z() * rise_m + up_table * up_m,
                    half_along_m: along * (bench.module_m[0] / 2.0),
                    half_up_m: up_table * (bench.module_m[1] / 2.0),
                });
            }
        }
        end_m
    }
}

/// The axis of a line over the ground, as a curve over the distance from its start.
struct LineAxis<'a> {
    terrain: &'a Terrain,
    start_m: Vector2<f64>,
    along: Vector2<f64>,
    curve: Option<LineCurve>,
}

impl<'a> LineAxis<'a> {
    fn new(terrain: &'a Terrain, block: &BlockSpec, line: &LineSpec) -> Self {
        let direction = |rad: f64| Vector2::new(rad.cos(), rad.sin());
        let x = direction(block.heading_rad);
        let start_m = Vector2::from(block.origin_m) + x * line.start_m[0] + Vector2::new(-x.y, x.x) * line.start_m[1];
        Self { terrain, start_m, along: direction(block.heading_rad + line.heading_rad), curve: line.curve }
    }

    /// The ground under the axis, local frame.
    fn ground(&self, along_m: f64) -> Vector3<f64> {
        let lateral_m = self.curve.map_or(0.0, |curve| {
            let wave = |s: f64| (std::f64::consts::TAU * s / curve.wavelength_m + curve.phase_rad).sin();
            curve.amplitude_m * (wave(along_m) - wave(0.0))
        });
        let place_m = self.start_m + self.along * along_m + Vector2::new(-self.along.y, self.along.x) * lateral_m;
        place_m.push(self.terrain.height_m(place_m))
    }

    /// Where on the axis a straight stick of the given length ends that starts at `from_m`.
    fn advance(&self, from_m: f64, length_m: f64) -> f64 {
        let from = self.ground(from_m);
        let mut step_m = length_m;
        if length_m > 1e-9 {
            for _ in 0..6 {
                step_m *= length_m / (self.ground(from_m + step_m) - from).norm();
            }
        }
        from_m + step_m
    }
}

/// One module as it stands.
#[derive(Debug, Clone, PartialEq)]
pub struct TruthModule {
    /// Index into [`PlantTruth::lines`].
    pub line: u32,
    /// Index into [`PlantTruth::benches`].
    pub bench: u32,
    /// From the left of the line's heading: 0 the northern row, for lines from north to south the eastern one.
    pub row: u32,
    /// From the start of the bench: 0 at its west end, for lines from north to south at its north end.
    pub col: u32,
    /// Middle of the face, local frame.
    pub center_enu_m: Vector3<f64>,
    /// From the middle to the middle of the side that ends the module along its row.
    pub half_along_m: Vector3<f64>,
    /// From the middle to the middle of its side up the table.
    pub half_up_m: Vector3<f64>,
}

impl TruthModule {
    /// South-west, south-east, north-east, north-west (for rows from west to east), local frame, metres.
    pub fn corners_enu_m(&self) -> [Vector3<f64>; 4] {
        let (c, u, v) = (self.center_enu_m, self.half_along_m, self.half_up_m);
        [c - u - v, c + u - v, c + u + v, c - u + v]
    }

    /// Unit normal of the face, pointing up.
    pub fn normal_enu(&self) -> Vector3<f64> {
        self.half_along_m.cross(&self.half_up_m).normalize()
    }

    /// Where a place (east, north) lies on the module as seen from above, in half modules along the row and up the
    /// table: both at most 1 in size inside it.
    pub fn place_on_face(&self, east_north_m: Vector2<f64>) -> Vector2<f64> {
        let d = east_north_m - self.center_enu_m.xy();
        let (u, v) = (self.half_along_m.xy(), self.half_up_m.xy());
        let area = u.perp(&v);
        Vector2::new(d.perp(&v) / area, u.perp(&d) / area)
    }
}

/// One bench as it stands.
#[derive(Debug, Clone, PartialEq)]
pub struct TruthBench {
    /// Index into [`PlantTruth::lines`].
    pub line: u32,
    /// Place in its line, 0 the first.
    pub index: u32,
    pub rows: u32,
    pub columns: u32,
    /// Its modules in [`PlantTruth::modules`], row by row.
    pub modules: Range<usize>,
    /// Places (row, column) without a module, sorted.
    pub missing: Vec<(u32, u32)>,
}

impl TruthBench {
    /// Index of the module at a place, if one stands there.
    pub fn module(&self, row: u32, col: u32) -> Option<usize> {
        if row >= self.rows || col >= self.columns {
            return None;
        }
        match self.missing.binary_search(&(row, col)) {
            Ok(_) => None,
            Err(before) => Some(self.modules.start + (row * self.columns + col) as usize - before),
        }
    }
}

/// One line as it stands.
#[derive(Debug, Clone, PartialEq)]
pub struct TruthLine {
    /// Index into [`PlantSpec::blocks`].
    pub block: u32,
    /// Its benches in [`PlantTruth::benches`], from its start on.
    pub benches: Range<usize>,
}

/// A plant as it stands: what a perfect mapping would find.
#[derive(Debug, Clone, PartialEq)]
pub struct PlantTruth {
    pub reference: GeodeticReference,
    pub terrain: Terrain,
    /// Line by line, bench by bench, row by row.
    pub modules: Vec<TruthModule>,
    pub benches: Vec<TruthBench>,
    pub lines: Vec<TruthLine>,
}

impl PlantTruth {
    /// Smallest and largest coordinates of module centres, local frame, metres. The plant must have a module.
    pub fn bounds_m(&self) -> (Vector3<f64>, Vector3<f64>) {
        let first = self.modules[0].center_enu_m;
        self.modules.iter().fold((first, first), |(low, high), m| (low.inf(&m.center_enu_m), high.sup(&m.center_enu_m)))
    }
}

/// Modules by place, in square cells seen from above.
pub(super) struct ModuleGrid {
    low_m: Vector2<f64>,
    cell_m: f64,
    size: [usize; 2],
    /// Where each cell starts in `members`, row by row, and the end.
    starts: Vec<u32>,
    members: Vec<u32>,
}

impl ModuleGrid {
    pub(super) fn new(truth: &PlantTruth, cell_m: f64) -> Self {
        let (low, high) = truth.bounds_m();
        let size = [0, 1].map(|k| ((high[k] - low[k]) / cell_m) as usize + 1);
        let mut grid =
            Self { low_m: low.xy(), cell_m, size, starts: vec![0; size[0] * size[1] + 1], members: Vec::new() };
        let cells: Vec<usize> = truth.modules.iter().map(|m| grid.cell(m.center_enu_m.xy())).collect();
        for &cell in &cells {
            grid.starts[cell + 1] += 1;
        }
        for cell in 1..grid.starts.len() {
            grid.starts[cell] += grid.starts[cell - 1];
        }
        let mut next = grid.starts.clone();
        grid.members = vec![0; cells.len()];
        for (module, &cell) in (0_u32..).zip(&cells) {
            grid.members[next[cell] as usize] = module;
            next[cell] += 1;
        }
        grid
    }

    fn column_and_row(&self, place_m: Vector2<f64>) -> [usize; 2] {
        [0, 1].map(|k| (((place_m[k] - self.low_m[k]) / self.cell_m).max(0.0) as usize).min(self.size[k] - 1))
    }

    fn cell(&self, place_m: Vector2<f64>) -> usize {
        let [x, y] = self.column_and_row(place_m);
        y * self.size[0] + x
    }

    /// Modules in the cells that a rectangle touches.
    pub(super) fn within(&self, low_m: Vector2<f64>, high_m: Vector2<f64>) -> impl Iterator<Item = usize> + '_ {
        let ([x0, y0], [x1, y1]) = (self.column_and_row(low_m), self.column_and_row(high_m));
        (y0..=y1)
            .flat_map(move |y| {
                let row = y * self.size[0];
                &self.members[self.starts[row + x0] as usize..self.starts[row + x1 + 1] as usize]
            })
            .map(|&module| module as usize)
    }

    /// The module whose face lies under or over a place, seen from above: of several the one whose middle is nearest.
    pub(super) fn at(&self, truth: &PlantTruth, place_m: Vector2<f64>) -> Option<usize> {
        let reach = Vector2::repeat(1.7);
        self.within(place_m - reach, place_m + reach)
            .map(|module| (truth.modules[module].place_on_face(place_m).amax(), module))
            .filter(|(distance, _)| *distance <= 1.0)
            .min_by(|a, b| a.0.total_cmp(&b.0))
            .map(|(_, module)| module)
    }
}
