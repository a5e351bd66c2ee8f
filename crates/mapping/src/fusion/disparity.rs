//! How the positions of two views disagree.

use super::FusionParams;
use nalgebra::Vector2;
use std::collections::BTreeMap;

/// What one pair of pieces says: position by the second view less position by the first, at a place. Metres.
#[derive(Debug, Clone, Copy)]
pub(super) struct Disparity {
    pub pair: usize,
    pub views: (usize, usize),
    pub at_m: Vector2<f64>,
    pub value_m: Vector2<f64>,
}

/// One displacement for each view, and nearby pairs of the same two views.
pub(super) struct DisparityField {
    offset_m: Vec<Vector2<f64>>,
    sigma_m: f64,
    least_sigma_m: f64,
    alike_m: f64,
    /// What is left for each pair of views.
    local: BTreeMap<(usize, usize), Vec<Residual>>,
}

/// What the displacements of the views leave of one disparity, metres.
struct Residual {
    pair: usize,
    at_m: Vector2<f64>,
    rest_m: Vector2<f64>,
}

impl DisparityField {
    pub(super) fn unknown(views: usize, prior_m: f64, params: &FusionParams) -> Self {
        Self {
            offset_m: vec![Vector2::zeros(); views],
            sigma_m: prior_m,
            least_sigma_m: params.view_least_sigma_m,
            alike_m: params.view_alike_m,
            local: BTreeMap::new(),
        }
    }

    /// Fits the displacement of each view (Gauss-Seidel on the normal equations, with a weak pull to nought), robustly.
    pub(super) fn fit(views: usize, known: &[Disparity], prior_m: f64, params: &FusionParams) -> Self {
        let mut field = Self::unknown(views, prior_m, params);
        if known.is_empty() {
            return field;
        }
        let mut of_view: Vec<Vec<usize>> = vec![Vec::new(); views];
        for (k, disparity) in known.iter().enumerate() {
            of_view[disparity.views.0].push(k);
            of_view[disparity.views.1].push(k);
        }
        for _ in 0..30 {
            for (view, members) in of_view.iter().enumerate() {
                let (mut sum, mut weight) = (Vector2::zeros(), 0.5);
                for &k in members {
                    let Disparity { views: (a, b), value_m, .. } = known[k];
                    let target = if b == view { field.offset_m[a] + value_m } else { field.offset_m[b] - value_m };
                    let robust = 1.0 / (1.0 + ((target - field.offset_m[view]).norm() / prior_m).powi(2));
                    sum += target * robust;
                    weight += robust;
                }
                field.offset_m[view] = sum / weight;
            }
        }
        let mut residuals: Vec<f64> = Vec::with_capacity(known.len());
        for disparity in known {
            let (a, b) = disparity.views;
            let rest = disparity.value_m - (field.offset_m[b] - field.offset_m[a]);
            residuals.push(rest.norm());
            field.local.entry((a, b)).or_default().push(Residual {
                pair: disparity.pair,
                at_m: disparity.at_m,
                rest_m: rest,
            });
        }
        residuals.sort_by(f64::total_cmp);
        // Median of a Rayleigh distribution is 1.18 sigma.
        let spread = residuals[residuals.len() / 2] / 1.18;
        let trust = known.len() as f64 / (known.len() as f64 + 6.0);
        field.sigma_m = (spread * trust + prior_m * (1.0 - trust)).clamp(field.least_sigma_m.min(prior_m), prior_m);
        field
    }

    /// Expected disparity at a place by all but one pair, and its standard deviation, metres.
    pub(super) fn expected(&self, pair: usize, views: (usize, usize), at_m: Vector2<f64>) -> (Vector2<f64>, f64) {
        let base = self.offset_m[views.1] - self.offset_m[views.0];
        let Some(near) = self.local.get(&views) else { return (base, self.sigma_m) };
        let prior = 1.0;
        let (mut sum, mut weight) = (Vector2::zeros(), prior);
        for residual in near.iter().filter(|residual| residual.pair != pair) {
            let w = 4.0 * (-(residual.at_m - at_m).norm_squared() / (2.0 * self.alike_m * self.alike_m)).exp();
            sum += residual.rest_m * w;
            weight += w;
        }
        let knowledge = (weight - prior) / weight;
        (base + sum / weight, self.sigma_m * (1.0 - 0.5 * knowledge))
    }
}
