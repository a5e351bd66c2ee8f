//! What a mapping may be told, and what it takes where it is told nothing.

use super::MapError;
use crate::fusion::Fused;
use crate::reconstruction;
use crate::refinement::{self, Control, Refined, Scaled};
use heliomap_model::Warning;
use serde::{Deserialize, Serialize};

/// What a mapping may be told.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MapOptions {
    /// Rows of modules per bench, if all benches have the same known number; inferred where it is not given.
    pub rows_per_bench: Option<u32>,
    /// Ground sampling distance in metres per pixel above which an image does not resolve modules and is left out of
    /// detection.
    pub max_gsd_m_per_px: Option<f64>,
    /// Known spacing of module centres along and across the row, metres (last paragraph of 4.3.1): fixes the scale.
    pub spacing_m: Option<[f64; 2]>,
    /// Known width (along the row) and height (across it) of a module's face, metres: fixes the scale likewise.
    pub module_size_m: Option<[f64; 2]>,
    /// Places that are known, to align the model by.
    pub control: Option<Control>,
    /// Whether known places set the scale too; where it is not given, they do unless a spacing or module size does.
    pub control_scale: Option<bool>,
    /// What heights refer to, where the user knows it.
    pub vertical_datum: Option<String>,
    /// How positions are refined.
    pub refinement: refinement::Method,
    /// Most pixels that an image may have.
    pub max_image_pixels: u64,
    /// Seed of every random choice.
    pub seed: u64,
}

impl Default for MapOptions {
    fn default() -> Self {
        Self {
            rows_per_bench: None,
            max_gsd_m_per_px: None,
            spacing_m: None,
            module_size_m: None,
            control: None,
            control_scale: None,
            vertical_datum: None,
            refinement: refinement::Method::default(),
            max_image_pixels: reconstruction::photo::DEFAULT_MAX_PIXELS,
            seed: 1,
        }
    }
}

impl MapOptions {
    /// Those options alone that are not as by default, JSON: what a program does not know does not keep it from reading
    /// them where it was not asked for.
    pub fn said(&self) -> String {
        let (mut said, silent) = (serde_json::json!(self), serde_json::json!(Self::default()));
        if let Some(options) = said.as_object_mut() {
            options.retain(|name, value| silent.get(name) != Some(value));
        }
        said.to_string()
    }

    /// Refuses values that make no sense.
    ///
    /// # Errors
    /// The first option that cannot be used, and why.
    pub fn check(&self) -> Result<(), MapError> {
        let refuse = |message: &str| {
            Err(MapError::Input { code: "option_invalid", message: format!("{message}; leave it out or correct it") })
        };
        if self.rows_per_bench.is_some_and(|rows| !(1..=64).contains(&rows)) {
            return refuse("rows_per_bench must be 1 to 64");
        }
        if self.max_gsd_m_per_px.is_some_and(|gsd| !(0.001..=1.0).contains(&gsd)) {
            return refuse("max_gsd_m_per_px must be 0.001 to 1 metre per pixel");
        }
        if self.spacing_m.is_some_and(|spacing| spacing.iter().any(|s| !(0.1..=10.0).contains(s))) {
            return refuse("spacing_m must be two lengths of 0.1 to 10 metres, along and across the row");
        }
        if self.module_size_m.is_some_and(|size| size.iter().any(|s| !(0.1..=10.0).contains(s))) {
            return refuse("module_size_m must be two lengths of 0.1 to 10 metres, width along the row and height");
        }
        if self.spacing_m.is_some() && self.module_size_m.is_some() {
            return refuse("spacing_m and module_size_m both fix the scale: give one of them");
        }
        if self.vertical_datum.as_ref().is_some_and(|datum| datum.is_empty() || datum.len() > 200) {
            return refuse("vertical_datum must be a name of 1 to 200 bytes");
        }
        if let Some(control) = &self.control {
            control.check()?;
        }
        Ok(())
    }

    /// Benches that have another number of rows than all are said to have.
    pub(super) fn rows_contradicted(&self, fused: &Fused) -> Option<Warning> {
        let rows = self.rows_per_bench?;
        let others: Vec<i32> =
            fused.benches.iter().map(|bench| bench.rows).filter(|found| *found != rows as i32).collect();
        let (least, most) = (others.iter().min()?, others.iter().max()?);
        let found = if least == most { format!("{most}") } else { format!("{least} to {most}") };
        let message = format!(
            "all benches are said to have {rows} rows, but {} of {} were found with {found}: they are as they were found; \
             check rows_per_bench, and these benches on the map",
            others.len(),
            fused.benches.len()
        );
        Some(Warning::new("rows_contradicted", message, []))
    }

    /// Known lengths against measured ones: a warning where the scale changed by more than GNSS errs.
    ///
    /// # Errors
    /// Lengths that no scale makes true: their ratio is another one.
    pub(super) fn scale_contradicted(&self, refined: &Refined) -> Result<Option<Warning>, MapError> {
        const MOST_ASPECT: f64 = 0.06;
        const MOST_SCALE: f64 = 0.1;
        let Some(Scaled { by, aspect }) = refined.scaled else { return Ok(None) };
        let (name, [along_m, across_m]) = match (self.spacing_m, self.module_size_m) {
            (Some(spacing_m), _) => ("spacing_m", spacing_m),
            (None, Some(size_m)) => ("module_size_m", size_m),
            (None, None) => return Ok(None),
        };
        if (aspect - 1.0).abs() > MOST_ASPECT {
            return Err(MapError::Input {
                code: "scale_contradicted",
                message: format!(
                    "{name} {along_m} x {across_m} m cannot be: along the row modules measure {:.2} times what they measure \
                     across it, and not {:.2} times; give the length along the row first, then the one across it",
                    along_m / across_m / aspect,
                    along_m / across_m
                ),
            });
        }
        Ok(((by - 1.0).abs() > MOST_SCALE).then(|| {
            let message = format!(
                "{name} {along_m} x {across_m} m makes the plant {by:.3} times as large as the reconstruction has it, where \
                 GNSS errs by a percent or two: check the lengths"
            );
            Warning::new("scale_changed", message, [])
        }))
    }

    /// What heights refer to: as the user says, else as the control does, else what is known of drones.
    pub(super) fn datum(&self) -> String {
        let of_control = || self.control.as_ref().and_then(|control| control.vertical_datum.clone());
        self.vertical_datum.clone().or_else(of_control).unwrap_or_else(|| {
            if self.control.is_some() {
                return "as the control that the model was aligned to".to_owned();
            }
            "as the image positions that the reconstruction was aligned to (for drones usually height above the WGS84 ellipsoid or \
         a barometric height; not checked)"
                .to_owned()
        })
    }
}
