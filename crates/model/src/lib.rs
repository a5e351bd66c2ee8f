//! The plant model as data: identifiers, lines, benches, sectors and modules, and their GeoJSON.
//!
//! This is the leaf of the workspace. It knows nothing of photos, of the mapping that makes a model, or of the service that
//! stores it.

pub mod alignment;
mod antimeridian;
pub mod geodesy;
pub mod geojson;
pub mod ids;
pub mod plant;

pub use alignment::{AlignedPlace, Alignment};
pub use geodesy::{GeodeticReference, Lla};
pub use geojson::Layer;
pub use ids::{BenchId, InvalidId, LineId, ModuleId, PlantId, SectorId};
pub use plant::{Bench, Line, Module, ModuleStatus, PlantModel, Sector, Warning};
