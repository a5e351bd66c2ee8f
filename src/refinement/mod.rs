//! From what the views say of each module to regular benches in space (paper, 3.6).

pub mod lattice_fit;
pub mod paper;

use crate::fusion::{Fused, View};
use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

/// How positions are refined.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Method {
    /// The lattice of each bench, estimated from the pixels of all views at once.
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
    /// Seed of the paper's RANSAC.
    pub seed: u64,
}

/// A module in space.
#[derive(Debug, Clone)]
pub struct RefinedModule {
    pub center_m: Vector3<f64>,
    /// One standard deviation east, north, up, metres.
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

/// Refines every bench. One entry per fused bench, in its order.
pub fn refine(views: &[View<'_>], fused: &Fused, options: &RefinementOptions) -> Vec<RefinedBench> {
    let mut refined = match options.method {
        Method::Lattice => lattice_fit::refine(views, &fused.benches),
        Method::Paper => paper::refine(views, &fused.benches, options.seed),
    };
    if let Some(spacing_m) = options.spacing_m {
        fix_scale(fused, &mut refined, spacing_m);
    }
    refined
}

/// Scales the whole model about its middle so that neighbouring modules stand as far apart as is known (the scale is what
/// GNSS leaves weakest).
fn fix_scale(fused: &Fused, refined: &mut [RefinedBench], spacing_m: [f64; 2]) {
    let mut ratios = Vec::new();
    for (bench, positions) in fused.benches.iter().zip(refined.iter()) {
        let place = |row: i32, col: i32| {
            let index = bench.modules.binary_search_by_key(&(row, col), |m| (m.row, m.col)).ok()?;
            Some(positions.modules[index].center_m)
        };
        for module in &bench.modules {
            for (axis, step) in [(0, (0, 1)), (1, (1, 0))] {
                let pair = (place(module.row, module.col), place(module.row + step.0, module.col + step.1));
                if let (Some(from), Some(to)) = pair {
                    ratios.push(spacing_m[axis] / (to - from).norm());
                }
            }
        }
    }
    if ratios.is_empty() {
        return;
    }
    ratios.sort_by(f64::total_cmp);
    let scale = ratios[ratios.len() / 2];
    let count = refined.iter().map(|bench| bench.modules.len()).sum::<usize>() as f64;
    let middle = refined.iter().flat_map(|b| &b.modules).map(|m| m.center_m).sum::<Vector3<f64>>() / count;
    for bench in refined {
        for module in &mut bench.modules {
            module.center_m = middle + (module.center_m - middle) * scale;
        }
        bench.module_size_m = bench.module_size_m.map(|size| size * scale);
    }
}
