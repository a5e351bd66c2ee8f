//! Is a found structure the true one?

use super::plant::{ModuleGrid, PlantTruth, TruthModule};
use nalgebra::{Matrix2, Vector2, Vector3};
use rstar::{RTree, primitives::GeomWithData};
use std::collections::BTreeMap;

/// One module as a mapping found it.
#[derive(Debug, Clone, PartialEq)]
pub struct FoundModule {
    /// Middle of the face in the mapping's local frame, metres.
    pub center_enu_m: Vector3<f64>,
    /// Any name of its line, the same for all its modules.
    pub line: String,
    /// Any name of its bench, the same for all its modules; need only be unique in its line.
    pub bench: String,
    pub row: u32,
    pub number: u32,
}

/// How a found plant differs from the true one.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct StructureReport {
    /// True modules that nothing was found at (indices into [`PlantTruth::modules`]).
    pub missing: Vec<usize>,
    /// Found modules where none stands, or a second one where one does (indices into what was found).
    pub false_modules: Vec<usize>,
    /// What is wrong with lines, benches, rows and numbers, each bench or line once.
    pub wrong_structure: Vec<WrongStructure>,
    /// Whether nothing differs.
    pub exact: bool,
    /// The true module of every found one.
    pub pairs: Vec<Option<usize>>,
}

/// A bench or line that is not the true one.
#[derive(Debug, Clone, PartialEq)]
pub struct WrongStructure {
    /// One sentence.
    pub message: String,
    /// The found modules concerned: all of the bench, or of the line (indices into what was found).
    pub modules: Vec<usize>,
}

/// Compares what was found with the truth. Modules are paired by place, seen from above: a common shift of up to a
/// metre, a scale error of up to a percent, a small turn, and shifts of single benches of up to 0.4 m do not matter;
/// then the middle of a found module must lie on the face of its true one. The structure agrees where one naming of
/// lines and benches, and for the whole plant one way of counting rows and one of counting numbers (from either end,
/// from any first number), turns the found places into the true ones.
pub fn structure_report(truth: &PlantTruth, found: &[FoundModule]) -> StructureReport {
    let mut report = StructureReport::default();
    if truth.modules.is_empty() || found.is_empty() {
        report.missing = (0..truth.modules.len()).collect();
        report.false_modules = (0..found.len()).collect();
        report.pairs = vec![None; found.len()];
        report.exact = truth.modules.is_empty() && found.is_empty();
        return report;
    }
    let grid = ModuleGrid::new(truth, 3.0);
    let places: Vec<Vector2<f64>> = found.iter().map(|module| module.center_enu_m.xy()).collect();
    let mut benches: BTreeMap<(&str, &str), Vec<usize>> = BTreeMap::new();
    for (index, module) in found.iter().enumerate() {
        benches.entry((&module.line, &module.bench)).or_default().push(index);
    }
    let alignment = Planar::align(truth, &grid, &places, benches.values());
    let places: Vec<Vector2<f64>> = places.iter().map(|place| alignment.apply(*place)).collect();
    report.pairs = pairs(truth, &grid, &places, benches.values());
    let mut taken = vec![false; truth.modules.len()];
    for (index, pair) in report.pairs.iter().enumerate() {
        match pair {
            Some(module) => taken[*module] = true,
            None => report.false_modules.push(index),
        }
    }
    report.missing = (0..taken.len()).filter(|&module| !taken[module]).collect();
    report.wrong_structure = wrong_structure(truth, found, &report.pairs, &benches);
    report.exact = report.missing.is_empty() && report.false_modules.is_empty() && report.wrong_structure.is_empty();
    report
}

/// The true module of every found one, each given once, to the nearest. Each found bench may be shifted as a whole.
fn pairs<'a>(
    truth: &PlantTruth,
    grid: &ModuleGrid,
    places: &[Vector2<f64>],
    benches: impl Iterator<Item = &'a Vec<usize>>,
) -> Vec<Option<usize>> {
    let mut best: Vec<Option<(f64, usize)>> = vec![None; truth.modules.len()];
    for members in benches {
        let shift = bench_shift(truth, grid, places, members);
        for &index in members {
            let place = places[index] + shift;
            if let Some(module) = grid.at(truth, place) {
                let distance = truth.modules[module].place_on_face(place).amax();
                if best[module].is_none_or(|(least, _)| distance < least) {
                    best[module] = Some((distance, index));
                }
            }
        }
    }
    let mut pairs = vec![None; places.len()];
    for (module, best) in best.into_iter().enumerate() {
        if let Some((_, index)) = best {
            pairs[index] = Some(module);
        }
    }
    pairs
}

/// The shift of at most 0.7 m that puts most members of a found bench on modules of one true bench; none where none is
/// needed.
fn bench_shift(truth: &PlantTruth, grid: &ModuleGrid, places: &[Vector2<f64>], members: &[usize]) -> Vector2<f64> {
    const LARGEST_SHIFT_M: f64 = 0.7;
    let settle = |start: Vector2<f64>| {
        let mut shift = start;
        let mut modules = Vec::new();
        for _ in 0..4 {
            modules.clear();
            let mut residual = Vector2::zeros();
            for &index in members {
                if let Some(module) = grid.at(truth, places[index] + shift) {
                    residual += truth.modules[module].center_enu_m.xy() - places[index] - shift;
                    modules.push(module);
                }
            }
            if modules.is_empty() {
                break;
            }
            let next = shift + residual / modules.len() as f64;
            if next.norm() > LARGEST_SHIFT_M || (next - shift).norm() < 1e-6 {
                break;
            }
            shift = next;
        }
        // Beside a narrow gap a bench shifted by a column has all modules on faces, but not on those of one bench.
        modules.sort_unstable();
        modules.dedup();
        let parts = modules.chunk_by(|a, b| truth.modules[*a].bench == truth.modules[*b].bench);
        (parts.map(<[usize]>::len).max().unwrap_or(0), shift)
    };
    let mut best = settle(Vector2::zeros());
    if best.0 < members.len() {
        for (east, north) in [(1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, 1), (1, -1), (-1, -1)] {
            let trial = settle(Vector2::new(f64::from(east), f64::from(north)) * 0.4);
            if trial.0 > best.0 {
                best = trial;
            }
        }
    }
    best.1
}

/// A similarity of the plane.
#[derive(Debug, Clone, Copy)]
struct Planar {
    turn: Matrix2<f64>,
    shift: Vector2<f64>,
}

impl Planar {
    fn apply(&self, place: Vector2<f64>) -> Vector2<f64> {
        self.turn * place + self.shift
    }

    /// The least-squares similarity of paired places.
    fn fit(pairs: &[(Vector2<f64>, Vector2<f64>)]) -> Option<Self> {
        let count = pairs.len() as f64;
        let (mut from_mean, mut to_mean) = (Vector2::zeros(), Vector2::zeros());
        for (from, to) in pairs {
            from_mean += from / count;
            to_mean += to / count;
        }
        let (mut dot, mut cross, mut spread) = (0.0, 0.0, 0.0);
        for (from, to) in pairs {
            let (from, to) = (from - from_mean, to - to_mean);
            dot += from.dot(&to);
            cross += from.perp(&to);
            spread += from.norm_squared();
        }
        if spread < 1e-6 {
            return None;
        }
        let turn = Matrix2::new(dot, -cross, cross, dot) / spread;
        Some(Self { turn, shift: to_mean - turn * from_mean })
    }

    /// Found places -> true places. From several starts (as they are, moments equalised, benches matched, shifted
    /// about) places and the modules under them are paired and fitted in turn; the start that ends best wins. `benches`
    /// are the found ones.
    fn align<'a>(
        truth: &PlantTruth,
        grid: &ModuleGrid,
        places: &[Vector2<f64>],
        benches: impl Iterator<Item = &'a Vec<usize>> + Clone,
    ) -> Self {
        let by_benches = Self::by_benches(truth, places, benches.clone());
        let step = places.len().div_ceil(8000);
        let members = (0..).zip(benches).flat_map(|(bench, members)| members.iter().map(move |&index| (bench, index)));
        let sample: Vec<(u32, Vector2<f64>)> =
            members.step_by(step).map(|(bench, index)| (bench, places[index])).collect();
        let identity = Self { turn: Matrix2::identity(), shift: Vector2::zeros() };
        let best = |starts: Vec<Self>| {
            let ends = starts.into_iter().map(|start| start.improved(truth, grid, &sample));
            ends.max_by(|a, b| a.0.total_cmp(&b.0)).unwrap_or((0.0, identity))
        };
        let mut end = best(vec![identity, Self::by_moments(truth, places), by_benches]);
        if end.0 < sample.len() as f64 - 1.0 {
            let shifted =
                |k: i32| Self { shift: Vector2::new(f64::from(k % 5 - 2), f64::from(k / 5 - 2)) * 0.5, ..identity };
            let other = best((0..25).map(shifted).collect());
            if other.0 > end.0 {
                end = other;
            }
        }
        end.1
    }

    /// Puts found benches on the true benches of as many modules next to them.
    fn by_benches<'a>(
        truth: &PlantTruth,
        places: &[Vector2<f64>],
        benches: impl Iterator<Item = &'a Vec<usize>>,
    ) -> Self {
        const REACH_M: f64 = 4.0;
        let mean = |sum: Vector2<f64>, count: usize| sum / count as f64;
        let middles = truth.benches.iter().enumerate().filter(|(_, bench)| !bench.modules.is_empty());
        let middles = middles.map(|(index, bench)| {
            let sum = truth.modules[bench.modules.clone()].iter().map(|module| module.center_enu_m.xy()).sum();
            GeomWithData::new(<[f64; 2]>::from(mean(sum, bench.modules.len())), index)
        });
        let tree = RTree::bulk_load(middles.collect());
        let found: Vec<(Vector2<f64>, usize)> = benches
            .map(|members| (mean(members.iter().map(|&index| places[index]).sum(), members.len()), members.len()))
            .collect();
        let mut best = Self { turn: Matrix2::identity(), shift: Vector2::zeros() };
        for round in 0..3 {
            let reach_m = if round == 0 { REACH_M } else { 1.0 };
            let pairs: Vec<(Vector2<f64>, Vector2<f64>)> = found
                .iter()
                .filter_map(|(middle, count)| {
                    let place = best.apply(*middle);
                    let (nearest, distance_2) = tree.nearest_neighbor_iter_with_distance_2(place.into()).next()?;
                    let same = truth.benches[nearest.data].modules.len() == *count;
                    (same && distance_2 < reach_m * reach_m).then(|| (*middle, Vector2::from(*nearest.geom())))
                })
                .collect();
            if pairs.is_empty() {
                break;
            }
            // A few benches tell a shift, not a scale.
            let fit = if pairs.len() >= 5 { Self::fit(&pairs) } else { None };
            best = fit.unwrap_or_else(|| {
                let shift = pairs.iter().map(|(from, to)| to - from).sum::<Vector2<f64>>() / pairs.len() as f64;
                Self { turn: Matrix2::identity(), shift }
            });
        }
        best
    }

    /// Makes centroid and spread equal.
    fn by_moments(truth: &PlantTruth, places: &[Vector2<f64>]) -> Self {
        let moments = |places: &mut dyn Iterator<Item = Vector2<f64>>| {
            let (mut count, mut sum, mut squares) = (0.0, Vector2::zeros(), 0.0);
            for place in places {
                count += 1.0;
                sum += place;
                squares += place.norm_squared();
            }
            let mean: Vector2<f64> = sum / count;
            (mean, (squares / count - mean.norm_squared()).max(1e-12).sqrt())
        };
        let (from, from_spread) = moments(&mut places.iter().copied());
        let (to, to_spread) = moments(&mut truth.modules.iter().map(|m| m.center_enu_m.xy()));
        let scale = (to_spread / from_spread).clamp(0.98, 1.02);
        Self { turn: Matrix2::identity() * scale, shift: to - from * scale }
    }

    /// The transform after fitting, and how good it is: the number of places on modules, counting of each found bench
    /// those on one true bench, less their mean distance in half modules.
    fn improved(mut self, truth: &PlantTruth, grid: &ModuleGrid, sample: &[(u32, Vector2<f64>)]) -> (f64, Self) {
        let mut score = 0.0;
        for _ in 0..12 {
            let mut pairs = Vec::with_capacity(sample.len());
            let mut benches = Vec::with_capacity(sample.len());
            let mut distance = 0.0;
            for (bench, place) in sample {
                let moved = self.apply(*place);
                if let Some(module) = grid.at(truth, moved) {
                    let module = &truth.modules[module];
                    distance += module.place_on_face(moved).amax();
                    pairs.push((*place, module.center_enu_m.xy()));
                    benches.push((*bench, module.bench));
                }
            }
            benches.sort_unstable();
            let together: usize = benches
                .chunk_by(|a, b| a.0 == b.0)
                .map(|found| found.chunk_by(|a, b| a.1 == b.1).map(<[(u32, u32)]>::len).max().unwrap_or(0))
                .sum();
            let now = together as f64 - distance / pairs.len().max(1) as f64;
            if now <= score + 1e-9 {
                break;
            }
            score = now;
            // Too few modules to tell a turn from a shift: keep to shifts.
            let next = if pairs.len() >= 8 { Self::fit(&pairs) } else { None };
            self = next.unwrap_or_else(|| {
                let count = pairs.len().max(1) as f64;
                let shift = pairs.iter().map(|(from, to)| to - self.turn * from).sum::<Vector2<f64>>() / count;
                Self { shift, ..self }
            });
        }
        (score, self)
    }
}

/// Sentences about lines, benches, rows and numbers that no renaming explains.
fn wrong_structure(
    truth: &PlantTruth,
    found: &[FoundModule],
    pairs: &[Option<usize>],
    benches: &BTreeMap<(&str, &str), Vec<usize>>,
) -> Vec<WrongStructure> {
    let mut wrong = Vec::new();
    // All found modules of benches or lines.
    let of_benches = |is_one: &dyn Fn(&TruthModule) -> bool| -> Vec<usize> {
        let is_one = |index: &usize| pairs[*index].is_some_and(|pair| is_one(&truth.modules[pair]));
        (0..found.len()).filter(is_one).collect()
    };
    let place = |bench: u32| {
        let bench = &truth.benches[bench as usize];
        format!("line {} bench {}", bench.line, bench.index)
    };

    // Lines and benches: each found one is one true one and the other way round.
    let mut true_benches: BTreeMap<u32, Vec<String>> = BTreeMap::new();
    let mut true_lines: BTreeMap<u32, BTreeMap<&str, usize>> = BTreeMap::new();
    let mut found_lines: BTreeMap<&str, BTreeMap<u32, usize>> = BTreeMap::new();
    for ((line, bench), members) in benches {
        let mut parts: BTreeMap<u32, usize> = BTreeMap::new();
        for module in members.iter().filter_map(|&index| pairs[index]) {
            let module = &truth.modules[module];
            *parts.entry(module.bench).or_default() += 1;
            *true_lines.entry(module.line).or_default().entry(line).or_default() += 1;
            *found_lines.entry(line).or_default().entry(module.line).or_default() += 1;
        }
        for bench_index in parts.keys() {
            true_benches.entry(*bench_index).or_default().push(format!("{line}/{bench}"));
        }
        if parts.len() > 1 {
            let parts: Vec<String> = parts.iter().map(|(b, count)| format!("{} ({count})", place(*b))).collect();
            let message = format!("found bench {line}/{bench} joins {}", parts.join(" and "));
            wrong.push(WrongStructure { message, modules: members.clone() });
        }
    }
    for (bench, names) in &true_benches {
        if names.len() > 1 {
            let message = format!("{} is split over {}", place(*bench), names.join(" and "));
            wrong.push(WrongStructure { message, modules: of_benches(&|module| module.bench == *bench) });
        }
    }
    for (line, names) in &true_lines {
        if names.len() > 1 {
            let names: Vec<String> = names.iter().map(|(name, count)| format!("{name} ({count})")).collect();
            let message = format!("line {line} is split over found lines {}", names.join(" and "));
            wrong.push(WrongStructure { message, modules: of_benches(&|module| module.line == *line) });
        }
    }
    for (name, lines) in &found_lines {
        if lines.len() > 1 {
            let lines: Vec<String> = lines.iter().map(|(line, count)| format!("{line} ({count})")).collect();
            let message = format!("found line {name} joins lines {}", lines.join(" and "));
            let modules = (0..found.len()).filter(|index| found[*index].line == **name).collect();
            wrong.push(WrongStructure { message, modules });
        }
    }

    // Rows and numbers: the convention that suits most modules holds for all.
    let rows = Counting::of(found.iter().zip(pairs).filter_map(|(found, pair)| {
        let module = &truth.modules[(*pair)?];
        Some((found.row, module.row, truth.benches[module.bench as usize].rows))
    }));
    let numbers = Counting::of(found.iter().zip(pairs).filter_map(|(found, pair)| {
        let module = &truth.modules[(*pair)?];
        Some((found.number, module.col, truth.benches[module.bench as usize].columns))
    }));
    let mut miscounted: BTreeMap<u32, (usize, String)> = BTreeMap::new();
    for (found, pair) in found.iter().zip(pairs) {
        let Some(module) = pair.map(|pair| &truth.modules[pair]) else { continue };
        let bench = &truth.benches[module.bench as usize];
        let expected = (rows.expected(module.row, bench.rows), numbers.expected(module.col, bench.columns));
        let have = (i64::from(found.row), i64::from(found.number));
        if have != expected {
            let example =
                || format!("row {} number {} should be row {} number {}", have.0, have.1, expected.0, expected.1);
            miscounted.entry(module.bench).or_insert_with(|| (0, example())).0 += 1;
        }
    }
    for (bench, (count, example)) in miscounted {
        let message = format!("{}: {count} modules miscounted, first {example}", place(bench));
        wrong.push(WrongStructure { message, modules: of_benches(&|module| module.bench == bench) });
    }
    wrong
}

/// A way of counting places: from either end, from a first number.
#[derive(Debug, Clone, Copy)]
struct Counting {
    from_the_end: bool,
    first: i64,
}

impl Counting {
    /// The way that suits most of (found number, true index, places in the bench).
    fn of(counted: impl Iterator<Item = (u32, u32, u32)>) -> Self {
        let mut votes: BTreeMap<(bool, i64), usize> = BTreeMap::new();
        for (number, index, places) in counted {
            for from_the_end in [false, true] {
                let counting = Self { from_the_end, first: 0 };
                let first = i64::from(number) - counting.expected(index, places);
                *votes.entry((from_the_end, first)).or_default() += 1;
            }
        }
        let most = votes.into_iter().max_by_key(|((from_the_end, first), count)| (*count, !from_the_end, -first.abs()));
        let (from_the_end, first) = most.map_or((false, 0), |(way, _)| way);
        Self { from_the_end, first }
    }

    fn expected(&self, index: u32, places: u32) -> i64 {
        let (index, places) = (i64::from(index), i64::from(places));
        self.first + if self.from_the_end { places - 1 - index } else { index }
    }
}
