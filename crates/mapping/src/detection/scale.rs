//! How far apart the pixels of a photo are on the ground, where no reconstruction tells: by what the drone wrote into the
//! file, else by looking at the modules at several scales.

use super::{DetectionError, Detector};
use crate::geometry::Quad;
use crate::reconstruction::{exif, xmp};
use image::RgbImage;
use nalgebra::Vector2;
use std::path::Path;

/// The short side of a module, metres: framed ones have 0.99 to 1.13, thin-film ones 0.6.
const SHORT_SIDE_M: f64 = 1.05;
/// Ground sampling distances that are tried, metres per pixel.
const TRIED_M: [f64; 3] = [0.011, 0.02, 0.045];
/// The most pixels of the middle of a photo that are tried.
const MOST_PX2: f64 = 4e6;
/// Heights above the ground that a drone may tell, metres.
const HEIGHTS_M: std::ops::RangeInclusive<f64> = 3.0..=500.0;

/// Ground sampling distance in metres per pixel of a photo of `width` x `height` pixels that was taken straight down, by the
/// height above the take-off point (XMP, as DJI writes it) and the focal length (EXIF) in its file; `None` where the file
/// does not tell both.
pub fn from_metadata(path: &Path, width: u32, height: u32) -> Option<f64> {
    let height_m = xmp::number(path, "drone-dji:RelativeAltitude")?;
    let focal_px = exif::film_focal_px(path, width, height)?;
    HEIGHTS_M.contains(&height_m).then(|| height_m / focal_px)
}

/// Ground sampling distance in metres per pixel by the look of the photo: the detector searches its middle as if it had been
/// taken from several heights, and the one at which it finds the largest area of modules in benches tells how many pixels a
/// module has. `None` where it finds next to none.
///
/// # Errors
/// As [`Detector::detect`].
pub fn by_look(detector: &dyn Detector, photo: &RgbImage) -> Result<Option<f64>, DetectionError> {
    let share = (MOST_PX2 / (f64::from(photo.width()) * f64::from(photo.height()))).sqrt().min(1.0);
    let [width, height] = [photo.width(), photo.height()].map(|length| (f64::from(length) * share) as u32);
    let (left, top) = ((photo.width() - width) / 2, (photo.height() - height) / 2);
    let middle = image::imageops::crop_imm(photo, left, top, width, height).to_image();
    let mut best: Option<(f64, f64)> = None;
    for gsd_m in TRIED_M {
        let quads: Vec<Quad> = detector.detect(&middle, Some(gsd_m))?.into_iter().map(|d| d.quad).collect();
        let mut sides: Vec<f64> = in_benches(&quads).iter().map(|quad| quad.extent_px().0).collect();
        if sides.len() < 4 {
            continue;
        }
        let area: f64 = quads.iter().map(Quad::area_px2).sum();
        sides.sort_unstable_by(f64::total_cmp);
        let side_px = sides[sides.len() / 2];
        if best.is_none_or(|(most, _)| area > most) {
            best = Some((area, SHORT_SIDE_M / side_px));
        }
    }
    Ok(best.map(|(_, gsd_m)| gsd_m))
}

/// The boxes that have another one of their size beside them.
fn in_benches(quads: &[Quad]) -> Vec<Quad> {
    let is_beside = |a: &Quad, b: &Quad| {
        let [u, v] = a.sides();
        let apart = b.center() - a.center();
        let ratio = b.area_px2() / a.area_px2();
        let near = |place: Vector2<f64>| (apart - place).norm() < 0.25 * a.extent_px().0;
        (0.7..1.4).contains(&ratio) && [u, -u, v, -v].into_iter().any(|step| near(step * 1.02))
    };
    quads.iter().filter(|a| quads.iter().any(|b| is_beside(a, b))).copied().collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::detection::{Detection, Source};

    /// Sees modules of `side_px` pixels where they have 20 to 30 pixels at the scale that it is told.
    struct Picky {
        side_px: f64,
    }

    impl Detector for Picky {
        fn detect(&self, _: &RgbImage, gsd_m: Option<f64>) -> Result<Vec<Detection>, DetectionError> {
            let gsd_m = gsd_m.unwrap();
            let scale = if gsd_m < 0.025 { gsd_m / 0.04 } else { 1.0 };
            if !(20.0..30.0).contains(&(self.side_px * scale)) {
                return Ok(Vec::new());
            }
            let (u, v) = (Vector2::new(self.side_px, 0.0), Vector2::new(0.0, self.side_px * 1.6));
            let quad = |k: usize| Quad::from_center(u * (1.02 * k as f64) + v, u / 2.0, v / 2.0);
            Ok((0..6).map(|k| Detection { quad: quad(k), score: 1.0, source: Source::Unet }).collect())
        }

        fn describe(&self) -> String {
            "picky".to_owned()
        }
    }

    #[test]
    fn the_scale_at_which_modules_are_seen_is_found() {
        let photo = RgbImage::new(64, 64);
        for (side_px, gsd_m) in [(25.0, 0.042), (52.0, 0.0202), (95.0, 0.01105)] {
            let found = by_look(&Picky { side_px }, &photo).unwrap().unwrap();
            assert!((found - gsd_m).abs() < 0.001, "{side_px} px: {found}");
        }
        assert_eq!(by_look(&Picky { side_px: 400.0 }, &photo).unwrap(), None);
    }
}
