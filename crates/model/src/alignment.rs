//! How a model was aligned to places that are known from elsewhere.

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

/// How a model was brought onto known places, and what is left between them and it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Alignment {
    /// Whether the scale was fitted too.
    pub with_scale: bool,
    /// What lengths were multiplied by.
    pub scale: f64,
    /// By how much the model was turned, degrees.
    pub rotation_deg: f64,
    /// By how much its middle was moved east, north and up, metres.
    pub translation_m: Vector3<f64>,
    /// Root mean square of the residuals of the places used, metres.
    pub rms_m: f64,
    pub places: Vec<AlignedPlace>,
}

/// A known place after the alignment.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct AlignedPlace {
    /// Name of the point or label of the module.
    pub name: String,
    /// Whether it took part; otherwise it is a check.
    pub used: bool,
    /// Model less known place, east, north and up, metres.
    pub residual_enu_m: Vector3<f64>,
}
