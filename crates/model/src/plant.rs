//! The plant model: lines of benches, benches of rows, rows of modules, each with its position on the ground.

use crate::alignment::Alignment;
use crate::geodesy::GeodeticReference;
use crate::ids::{BenchId, LineId, ModuleId, PlantId, SectorId};
use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

/// How sure it is that a module stands where the model says.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ModuleStatus {
    /// Every view that shows its place detected it.
    Detected,
    /// Some views only inferred it from its neighbours; at least one other view detected it (paper, 3.5).
    Confirmed,
    /// A person set it.
    Manual,
}

impl ModuleStatus {
    /// The word used in exports.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Detected => "detected",
            Self::Confirmed => "confirmed",
            Self::Manual => "manual",
        }
    }
}

/// One photovoltaic module.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Module {
    pub id: ModuleId,
    /// Place as a technician reads it, for example `L03-B02-R1-017`.
    pub label: String,
    pub line: LineId,
    pub bench: BenchId,
    pub sector: SectorId,
    /// Row in its bench from the north, 1 the first.
    pub row: u32,
    /// Number along its row from the west end of the bench, 1 the first; a missing module keeps its number free.
    pub number: u32,
    /// The four corners in the local frame, metres: south-west, south-east, north-east, north-west as seen by a person
    /// who looks at the face with the row running from west to east.
    pub corners_enu_m: [Vector3<f64>; 4],
    /// The middle of the face in the local frame, metres.
    pub center_enu_m: Vector3<f64>,
    /// Unit normal of the face, pointing up.
    pub normal_enu: Vector3<f64>,
    /// Extent along the row, metres.
    pub width_m: f64,
    /// Extent up the table, metres.
    pub height_m: f64,
    /// One standard deviation of the centre (east, north, up), metres; `None` where it could not be estimated.
    pub sigma_enu_m: Option<Vector3<f64>>,
    /// Names of the images in which it was detected, sorted.
    pub images: Vec<String>,
    pub status: ModuleStatus,
}

impl Module {
    /// Angle between the face and the horizontal, degrees.
    pub fn tilt_deg(&self) -> f64 {
        self.normal_enu.z.clamp(-1.0, 1.0).acos().to_degrees()
    }

    /// Compass direction that the face looks to, degrees clockwise from north, 0 to 360.
    pub fn azimuth_deg(&self) -> f64 {
        self.normal_enu.x.atan2(self.normal_enu.y).to_degrees().rem_euclid(360.0)
    }
}

/// One row of one bench (the paper's sector).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Sector {
    pub id: SectorId,
    pub label: String,
    pub line: LineId,
    pub bench: BenchId,
    /// Row in its bench from the north, 1 the first.
    pub row: u32,
}

/// One table of modules.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Bench {
    pub id: BenchId,
    pub label: String,
    pub line: LineId,
    /// Place in its line from the west, 1 the first.
    pub index: u32,
    pub rows: u32,
    /// Numbers per row, missing modules counted.
    pub columns: u32,
    /// Whether the images end before the bench does, at its west and its east end.
    pub open_ended: [bool; 2],
    /// How sure its structure is, 0 to 1.
    pub confidence: f64,
}

/// Benches one behind the other along a common axis.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Line {
    pub id: LineId,
    pub label: String,
    /// Place in the plant from the north, 1 the first.
    pub index: u32,
}

/// Something a person should know about the model: what, and where.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct Warning {
    /// A stable word, for example `unmatched_bench`.
    pub code: String,
    /// One sentence with the place in it.
    pub message: String,
    /// Images concerned, sorted.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub images: Vec<String>,
    /// Benches concerned, sorted; what was left out of the model has none.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub benches: Vec<BenchId>,
}

impl Warning {
    /// A warning about the images named.
    pub fn new(code: &str, message: impl Into<String>, images: impl IntoIterator<Item = String>) -> Self {
        let mut images: Vec<String> = images.into_iter().collect();
        images.sort();
        images.dedup();
        Self { code: code.to_owned(), message: message.into(), images, benches: Vec::new() }
    }
}

/// A whole plant. All vectors are sorted: lines from the north, benches from the west, rows from the north, modules by
/// number (where rows run north-south: lines and rows from the east, benches from the north), so that equal input gives
/// equal bytes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PlantModel {
    pub plant: PlantId,
    pub plant_name: String,
    /// 1 for the first model of a plant, then counting up.
    pub version: u32,
    /// The survey that it was mapped from.
    pub survey: String,
    /// Origin of the local frame (x east, y north, z up).
    pub reference: GeodeticReference,
    /// What heights refer to, as far as it is known.
    pub vertical_datum: String,
    /// How it was brought onto known places, if any were given.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub alignment: Option<Alignment>,
    /// Digest of the parameters that it was mapped with; models of equal digests can be compared.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub parameters: Option<String>,
    pub lines: Vec<Line>,
    pub benches: Vec<Bench>,
    pub sectors: Vec<Sector>,
    pub modules: Vec<Module>,
    pub warnings: Vec<Warning>,
    /// How many identifiers of each kind (line, bench, sector, module) were ever given in the plant.
    pub serials: [u64; 4],
}
