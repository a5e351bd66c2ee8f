//! Whether every module has its line, bench, row and number, up to one naming per level.
//!
//! Lines and benches may have any names, but each of the plant must be one of the truth. Rows may be counted from the
//! north or the south and numbers from the west or the east, from any first number, but alike in the whole plant. Where
//! both sides number lines and benches, these too must follow one direction: a technician walks by them.

use super::model::ReferenceModel;
use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet};

/// Labels listed with a problem.
const MAX_LISTED: usize = 10;

/// What part of a module's place is judged.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Level {
    Line,
    Bench,
    Row,
    Number,
    /// The number of the line in the plant.
    LineOrder,
    /// The number of the bench in its line.
    BenchOrder,
}

impl Level {
    /// The word in reports.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Line => "line",
            Self::Bench => "bench",
            Self::Row => "row",
            Self::Number => "number",
            Self::LineOrder => "line order",
            Self::BenchOrder => "bench order",
        }
    }
}

/// How the plant counts what the truth counts: `plant = truth + offset`, or from the other end, where the truth's last
/// one is `offset`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Convention {
    pub reversed: bool,
    pub offset: i64,
}

impl Convention {
    /// What the plant should say where the truth says `value` and its last is `last`.
    fn expected(self, value: i64, last: i64) -> i64 {
        if self.reversed { last - value + self.offset } else { value + self.offset }
    }
}

/// Agreement at one level.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LevelAgreement {
    pub level: Level,
    /// Modules compared.
    pub compared: usize,
    /// Modules that disagree.
    pub wrong: usize,
    /// The convention that most modules follow; `None` for names.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub convention: Option<Convention>,
}

/// Modules of the plant that disagree in the same way.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Problem {
    pub level: Level,
    /// One sentence that names the place.
    pub message: String,
    /// How many modules are concerned.
    pub count: usize,
    /// Labels of the first of them.
    pub modules: Vec<String>,
}

/// The verdict on the structure of the paired modules.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Structure {
    /// Nothing is wrong at any level, and no place is taken twice.
    pub exact: bool,
    pub levels: Vec<LevelAgreement>,
    /// Plant line and truth line of the naming, in the order of the plant.
    pub lines: Vec<[String; 2]>,
    /// Plant bench and truth bench of the naming, in the order of the plant.
    pub benches: Vec<[String; 2]>,
    pub problems: Vec<Problem>,
}

/// Compares the places of paired modules (indices into plant and truth).
pub fn compare(plant: &ReferenceModel, truth: &ReferenceModel, pairs: &[(usize, usize)]) -> Structure {
    let mut comparison = Comparison { plant, truth, pairs, levels: Vec::new(), problems: Vec::new() };
    let line_name = |model: &ReferenceModel, k: usize| model.lines[k].name.clone();
    let bench_name = |model: &ReferenceModel, k: usize| model.benches[k].name.clone();
    let lines = comparison.naming(Level::Line, |model, m| model.modules[m].line, line_name);
    let benches = comparison.naming(Level::Bench, |model, m| model.modules[m].bench, bench_name);
    comparison.rows_and_numbers(Level::Row);
    comparison.rows_and_numbers(Level::Number);
    comparison.order(Level::LineOrder);
    comparison.order(Level::BenchOrder);
    comparison.taken_twice();
    let Comparison { levels, problems, .. } = comparison;
    Structure { exact: problems.is_empty(), levels, lines, benches, problems }
}

struct Comparison<'a> {
    plant: &'a ReferenceModel,
    truth: &'a ReferenceModel,
    pairs: &'a [(usize, usize)],
    levels: Vec<LevelAgreement>,
    problems: Vec<Problem>,
}

impl Comparison<'_> {
    fn problem(&mut self, level: Level, message: String, modules: &[usize]) {
        let labels = modules.iter().take(MAX_LISTED).map(|&m| self.plant.modules[m].label.clone()).collect();
        self.problems.push(Problem { level, message, count: modules.len(), modules: labels });
    }

    /// The one-to-one naming that most modules agree with; the others are wrong.
    fn naming(
        &mut self,
        level: Level,
        group: impl Fn(&ReferenceModel, usize) -> usize,
        name: impl Fn(&ReferenceModel, usize) -> String,
    ) -> Vec<[String; 2]> {
        let (plant, truth) = (self.plant, self.truth);
        let mut shared: BTreeMap<(usize, usize), Vec<usize>> = BTreeMap::new();
        for &(p, t) in self.pairs {
            shared.entry((group(plant, p), group(truth, t))).or_default().push(p);
        }
        let mut by_size: Vec<(usize, usize)> = shared.keys().copied().collect();
        by_size.sort_by_key(|key| (std::cmp::Reverse(shared[key].len()), *key));
        let (mut truth_of, mut plant_of) = (BTreeMap::new(), BTreeMap::new());
        for (p, t) in by_size {
            if !truth_of.contains_key(&p) && !plant_of.contains_key(&t) {
                truth_of.insert(p, t);
                plant_of.insert(t, p);
            }
        }
        let mut wrong = 0;
        for ((p, t), modules) in shared {
            if truth_of.get(&p) == Some(&t) {
                continue;
            }
            wrong += modules.len();
            let word = level.as_str();
            let verb = if modules.len() == 1 { "module stands" } else { "modules stand" };
            let whose = match plant_of.get(&t) {
                Some(&other) => format!("whose name is {}", name(plant, other)),
                None => "for which the plant has no name".to_owned(),
            };
            let message = format!(
                "{} {verb} in {word} {} of the truth, {whose}, but the plant says {word} {}",
                modules.len(),
                name(truth, t),
                name(plant, p)
            );
            self.problem(level, message, &modules);
        }
        self.levels.push(LevelAgreement { level, compared: self.pairs.len(), wrong, convention: None });
        truth_of.into_iter().map(|(p, t)| [name(plant, p), name(truth, t)]).collect()
    }

    /// Rows or numbers against the plant's one convention; what is wrong is told bench by bench.
    fn rows_and_numbers(&mut self, level: Level) {
        let compared: Vec<Compared> = self
            .pairs
            .iter()
            .map(|&(p, t)| {
                let (module, at) = (&self.plant.modules[p], &self.truth.modules[t]);
                let bench = &self.truth.benches[at.bench];
                let [plant, truth, last] = match level {
                    Level::Row => [module.row, at.row, bench.rows[1]],
                    _ => [module.number, at.number, bench.numbers[1]],
                };
                Compared { module: p, group: module.bench, plant, truth, last }
            })
            .collect();
        let convention = self.agree(level, &compared);
        let mut benches: BTreeMap<usize, Vec<Compared>> = BTreeMap::new();
        for item in compared {
            benches.entry(item.group).or_default().push(item);
        }
        for (bench, items) in benches {
            let wrong: Vec<Compared> = items.iter().copied().filter(|item| !item.follows(convention)).collect();
            if wrong.is_empty() {
                continue;
            }
            let other_end = Convention::of_most(&items, !convention.reversed);
            let shifts: BTreeSet<i64> = items.iter().map(|item| item.shift(convention)).collect();
            let word = if level == Level::Row { "rows" } else { "modules" };
            let how = if shifts.len() == 1 {
                format!("all {word} are off by {:+}", shifts.first().copied().unwrap_or(0))
            } else if other_end.is_some_and(|other| items.iter().all(|item| item.follows(other))) {
                format!("the {word} are numbered from the other end")
            } else {
                let listed: Vec<String> = wrong
                    .iter()
                    .take(3)
                    .map(|item| format!("{} for {}", item.plant, convention.expected(item.truth, item.last)))
                    .collect();
                let dots = if wrong.len() > 3 { ", ..." } else { "" };
                format!("{} of {} wrong ({}{dots})", wrong.len(), items.len(), listed.join(", "))
            };
            let message = format!("bench {}: {how}", self.plant.benches[bench].name);
            let modules: Vec<usize> = wrong.iter().map(|item| item.module).collect();
            self.problem(level, message, &modules);
        }
    }

    /// The numbers of lines in the plant or of benches in their lines, where both sides have them.
    fn order(&mut self, level: Level) {
        let mut last_of_line: BTreeMap<usize, i64> = BTreeMap::new();
        let last_line = self.truth.lines.iter().filter_map(|line| line.index).max().unwrap_or(0);
        for module in &self.truth.modules {
            if let Some(index) = self.truth.benches[module.bench].index {
                let last = last_of_line.entry(module.line).or_insert(index);
                *last = (*last).max(index);
            }
        }
        let compared: Option<Vec<Compared>> = self
            .pairs
            .iter()
            .map(|&(p, t)| {
                let (module, at) = (&self.plant.modules[p], &self.truth.modules[t]);
                let (group, plant, truth, last) = match level {
                    Level::LineOrder => {
                        (module.line, self.plant.lines[module.line].index?, self.truth.lines[at.line].index?, last_line)
                    }
                    _ => (
                        module.bench,
                        self.plant.benches[module.bench].index?,
                        self.truth.benches[at.bench].index?,
                        last_of_line.get(&at.line).copied()?,
                    ),
                };
                Some(Compared { module: p, group, plant, truth, last })
            })
            .collect();
        let Some(compared) = compared else { return };
        let convention = self.agree(level, &compared);
        let mut groups: BTreeMap<(usize, i64), Vec<usize>> = BTreeMap::new();
        for item in compared.iter().filter(|item| !item.follows(convention)) {
            let expected = convention.expected(item.truth, item.last);
            groups.entry((item.group, expected)).or_default().push(item.module);
        }
        for ((group, expected), modules) in groups {
            let (word, name, index) = match level {
                Level::LineOrder => ("line", &self.plant.lines[group].name, self.plant.lines[group].index),
                _ => ("bench", &self.plant.benches[group].name, self.plant.benches[group].index),
            };
            let whole = if level == Level::LineOrder { "plant" } else { "line" };
            let number = index.unwrap_or_default();
            let verb = if modules.len() == 1 { "stands" } else { "stand" };
            let message = format!(
                "{word} {name} is number {number} of its {whole}, but {} of its modules {verb} in number {expected}",
                modules.len()
            );
            self.problem(level, message, &modules);
        }
    }

    /// The convention that most modules follow, noted with the number of those that do not.
    fn agree(&mut self, level: Level, compared: &[Compared]) -> Convention {
        let forward = Convention::of_most(compared, false);
        let backward = Convention::of_most(compared, true);
        let followers = |convention: &Convention| compared.iter().filter(|item| item.follows(*convention)).count();
        // `max_by_key` takes the last among equals: the truth's own direction.
        let convention = [backward, forward]
            .into_iter()
            .flatten()
            .max_by_key(followers)
            .unwrap_or(Convention { reversed: false, offset: 0 });
        let wrong = compared.len() - followers(&convention);
        self.levels.push(LevelAgreement { level, compared: compared.len(), wrong, convention: Some(convention) });
        convention
    }

    /// Places of the plant that more than one module claims.
    fn taken_twice(&mut self) {
        let mut places: BTreeMap<(usize, i64, i64), Vec<usize>> = BTreeMap::new();
        for (k, module) in self.plant.modules.iter().enumerate() {
            places.entry((module.bench, module.row, module.number)).or_default().push(k);
        }
        for ((bench, row, number), modules) in places.into_iter().filter(|(_, modules)| modules.len() > 1) {
            let message = format!(
                "{} modules of the plant claim bench {}, row {row}, number {number}",
                modules.len(),
                self.plant.benches[bench].name
            );
            self.problem(Level::Number, message, &modules);
        }
    }
}

/// A value of the plant beside that of the truth, and the truth's last one.
#[derive(Clone, Copy)]
struct Compared {
    /// Index into the plant's modules.
    module: usize,
    /// What it is told by: its line or bench in the plant.
    group: usize,
    plant: i64,
    truth: i64,
    last: i64,
}

impl Compared {
    fn shift(&self, convention: Convention) -> i64 {
        self.plant - convention.expected(self.truth, self.last)
    }

    fn follows(&self, convention: Convention) -> bool {
        self.shift(convention) == 0
    }
}

impl Convention {
    /// Of those with this direction, the one that most modules follow; the smallest offset among equals. `None` without
    /// modules.
    fn of_most(compared: &[Compared], reversed: bool) -> Option<Self> {
        let mut votes: BTreeMap<i64, usize> = BTreeMap::new();
        for item in compared {
            *votes.entry(item.shift(Self { reversed, offset: 0 })).or_default() += 1;
        }
        let most = votes.values().copied().max()?;
        votes.into_iter().find(|(_, count)| *count == most).map(|(offset, _)| Self { reversed, offset })
    }
}
