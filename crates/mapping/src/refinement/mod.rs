//! From what the views say of each module to regular benches in space (paper, 3.6).

mod adjustment;
mod adopt;
pub mod alignment;
mod consensus;
mod exclusion;
mod lattice;
mod normal;
mod paper;
mod params;
mod scale;
mod spacing;
mod uncertainty;
mod verify;
mod views;

use crate::fusion::{Fused, View};
use crate::geometry::{Pose, Similarity};
pub use alignment::{Control, ControlError};
use heliomap_model::Alignment;
use nalgebra::{Rotation3, Vector3};
pub use params::RefinementParams;
pub use scale::Scaled;
use serde::{Deserialize, Serialize};
pub use verify::refine_verified;

/// How positions are refined.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Method {
    /// The lattices of all benches and the poses of all views, estimated together from the pixels of all views.
    #[default]
    Lattice,
    /// Mean cloud positions, a RANSAC line per row, and uniform spacing (paper, 3.6), to compare with.
    Paper,
}

/// What may be told to the refinement.
#[derive(Debug, Clone, Copy, Default)]
pub struct RefinementOptions {
    pub method: Method,
    /// Known spacing of module centres along and across the row, metres: fixes the scale of the model.
    pub spacing_m: Option<[f64; 2]>,
    /// Known width (along the row) and height (across it) of a module's face, metres: fixes the scale likewise.
    pub module_size_m: Option<[f64; 2]>,
    /// Seed of the paper's RANSAC.
    pub seed: u64,
    pub params: RefinementParams,
}

/// A module in space.
#[derive(Debug, Clone)]
pub struct RefinedModule {
    pub center_m: Vector3<f64>,
    /// One standard deviation east, north, up, relative to the plant around it, metres.
    pub sigma_m: Option<Vector3<f64>>,
}

/// A bench in space. Modules stand in the order of the fused bench.
#[derive(Debug, Clone)]
pub struct RefinedBench {
    pub modules: Vec<RefinedModule>,
    /// Unit vector along the row, towards higher numbers.
    pub along: Vector3<f64>,
    /// Unit vector in the face across the row, towards higher rows.
    pub across: Vector3<f64>,
    /// Extent of a module along and across the row, metres.
    pub module_size_m: [f64; 2],
}

impl RefinedBench {
    /// Unit normal of the face, upwards.
    pub fn normal(&self) -> Vector3<f64> {
        let normal = self.across.cross(&self.along);
        if normal.z < 0.0 { -normal } else { normal }
    }
}

/// The plant in space.
#[derive(Debug, Clone)]
pub struct Refined {
    /// One per fused bench, in its order.
    pub benches: Vec<RefinedBench>,
    /// One per view: its pose as the benches have it.
    pub poses: Vec<Pose>,
    /// How all was brought onto known places, if it was.
    pub alignment: Option<Alignment>,
    /// How known lengths scaled all, if they did.
    pub scaled: Option<Scaled>,
}

impl Refined {
    /// Mean of all modules, metres.
    fn middle(&self) -> Vector3<f64> {
        let count = self.benches.iter().map(|bench| bench.modules.len()).sum::<usize>().max(1) as f64;
        self.benches.iter().flat_map(|b| &b.modules).map(|m| m.center_m).sum::<Vector3<f64>>() / count
    }

    /// Moves, turns and scales everything.
    fn transform(&mut self, motion: &Similarity) {
        let share = motion.rotation.matrix().map(|value| value * value) * (motion.scale * motion.scale);
        for bench in &mut self.benches {
            for module in &mut bench.modules {
                module.center_m = motion.apply(&module.center_m);
                module.sigma_m = module.sigma_m.map(|s| (share * s.component_mul(&s)).map(f64::sqrt));
            }
            bench.along = motion.rotation * bench.along;
            bench.across = motion.rotation * bench.across;
            bench.module_size_m = bench.module_size_m.map(|size| size * motion.scale);
        }
        for pose in &mut self.poses {
            let center = motion.apply(&pose.center());
            pose.camera_from_world *= motion.rotation.inverse();
            pose.translation_m = -(pose.camera_from_world * center);
        }
    }

    /// Scales everything about its middle.
    fn scale(&mut self, scale: f64) {
        let middle = self.middle();
        self.transform(&Similarity { scale, rotation: Rotation3::identity(), translation_m: middle * (1.0 - scale) });
    }
}

/// Refines every bench.
pub fn refine(views: &[View<'_>], fused: &Fused, options: &RefinementOptions) -> Refined {
    let mut refined = match options.method {
        Method::Lattice => adjustment::refine(views, fused, &options.params),
        Method::Paper => Refined {
            benches: paper::refine(views, &fused.benches, options.seed),
            poses: views.iter().map(|view| view.shot.pose).collect(),
            alignment: None,
            scaled: None,
        },
    };
    refined.scaled = match (options.spacing_m, options.module_size_m) {
        (Some(spacing_m), _) => scale::by_spacing(fused, &refined, spacing_m),
        (None, Some(size_m)) => scale::by_module_size(fused, &refined, size_m),
        (None, None) => None,
    };
    if let Some(scaled) = refined.scaled {
        refined.scale(scaled.by);
    }
    refined
}
