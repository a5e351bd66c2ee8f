//! The best rigid or similarity transform between two sets of paired points (Umeyama 1991).

use nalgebra::{Matrix3, Rotation3, Vector3};

/// `target = scale * rotation * source + translation`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Similarity {
    pub scale: f64,
    pub rotation: Rotation3<f64>,
    pub translation_m: Vector3<f64>,
}

impl Similarity {
    /// The transform that changes nothing.
    pub fn identity() -> Self {
        Self { scale: 1.0, rotation: Rotation3::identity(), translation_m: Vector3::zeros() }
    }

    /// Least-squares fit of `target` by `source`, both N x 3 in metres, paired by position. `None` with fewer than three
    /// points, or where the points do not fix the rotation (all on one line).
    pub fn fit(source: &[Vector3<f64>], target: &[Vector3<f64>], with_scale: bool) -> Option<Self> {
        let count = source.len();
        if count < 3 || target.len() != count {
            return None;
        }
        let mean = |points: &[Vector3<f64>]| points.iter().sum::<Vector3<f64>>() / count as f64;
        let (source_mean, target_mean) = (mean(source), mean(target));
        let mut covariance = Matrix3::zeros();
        let mut source_variance = 0.0;
        for (s, t) in source.iter().zip(target) {
            covariance += (t - target_mean) * (s - source_mean).transpose();
            source_variance += (s - source_mean).norm_squared();
        }
        let svd = covariance.svd(true, true);
        let (u, v_t) = (svd.u?, svd.v_t?);
        let mut singular: Vec<(f64, usize)> = svd.singular_values.iter().copied().zip(0..).collect();
        singular.sort_by(|a, b| b.0.total_cmp(&a.0));
        if singular[1].0.partial_cmp(&(1e-9 * singular[0].0)) != Some(std::cmp::Ordering::Greater) {
            return None;
        }
        let mut signs = Vector3::repeat(1.0);
        if (u * v_t).determinant() < 0.0 {
            signs[singular[2].1] = -1.0;
        }
        let rotation = Rotation3::from_matrix_unchecked(u * Matrix3::from_diagonal(&signs) * v_t);
        let scale = if with_scale { svd.singular_values.dot(&signs) / source_variance } else { 1.0 };
        let translation_m = target_mean - scale * (rotation * source_mean);
        Some(Self { scale, rotation, translation_m })
    }

    /// The image of a point in metres.
    pub fn apply(&self, point_m: &Vector3<f64>) -> Vector3<f64> {
        self.scale * (self.rotation * point_m) + self.translation_m
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn points() -> Vec<Vector3<f64>> {
        (0..20)
            .map(|k| Vector3::new(f64::from(k % 5) * 3.0, f64::from(k / 5) * 7.0, f64::from(k * k % 7) * 0.3))
            .collect()
    }

    #[test]
    fn recovers_a_known_similarity() {
        let truth = Similarity {
            scale: 1.01,
            rotation: Rotation3::new(Vector3::new(0.1, -0.2, 2.9)),
            translation_m: Vector3::new(5.0, -80.0, 400.0),
        };
        let source = points();
        let target: Vec<_> = source.iter().map(|p| truth.apply(p)).collect();
        let fit = Similarity::fit(&source, &target, true).unwrap();
        assert!((fit.scale - truth.scale).abs() < 1e-12);
        for (s, t) in source.iter().zip(&target) {
            assert!((fit.apply(s) - t).norm() < 1e-9);
        }
        let rigid = Similarity::fit(&source, &target, false).unwrap();
        assert_eq!(rigid.scale, 1.0);
    }

    #[test]
    fn refuses_points_on_a_line() {
        let line: Vec<_> = (0..10).map(|k| Vector3::new(f64::from(k), 0.0, 0.0)).collect();
        assert!(Similarity::fit(&line, &line, true).is_none());
    }
}
