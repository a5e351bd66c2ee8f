//! A bench as a lattice in space: origin, a step along the row, a step across it, and bends where it is long.

use super::views::AdjustedView;
use crate::fusion::{FusedBench, View};
use nalgebra::{SMatrix, SVector, Vector2, Vector3};

/// Vectors that make up a lattice: origin, step along, step across, bend.
pub(super) const TERMS: usize = 4;
/// Numbers that make up a lattice.
pub(super) const PARAMS: usize = 3 * TERMS;
/// Benches from this many columns on may bend.
const BEND_COLUMNS: i32 = 10;

pub(super) type BenchVector = SVector<f64, PARAMS>;
pub(super) type BenchMatrix = SMatrix<f64, PARAMS, PARAMS>;

/// `position = origin + c step_col + r step_row + (s^2 - 1/3) bend`, with `c`, `r` counted from the middle of the bench
/// and `s` running from -1 to 1 along it. Metres, in the frame of the reconstruction.
#[derive(Debug, Clone)]
pub(super) struct Lattice {
    pub(super) terms: [Vector3<f64>; TERMS],
    half_cols: f64,
    pub(super) bends: bool,
}

impl Lattice {
    /// How much each term counts at a place.
    pub(super) fn factors(&self, c: f64, r: f64) -> [f64; TERMS] {
        let s = c / self.half_cols;
        [1.0, c, r, s * s - 1.0 / 3.0]
    }

    pub(super) fn position(&self, c: f64, r: f64) -> Vector3<f64> {
        self.terms.iter().zip(self.factors(c, r)).map(|(term, factor)| term * factor).sum()
    }

    pub(super) fn step_col(&self) -> Vector3<f64> {
        self.terms[1]
    }

    pub(super) fn step_row(&self) -> Vector3<f64> {
        self.terms[2]
    }

    pub(super) fn add(&mut self, step: &BenchVector) {
        for (k, term) in self.terms.iter_mut().enumerate() {
            *term += Vector3::new(step[3 * k], step[3 * k + 1], step[3 * k + 2]);
        }
    }

    /// A start from the positions that the single views give, by robust linear least squares.
    pub(super) fn start(views: &[View<'_>], bench: &FusedBench) -> Self {
        let [u, v] = bench.pitch_m;
        let samples: Vec<(f64, f64, Vector3<f64>)> = bench
            .modules
            .iter()
            .map(|m| {
                let (c, r) = centered(bench, m.row, m.col);
                let count = m.observations.len() as f64;
                (c, r, m.observations.iter().map(|o| o.position_m).sum::<Vector3<f64>>() / count)
            })
            .collect();
        let mean = samples.iter().map(|s| s.2).sum::<Vector3<f64>>() / samples.len() as f64;
        let mut lattice = Self {
            terms: [mean, Vector3::new(u.x, u.y, 0.0), Vector3::new(v.x, v.y, 0.0), Vector3::zeros()],
            half_cols: (f64::from(bench.cols) / 2.0).max(0.5),
            bends: bench.cols >= BEND_COLUMNS,
        };
        let mut cut = 2.0_f64;
        for _ in 0..5 {
            let weak = Vector3::new(1e-9, 1e-3, 1e-3);
            let mut normal = nalgebra::Matrix3::from_diagonal(&weak);
            let mut right = [0, 1, 2].map(|k| lattice.terms[k] * weak[k]);
            for (c, r, p) in &samples {
                let t = (lattice.position(*c, *r) - p).norm() / cut;
                let weight = 1.0 / (1.0 + t * t);
                let row = Vector3::new(1.0, *c, *r);
                normal += weight * row * row.transpose();
                for (slot, basis) in right.iter_mut().zip(row.iter()) {
                    *slot += p * (weight * basis);
                }
            }
            let Some(inverse) = normal.try_inverse() else { break };
            for k in 0..3 {
                lattice.terms[k] = right[0] * inverse[(k, 0)] + right[1] * inverse[(k, 1)] + right[2] * inverse[(k, 2)];
            }
            cut = 0.3;
        }
        if bench.rows == 1 {
            lattice.terms[2] = lone_row_step(views, bench, &lattice);
        }
        lattice
    }

    /// Share of the pitch that a module's face takes along and across the row: the median over all boxes.
    pub(super) fn fill(&self, views: &[View<'_>], adjusted: &[AdjustedView], bench: &FusedBench) -> (f64, f64) {
        let (mut along, mut across) = (Vec::new(), Vec::new());
        for module in &bench.modules {
            let (c, r) = centered(bench, module.row, module.col);
            for o in &module.observations {
                let at = |dc: f64, dr: f64| adjusted[o.view].pixel(&self.position(c + dc, r + dr));
                let ends = (at(-0.5, 0.0), at(0.5, 0.0), at(0.0, -0.5), at(0.0, 0.5));
                let (Some(west), Some(east), Some(north), Some(south)) = ends else { continue };
                let (step_u, step_v) = (east - west, south - north);
                let [a, b] = views[o.view].detections.detections[o.detection].quad.sides();
                let (u, v) =
                    if a.dot(&step_u).abs() / a.norm() > b.dot(&step_u).abs() / b.norm() { (a, b) } else { (b, a) };
                along.push(u.norm() / step_u.norm());
                across.push(v.norm() / step_v.norm());
            }
        }
        // A column or row alone has no neighbour to overlap.
        let clamp = |values: Vec<f64>| median(values).unwrap_or(0.98).clamp(0.5, 0.998);
        (clamp(along), clamp(across))
    }
}

/// Place of a module counted from the middle of its bench.
pub(super) fn centered(bench: &FusedBench, row: i32, col: i32) -> (f64, f64) {
    (f64::from(col) - f64::from(bench.cols - 1) / 2.0, f64::from(row) - f64::from(bench.rows - 1) / 2.0)
}

/// For a single row the step across is the face itself, from its upper to its lower edge: first guess level.
fn lone_row_step(views: &[View<'_>], bench: &FusedBench, lattice: &Lattice) -> Vector3<f64> {
    let along = lattice.step_col().try_normalize(1e-9).unwrap_or(Vector3::x());
    let level = Vector3::new(along.y, -along.x, 0.0).try_normalize(1e-9).unwrap_or(-Vector3::y());
    let ratios: Vec<f64> = bench
        .modules
        .iter()
        .flat_map(|m| &m.observations)
        .map(|o| {
            let [u, v] = views[o.view].detections.detections[o.detection].quad.sides();
            let (a, b) = (u.norm(), v.norm());
            let shot = views[o.view].shot;
            let image_along = shot.pose.camera_from_world * along;
            let image_along = Vector2::new(image_along.x, image_along.y);
            if u.dot(&image_along).abs() / a >= v.dot(&image_along).abs() / b { b / a } else { a / b }
        })
        .collect();
    level * lattice.step_col().norm() * 0.98 * median(ratios).unwrap_or(1.0)
}

pub(super) fn median(mut values: Vec<f64>) -> Option<f64> {
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, f64::total_cmp).1)
}
