//! A smooth map from lattice coordinates to the image: where the module of a column and row stands.

use nalgebra::{DMatrix, DVector, Vector2};
use serde::{Deserialize, Serialize};

/// `pixel = sum of coefficient * basis(column, row)`: affine in both, and bent along the row where there are enough
/// columns to tell (perspective, terrain).
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct LatticeMap {
    center: Vector2<f64>,
    scale: f64,
    /// Half the extent of the samples along each axis, plus one half: beyond it the map goes on straight.
    reach: Vector2<f64>,
    /// Powers (of column, of row) and the coefficient in pixels.
    terms: Vec<(u8, u8, Vector2<f64>)>,
}

/// One observation: where the centre of the module at (column, row) was seen.
#[derive(Debug, Clone, Copy)]
pub struct Sample {
    pub col: f64,
    pub row: f64,
    pub pixel: Vector2<f64>,
}

impl LatticeMap {
    /// Robust fit (Tukey's biweight on residuals, started from least squares). `side_u` and `side_v` in pixels stand in
    /// for the pitch along an axis of which the samples hold one value only.
    pub fn fit(samples: &[Sample], side_u: Vector2<f64>, side_v: Vector2<f64>) -> Self {
        let range = |f: fn(&Sample) -> f64| {
            samples.iter().map(f).fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(v), high.max(v)))
        };
        let (col_low, col_high) = range(|s| s.col);
        let (row_low, row_high) = range(|s| s.row);
        let (cols, rows) = (col_high - col_low + 1.0, row_high - row_low + 1.0);
        let center = Vector2::new((col_low + col_high) / 2.0, (row_low + row_high) / 2.0);
        let scale = (cols.max(rows) / 2.0).max(1.0);
        let count = samples.len() as f64;
        let mut powers = vec![(0_u8, 0_u8)];
        if cols >= 2.0 {
            powers.push((1, 0));
        }
        if rows >= 2.0 {
            powers.push((0, 1));
        }
        if cols >= 3.0 && rows >= 2.0 && count >= 8.0 {
            powers.push((1, 1));
        }
        if cols >= 5.0 && count >= 8.0 {
            powers.push((2, 0));
        }
        if cols >= 12.0 && count >= 16.0 {
            powers.push((3, 0));
        }
        if rows >= 4.0 && count >= 16.0 {
            powers.push((0, 2));
        }
        let mut weights = vec![1.0; samples.len()];
        let reach = Vector2::new(cols, rows) / 2.0;
        let mut map = Self { center, scale, reach, terms: Vec::new() };
        let pitch = side_u.norm().min(side_v.norm()).max(1e-9);
        for round in 0..6 {
            map.terms = map.solve(samples, &weights, &powers);
            map.complete(cols, rows, side_u, side_v);
            let mut residuals: Vec<f64> = samples.iter().map(|s| (map.pixel(s.col, s.row) - s.pixel).norm()).collect();
            let exact = residuals.clone();
            residuals.sort_by(f64::total_cmp);
            let median = residuals[residuals.len() / 2];
            let cut = (4.0 * 1.4826 * median).max(0.02 * pitch).max(0.2);
            if round == 5 {
                break;
            }
            for (weight, residual) in weights.iter_mut().zip(exact) {
                let t = residual / cut;
                // Outliers keep a trace of weight, so that the system stays solvable.
                *weight = if t < 1.0 { (1.0 - t * t).powi(2) } else { 0.0 }.max(1e-6);
            }
        }
        map
    }

    fn basis(&self, col: f64, row: f64, power: (u8, u8)) -> f64 {
        let (c, r) = ((col - self.center.x) / self.scale, (row - self.center.y) / self.scale);
        c.powi(i32::from(power.0)) * r.powi(i32::from(power.1))
    }

    fn solve(&self, samples: &[Sample], weights: &[f64], powers: &[(u8, u8)]) -> Vec<(u8, u8, Vector2<f64>)> {
        let n = powers.len();
        let mut normal = DMatrix::<f64>::zeros(n, n);
        let mut right = [DVector::<f64>::zeros(n), DVector::<f64>::zeros(n)];
        let mut row = vec![0.0; n];
        for (sample, weight) in samples.iter().zip(weights) {
            for (value, power) in row.iter_mut().zip(powers) {
                *value = self.basis(sample.col, sample.row, *power);
            }
            for i in 0..n {
                for j in 0..=i {
                    normal[(i, j)] += weight * row[i] * row[j];
                }
                right[0][i] += weight * row[i] * sample.pixel.x;
                right[1][i] += weight * row[i] * sample.pixel.y;
            }
        }
        for i in 0..n {
            normal[(i, i)] += 1e-9;
            for j in 0..i {
                normal[(j, i)] = normal[(i, j)];
            }
        }
        let Some(cholesky) = normal.cholesky() else {
            return vec![(0, 0, samples.iter().map(|s| s.pixel).sum::<Vector2<f64>>() / samples.len() as f64)];
        };
        let (x, y) = (cholesky.solve(&right[0]), cholesky.solve(&right[1]));
        powers.iter().enumerate().map(|(k, power)| (power.0, power.1, Vector2::new(x[k], y[k]))).collect()
    }

    /// Adds the pitch along an axis that the samples do not show.
    fn complete(&mut self, cols: f64, rows: f64, side_u: Vector2<f64>, side_v: Vector2<f64>) {
        if cols < 2.0 || !self.terms.iter().any(|t| (t.0, t.1) == (1, 0)) {
            self.terms.push((1, 0, side_u * self.scale));
        }
        if rows < 2.0 || !self.terms.iter().any(|t| (t.0, t.1) == (0, 1)) {
            self.terms.push((0, 1, side_v * self.scale));
        }
    }

    /// The pixel of a lattice coordinate. Beyond the samples the map goes on straight: a bend must not run away.
    pub fn pixel(&self, col: f64, row: f64) -> Vector2<f64> {
        let inside = |value: f64, axis: usize| {
            value.clamp(self.center[axis] - self.reach[axis], self.center[axis] + self.reach[axis])
        };
        let (c, r) = (inside(col, 0), inside(row, 1));
        let mut pixel = self.polynomial(c, r);
        if c != col {
            pixel += (self.polynomial(c + 0.5, r) - self.polynomial(c - 0.5, r)) * (col - c);
        }
        if r != row {
            pixel += (self.polynomial(c, r + 0.5) - self.polynomial(c, r - 0.5)) * (row - r);
        }
        pixel
    }

    fn polynomial(&self, col: f64, row: f64) -> Vector2<f64> {
        self.terms.iter().map(|(i, j, coefficient)| *coefficient * self.basis(col, row, (*i, *j))).sum()
    }

    /// Pixels per column and per row at a lattice coordinate.
    pub fn pitch(&self, col: f64, row: f64) -> [Vector2<f64>; 2] {
        [
            (self.pixel(col + 0.5, row) - self.pixel(col - 0.5, row)),
            (self.pixel(col, row + 0.5) - self.pixel(col, row - 0.5)),
        ]
    }

    /// The lattice coordinate (column, row) of a pixel by Newton's method; `None` where it does not converge.
    pub fn coordinate(&self, pixel: Vector2<f64>) -> Option<Vector2<f64>> {
        let mut at = self.center;
        for _ in 0..25 {
            let [du, dv] = self.pitch(at.x, at.y);
            let determinant = du.perp(&dv);
            if determinant.abs() < 1e-9 {
                return None;
            }
            let miss = pixel - self.pixel(at.x, at.y);
            let step = Vector2::new(miss.perp(&dv) / determinant, du.perp(&miss) / determinant);
            at += step.cap_magnitude(20.0);
            if step.norm() < 1e-6 {
                return Some(at);
            }
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn follows_perspective_and_ignores_outliers() {
        let truth = |c: f64, r: f64| {
            let w = 1.0 + 0.004 * c + 0.01 * r;
            Vector2::new((100.0 + 25.0 * c + 3.0 * r) / w, (200.0 - 2.0 * c + 40.0 * r) / w)
        };
        let mut samples: Vec<Sample> = (0..40)
            .map(|k| Sample {
                col: f64::from(k / 2),
                row: f64::from(k % 2),
                pixel: truth(f64::from(k / 2), f64::from(k % 2)),
            })
            .collect();
        samples[7].pixel.x += 12.0;
        samples[20].pixel.y -= 9.0;
        let map = LatticeMap::fit(&samples, Vector2::new(25.0, -2.0), Vector2::new(3.0, 40.0));
        for (c, r) in [(0.0, 0.0), (3.0, 1.0), (19.0, 1.0), (20.0, 0.0), (10.0, 0.0)] {
            assert!((map.pixel(c, r) - truth(c, r)).norm() < 0.6, "{c} {r}: {} {}", map.pixel(c, r), truth(c, r));
            let back = map.coordinate(map.pixel(c, r)).unwrap();
            assert!((back - Vector2::new(c, r)).norm() < 1e-5);
        }
    }

    #[test]
    fn one_row_takes_the_side_for_the_pitch_across() {
        let samples: Vec<Sample> = (0..9)
            .map(|k| Sample { col: f64::from(k), row: 0.0, pixel: Vector2::new(20.0 * f64::from(k), 5.0) })
            .collect();
        let map = LatticeMap::fit(&samples, Vector2::new(20.0, 0.0), Vector2::new(0.0, 33.0));
        assert!((map.pixel(4.0, 1.0) - Vector2::new(80.0, 38.0)).norm() < 1e-4);
    }
}
