//! The result: the model of a plant, its identifiers and labels, and its exports.

pub mod assemble;
pub mod geojson;
pub mod ids;
pub mod model;
mod resurvey;

pub use geojson::Layer;
pub use ids::{BenchId, LineId, ModuleId, PlantId, SectorId};
pub use model::{Bench, Line, Module, ModuleStatus, PlantModel, Sector, Warning};
