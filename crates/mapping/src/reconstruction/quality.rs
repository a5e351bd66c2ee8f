//! How good a photo is as a picture: whether it is sharp and well exposed. Measured on the picture alone, at one scale
//! whatever the camera, in a time that its number of pixels bounds.

use image::GrayImage;
use serde::{Deserialize, Serialize};

/// The longer side at which pictures are measured, pixels: larger ones are averaged down to it.
pub const MEASURED_PX: u32 = 2048;
/// Smallest side that tells how sharp a picture is, pixels.
const MIN_SIDE_PX: u32 = 64;
/// Energy of 8-bit rounding, which is no detail, grey levels squared.
const ROUNDING: f64 = 0.05;

// Checked against all 449 photos that we have, some of them blurred a little on purpose: fine detail is 0.078 at least and
// coarse detail 0.141. Blurred by a Gaussian of 2 px or more, fine detail is below 0.055 or coarse below 0.1.
/// Less fine detail than this is blur.
const BLURRED_FINE: f64 = 0.06;
/// Less coarse detail than this is strong blur, under which rounding passes for fine detail.
const BLURRED_COARSE: f64 = 0.1;
/// Grey levels that count as black and as white.
const BLACK: u8 = 4;
const WHITE: u8 = 251;
/// More black than this is too dark: five times the most in a good photo.
const DARK_SHARE: f64 = 0.25;
/// More white than this is too bright: five times the most in a good photo.
const BRIGHT_SHARE: f64 = 0.17;

/// What was measured on a picture.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Quality {
    /// Energy of second differences over that at a quarter of the scale, in the direction that has least: about 0.5 and
    /// more where the picture is sharp. None where it is too small to tell.
    pub fine: Option<f64>,
    /// The same at half the scale.
    pub coarse: Option<f64>,
    /// Share of pixels that are black.
    pub dark_share: f64,
    /// Share of pixels that are white.
    pub bright_share: f64,
}

/// What is wrong with a picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Flaw {
    Blurred,
    Underexposed,
    Overexposed,
}

impl Quality {
    /// Measures a picture that is at most [`MEASURED_PX`] long. H x W, 8-bit grey.
    pub fn measure(picture: &GrayImage) -> Self {
        let pixels = picture.as_raw();
        let share = |count: usize| count as f64 / pixels.len().max(1) as f64;
        let detail = (picture.width().min(picture.height()) >= MIN_SIDE_PX).then(|| detail(picture));
        Self {
            fine: detail.map(|[fine, _]| fine),
            coarse: detail.map(|[_, coarse]| coarse),
            dark_share: share(pixels.iter().filter(|grey| **grey <= BLACK).count()),
            bright_share: share(pixels.iter().filter(|grey| **grey >= WHITE).count()),
        }
    }

    /// What is wrong with the picture.
    pub fn flaws(&self) -> Vec<Flaw> {
        let blurred = self.fine.is_some_and(|fine| fine < BLURRED_FINE)
            || self.coarse.is_some_and(|coarse| coarse < BLURRED_COARSE);
        [
            (blurred, Flaw::Blurred),
            (self.dark_share > DARK_SHARE, Flaw::Underexposed),
            (self.bright_share > BRIGHT_SHARE, Flaw::Overexposed),
        ]
        .into_iter()
        .filter_map(|(is_so, flaw)| is_so.then_some(flaw))
        .collect()
    }
}

/// Energy of second differences at a scale over that at a quarter of it, least of all directions; at the whole scale and at
/// half of it. A ratio, so that it is the same for every contrast; natural pictures have about as much at every scale, and
/// blur takes the finest first.
fn detail(picture: &GrayImage) -> [f64; 2] {
    let mut level = Level {
        width: picture.width() as usize,
        height: picture.height() as usize,
        grey: picture.as_raw().iter().map(|grey| f32::from(*grey)).collect(),
    };
    let mut energies = [[0.0; 4]; 4];
    for (index, energy) in energies.iter_mut().enumerate() {
        if index > 0 {
            level = level.halved();
        }
        *energy = level.energy();
    }
    [0, 1].map(|from| {
        let ratio = |direction: usize| energies[from][direction] / energies[from + 2][direction];
        (0..4).map(ratio).fold(f64::INFINITY, f64::min)
    })
}

/// The picture at some scale.
struct Level {
    width: usize,
    height: usize,
    /// Row by row.
    grey: Vec<f32>,
}

impl Level {
    /// At half the scale: means of 2 x 2 pixels.
    fn halved(&self) -> Self {
        let (width, height) = (self.width / 2, self.height / 2);
        let mut grey = Vec::with_capacity(width * height);
        for v in 0..height {
            let top = &self.grey[2 * v * self.width..][..self.width];
            let bottom = &self.grey[(2 * v + 1) * self.width..][..self.width];
            let pairs = top.chunks_exact(2).zip(bottom.chunks_exact(2));
            grey.extend(pairs.map(|(a, b)| (a[0] + a[1] + b[0] + b[1]) / 4.0));
        }
        Self { width, height, grey }
    }

    /// Mean squared second differences along rows, columns and both diagonals, no less than what rounding makes.
    fn energy(&self) -> [f64; 4] {
        let w = self.width;
        let mut sums = [0.0_f64; 4];
        for v in 1..self.height - 1 {
            let mut row = [0.0_f32; 4];
            for u in 1..w - 1 {
                let at = v * w + u;
                let twice = 2.0 * self.grey[at];
                for (sum, step) in row.iter_mut().zip([1, w, w + 1, w - 1]) {
                    let second = self.grey[at - step] - twice + self.grey[at + step];
                    *sum += second * second;
                }
            }
            for (sum, row) in sums.iter_mut().zip(row) {
                *sum += f64::from(row);
            }
        }
        let count = ((self.height - 2) * (w - 2)) as f64;
        sums.map(|sum| sum / count + ROUNDING)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::Luma;

    /// Benches of modules in a field, sharp, in a contrast of choice.
    fn picture(contrast: f32) -> GrayImage {
        GrayImage::from_fn(400, 300, |x, y| {
            let bench = (y / 30) % 2 == 0 && x % 13 > 1 && y % 15 > 1;
            let weed = (x.wrapping_mul(2_654_435_761) ^ y.wrapping_mul(40_503)).wrapping_mul(2_246_822_519) >> 24;
            let grey = if bench { 40.0 } else { 120.0 + 0.3 * weed as f32 };
            Luma([(100.0 + contrast * (grey - 100.0)) as u8])
        })
    }

    fn flaws(picture: &GrayImage) -> Vec<Flaw> {
        Quality::measure(picture).flaws()
    }

    #[test]
    fn blur_is_told_from_low_contrast() {
        assert_eq!(flaws(&picture(1.0)), []);
        assert_eq!(flaws(&picture(0.3)), []);
        for sigma in [2.0, 4.0, 8.0] {
            let blurred = image::imageops::blur(&picture(1.0), sigma);
            assert_eq!(flaws(&blurred), [Flaw::Blurred], "{sigma}: {:?}", Quality::measure(&blurred));
        }
    }

    #[test]
    fn clipped_pictures_are_told() {
        let shifted = |by: i32| {
            let mut picture = picture(1.0);
            picture.pixels_mut().for_each(|p| p.0[0] = (i32::from(p.0[0]) + by).clamp(0, 255) as u8);
            picture
        };
        assert_eq!(flaws(&shifted(-60)), [Flaw::Underexposed]);
        assert_eq!(flaws(&shifted(140)), [Flaw::Overexposed]);
        let black = Quality::measure(&GrayImage::new(200, 200));
        assert_eq!((black.flaws(), black.dark_share), (vec![Flaw::Underexposed], 1.0));
        let tiny = Quality::measure(&GrayImage::from_pixel(8, 8, Luma([99])));
        assert_eq!((tiny.fine, tiny.flaws()), (None, vec![]));
    }
}
