//! Identifiers that never change once given, and the labels that a technician can walk to.

use serde::{Deserialize, Serialize};
use std::fmt;
use std::str::FromStr;
use uuid::Uuid;

/// Why a text is no identifier.
#[derive(Debug, thiserror::Error)]
#[error("`{text}` is no {kind} identifier: a UUID such as 8c1f0b1e-6f0a-5d0c-9a59-0c1d2e3f4a5b is expected")]
pub struct InvalidId {
    pub kind: &'static str,
    pub text: String,
}

macro_rules! id_type {
    ($(#[$doc:meta])* $name:ident, $kind:literal) => {
        $(#[$doc])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
        #[serde(transparent)]
        pub struct $name(pub Uuid);

        impl $name {
            /// The identifier of the `serial`-th one ever given in a plant: the same in every run, different in every
            /// plant.
            pub fn from_serial(plant: PlantId, serial: u64) -> Self {
                Self(Uuid::new_v5(&plant.0, format!(concat!($kind, "/{}"), serial).as_bytes()))
            }
        }

        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                self.0.fmt(f)
            }
        }

        impl FromStr for $name {
            type Err = InvalidId;

            fn from_str(text: &str) -> Result<Self, InvalidId> {
                Uuid::try_parse(text).map(Self).map_err(|_| InvalidId { kind: $kind, text: text.chars().take(64).collect() })
            }
        }
    };
}

/// Identifies a plant.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct PlantId(pub Uuid);

impl PlantId {
    /// The identifier of a plant known by its name alone (mapping without a server): the same name gives the same one.
    pub fn from_name(name: &str) -> Self {
        Self(Uuid::new_v5(&Uuid::NAMESPACE_URL, format!("heliomap:plant/{name}").as_bytes()))
    }
}

impl fmt::Display for PlantId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

impl FromStr for PlantId {
    type Err = InvalidId;

    fn from_str(text: &str) -> Result<Self, InvalidId> {
        Uuid::try_parse(text).map(Self).map_err(|_| InvalidId { kind: "plant", text: text.chars().take(64).collect() })
    }
}

id_type!(
    /// Identifies a module for as long as the plant stands.
    ModuleId,
    "module"
);
id_type!(
    /// Identifies a sector: one row of one bench.
    SectorId,
    "sector"
);
id_type!(
    /// Identifies a bench.
    BenchId,
    "bench"
);
id_type!(
    /// Identifies a line of benches.
    LineId,
    "line"
);
