//! The paper's refinement (3.6): mean positions, a RANSAC line through each row, the bench axis as their mean, modules
//! projected onto it (equation 4), and uniform spacing along each row. Kept to compare with.

use super::{RefinedBench, RefinedModule};
use crate::fusion::{FusedBench, View};
use nalgebra::Vector3;
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};

/// RANSAC inliers stand this near to the line, metres.
const INLIER_M: f64 = 0.25;
const TRIALS: usize = 100;

pub(super) fn refine(views: &[View<'_>], benches: &[FusedBench], seed: u64) -> Vec<RefinedBench> {
    let mut rng = StdRng::seed_from_u64(seed);
    benches.iter().map(|bench| refine_bench(views, bench, &mut rng)).collect()
}

/// Mean of what the cloud says in each view; where it says nothing, of the smoothed surface.
fn mean_position(module: &crate::fusion::FusedModule) -> Vector3<f64> {
    let points: Vec<Vector3<f64>> = module.observations.iter().map(|o| o.cloud_m.unwrap_or(o.position_m)).collect();
    points.iter().sum::<Vector3<f64>>() / points.len() as f64
}

/// A line through the points by RANSAC and least squares on its inliers: a point on it and its direction.
fn line(points: &[Vector3<f64>], rng: &mut StdRng) -> Option<(Vector3<f64>, Vector3<f64>)> {
    if points.len() < 2 {
        return None;
    }
    let mut best: Vec<usize> = Vec::new();
    for _ in 0..TRIALS {
        let (i, j) = (rng.random_range(0..points.len()), rng.random_range(0..points.len()));
        let Some(direction) = (points[j] - points[i]).try_normalize(1e-9) else { continue };
        let inliers: Vec<usize> = (0..points.len())
            .filter(|k| {
                let offset = points[*k] - points[i];
                (offset - direction * offset.dot(&direction)).norm() < INLIER_M
            })
            .collect();
        if inliers.len() > best.len() {
            best = inliers;
        }
    }
    let origin = best.iter().map(|k| points[*k]).sum::<Vector3<f64>>() / best.len() as f64;
    let mut scatter = nalgebra::Matrix3::zeros();
    for k in &best {
        let offset = points[*k] - origin;
        scatter += offset * offset.transpose();
    }
    let eigen = scatter.symmetric_eigen();
    let direction = eigen.eigenvectors.column(eigen.eigenvalues.imax()).into_owned();
    Some((origin, direction))
}

fn refine_bench(views: &[View<'_>], bench: &FusedBench, rng: &mut StdRng) -> RefinedBench {
    let positions: Vec<Vector3<f64>> = bench.modules.iter().map(mean_position).collect();
    let heading = Vector3::new(bench.pitch_m[0].x, bench.pitch_m[0].y, 0.0);
    let rows: Vec<Vec<usize>> = (0..bench.rows)
        .map(|row| (0..bench.modules.len()).filter(|k| bench.modules[*k].row == row).collect())
        .collect();
    let (mut origin, mut axis, mut lines) = (Vector3::zeros(), Vector3::zeros(), 0.0);
    for members in &rows {
        let points: Vec<Vector3<f64>> = members.iter().map(|k| positions[*k]).collect();
        if let Some((point, direction)) = line(&points, rng) {
            origin += point;
            axis += if direction.dot(&heading) < 0.0 { -direction } else { direction };
            lines += 1.0;
        }
    }
    let along = axis.try_normalize(1e-9).unwrap_or_else(|| heading.normalize());
    let origin = if lines > 0.0 { origin / lines } else { positions[0] };
    let mut centers = positions.clone();
    let mut across_sum = Vector3::zeros();
    let mut row_offsets = Vec::new();
    for members in rows.iter().filter(|members| !members.is_empty()) {
        // Equation 4: foot of each module on the bench axis, and the mean vector from there to the row.
        let offset = members
            .iter()
            .map(|k| {
                let from = positions[*k] - origin;
                from - along * from.dot(&along)
            })
            .sum::<Vector3<f64>>()
            / members.len() as f64;
        row_offsets.push(offset);
        // Uniform spacing: place along the axis as a linear function of the column.
        let count = members.len() as f64;
        let mean_col = members.iter().map(|k| f64::from(bench.modules[*k].col)).sum::<f64>() / count;
        let along_of = |k: usize| (positions[k] - origin).dot(&along);
        let mean_along = members.iter().map(|k| along_of(*k)).sum::<f64>() / count;
        let (mut top, mut bottom) = (0.0, 0.0);
        for &k in members {
            let c = f64::from(bench.modules[k].col) - mean_col;
            top += c * (along_of(k) - mean_along);
            bottom += c * c;
        }
        let spacing = if bottom > 0.0 { top / bottom } else { 0.0 };
        for &k in members {
            let c = f64::from(bench.modules[k].col) - mean_col;
            centers[k] = origin + along * (mean_along + spacing * c) + offset;
        }
    }
    for pair in row_offsets.windows(2) {
        across_sum += pair[1] - pair[0];
    }
    let level = Vector3::new(along.y, -along.x, 0.0);
    let across_raw = if across_sum.norm() > 1e-6 { across_sum } else { level };
    let across = (across_raw - along * along.dot(&across_raw)).normalize();
    let size = module_size(views, bench, &positions);
    RefinedBench {
        modules: centers.into_iter().map(|center_m| RefinedModule { center_m, sigma_m: None }).collect(),
        along,
        across,
        module_size_m: size,
    }
}

/// Extent of a module by the boxes and the depth of each view, metres.
fn module_size(views: &[View<'_>], bench: &FusedBench, positions: &[Vector3<f64>]) -> [f64; 2] {
    let mut sizes = [Vec::new(), Vec::new()];
    for (module, position) in bench.modules.iter().zip(positions) {
        for o in &module.observations {
            let shot = views[o.view].shot;
            let metres_per_px = shot.pose.to_camera(position).z / shot.camera.focal_px();
            let heading = shot.pose.camera_from_world * Vector3::new(bench.pitch_m[0].x, bench.pitch_m[0].y, 0.0);
            let [a, b] = views[o.view].detections.detections[o.detection].quad.sides();
            let turn = |side: nalgebra::Vector2<f64>| (side.x * heading.x + side.y * heading.y).abs() / side.norm();
            let (u, v) = if turn(a) > turn(b) { (a, b) } else { (b, a) };
            sizes[0].push(u.norm() * metres_per_px);
            sizes[1].push(v.norm() * metres_per_px);
        }
    }
    sizes.map(|mut values| {
        values.sort_by(f64::total_cmp);
        values.get(values.len() / 2).copied().unwrap_or(1.0)
    })
}
