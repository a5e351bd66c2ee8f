//! What is compared: the modules of a plant with their places and positions, whoever made it.

use heliomap_mapping::geometry::Similarity;
use heliomap_model::PlantModel;
use heliomap_model::{GeodeticReference, Lla};
use nalgebra::{Matrix3, Rotation3, Vector3};
use std::collections::BTreeMap;

/// One module of a [`ReferenceModel`].
#[derive(Debug, Clone, PartialEq)]
pub struct ReferenceModule {
    /// What the source calls it; unique only if the source is honest.
    pub id: String,
    /// Its place as a person reads it.
    pub label: String,
    /// Index into [`ReferenceModel::lines`].
    pub line: usize,
    /// Index into [`ReferenceModel::benches`].
    pub bench: usize,
    /// Row in its bench, in the numbering of the source.
    pub row: i64,
    /// Number along its row, in the numbering of the source, holes counted.
    pub number: i64,
    /// The four corners in the local frame, metres, in ring order (south-west, south-east, north-east, north-west).
    pub corners_enu_m: [Vector3<f64>; 4],
    /// The middle of the face in the local frame, metres.
    pub center_enu_m: Vector3<f64>,
    /// One standard deviation of the centre (east, north, up), metres, where the source states it.
    pub sigma_enu_m: Option<Vector3<f64>>,
}

impl ReferenceModule {
    /// Extent along the row and up the table, metres.
    pub fn extent_m(&self) -> [f64; 2] {
        let c = &self.corners_enu_m;
        [(c[1] - c[0] + c[2] - c[3]).norm() / 2.0, (c[2] - c[1] + c[3] - c[0]).norm() / 2.0]
    }

    /// The shorter side, metres.
    pub fn shorter_side_m(&self) -> f64 {
        let [width_m, height_m] = self.extent_m();
        width_m.min(height_m)
    }
}

/// A line of benches.
#[derive(Debug, Clone, PartialEq)]
pub struct ReferenceLine {
    pub name: String,
    /// Its number in the plant, where the source has one.
    pub index: Option<i64>,
}

/// A bench. The ranges bound rows and numbers, both ends included, holes counted.
#[derive(Debug, Clone, PartialEq)]
pub struct ReferenceBench {
    pub name: String,
    /// Its number in its line, where the source has one.
    pub index: Option<i64>,
    pub rows: [i64; 2],
    pub numbers: [i64; 2],
}

/// Every module of a plant, in metres about `reference`.
#[derive(Debug, Clone, PartialEq)]
pub struct ReferenceModel {
    /// Where it came from, for messages.
    pub name: String,
    /// Origin of the local frame (x east, y north, z up).
    pub reference: GeodeticReference,
    pub lines: Vec<ReferenceLine>,
    pub benches: Vec<ReferenceBench>,
    pub modules: Vec<ReferenceModule>,
}

impl ReferenceModel {
    /// The modules of a mapped plant.
    pub fn from_plant(plant: &PlantModel) -> Self {
        let mut builder = Builder::default();
        for module in &plant.modules {
            let place = Place {
                line: module.line.to_string(),
                bench: module.bench.to_string(),
                row: i64::from(module.row),
                number: i64::from(module.number),
            };
            builder.push(
                module.id.to_string(),
                module.label.clone(),
                place,
                module.corners_enu_m,
                module.center_enu_m,
                module.sigma_enu_m,
            );
        }
        builder.finish(plant.plant_name.clone(), plant.reference)
    }

    /// The same modules about another origin.
    pub fn in_frame_of(mut self, reference: GeodeticReference) -> Self {
        if self.reference == reference {
            return self;
        }
        // Two tangent planes differ by a rigid motion, which four points fix.
        let image = |point: Vector3<f64>| reference.enu_from_lla(self.reference.lla_from_enu(point));
        let origin = image(Vector3::zeros());
        let reach_m = 1000.0;
        let axes = [Vector3::x(), Vector3::y(), Vector3::z()].map(|axis| (image(axis * reach_m) - origin) / reach_m);
        let rotation = Rotation3::from_matrix(&Matrix3::from_columns(&axes));
        let motion = Similarity { scale: 1.0, rotation, translation_m: origin };
        for module in &mut self.modules {
            module.center_enu_m = motion.apply(&module.center_enu_m);
            module.corners_enu_m = module.corners_enu_m.map(|corner| motion.apply(&corner));
        }
        self.reference = reference;
        self
    }

    /// The geodetic position of a module's centre.
    pub fn lla(&self, module: &ReferenceModule) -> Lla {
        self.reference.lla_from_enu(module.center_enu_m)
    }
}

/// Where a module stands, in the names of its source.
#[derive(Debug, Clone)]
pub(super) struct Place {
    pub line: String,
    pub bench: String,
    pub row: i64,
    pub number: i64,
}

/// Gathers modules and gives their lines and benches indices in the order in which they appear.
#[derive(Default)]
pub(super) struct Builder {
    lines: Vec<ReferenceLine>,
    benches: Vec<ReferenceBench>,
    modules: Vec<ReferenceModule>,
    line_of_name: BTreeMap<String, usize>,
    bench_of_name: BTreeMap<(usize, String), usize>,
}

impl Builder {
    /// Adds a module. A bench is known by its line and its name, so that sources may number benches anew in each line.
    pub fn push(
        &mut self,
        id: String,
        label: String,
        place: Place,
        corners_enu_m: [Vector3<f64>; 4],
        center_enu_m: Vector3<f64>,
        sigma_enu_m: Option<Vector3<f64>>,
    ) {
        let numbered = parse_label(&label);
        let line = match self.line_of_name.get(&place.line) {
            Some(&line) => line,
            None => {
                let name = numbered.map_or_else(|| place.line.clone(), |n| n.line_name(&label));
                self.lines.push(ReferenceLine { name, index: numbered.map(|n| n.line) });
                self.line_of_name.insert(place.line, self.lines.len() - 1);
                self.lines.len() - 1
            }
        };
        let key = (line, place.bench);
        let bench = match self.bench_of_name.get(&key) {
            Some(&bench) => bench,
            None => {
                let name = numbered.map_or_else(|| key.1.clone(), |n| n.bench_name(&label));
                let (rows, numbers) = ([place.row; 2], [place.number; 2]);
                self.benches.push(ReferenceBench { name, index: numbered.map(|n| n.bench), rows, numbers });
                self.bench_of_name.insert(key, self.benches.len() - 1);
                self.benches.len() - 1
            }
        };
        let extent = &mut self.benches[bench];
        extent.rows = [extent.rows[0].min(place.row), extent.rows[1].max(place.row)];
        extent.numbers = [extent.numbers[0].min(place.number), extent.numbers[1].max(place.number)];
        let (row, number) = (place.row, place.number);
        self.modules.push(ReferenceModule {
            id,
            label,
            line,
            bench,
            row,
            number,
            corners_enu_m,
            center_enu_m,
            sigma_enu_m,
        });
    }

    /// Names and numbers the line and the bench of the last module, where the source has them apart from labels.
    pub fn number_last(&mut self, line: (String, i64), bench: (String, i64), rows: [i64; 2], numbers: [i64; 2]) {
        let Some(module) = self.modules.last() else { return };
        self.lines[module.line] = ReferenceLine { name: line.0, index: Some(line.1) };
        let extent = &mut self.benches[module.bench];
        let wider = |a: [i64; 2], b: [i64; 2]| [a[0].min(b[0]), a[1].max(b[1])];
        *extent = ReferenceBench {
            name: bench.0,
            index: Some(bench.1),
            rows: wider(extent.rows, rows),
            numbers: wider(extent.numbers, numbers),
        };
    }

    pub fn finish(self, name: String, reference: GeodeticReference) -> ReferenceModel {
        ReferenceModel { name, reference, lines: self.lines, benches: self.benches, modules: self.modules }
    }
}

/// Line and bench numbers of a label such as `L03-B02-R1-017`, and where their names end in it.
#[derive(Clone, Copy)]
struct NumberedLabel {
    line: i64,
    bench: i64,
    line_end: usize,
    bench_end: usize,
}

impl NumberedLabel {
    fn line_name(&self, label: &str) -> String {
        label[..self.line_end].to_owned()
    }

    fn bench_name(&self, label: &str) -> String {
        label[..self.bench_end].to_owned()
    }
}

fn parse_label(label: &str) -> Option<NumberedLabel> {
    let number = |part: &str, letter: char| part.strip_prefix(letter)?.parse::<u32>().ok().map(i64::from);
    let mut parts = label.split('-');
    let (line, bench) = (parts.next()?, parts.next()?);
    let line_end = line.len();
    let bench_end = line_end + 1 + bench.len();
    Some(NumberedLabel { line: number(line, 'L')?, bench: number(bench, 'B')?, line_end, bench_end })
}
