//! How a network sees a whole photo: at a scale that it likes, in tiles of bounded size.

use super::DetectionError;
use super::runtime::ImageModel;
use fast_image_resize as fir;
use image::RgbImage;
use std::ops::{Range, RangeInclusive};

/// The network's input has a size that is a multiple of this many pixels.
pub(super) const STRIDE: usize = 32;
/// The most pixels of a tile. It bounds the memory of each session, to about 0.1 kB per pixel.
const TILE_PX2: usize = 1 << 20;
/// What a tile has beyond the part that is kept, at every seam: there the network sees too little around it.
const MARGIN: usize = 48;
/// Range of factors by which an image is ever scaled.
const SCALES: RangeInclusive<f64> = 1.0 / 16.0..=4.0;

/// Ground sampling distances that a network likes, and the one that it likes best, metres per pixel, where it tells.
#[derive(Debug, Clone, Default)]
pub(super) struct WorkingRange(Option<(RangeInclusive<f64>, f64)>);

impl WorkingRange {
    /// As the metadata `heliomap.gsd_range_m` (`least,most`) and `heliomap.gsd_m` of a model have it.
    pub fn of_model(model: &ImageModel) -> Result<Self, DetectionError> {
        let range = match model.ours("gsd_range_m") {
            Some(text) => {
                let wrong =
                    || model.unfit(format!("its metadata `heliomap.gsd_range_m` is `{text}`; `least,most` is needed"));
                let (least, most) = text.split_once(',').ok_or_else(wrong)?;
                let (least, most) = (model.number("gsd_range_m", least)?, model.number("gsd_range_m", most)?);
                if least > most {
                    return Err(wrong());
                }
                Some(least..=most)
            }
            None => None,
        };
        let best = model.ours("gsd_m").map(|text| model.number("gsd_m", text)).transpose()?;
        Ok(Self(match (range, best) {
            (Some(range), best) => {
                let best =
                    best.unwrap_or_else(|| (range.start() * range.end()).sqrt()).clamp(*range.start(), *range.end());
                Some((range, best))
            }
            (None, Some(best)) => Some((best / 1.6..=best * 1.6, best)),
            (None, None) => None,
        }))
    }

    /// The factor by which an image of the given ground sampling distance (metres per pixel) is scaled for the network: 1
    /// where it is unknown or within the range that the network likes, else what brings it to the distance it likes best.
    pub fn scale(&self, image_gsd_m: Option<f64>) -> f64 {
        match (&self.0, image_gsd_m) {
            (Some((range, best)), Some(gsd_m)) if gsd_m.is_finite() && gsd_m > 0.0 && !range.contains(&gsd_m) => {
                (gsd_m / best).clamp(*SCALES.start(), *SCALES.end())
            }
            _ => 1.0,
        }
    }
}

/// The image scaled by a factor, averaged where it shrinks and bicubic where it grows; `None` where nothing changes.
pub(super) fn resample(image: &RgbImage, scale: f64) -> Result<Option<RgbImage>, DetectionError> {
    let size = |pixels: u32| ((f64::from(pixels) * scale).round() as u32).max(1);
    let (width, height) = (size(image.width()), size(image.height()));
    if (width, height) == image.dimensions() {
        return Ok(None);
    }
    let kernel = if scale < 1.0 { fir::FilterType::Hamming } else { fir::FilterType::CatmullRom };
    let options = fir::ResizeOptions::new().resize_alg(fir::ResizeAlg::Convolution(kernel));
    let mut target = RgbImage::new(width, height);
    fir::Resizer::new()
        .resize(image, &mut target, Some(&options))
        .map_err(|error| DetectionError::Inference { what: error.to_string() })?;
    Ok(Some(target))
}

/// A part of the image that the network sees at once.
#[derive(Debug, Clone)]
pub(super) struct Tile {
    pub columns: Stretch,
    pub rows: Stretch,
}

/// The rows or the columns of a tile.
#[derive(Debug, Clone)]
pub(super) struct Stretch {
    /// First pixel.
    pub start: usize,
    /// Pixels that the network sees; may reach beyond the image.
    pub size: usize,
    /// Pixels of the image that are kept.
    pub kept: Range<usize>,
}

/// Cuts an image into tiles of one size, bounded by [`TILE_PX2`] or `fixed` (height and width), so that the network has the
/// least to do. The kept parts join without gap, each at least a margin from its tile's seams. Depends on nothing but the
/// sizes, so that the result is the same whatever runs it.
pub(super) fn tiles(width: usize, height: usize, fixed: [Option<u32>; 2]) -> Vec<Tile> {
    let [fixed_height, fixed_width] = fixed.map(|size| size.map(|size| size as usize));
    let choices = |length: usize, fixed: Option<usize>| -> Vec<(usize, usize)> {
        if let Some(size) = fixed {
            let margin = MARGIN.min(size / 8);
            let count = if length <= size { 1 } else { (length - 2 * margin).div_ceil(size - 2 * margin) };
            return vec![(count, size)];
        }
        let size = |count: usize| (length + (count - 1) * 2 * MARGIN).div_ceil(count).next_multiple_of(STRIDE);
        // More tiles than this would be narrower than their margins are worth.
        (1..=length.div_ceil(4 * MARGIN)).map(|count| (count, size(count))).collect()
    };
    let (columns, rows) = (choices(width, fixed_width), choices(height, fixed_height));
    let pairs = columns.iter().flat_map(|column| rows.iter().map(move |row| (*column, *row)));
    let (column, row) = pairs
        .min_by_key(|((columns, width), (rows, height))| {
            let is_large = fixed_width.is_none() && width * height > TILE_PX2;
            (is_large, columns * width * rows * height)
        })
        .expect("there is at least one choice");
    let columns = stretches(width, column);
    stretches(height, row)
        .into_iter()
        .flat_map(|rows| columns.iter().map(move |columns| Tile { columns: columns.clone(), rows: rows.clone() }))
        .collect()
}

/// `count` stretches of `size` pixels, evenly spread over `length` pixels, the first at the start and the last at the end.
fn stretches(length: usize, (count, size): (usize, usize)) -> Vec<Stretch> {
    if count == 1 {
        return vec![Stretch { start: 0, size, kept: 0..length }];
    }
    let start = |index: usize| (length - size) * index / (count - 1);
    let seam = |index: usize| (start(index) + start(index - 1) + size) / 2;
    (0..count)
        .map(|index| {
            let from = if index == 0 { 0 } else { seam(index) };
            let to = if index + 1 == count { length } else { seam(index + 1) };
            Stretch { start: start(index), size, kept: from..to }
        })
        .collect()
}

/// What a tile shows beyond the image's edge.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Beyond {
    /// The image, mirrored.
    Mirrored,
    /// The grey with which the YOLO family pads.
    Grey,
}

const GREY: f32 = 114.0 / 255.0;

/// A tile of the image as the network takes it: planes of red, green and blue, 0 to 1.
pub(super) fn fill(pixels: &mut Vec<f32>, image: &RgbImage, tile: &Tile, beyond: Beyond) {
    let (width, height) = (image.width() as usize, image.height() as usize);
    let (columns, rows) = (&tile.columns, &tile.rows);
    let plane = rows.size * columns.size;
    pixels.resize(3 * plane, 0.0);
    let places: Vec<usize> = (0..columns.size).map(|x| 3 * mirrored(columns.start + x, width)).collect();
    let (red, rest) = pixels.split_at_mut(plane);
    let (green, blue) = rest.split_at_mut(plane);
    for y in 0..rows.size {
        let line = &image.as_raw()[3 * width * mirrored(rows.start + y, height)..][..3 * width];
        let row = y * columns.size..(y + 1) * columns.size;
        let (red, green, blue) = (&mut red[row.clone()], &mut green[row.clone()], &mut blue[row]);
        for (x, &at) in places.iter().enumerate() {
            red[x] = f32::from(line[at]) / 255.0;
            green[x] = f32::from(line[at + 1]) / 255.0;
            blue[x] = f32::from(line[at + 2]) / 255.0;
        }
        if beyond == Beyond::Grey {
            let inside =
                if rows.start + y < height { width.saturating_sub(columns.start).min(columns.size) } else { 0 };
            for plane in [red, green, blue] {
                plane[inside..].fill(GREY);
            }
        }
    }
}

/// The pixel that is seen at `index` where an image of `length` pixels is mirrored at the centres of its last pixels.
fn mirrored(index: usize, length: usize) -> usize {
    let period = (2 * length - 2).max(1);
    let within = index % period;
    within.min(period - within)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tiles_keep_every_pixel_once_away_from_seams() {
        let free = [None; 2];
        for (width, height, fixed) in [
            (1, 1, free),
            (31, 900, free),
            (1368, 912, free),
            (2736, 1824, free),
            (1_000_000, 7, free),
            (12_000, 8000, free),
            (97, 50, [Some(64), Some(96)]),
            (5000, 641, [Some(640), Some(640)]),
        ] {
            let tiles = tiles(width, height, fixed);
            let mut kept = 0;
            for tile in &tiles {
                kept += tile.columns.kept.len() * tile.rows.kept.len();
                if fixed == free {
                    assert!(tile.columns.size % STRIDE == 0 && tile.rows.size % STRIDE == 0);
                    assert!(tile.columns.size * tile.rows.size <= TILE_PX2);
                }
                for (stretch, length) in [(&tile.columns, width), (&tile.rows, height)] {
                    let margin = if fixed == free { MARGIN } else { 8 };
                    let end = stretch.start + stretch.size;
                    assert!(
                        stretch.start == 0 && stretch.kept.start == 0 || stretch.kept.start >= stretch.start + margin
                    );
                    assert!(end >= length && stretch.kept.end == length || stretch.kept.end + margin <= end);
                    assert!(stretch.start == 0 || end <= length);
                }
            }
            assert_eq!(kept, width * height);
            let mut starts: Vec<_> = tiles.iter().map(|tile| (tile.rows.kept.start, tile.columns.kept.start)).collect();
            starts.dedup();
            assert_eq!(starts.len(), tiles.len());
        }
        // Half a photo at a time, with little to see twice.
        let seen: usize = tiles(1368, 912, free).iter().map(|tile| tile.columns.size * tile.rows.size).sum();
        assert!((seen as f64) < 1.1 * 1368.0 * 912.0);
    }

    #[test]
    fn beyond_the_edge_the_image_is_mirrored() {
        let seen: Vec<usize> = (0..9).map(|index| mirrored(index, 4)).collect();
        assert_eq!(seen, [0, 1, 2, 3, 2, 1, 0, 1, 2]);
        assert_eq!(mirrored(7, 1), 0);
    }
}
