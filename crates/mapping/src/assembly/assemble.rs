//! The refined structure becomes the plant model: labels, identifiers, corners on the ground.

use super::resurvey;
use crate::fusion::{Doubt, Fused, FusedBench, View};
use crate::refinement::{Refined, RefinedBench};
use heliomap_model::{
    Bench, BenchId, GeodeticReference, Line, LineId, Module, ModuleId, ModuleStatus, PlantId, PlantModel, Sector,
    SectorId, Warning,
};
use nalgebra::Vector3;
use std::collections::{BTreeMap, BTreeSet, HashMap};

/// What the model is of.
#[derive(Debug, Clone, Copy)]
pub struct Identity<'a> {
    pub plant: PlantId,
    pub plant_name: &'a str,
    pub survey: &'a str,
    /// The newest model so far: its identifiers live on.
    pub previous: Option<&'a PlantModel>,
}

/// Assembles the model. What is found again keeps its identifier of `identity.previous`; what is new gets the next ones.
pub fn assemble(
    views: &[View<'_>],
    fused: &Fused,
    refined: &Refined,
    reference: GeodeticReference,
    vertical_datum: String,
    identity: &Identity<'_>,
    mut warnings: Vec<Warning>,
) -> PlantModel {
    let drafts = drafts(fused, refined);
    let mut registry = Registry::new(identity.plant, reference, identity.previous, &drafts);
    let model = PlantModel {
        plant: identity.plant,
        plant_name: identity.plant_name.to_owned(),
        version: identity.previous.map_or(1, |previous| previous.version + 1),
        survey: identity.survey.to_owned(),
        reference,
        vertical_datum,
        alignment: refined.alignment.clone(),
        parameters: None,
        lines: Vec::new(),
        benches: Vec::new(),
        sectors: Vec::new(),
        modules: Vec::with_capacity(drafts.len()),
        warnings: Vec::new(),
        serials: [0; 4],
    };
    let labels = vec![None; fused.benches.len()];
    let mut assembly = Assembly { views, registry: &mut registry, model, labels };
    let mut drafts = drafts.iter().enumerate();
    for (line_index, line) in fused.lines.iter().enumerate() {
        let line_label = format!("L{:02}", line_index + 1);
        let line_id = assembly.registry.line(line_index);
        assembly.model.lines.push(Line { id: line_id, label: line_label.clone(), index: line_index as u32 + 1 });
        for (bench_in_line, &bench_index) in line.benches.iter().enumerate() {
            let place =
                BenchPlace { line: line_id, line_label: &line_label, in_line: bench_in_line, index: bench_index };
            let bench = &fused.benches[bench_index];
            assembly.bench(place, bench, drafts.by_ref().take(bench.modules.len()));
        }
    }
    let Assembly { mut model, labels, .. } = assembly;
    warnings.extend(fused.doubts.iter().map(|doubt| warning(doubt, &labels)));
    warnings.extend(registry.warning.take());
    warnings.sort();
    warnings.dedup();
    model.warnings = warnings;
    model.serials = registry.serials;
    model
}

/// All modules in the order of lines, benches and modules.
fn drafts<'a>(fused: &'a Fused, refined: &'a Refined) -> Vec<Draft<'a>> {
    let mut drafts = Vec::new();
    for (line_index, line) in fused.lines.iter().enumerate() {
        for &bench_index in &line.benches {
            let (bench, refined) = (&fused.benches[bench_index], &refined.benches[bench_index]);
            for (module, position) in bench.modules.iter().zip(&refined.modules) {
                drafts.push(Draft { line_index, bench_index, module, position, bench: refined });
            }
        }
    }
    drafts
}

/// Where a bench stands: in which line, and its index there and among the fused benches.
#[derive(Clone, Copy)]
struct BenchPlace<'a> {
    line: LineId,
    line_label: &'a str,
    in_line: usize,
    index: usize,
}

/// A model that is being assembled.
struct Assembly<'a> {
    views: &'a [View<'a>],
    registry: &'a mut Registry,
    model: PlantModel,
    /// Identifier and label of each fused bench that is in the model.
    labels: Vec<Option<(BenchId, String)>>,
}

impl Assembly<'_> {
    /// Adds a bench with its sectors and modules.
    fn bench<'d>(
        &mut self,
        place: BenchPlace<'_>,
        bench: &FusedBench,
        drafts: impl Iterator<Item = (usize, &'d Draft<'d>)>,
    ) {
        let label = format!("{}-B{:02}", place.line_label, place.in_line + 1);
        let id = self.registry.bench(place.index);
        self.labels[place.index] = Some((id, label.clone()));
        self.model.benches.push(Bench {
            id,
            label: label.clone(),
            line: place.line,
            index: place.in_line as u32 + 1,
            rows: bench.rows as u32,
            columns: bench.cols as u32,
            open_ended: bench.open_ended,
            confidence: bench.confidence,
        });
        let sectors = self.sectors(place, bench, id, &label);
        for (number, draft) in drafts {
            let module = draft.module;
            let images: BTreeSet<String> =
                module.observations.iter().map(|o| self.views[o.view].shot.name.clone()).collect();
            self.model.modules.push(Module {
                id: self.registry.module(number),
                label: format!("{label}-R{}-{:03}", module.row + 1, module.col + 1),
                line: place.line,
                bench: id,
                sector: sectors[&module.row],
                row: module.row as u32 + 1,
                number: module.col as u32 + 1,
                corners_enu_m: draft.corners(),
                center_enu_m: draft.position.center_m,
                normal_enu: draft.bench.normal(),
                width_m: draft.bench.module_size_m[0],
                height_m: draft.bench.module_size_m[1],
                sigma_enu_m: draft.position.sigma_m,
                images: images.into_iter().collect(),
                status: if module.inferred_in.is_empty() { ModuleStatus::Detected } else { ModuleStatus::Confirmed },
            });
        }
    }

    /// Adds a sector for each row of a bench that has modules: the sectors by row.
    fn sectors(
        &mut self,
        place: BenchPlace<'_>,
        bench: &FusedBench,
        bench_id: BenchId,
        bench_label: &str,
    ) -> BTreeMap<i32, SectorId> {
        let mut sectors = BTreeMap::new();
        for row in (0..bench.rows).filter(|row| bench.modules.iter().any(|module| module.row == *row)) {
            let id = self.registry.sector(place.index, row);
            sectors.insert(row, id);
            self.model.sectors.push(Sector {
                id,
                label: format!("{bench_label}-R{}", row + 1),
                line: place.line,
                bench: bench_id,
                row: row as u32 + 1,
            });
        }
        sectors
    }
}

/// The warning of a doubt, with benches by their labels as on the map.
fn warning(doubt: &Doubt, named: &[Option<(BenchId, String)>]) -> Warning {
    let (mut benches, labels): (Vec<BenchId>, Vec<&str>) = doubt
        .benches
        .iter()
        .filter_map(|bench| named[*bench].as_ref().map(|(id, label)| (*id, label.as_str())))
        .unzip();
    benches.sort_unstable();
    let message =
        if labels.is_empty() { doubt.message.clone() } else { format!("{}: {}", labels.join(", "), doubt.message) };
    Warning { benches, ..Warning::new(&doubt.code, message, doubt.images.iter().cloned()) }
}

/// A module on its way into the model.
struct Draft<'a> {
    line_index: usize,
    bench_index: usize,
    module: &'a crate::fusion::FusedModule,
    position: &'a crate::refinement::RefinedModule,
    bench: &'a RefinedBench,
}

impl Draft<'_> {
    /// South-west, south-east, north-east, north-west.
    fn corners(&self) -> [Vector3<f64>; 4] {
        let half_along = self.bench.along * (self.bench.module_size_m[0] / 2.0);
        let half_down = self.bench.across * (self.bench.module_size_m[1] / 2.0);
        let center = self.position.center_m;
        [
            center - half_along + half_down,
            center + half_along + half_down,
            center + half_along - half_down,
            center - half_along - half_down,
        ]
    }
}

/// Assigns identifiers: the previous ones to what is found again, new ones to the rest.
struct Registry {
    plant: PlantId,
    serials: [u64; 4],
    lines: HashMap<usize, LineId>,
    benches: HashMap<usize, BenchId>,
    sectors: HashMap<(usize, i32), SectorId>,
    modules: HashMap<usize, ModuleId>,
    warning: Option<Warning>,
}

impl Registry {
    fn new(plant: PlantId, reference: GeodeticReference, previous: Option<&PlantModel>, drafts: &[Draft<'_>]) -> Self {
        let mut registry = Self {
            plant,
            serials: previous.map_or([0; 4], |model| model.serials),
            lines: HashMap::new(),
            benches: HashMap::new(),
            sectors: HashMap::new(),
            modules: HashMap::new(),
            warning: None,
        };
        let Some(previous) = previous else { return registry };
        let (new, old) = compared(reference, previous, drafts);
        let found = resurvey::find_again(&new, &old);
        registry.warning = identifier_warning(&found, previous.modules.len());
        let pairs = found.pairs;
        for &(draft, old) in &pairs {
            registry.modules.insert(draft, previous.modules[old].id);
        }
        let of_pairs = || pairs.iter().map(|&(draft, old)| (&drafts[draft], &previous.modules[old]));
        registry.lines = elect(of_pairs().map(|(draft, old)| (draft.line_index, old.line)));
        registry.benches = elect(of_pairs().map(|(draft, old)| (draft.bench_index, old.bench)));
        registry.sectors = elect(of_pairs().map(|(draft, old)| ((draft.bench_index, draft.module.row), old.sector)));
        registry
    }

    fn next(&mut self, kind: usize) -> u64 {
        self.serials[kind] += 1;
        self.serials[kind]
    }

    fn line(&mut self, index: usize) -> LineId {
        if let Some(id) = self.lines.get(&index) {
            return *id;
        }
        LineId::from_serial(self.plant, self.next(0))
    }

    fn bench(&mut self, index: usize) -> BenchId {
        if let Some(id) = self.benches.get(&index) {
            return *id;
        }
        BenchId::from_serial(self.plant, self.next(1))
    }

    fn sector(&mut self, bench: usize, row: i32) -> SectorId {
        if let Some(id) = self.sectors.get(&(bench, row)) {
            return *id;
        }
        SectorId::from_serial(self.plant, self.next(2))
    }

    fn module(&mut self, draft: usize) -> ModuleId {
        if let Some(id) = self.modules.get(&draft) {
            return *id;
        }
        ModuleId::from_serial(self.plant, self.next(3))
    }
}

/// A warning where the identifiers of the previous model could not be carried over, or not surely.
fn identifier_warning(found: &resurvey::FoundAgain, previous_modules: usize) -> Option<Warning> {
    if previous_modules > 0 && found.pairs.is_empty() {
        let message = "no module of the previous model was found again within 15 m: all identifiers are new; check that these \
                       images are of the same plant";
        return Some(Warning::new("identifiers_new", message, []));
    }
    let other_m = found.or_moved_by_m?;
    let message = format!(
        "the plant fits the previous model equally well when moved by {:.1} m east and {:.1} m north: bench ends do not decide \
         between the two, so identifiers may have moved to neighbouring modules; control points would decide",
        other_m.x, other_m.y
    );
    Some(Warning::new("identifiers_unsure", message, []))
}

/// Each new group takes the old identifier that most of its modules had; of two that want the same, the one with more.
fn elect<K: Copy + Ord + std::hash::Hash, V: Copy + Ord>(pairs: impl Iterator<Item = (K, V)>) -> HashMap<K, V> {
    let mut votes: BTreeMap<(K, V), usize> = BTreeMap::new();
    for pair in pairs {
        *votes.entry(pair).or_default() += 1;
    }
    let mut ranked: Vec<((K, V), usize)> = votes.into_iter().collect();
    ranked.sort_by(|a, b| b.1.cmp(&a.1).then(a.0.cmp(&b.0)));
    let mut elected = HashMap::new();
    let mut taken = BTreeSet::new();
    for ((key, value), _) in ranked {
        if !elected.contains_key(&key) && taken.insert(value) {
            elected.insert(key, value);
        }
    }
    elected
}

/// Modules of the survey and of the model before, as they are compared: in the frame of the survey.
fn compared(
    reference: GeodeticReference,
    previous: &PlantModel,
    drafts: &[Draft<'_>],
) -> (Vec<resurvey::Place>, Vec<resurvey::Place>) {
    let half_m = |width_m: f64, height_m: f64| 0.5 * width_m.min(height_m);
    let new = drafts
        .iter()
        .map(|draft| resurvey::Place {
            bench: draft.bench_index,
            at_m: draft.position.center_m.xy(),
            reach_m: half_m(draft.bench.module_size_m[0], draft.bench.module_size_m[1]),
        })
        .collect();
    let number: HashMap<BenchId, usize> =
        previous.benches.iter().enumerate().map(|(index, bench)| (bench.id, index)).collect();
    let old = previous
        .modules
        .iter()
        .map(|module| resurvey::Place {
            bench: number.get(&module.bench).copied().unwrap_or(usize::MAX),
            at_m: reference.enu_from_lla(previous.reference.lla_from_enu(module.center_enu_m)).xy(),
            reach_m: half_m(module.width_m, module.height_m),
        })
        .collect();
    (new, old)
}
