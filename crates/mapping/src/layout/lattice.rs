//! A smooth map from lattice coordinates to the image: where the module of a column and row stands.

use nalgebra::{SMatrix, Vector2};
use serde::{Deserialize, Serialize};

/// Terms of the longest map, and the powers that are in it.
const MOST_TERMS: usize = 7;
/// A fit ends when no coefficient moves further, shares of the shorter pitch.
const SETTLED: f64 = 1e-4;

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
        let reach = Vector2::new(cols, rows) / 2.0;
        let mut map = Self { center, scale, reach, terms: Vec::new() };
        let pitch = side_u.norm().min(side_v.norm()).max(1e-9);
        let bases: Vec<[f64; MOST_TERMS]> = samples.iter().map(|s| map.bases(s.col, s.row, &powers)).collect();
        let mut weights = vec![1.0; samples.len()];
        let mut residuals = vec![0.0; samples.len()];
        let mut sorted = Vec::with_capacity(samples.len());
        for round in 0..6 {
            let before = std::mem::replace(&mut map.terms, solve(samples, &bases, &weights, &powers));
            let moved = before.iter().zip(&map.terms).map(|(old, new)| (old.2 - new.2).amax()).fold(0.0, f64::max);
            if round == 5 || (round > 0 && moved < SETTLED * pitch) {
                break;
            }
            for ((rest, sample), basis) in residuals.iter_mut().zip(samples).zip(&bases) {
                let fitted = map.terms.iter().zip(basis).map(|(term, basis)| term.2 * *basis).sum::<Vector2<f64>>();
                *rest = (fitted - sample.pixel).norm();
            }
            sorted.clone_from(&residuals);
            let median = *sorted.select_nth_unstable_by(samples.len() / 2, f64::total_cmp).1;
            let cut = (4.0 * 1.4826 * median).max(0.02 * pitch).max(0.2);
            for (weight, residual) in weights.iter_mut().zip(&residuals) {
                let t = residual / cut;
                // Outliers keep a trace of weight, so that the system stays solvable.
                *weight = if t < 1.0 { (1.0 - t * t).powi(2) } else { 0.0 }.max(1e-6);
            }
        }
        map.complete(cols, rows, side_u, side_v);
        map
    }

    /// Column and row in the map's own units.
    fn scaled(&self, col: f64, row: f64) -> [f64; 2] {
        [(col - self.center.x) / self.scale, (row - self.center.y) / self.scale]
    }

    /// The value of each term's powers.
    fn bases(&self, col: f64, row: f64, powers: &[(u8, u8)]) -> [f64; MOST_TERMS] {
        let [c, r] = self.scaled(col, row).map(powers_of);
        let mut values = [0.0; MOST_TERMS];
        for (value, (i, j)) in values.iter_mut().zip(powers) {
            *value = c[usize::from(*i)] * r[usize::from(*j)];
        }
        values
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
        let [c, r] = self.within(col, row);
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
        let [c, r] = self.scaled(col, row).map(powers_of);
        self.terms.iter().map(|(i, j, coefficient)| *coefficient * (c[usize::from(*i)] * r[usize::from(*j)])).sum()
    }

    /// Derivatives of the polynomial by column and by row.
    fn slopes(&self, col: f64, row: f64) -> [Vector2<f64>; 2] {
        let [c, r] = self.scaled(col, row).map(powers_of);
        let mut slopes = [Vector2::zeros(); 2];
        for (i, j, coefficient) in &self.terms {
            let (i, j) = (usize::from(*i), usize::from(*j));
            if i > 0 {
                slopes[0] += coefficient * (i as f64 * c[i - 1] * r[j] / self.scale);
            }
            if j > 0 {
                slopes[1] += coefficient * (j as f64 * c[i] * r[j - 1] / self.scale);
            }
        }
        slopes
    }

    /// The nearest lattice coordinate at which there were samples.
    fn within(&self, col: f64, row: f64) -> [f64; 2] {
        let inside = |value: f64, axis: usize| {
            value.clamp(self.center[axis] - self.reach[axis], self.center[axis] + self.reach[axis])
        };
        [inside(col, 0), inside(row, 1)]
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
            let [c, r] = self.within(at.x, at.y);
            let [du, dv] = self.slopes(c, r);
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

/// The powers of a number from nought to the third.
fn powers_of(value: f64) -> [f64; 4] {
    let square = value * value;
    [1.0, value, square, square * value]
}

/// Weighted least squares.
fn solve(
    samples: &[Sample],
    bases: &[[f64; MOST_TERMS]],
    weights: &[f64],
    powers: &[(u8, u8)],
) -> Vec<(u8, u8, Vector2<f64>)> {
    let mut normal = SMatrix::<f64, MOST_TERMS, MOST_TERMS>::zeros();
    let mut right = SMatrix::<f64, MOST_TERMS, 2>::zeros();
    let count = powers.len();
    for ((sample, basis), weight) in samples.iter().zip(bases).zip(weights) {
        for i in 0..count {
            let weighted = weight * basis[i];
            for j in 0..=i {
                normal[(i, j)] += weighted * basis[j];
            }
            right[(i, 0)] += weighted * sample.pixel.x;
            right[(i, 1)] += weighted * sample.pixel.y;
        }
    }
    for i in 0..MOST_TERMS {
        // Terms that are not in use stay nought.
        normal[(i, i)] += if i < count { 1e-9 } else { 1.0 };
        for j in 0..i {
            normal[(j, i)] = normal[(i, j)];
        }
    }
    let Some(cholesky) = normal.cholesky() else {
        return vec![(0, 0, samples.iter().map(|s| s.pixel).sum::<Vector2<f64>>() / samples.len() as f64)];
    };
    let solution = cholesky.solve(&right);
    powers.iter().enumerate().map(|(k, power)| (power.0, power.1, solution.row(k).transpose())).collect()
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
