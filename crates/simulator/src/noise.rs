//! Random draws that the simulator needs besides uniform ones.

use nalgebra::Vector3;
use rand::{RngExt, SeedableRng, rngs::StdRng};

/// A generator of its own for part `index` of `purpose`, so that parts can be drawn in any order and on any thread.
pub(super) fn stream(seed: u64, purpose: u64, index: usize) -> StdRng {
    // SplitMix64's finaliser, once per ingredient: streams of neighbouring indices have nothing in common.
    let mut state = seed;
    for ingredient in [purpose, index as u64] {
        state = state.wrapping_add(ingredient.wrapping_add(1).wrapping_mul(0x9E37_79B9_7F4A_7C15));
        state = (state ^ (state >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        state = (state ^ (state >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        state ^= state >> 31;
    }
    StdRng::seed_from_u64(state)
}

/// A draw from the normal distribution with mean 0 and standard deviation 1 (Box and Muller 1958).
pub(super) fn normal(rng: &mut StdRng) -> f64 {
    normal_pair(rng).0
}

/// Two independent normal draws.
pub(super) fn normal_pair(rng: &mut StdRng) -> (f64, f64) {
    let radius = (-2.0 * (1.0 - rng.random::<f64>()).ln()).sqrt();
    let (sin, cos) = (std::f64::consts::TAU * rng.random::<f64>()).sin_cos();
    (radius * cos, radius * sin)
}

/// A draw from the uniform distribution on [-1, 1].
pub(super) fn signed(rng: &mut StdRng) -> f64 {
    rng.random_range(-1.0..=1.0)
}

/// A horizontal vector from the uniform distribution on the disc of the given radius.
pub(super) fn horizontal(rng: &mut StdRng, radius: f64) -> Vector3<f64> {
    let (sin, cos) = (std::f64::consts::PI * signed(rng)).sin_cos();
    Vector3::new(cos, sin, 0.0) * (radius * rng.random::<f64>().sqrt())
}

/// A draw from the Poisson distribution (Knuth's product method; for small means).
pub(super) fn poisson(rng: &mut StdRng, mean: f64) -> usize {
    let limit = (-mean).exp();
    let mut product = rng.random::<f64>();
    let mut count = 0;
    while product > limit {
        product *= rng.random::<f64>();
        count += 1;
    }
    count
}
