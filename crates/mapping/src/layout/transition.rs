//! What lies between two neighbouring modules: image patches and their histograms (paper, 3.3 and Fig. 8).

use super::LayoutParams;
use crate::geometry::Quad;
use image::GrayImage;
use nalgebra::Vector2;

const BINS: usize = 32;

/// Grey values (0 to 1) on a strip between the facing edges of two neighbouring modules.
fn strip(grey: &GrayImage, west: &Quad, east: &Quad) -> Vec<f64> {
    let (from, to) = (west.center(), east.center());
    let along = to - from;
    // Half the depth of each module along the connecting line, from its own sides.
    let half = |quad: &Quad| {
        let direction = along.normalize();
        let [u, v] = quad.sides();
        u.dot(&direction).abs().max(v.dot(&direction).abs()) / 2.0
    };
    let across = {
        let [u, v] = west.sides();
        if u.dot(&along).abs() / u.norm() > v.dot(&along).abs() / v.norm() { v } else { u }
    };
    let start = half(west) / along.norm();
    let end = 1.0 - half(east) / along.norm();
    let middle = (start + end) / 2.0;
    let reach = ((end - start) / 2.0).max(0.5 / along.norm());
    let mut values = Vec::with_capacity(5 * 15);
    for i in 0..5 {
        let t = middle + reach * (f64::from(i) / 2.0 - 1.0) * 0.8;
        for j in 0..15 {
            let s = (f64::from(j) / 14.0 - 0.5) * 0.8;
            if let Some(value) = sample(grey, from + along * t + across * s) {
                values.push(value);
            }
        }
    }
    values
}

/// Bilinear sample, 0 to 1; `None` outside the image.
fn sample(grey: &GrayImage, at: Vector2<f64>) -> Option<f64> {
    let (x, y) = (at.x.floor(), at.y.floor());
    if x < 0.0 || y < 0.0 || x + 1.0 >= f64::from(grey.width()) || y + 1.0 >= f64::from(grey.height()) {
        return None;
    }
    let (fx, fy) = (at.x - x, at.y - y);
    let pixel = |dx: u32, dy: u32| f64::from(grey.get_pixel(x as u32 + dx, y as u32 + dy).0[0]) / 255.0;
    let top = pixel(0, 0) * (1.0 - fx) + pixel(1, 0) * fx;
    let bottom = pixel(0, 1) * (1.0 - fx) + pixel(1, 1) * fx;
    Some(top * (1.0 - fy) + bottom * fy)
}

fn histogram(values: &[f64]) -> [f64; BINS] {
    let mut bins = [0.0; BINS];
    for value in values {
        bins[((value * BINS as f64) as usize).min(BINS - 1)] += 1.0 / values.len() as f64;
    }
    bins
}

/// Share that two histograms have in common, 0 to 1, with neighbouring bins blurred into each other.
fn similarity(a: &[f64; BINS], b: &[f64; BINS]) -> f64 {
    let blur = |h: &[f64; BINS]| -> Vec<f64> {
        (0..BINS)
            .map(|k| {
                let next = |i: usize| h.get(i).copied().unwrap_or(0.0);
                0.5 * h[k] + 0.25 * next(k + 1) + 0.25 * if k > 0 { h[k - 1] } else { 0.0 }
            })
            .collect()
    };
    blur(a).iter().zip(blur(b)).map(|(x, y)| x.min(y)).sum()
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// How much darker the ground between the pairs `here` is than between the pairs `usual`, 0 to 1 grey; negative where it
/// is brighter. `None` where nothing can be sampled.
pub(super) fn darkness(grey: &GrayImage, here: &[(Quad, Quad)], usual: &[(Quad, Quad)]) -> Option<f64> {
    let values = |pairs: &[(Quad, Quad)]| -> Vec<f64> {
        pairs.iter().flat_map(|(west, east)| strip(grey, west, east)).collect()
    };
    let (here, usual) = (values(here), values(usual));
    (!here.is_empty() && !usual.is_empty()).then(|| mean(&usual) - mean(&here))
}

/// Whether what lies between the pairs `here` is ground rather than the seam that lies between the pairs `usual`: a
/// significantly darker patch, or one of quite another histogram.
pub(super) fn is_gap(grey: &GrayImage, here: &[(Quad, Quad)], usual: &[(Quad, Quad)], params: &LayoutParams) -> bool {
    let values = |pairs: &[(Quad, Quad)]| -> Vec<f64> {
        pairs.iter().flat_map(|(west, east)| strip(grey, west, east)).collect()
    };
    let (here_values, usual_values) = (values(here), values(usual));
    if here_values.is_empty() || usual_values.is_empty() {
        return false;
    }
    let alike = similarity(&histogram(&here_values), &histogram(&usual_values));
    let darker = mean(&usual_values) - mean(&here_values);
    (darker > params.ground_darker && alike < params.ground_alike) || alike < params.ground_unlike
}

/// Whether the places look like the examples of modules, or are washed out by glare.
pub(super) fn looks_like_modules(grey: &GrayImage, places: &[Quad], examples: &[Quad], params: &LayoutParams) -> bool {
    let inside = |quad: &Quad| -> Vec<f64> {
        let (center, [u, v]) = (quad.center(), quad.sides());
        let mut values = Vec::with_capacity(81);
        for i in -4..=4 {
            for j in -4..=4 {
                if let Some(value) = sample(grey, center + u * (f64::from(i) * 0.1) + v * (f64::from(j) * 0.1)) {
                    values.push(value);
                }
            }
        }
        values
    };
    let known: Vec<f64> = examples.iter().flat_map(inside).collect();
    if known.is_empty() {
        return false;
    }
    let reference = histogram(&known);
    places.iter().all(|place| {
        let values = inside(place);
        if values.is_empty() {
            return true;
        }
        let glare = values.iter().filter(|value| **value > params.glare).count() * 3 > values.len();
        glare || similarity(&histogram(&values), &reference) > params.module_alike
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::Luma;

    fn module(x: f64) -> Quad {
        Quad::from_center(Vector2::new(x, 40.0), Vector2::new(12.0, 0.0), Vector2::new(0.0, 20.0))
    }

    /// Modules of grey 90 with seams of grey 200; between x = 100 and 104 dark ground.
    fn picture() -> GrayImage {
        GrayImage::from_fn(220, 80, |x, _| match x {
            100..=104 => Luma([30]),
            _ if (x + 2) % 26 < 4 => Luma([200]),
            _ => Luma([90]),
        })
    }

    #[test]
    fn dark_ground_is_told_from_bright_seams() {
        let grey = picture();
        let usual = [(module(11.5), module(37.5)), (module(37.5), module(63.5))];
        let gap = [(module(89.0), module(116.0))];
        assert!(is_gap(&grey, &gap, &usual, &LayoutParams::default()));
        assert!(!is_gap(&grey, &usual[..1], &usual[1..], &LayoutParams::default()));
        assert!(darkness(&grey, &gap, &usual).unwrap() > 0.2);
    }

    #[test]
    fn glare_and_modules_pass_for_modules_and_ground_does_not() {
        let mut grey = GrayImage::from_pixel(200, 80, Luma([90]));
        for (x, _, pixel) in grey.enumerate_pixels_mut() {
            if x > 80 {
                *pixel = Luma([if x > 140 { 255 } else { 160 }]);
            }
        }
        let examples = [module(20.0), module(50.0)];
        assert!(looks_like_modules(&grey, &[module(64.0)], &examples, &LayoutParams::default()));
        assert!(looks_like_modules(&grey, &[module(170.0)], &examples, &LayoutParams::default()));
        assert!(!looks_like_modules(&grey, &[module(110.0)], &examples, &LayoutParams::default()));
    }
}
