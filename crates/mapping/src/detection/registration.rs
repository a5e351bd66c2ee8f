//! Modules of one lattice look alike: where each stands against its neighbours is measured on the photo itself.
//!
//! A network sees the edge of a module that faces another one differently from the edge that faces the ground, so that rows
//! come out too far apart, or too close, by up to half a pixel, and the same in every photo: no later step can tell. The
//! glass of neighbours is the same picture twice, and the shift between the two is known to a few hundredths of a pixel.
//! Along the row the network's errors have no such direction, and its centres stay.

use super::DetectionError;
use super::lattice::{self, median};
use super::mask_to_boxes::{ModuleBox, middle};
use super::tiles::resample;
use image::RgbImage;
use nalgebra::{Matrix2, Vector2};
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Part of a module that is compared, about its centre: frames and seams are left out.
const GLASS: f64 = 0.84;
/// Length of the shorter edge, pixels, down to which a photo is shrunk: finer lines than a centre's error lead astray.
const SHORT_EDGE_PX: f64 = 24.0;
/// Fewest samples along an edge that show a texture.
const LEAST_SAMPLES: usize = 8;
/// Light and colour that change over more than this part of a module are no texture.
const COARSE: f64 = 0.1;
/// Rounds of Gauss-Newton for one shift, and the step in modules at which it ends.
const ROUNDS: usize = 8;
const STILL: f64 = 1e-4;
/// A larger shift, in pixels, is no error of a centre but another part of the cell grid.
const LARGEST_PX: f64 = 1.2;
/// Least correlation of two modules whose shift is believed.
const LIKENESS: f64 = 0.4;
/// Fewest pairs of modules that tell the distance of two rows, and their largest median deviation in pixels.
const LEAST_PAIRS: usize = 6;
const SPREAD_PX: f64 = 0.3;

/// Moves rows of modules so that neighbours across them stand alike on what they show. Boxes and their order are
/// kept; sizes are as they were.
///
/// # Errors
/// A photo that cannot be shrunk.
pub(super) fn register(boxes: &mut [ModuleBox], image: &RgbImage) -> Result<(), DetectionError> {
    let usual = middle(boxes.iter().map(|b| b.u.norm().min(b.v.norm())));
    let shrink = (usual / SHORT_EDGE_PX).floor().max(1.0);
    let small = resample(image, 1.0 / shrink)?;
    let image = small.as_ref().unwrap_or(image);
    let scaled: Vec<ModuleBox> = boxes.iter().map(|b| b.scaled(Vector2::repeat(1.0 / shrink))).collect();
    for (b, moved) in boxes.iter_mut().zip(moves(&scaled, image)) {
        b.center += moved * shrink;
    }
    Ok(())
}

/// How far the centre of each box is to move, pixels: each row as a whole, so that the rows of a lattice stand as far apart
/// as their modules look alike, about the place where they were.
fn moves(boxes: &[ModuleBox], image: &RgbImage) -> Vec<Vector2<f64>> {
    let mut moved = vec![Vector2::zeros(); boxes.len()];
    for cells in lattice::grouped(boxes) {
        let mut rows: BTreeMap<i32, BTreeMap<i32, usize>> = BTreeMap::new();
        for ((column, row), index) in cells {
            rows.entry(row).or_default().insert(column, index);
        }
        let mut offsets = vec![Vector2::zeros()];
        for (upper, lower) in rows.values().zip(rows.values().skip(1)) {
            let pairs: Vec<(usize, usize)> =
                upper.iter().filter_map(|(column, &from)| Some((from, *lower.get(column)?))).collect();
            let last = offsets[offsets.len() - 1];
            offsets.push(last + apart(boxes, &pairs, image));
        }
        let count: usize = rows.values().map(BTreeMap::len).sum();
        let mean = rows.values().zip(&offsets).map(|(row, offset)| offset * row.len() as f64).sum::<Vector2<f64>>();
        for (row, offset) in rows.values().zip(&offsets) {
            for &index in row.values() {
                moved[index] = offset - mean / count as f64;
            }
        }
    }
    moved
}

/// By how much two rows must stand further apart, pixels: the median of their pairs of modules; nothing where too few tell, or
/// too differently.
fn apart(boxes: &[ModuleBox], pairs: &[(usize, usize)], image: &RgbImage) -> Vector2<f64> {
    let step: Vector2<f64> = pairs.iter().map(|&(from, to)| boxes[to].center - boxes[from].center).sum();
    let Some(across) = step.try_normalize(1e-9) else { return Vector2::zeros() };
    let mut shifts: Vec<f64> =
        pairs.par_iter().filter_map(|pair| Some(shift(boxes, *pair, image)?.dot(&across))).collect();
    if shifts.len() < LEAST_PAIRS {
        return Vector2::zeros();
    }
    let usual = median(&mut shifts);
    let mut deviations: Vec<f64> = shifts.iter().map(|shift| (shift - usual).abs()).collect();
    if median(&mut deviations) > SPREAD_PX { Vector2::zeros() } else { across * usual }
}

/// How much further from one box another must stand, pixels, so that both stand alike on their modules: by Gauss-Newton on the
/// difference of their pictures; `None` where these are not alike.
fn shift(boxes: &[ModuleBox], (from, to): (usize, usize), image: &RgbImage) -> Option<Vector2<f64>> {
    let (a, b) = (boxes[from], boxes[to]);
    let edges = |u: Vector2<f64>, v: Vector2<f64>| Matrix2::from_columns(&[u, v]);
    let px_from_a = edges(a.u, a.v);
    let px_from_b = edges(b.u * a.u.dot(&b.u).signum(), b.v * a.v.dot(&b.v).signum());
    let columns = (GLASS * a.u.norm()) as usize;
    let rows = (GLASS * a.v.norm()) as usize;
    if columns < LEAST_SAMPLES || rows < LEAST_SAMPLES {
        return None;
    }
    let grid = PatchGrid { columns, rows };
    let model = grid.sample(image, a.center, &px_from_a, Vector2::zeros())?;
    let energy: f64 = model.inner().map(|at| model.value(at).powi(2)).sum();
    let mut shift = Vector2::zeros();
    for _ in 0..ROUNDS {
        let seen = grid.sample(image, b.center, &px_from_b, shift)?;
        let (mut common, mut own) = (0.0, 0.0);
        for at in seen.inner() {
            common += model.value(at) * seen.value(at);
            own += seen.value(at).powi(2);
        }
        if energy <= 0.0 || own <= 0.0 {
            return None;
        }
        let gain = common / energy;
        let (mut normal, mut right) = (Matrix2::zeros(), Vector2::zeros());
        for at in seen.inner() {
            let slope = seen.slope(at);
            let difference = seen.value(at) - gain * model.value(at);
            normal += slope * slope.transpose();
            right -= slope * difference;
        }
        let step = normal.try_inverse()? * right;
        shift += step;
        if (px_from_b * shift).norm() > LARGEST_PX {
            return None;
        }
        if step.amax() < STILL {
            let likeness = common / (energy * own).sqrt();
            if likeness < LIKENESS {
                return None;
            }
            return Some(px_from_b * shift);
        }
    }
    None
}

/// Where a module's picture is sampled, about once per pixel.
struct PatchGrid {
    columns: usize,
    rows: usize,
}

/// A module's texture: its grey values, less what changes slowly.
struct Patch {
    columns: usize,
    rows: usize,
    values: Vec<f64>,
    /// Samples at each border whose surroundings are not all known.
    border: (usize, usize),
}

impl PatchGrid {
    /// The texture of the module at `center`, moved by `shift` modules; `None` where the image ends before.
    fn sample(
        &self,
        image: &RgbImage,
        center: Vector2<f64>,
        px_from_module: &Matrix2<f64>,
        shift: Vector2<f64>,
    ) -> Option<Patch> {
        let place = |index: usize, count: usize| GLASS * ((index as f64 + 0.5) / count as f64 - 0.5);
        let mut values = Vec::with_capacity(self.columns * self.rows);
        for row in 0..self.rows {
            for column in 0..self.columns {
                let at = Vector2::new(place(column, self.columns), place(row, self.rows)) + shift;
                values.push(grey(image, center + px_from_module * at)?);
            }
        }
        let border = (self.border(self.columns), self.border(self.rows));
        let means = blurred(&blurred(&values, self.columns, border.0, 1), self.columns, border.1, self.columns);
        for (value, mean) in values.iter_mut().zip(means) {
            *value -= mean;
        }
        Some(Patch { columns: self.columns, rows: self.rows, values, border })
    }

    /// Half the width of the window over which light may not change.
    fn border(&self, count: usize) -> usize {
        ((COARSE / GLASS * count as f64).round() as usize).max(2)
    }
}

impl Patch {
    /// Indices of the samples whose neighbours are all there.
    fn inner(&self) -> impl Iterator<Item = usize> + use<> {
        let (columns, across, down) = (self.columns, self.border.0, self.border.1);
        let rows = down..self.rows - down;
        rows.flat_map(move |row| (across..columns - across).map(move |column| row * columns + column))
    }

    fn value(&self, at: usize) -> f64 {
        self.values[at]
    }

    /// Change of the value per module along both edges.
    fn slope(&self, at: usize) -> Vector2<f64> {
        let along = self.values[at + 1] - self.values[at - 1];
        let across = self.values[at + self.columns] - self.values[at - self.columns];
        Vector2::new(along * self.columns as f64, across * self.rows as f64) / (2.0 * GLASS)
    }
}

/// Means over `2 reach + 1` samples along one axis (samples `stride` apart), fewer at the ends.
pub(super) fn blurred(values: &[f64], columns: usize, reach: usize, stride: usize) -> Vec<f64> {
    let (lines, length) =
        if stride == 1 { (values.len() / columns, columns) } else { (columns, values.len() / columns) };
    let mut out = vec![0.0; values.len()];
    for line in 0..lines {
        let index = |k: usize| if stride == 1 { line * columns + k } else { k * stride + line };
        for k in 0..length {
            let (from, to) = (k.saturating_sub(reach), (k + reach + 1).min(length));
            out[index(k)] = (from..to).map(|other| values[index(other)]).sum::<f64>() / (to - from) as f64;
        }
    }
    out
}

/// Grey value at a place of the image, bilinear; `None` outside.
pub(super) fn grey(image: &RgbImage, at: Vector2<f64>) -> Option<f64> {
    let (width, height) = image.dimensions();
    if !(at.x >= 0.0 && at.y >= 0.0 && at.x < f64::from(width) - 1.0 && at.y < f64::from(height) - 1.0) {
        return None;
    }
    let (x, y) = (at.x as u32, at.y as u32);
    let (right, down) = (at.x - f64::from(x), at.y - f64::from(y));
    let value = |x: u32, y: u32| image.get_pixel(x, y).0.iter().map(|c| f64::from(*c)).sum::<f64>() / 3.0;
    let upper = value(x, y) * (1.0 - right) + value(x + 1, y) * right;
    let lower = value(x, y + 1) * (1.0 - right) + value(x + 1, y + 1) * right;
    Some(upper * (1.0 - down) + lower * down)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::detection::Source;

    const ROWS: usize = 2;
    const COLUMNS: usize = 9;

    fn modules() -> Vec<ModuleBox> {
        let (along, across) = (Vector2::new(31.3, 2.1), Vector2::new(-3.4, 50.7));
        (0..ROWS * COLUMNS)
            .map(|k| ModuleBox {
                center: Vector2::new(40.0, 50.0) + along * (k % COLUMNS) as f64 + across * (k / COLUMNS) as f64,
                u: across * 0.97,
                v: along * 0.97,
                score: 0.9,
                source: Source::Unet,
            })
            .collect()
    }

    /// A photo of modules with cells, on a ground; each pixel is the mean of 25 points.
    fn photo(modules: &[ModuleBox], contrast: f64) -> RgbImage {
        let frames: Vec<_> =
            modules.iter().map(|b| (b.center, Matrix2::from_columns(&[b.u, b.v]).try_inverse().unwrap())).collect();
        let shade = |at: Vector2<f64>| {
            let inside = frames.iter().map(|(center, inverse)| inverse * (at - center)).find(|p| p.amax() < 0.5);
            inside.map_or(120.0, |p| {
                let is_line = ((p.x + 0.5) * 10.0).fract() < 0.15 || ((p.y + 0.5) * 6.0).fract() < 0.15;
                60.0 + if is_line { contrast } else { 0.0 }
            })
        };
        RgbImage::from_fn(340, 150, |x, y| {
            let fine = |k: u32| f64::from(k) / 5.0 - 0.4;
            let points = (0..25).map(|k| Vector2::new(f64::from(x) + fine(k % 5), f64::from(y) + fine(k / 5)));
            let value = points.map(shade).sum::<f64>() / 25.0;
            image::Rgb([value.round() as u8; 3])
        })
    }

    /// Rows pushed apart, as a network does it.
    fn pushed(modules: &[ModuleBox]) -> Vec<ModuleBox> {
        let push = |k: usize| modules[k].u.normalize() * if k < COLUMNS { -0.4 } else { 0.4 };
        modules.iter().enumerate().map(|(k, b)| ModuleBox { center: b.center + push(k), ..*b }).collect()
    }

    #[test]
    fn rows_come_to_their_true_distance() {
        let truth = modules();
        let mut boxes = pushed(&truth);
        register(&mut boxes, &photo(&truth, 90.0)).unwrap();
        for (b, t) in boxes.iter().zip(&truth) {
            assert!((b.center - t.center).norm() < 0.12, "{} px off", (b.center - t.center).norm());
            assert_eq!((b.u, b.v), (t.u, t.v));
        }
    }

    #[test]
    fn glass_without_texture_tells_nothing() {
        let truth = modules();
        let mut boxes = pushed(&truth);
        let before = boxes.clone();
        register(&mut boxes, &photo(&truth, 0.0)).unwrap();
        assert_eq!(boxes, before);
        register(&mut [], &photo(&truth, 0.0)).unwrap();
    }
}
