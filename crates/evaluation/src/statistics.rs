//! Five-number summaries, neighbour spacing, and how honest the stated uncertainties are.

use super::model::ReferenceModel;
use nalgebra::Vector3;
use serde::Serialize;
use std::collections::BTreeMap;

/// Minimum, quartiles and maximum (linear interpolation between order statistics).
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct FiveNumbers {
    pub min: f64,
    pub q1: f64,
    pub median: f64,
    pub q3: f64,
    pub max: f64,
}

impl FiveNumbers {
    /// The summary of finite values; `None` without any.
    pub fn of(mut values: Vec<f64>) -> Option<Self> {
        if values.is_empty() {
            return None;
        }
        values.sort_by(f64::total_cmp);
        let quantile = |share: f64| {
            let place = share * (values.len() - 1) as f64;
            let below = place.floor() as usize;
            let above = (below + 1).min(values.len() - 1);
            values[below] + (values[above] - values[below]) * (place - below as f64)
        };
        Some(Self {
            min: quantile(0.0),
            q1: quantile(0.25),
            median: quantile(0.5),
            q3: quantile(0.75),
            max: quantile(1.0),
        })
    }

    /// The five numbers in order.
    pub fn values(&self) -> [f64; 5] {
        [self.min, self.q1, self.median, self.q3, self.max]
    }
}

/// Share of errors within one, two and three stated standard deviations. Gaussian errors with honest deviations give
/// 0.683, 0.954 and 0.997.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Calibration {
    /// Modules that state a standard deviation.
    pub modules: usize,
    pub x: [f64; 3],
    pub y: [f64; 3],
    pub z: [f64; 3],
}

impl Calibration {
    /// From differences and the standard deviations stated for them, metres; `None` where none is stated.
    pub fn of(differences_m: &[Vector3<f64>], sigmas_m: &[Option<Vector3<f64>>]) -> Option<Self> {
        let stated: Vec<(Vector3<f64>, Vector3<f64>)> =
            differences_m.iter().zip(sigmas_m).filter_map(|(d, sigma)| sigma.map(|sigma| (*d, sigma))).collect();
        if stated.is_empty() {
            return None;
        }
        let share = |axis: usize, sigmas: f64| {
            let within = stated.iter().filter(|(d, sigma)| d[axis].abs() <= sigmas * sigma[axis]).count();
            within as f64 / stated.len() as f64
        };
        let shares = |axis| [share(axis, 1.0), share(axis, 2.0), share(axis, 3.0)];
        Some(Self { modules: stated.len(), x: shares(0), y: shares(1), z: shares(2) })
    }
}

/// Differences plant minus truth of the paired modules, metres (paper, Figs. 16 and 18).
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Differences {
    /// East.
    pub x: FiveNumbers,
    /// North.
    pub y: FiveNumbers,
    /// Up.
    pub z: FiveNumbers,
    /// Length of the horizontal difference.
    pub horizontal: FiveNumbers,
    /// Size of the vertical difference.
    pub vertical: FiveNumbers,
    /// Whether the errors keep what the plant's standard deviations promise.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub calibration: Option<Calibration>,
}

impl Differences {
    /// The summary of at least one difference; `None` without any.
    pub fn of(differences_m: &[Vector3<f64>], sigmas_m: &[Option<Vector3<f64>>]) -> Option<Self> {
        let summary = |f: fn(&Vector3<f64>) -> f64| FiveNumbers::of(differences_m.iter().map(f).collect());
        Some(Self {
            x: summary(|d| d.x)?,
            y: summary(|d| d.y)?,
            z: summary(|d| d.z)?,
            horizontal: summary(|d| d.xy().norm())?,
            vertical: summary(|d| d.z.abs())?,
            calibration: Calibration::of(differences_m, sigmas_m),
        })
    }
}

/// How wrong distances between modules that stand far apart are, as shares of the true distance.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Distances {
    /// Modules nearer to each other than this are not compared, metres.
    pub least_m: f64,
    /// How many distances were compared.
    pub compared: usize,
    pub median: f64,
    pub largest: f64,
}

impl Distances {
    const LEAST_M: f64 = 20.0;
    /// Modules between all of which distances are compared; of more, evenly spread ones.
    const MOST_MODULES: usize = 2_000;

    /// The errors between all pairs of (plant, truth) positions in metres; `None` where no two are far enough apart.
    pub fn of(positions_m: &[(Vector3<f64>, Vector3<f64>)]) -> Option<Self> {
        let stride = positions_m.len().div_ceil(Self::MOST_MODULES).max(1);
        let chosen: Vec<&(Vector3<f64>, Vector3<f64>)> = positions_m.iter().step_by(stride).collect();
        let mut errors = Vec::new();
        for (k, (plant, truth)) in chosen.iter().enumerate() {
            for (other_plant, other_truth) in &chosen[..k] {
                let true_m = (truth - other_truth).norm();
                if true_m >= Self::LEAST_M {
                    errors.push(((plant - other_plant).norm() / true_m - 1.0).abs());
                }
            }
        }
        let compared = errors.len();
        let numbers = FiveNumbers::of(errors)?;
        Some(Self { least_m: Self::LEAST_M, compared, median: numbers.median, largest: numbers.max })
    }
}

/// Distances between neighbouring module centres of one model, metres (paper, Fig. 17).
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Spacing {
    /// Between consecutive numbers of a row; `None` where no row has two.
    pub rows: Option<FiveNumbers>,
    /// Between consecutive rows of a number; `None` where no bench has two rows.
    pub columns: Option<FiveNumbers>,
    /// Median module size along the row and up the table.
    pub module_m: [f64; 2],
}

impl Spacing {
    /// The spacing of a model in its own structure.
    pub fn of(model: &ReferenceModel) -> Self {
        let places: BTreeMap<(usize, i64, i64), Vector3<f64>> =
            model.modules.iter().map(|m| ((m.bench, m.row, m.number), m.center_enu_m)).collect();
        let distances = |row_step: i64, number_step: i64| {
            let neighbours = places.iter().filter_map(|(&(bench, row, number), center)| {
                let neighbour = places.get(&(bench, row + row_step, number + number_step))?;
                Some((neighbour - center).norm())
            });
            FiveNumbers::of(neighbours.collect())
        };
        let median_extent = |axis: usize| {
            let extents = model.modules.iter().map(|m| m.extent_m()[axis]).collect();
            FiveNumbers::of(extents).map_or(0.0, |summary| summary.median)
        };
        Self { rows: distances(0, 1), columns: distances(1, 0), module_m: [median_extent(0), median_extent(1)] }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quartiles_interpolate() {
        let summary = FiveNumbers::of(vec![4.0, 1.0, 2.0, 3.0]).unwrap();
        assert_eq!(summary.values(), [1.0, 1.75, 2.5, 3.25, 4.0]);
        assert_eq!(FiveNumbers::of(vec![7.0]).unwrap().values(), [7.0; 5]);
        assert!(FiveNumbers::of(Vec::new()).is_none());
    }

    #[test]
    fn distances_tell_the_scale_and_nothing_of_the_place() {
        let truth: Vec<Vector3<f64>> = (0..50).map(|k| Vector3::new(f64::from(k), f64::from(k % 7), 1.0)).collect();
        let scaled =
            |scale: f64| -> Vec<_> { truth.iter().map(|t| (t * scale + Vector3::new(3.0, -8.0, 1.0), *t)).collect() };
        let distances = Distances::of(&scaled(1.002)).unwrap();
        assert!((distances.median - 0.002).abs() < 1e-9 && (distances.largest - 0.002).abs() < 1e-9);
        assert!(Distances::of(&scaled(1.0)).unwrap().largest < 1e-12);
        assert!(Distances::of(&scaled(1.0)[..15]).is_none());
    }

    #[test]
    fn calibration_counts_only_what_states_a_deviation() {
        let errors = [Vector3::new(0.5, 1.5, 2.5), Vector3::new(-0.5, -3.5, 0.0), Vector3::new(9.0, 9.0, 9.0)];
        let one = Some(Vector3::repeat(1.0));
        let calibration = Calibration::of(&errors, &[one, one, None]).unwrap();
        assert_eq!(calibration.modules, 2);
        assert_eq!(calibration.x, [1.0, 1.0, 1.0]);
        assert_eq!(calibration.y, [0.0, 0.5, 0.5]);
        assert_eq!(calibration.z, [0.5, 0.5, 1.0]);
        assert!(Calibration::of(&errors, &[None, None, None]).is_none());
    }
}
