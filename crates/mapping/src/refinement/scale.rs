//! The scale of the model by lengths that are known: GNSS leaves it weakest.

use super::Refined;
use crate::fusion::Fused;

/// Seam between two modules that clamps hold, and its standard deviation, metres.
const SEAM_M: f64 = 0.02;
const SEAM_SIGMA_M: f64 = 0.003;
/// Standard deviation of the size of boxes, as a share.
const BOX_SIGMA: f64 = 0.015;
/// Pitch and boxes contradict each other beyond this share.
const CONTRADICTION: f64 = 0.015;

/// What known lengths made of the scale.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Scaled {
    /// What the model was multiplied by.
    pub by: f64,
    /// Known over measured ratio of length along the row to length across it; 1 where only one of both is measured.
    pub aspect: f64,
}

/// Median distance of neighbouring modules along and across the row, over the whole plant, metres.
fn pitches_m(fused: &Fused, refined: &Refined) -> [Option<f64>; 2] {
    let mut lengths = [Vec::new(), Vec::new()];
    for (bench, positions) in fused.benches.iter().zip(&refined.benches) {
        let place = |row: i32, col: i32| {
            let index = bench.modules.binary_search_by_key(&(row, col), |m| (m.row, m.col)).ok()?;
            Some(positions.modules[index].center_m)
        };
        for (module, position) in bench.modules.iter().zip(&positions.modules) {
            for (axis, step) in [(0, (0, 1)), (1, (1, 0))] {
                if let Some(next) = place(module.row + step.0, module.col + step.1) {
                    lengths[axis].push((next - position.center_m).norm());
                }
            }
        }
    }
    lengths.map(super::lattice::median)
}

/// What the model must be multiplied by so that neighbours stand as far apart as is known, along and across the row.
/// `None` without neighbours.
pub(super) fn by_spacing(fused: &Fused, refined: &Refined, spacing_m: [f64; 2]) -> Option<Scaled> {
    // Each direction by how many of its pitches a bench holds: the longer one is known better.
    let pitches = pitches_m(fused, refined);
    let (mut sum, mut weight) = (0.0, 0.0);
    for axis in 0..2 {
        let steps: f64 = fused.benches.iter().map(|b| f64::from([b.cols, b.rows][axis] - 1).powi(2)).sum();
        if let Some(pitch) = pitches[axis] {
            sum += steps * spacing_m[axis] / pitch;
            weight += steps;
        }
    }
    let aspect = match pitches {
        [Some(along), Some(across)] => spacing_m[0] / spacing_m[1] * across / along,
        _ => 1.0,
    };
    (weight > 0.0).then(|| Scaled { by: sum / weight, aspect })
}

/// What the model must be multiplied by so that modules have the size that is known, width along the row and height
/// across it. Boxes are hardly right to one percent of a module; the pitch along the row is known to a few tenths of a
/// millimetre, but is a module and its seam, which the clamps between modules make about 2 cm wide. Both are weighed,
/// unless they contradict each other: then modules are mounted otherwise, and the boxes decide.
pub(super) fn by_module_size(fused: &Fused, refined: &Refined, size_m: [f64; 2]) -> Option<Scaled> {
    let [width_m, height_m] = size_m;
    let median_of = |of: &dyn Fn([f64; 2]) -> f64| {
        super::lattice::median(refined.benches.iter().map(|bench| of(bench.module_size_m)).collect())
    };
    let by_boxes = median_of(&|[width, height]| (width_m * height_m / (width * height)).sqrt())?;
    let aspect = median_of(&|[width, height]| width_m / height_m * height / width)?;
    let by_pitch = pitches_m(fused, refined)[0].map(|along_m| (width_m + SEAM_M) / along_m);
    let by = match by_pitch {
        Some(by_pitch) if (by_pitch / by_boxes - 1.0).abs() <= CONTRADICTION => {
            let (boxes, pitch) = (BOX_SIGMA.powi(-2), (SEAM_SIGMA_M / width_m).powi(-2));
            (by_boxes * boxes + by_pitch * pitch) / (boxes + pitch)
        }
        _ => by_boxes,
    };
    Some(Scaled { by, aspect })
}
