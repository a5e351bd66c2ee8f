//! The scale of the model by lengths that are known: GNSS leaves it weakest.

use super::Refined;
use crate::fusion::Fused;

/// Sides of a module that differ by less than this share cannot tell seam from scale.
const UNEQUAL: f64 = 0.2;
/// Widest seam between two modules of a bench, metres.
const WIDEST_SEAM_M: f64 = 0.08;

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
pub(super) fn by_spacing(fused: &Fused, refined: &Refined, spacing_m: [f64; 2]) -> Option<f64> {
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
    (weight > 0.0).then(|| sum / weight)
}

/// What the model must be multiplied by so that modules have the size that is known, width along the row and height
/// across it. Pitches are known to a few tenths of a millimetre, boxes hardly to one percent: the pitch is a side and a
/// seam, and with seams alike both ways the two pitches tell scale and seam. Where there is one row, or modules are
/// square, the boxes must do.
pub(super) fn by_module_size(fused: &Fused, refined: &Refined, size_m: [f64; 2]) -> Option<f64> {
    let [width_m, height_m] = size_m;
    if let [Some(along_m), Some(across_m)] = pitches_m(fused, refined)
        && (height_m - width_m).abs() > UNEQUAL * width_m.min(height_m)
    {
        let scale = (height_m - width_m) / (across_m - along_m);
        let seam_m = scale * along_m - width_m;
        if (0.0..WIDEST_SEAM_M).contains(&seam_m) {
            return Some(scale);
        }
    }
    let ratios: Vec<f64> = refined
        .benches
        .iter()
        .flat_map(|bench| [width_m / bench.module_size_m[0], height_m / bench.module_size_m[1]])
        .collect();
    super::lattice::median(ratios)
}
