//! Pictures of a mapping for people: detections, rows, gaps, hypotheses and identifiers on the photos, and the plant from
//! above (the paper's optional intermediate outputs).

use font8x8::{BASIC_FONTS, UnicodeFonts};
use heliomap_mapping::detection::{Detection, Source};
use heliomap_mapping::geometry::Quad;
use heliomap_mapping::layout::Layout;
use heliomap_mapping::pipeline::Mapping;
use heliomap_mapping::reconstruction::PhotoError;
use heliomap_model::PlantModel;
use image::{Rgb, RgbImage};
use imageproc::drawing::{draw_filled_rect_mut, draw_line_segment_mut, draw_polygon_mut};
use imageproc::point::Point;
use imageproc::rect::Rect;
use nalgebra::Vector2;
use std::collections::HashMap;
use std::path::{Path, PathBuf};

/// Photos are drawn on at this width or their own, whichever is more, so that numbers can be read.
const LEAST_WIDTH_PX: u32 = 2400;
/// Width of the view from above.
const PLAN_WIDTH_PX: f64 = 3000.0;

/// Why a picture could not be made.
#[derive(Debug, thiserror::Error)]
pub enum OverlayError {
    #[error("{} cannot be made: {source}", path.display())]
    Folder { path: PathBuf, source: std::io::Error },
    #[error(transparent)]
    Photo(#[from] PhotoError),
    #[error("{} cannot be written: {source}", path.display())]
    Write { path: PathBuf, source: image::ImageError },
}

/// Draws every searched image and the plant from above into `folder` (made if it is not there): `NAME.png` for each
/// image, and `plant.png`.
pub fn draw(mapping: &Mapping, folder: &Path) -> Result<(), OverlayError> {
    std::fs::create_dir_all(folder).map_err(|source| OverlayError::Folder { path: folder.to_owned(), source })?;
    let labels = labels(mapping);
    for (view, photo) in mapping.photos.iter().enumerate() {
        let picture = draw_view(mapping, view, &photo.load()?, &labels);
        let stem = Path::new(&photo.shot).file_stem().unwrap_or_default().to_string_lossy().into_owned();
        write(&picture, &folder.join(format!("{stem}.png")))?;
    }
    write(&plan(&mapping.model), &folder.join("plant.png"))
}

/// Draws boxes over a photo, for people who tune flights and models: the U-Net's green, YOLO's magenta, others blue, each
/// with a dot in its middle; and, where a truth is known, missed modules red and false boxes orange.
pub fn draw_boxes(photo: &RgbImage, detections: &[Detection], missed: &[Quad], wrong: &[Quad]) -> RgbImage {
    let scale = LEAST_WIDTH_PX.div_ceil(photo.width().max(1)).clamp(1, 8);
    let mut canvas = image::imageops::resize(
        photo,
        photo.width() * scale,
        photo.height() * scale,
        image::imageops::FilterType::Triangle,
    );
    let at = |p: Vector2<f64>| (p + Vector2::repeat(0.5)) * f64::from(scale) - Vector2::repeat(0.5);
    for detection in detections {
        let color = match detection.source {
            Source::Unet => GREEN,
            Source::Yolo => MAGENTA,
            Source::External => color(0),
        };
        outline(&mut canvas, &detection.quad.map(at), color, 1);
        let center = at(detection.quad.center());
        line(&mut canvas, center - Vector2::new(1.0, 0.0), center + Vector2::new(1.0, 0.0), color, 2);
    }
    for (quads, color) in [(missed, RED), (wrong, ORANGE)] {
        for quad in quads {
            outline(&mut canvas, &quad.map(at), color, 3);
        }
    }
    canvas
}

/// Writes a picture, into a folder that is made where it is missing.
///
/// # Errors
/// A folder or a file that cannot be made.
pub fn write_into(folder: &Path, name: &str, picture: &RgbImage) -> Result<(), OverlayError> {
    std::fs::create_dir_all(folder).map_err(|source| OverlayError::Folder { path: folder.to_owned(), source })?;
    write(picture, &folder.join(name))
}

fn write(picture: &RgbImage, path: &Path) -> Result<(), OverlayError> {
    picture.save(path).map_err(|source| OverlayError::Write { path: path.to_owned(), source })
}

/// What each detection became: bench label, row and number.
struct Place {
    bench: usize,
    label: String,
    row: u32,
    number: u32,
}

fn labels(mapping: &Mapping) -> HashMap<(usize, usize), Place> {
    let mut places = HashMap::new();
    // Benches of the model stand in the order of the fused ones.
    for (index, (bench, fused)) in mapping.model.benches.iter().zip(&mapping.fused.benches).enumerate() {
        for module in &fused.modules {
            for o in &module.observations {
                let place = Place {
                    bench: index,
                    label: bench.label.clone(),
                    row: module.row as u32 + 1,
                    number: module.col as u32 + 1,
                };
                places.insert((o.view, o.detection), place);
            }
        }
    }
    places
}

fn draw_view(mapping: &Mapping, view: usize, photo: &RgbImage, labels: &HashMap<(usize, usize), Place>) -> RgbImage {
    let scale = LEAST_WIDTH_PX.div_ceil(photo.width()).max(1);
    let mut canvas = image::imageops::resize(
        photo,
        photo.width() * scale,
        photo.height() * scale,
        image::imageops::FilterType::Triangle,
    );
    let (layout, detections) = (&mapping.layouts[view], &mapping.detections[view]);
    let at = |p: Vector2<f64>| (p + Vector2::repeat(0.5)) * f64::from(scale) - Vector2::repeat(0.5);
    for &loose in &layout.loose {
        outline(&mut canvas, &detections.detections[loose].quad.map(at), RED, 2);
    }
    for piece in &layout.pieces {
        for row in 0..piece.rows {
            let centers: Vec<Vector2<f64>> =
                piece.cells.iter().filter(|c| c.row == row).map(|c| at(c.quad.center())).collect();
            for pair in centers.windows(2) {
                line(&mut canvas, pair[0], pair[1], GREY, 1);
            }
        }
        let mut named = false;
        for cell in &piece.cells {
            let quad = cell.quad.map(at);
            let Some(detection) = cell.detection else {
                outline(&mut canvas, &quad, WHITE, 1);
                line(&mut canvas, quad.corners[0], quad.corners[2], WHITE, 1);
                line(&mut canvas, quad.corners[1], quad.corners[3], WHITE, 1);
                continue;
            };
            match labels.get(&(view, detection)) {
                Some(place) => {
                    outline(&mut canvas, &quad, color(place.bench), 2);
                    let (short, _) = quad.extent_px();
                    if short > 26.0 {
                        text(&mut canvas, quad.center(), &place.number.to_string(), 1, None);
                    }
                    if !named && cell.col > 0 {
                        named = true;
                        let name = format!("{} R{}", place.label, place.row);
                        text(
                            &mut canvas,
                            quad.corners[0] + Vector2::new(40.0, -12.0),
                            &name,
                            2,
                            Some(color(place.bench)),
                        );
                    }
                }
                None => outline(&mut canvas, &quad, ORANGE, 2),
            }
        }
    }
    gaps(&mut canvas, layout, at);
    let legend = format!(
        "{}: {} detections, {} pieces, {} gaps | colour: bench, crossed white: hypothesis, magenta: gap, red: loose, orange: \
         left out",
        layout.image,
        detections.detections.len(),
        layout.pieces.len(),
        layout.gaps.len()
    );
    let middle = Vector2::new(legend.len() as f64 * 8.0 + 10.0, 14.0);
    text(&mut canvas, middle, &legend, 2, Some(Rgb([0, 0, 0])));
    canvas
}

fn gaps(canvas: &mut RgbImage, layout: &Layout, at: impl Fn(Vector2<f64>) -> Vector2<f64>) {
    for gap in &layout.gaps {
        let (center, reach) = (at(gap.center_px), 9.0);
        for direction in [Vector2::new(reach, reach), Vector2::new(reach, -reach)] {
            line(canvas, center - direction, center + direction, MAGENTA, 3);
        }
    }
}

/// The plant from above: north up, a grid of 10 m, modules filled by bench, bench labels.
fn plan(model: &PlantModel) -> RgbImage {
    let corners = || model.modules.iter().flat_map(|m| m.corners_enu_m.iter());
    let (mut low, mut high) = (Vector2::repeat(f64::INFINITY), Vector2::repeat(f64::NEG_INFINITY));
    for corner in corners() {
        low = low.inf(&corner.xy());
        high = high.sup(&corner.xy());
    }
    low -= Vector2::repeat(5.0);
    high += Vector2::repeat(5.0);
    let extent = high - low;
    let scale = PLAN_WIDTH_PX / extent.x.max(extent.y);
    let size = [extent.x, extent.y].map(|e| (e * scale).ceil().max(1.0) as u32);
    let mut canvas = RgbImage::from_pixel(size[0], size[1], Rgb([250, 250, 247]));
    let at = |p: Vector2<f64>| Vector2::new((p.x - low.x) * scale, (high.y - p.y) * scale);
    for axis in 0..2 {
        let mut metre = (low[axis] / 10.0).ceil() * 10.0;
        while metre < high[axis] {
            let (mut from, mut to) = (low, high);
            from[axis] = metre;
            to[axis] = metre;
            line(&mut canvas, at(from), at(to), Rgb([225, 225, 220]), 1);
            metre += 10.0;
        }
    }
    let bench_index: HashMap<_, _> = model.benches.iter().enumerate().map(|(index, b)| (b.id, index)).collect();
    let mut middles: Vec<(Vector2<f64>, f64)> = vec![(Vector2::zeros(), 0.0); model.benches.len()];
    for module in &model.modules {
        let index = bench_index[&module.bench];
        middles[index] = (middles[index].0 + module.center_enu_m.xy(), middles[index].1 + 1.0);
        let polygon: Vec<Point<i32>> = module
            .corners_enu_m
            .iter()
            // A little smaller than it is, so that neighbours can be told apart.
            .map(|c| at(module.center_enu_m.xy() + (c - module.center_enu_m).xy() * 0.9))
            .map(|p| Point::new(p.x.round() as i32, p.y.round() as i32))
            .collect();
        if polygon[0] != polygon[3] && polygon.len() == 4 {
            draw_polygon_mut(&mut canvas, &polygon, color(index));
        }
    }
    for (bench, (sum, count)) in model.benches.iter().zip(middles) {
        text(&mut canvas, at(sum / count), &bench.label, 2, Some(Rgb([0, 0, 0])));
    }
    let legend = format!(
        "{} modules, {} benches, {} lines; grid 10 m, north up",
        model.modules.len(),
        model.benches.len(),
        model.lines.len()
    );
    text(&mut canvas, Vector2::new(legend.len() as f64 * 8.0 + 10.0, 14.0), &legend, 2, Some(Rgb([0, 0, 0])));
    canvas
}

const GREEN: Rgb<u8> = Rgb([60, 255, 60]);
const RED: Rgb<u8> = Rgb([230, 30, 30]);
const ORANGE: Rgb<u8> = Rgb([255, 150, 0]);
const WHITE: Rgb<u8> = Rgb([255, 255, 255]);
const GREY: Rgb<u8> = Rgb([200, 200, 200]);
const MAGENTA: Rgb<u8> = Rgb([255, 0, 200]);

/// Colours that neighbouring benches do not share.
fn color(bench: usize) -> Rgb<u8> {
    const COLORS: [[u8; 3]; 8] = [
        [66, 190, 255],
        [120, 220, 80],
        [255, 210, 60],
        [170, 120, 255],
        [60, 220, 190],
        [255, 140, 100],
        [150, 200, 255],
        [210, 230, 120],
    ];
    Rgb(COLORS[bench * 5 % COLORS.len()])
}

fn outline(canvas: &mut RgbImage, quad: &Quad, color: Rgb<u8>, width: i32) {
    for k in 0..4 {
        line(canvas, quad.corners[k], quad.corners[(k + 1) % 4], color, width);
    }
}

fn line(canvas: &mut RgbImage, from: Vector2<f64>, to: Vector2<f64>, color: Rgb<u8>, width: i32) {
    for step in 0..width {
        let offset = step as f32 - (width - 1) as f32 / 2.0;
        let flat = (to - from).x.abs() > (to - from).y.abs();
        let (dx, dy) = if flat { (0.0, offset) } else { (offset, 0.0) };
        let shifted = |p: Vector2<f64>| (p.x as f32 + dx, p.y as f32 + dy);
        draw_line_segment_mut(canvas, shifted(from), shifted(to), color);
    }
}

/// Text centred on a point, on a plate if one is given: white on dark plates, black on bright ones.
fn text(canvas: &mut RgbImage, center: Vector2<f64>, words: &str, scale: u32, plate: Option<Rgb<u8>>) {
    let (width, height) = (words.chars().count() as u32 * 8 * scale, 8 * scale);
    let left = center.x as i64 - i64::from(width / 2);
    let top = center.y as i64 - i64::from(height / 2);
    if let Some(plate) = plate {
        let rect = Rect::at(left as i32 - 2, top as i32 - 2).of_size(width + 4, height + 4);
        draw_filled_rect_mut(canvas, rect, plate);
    }
    let dark_ink = plate.is_some_and(|p| p.0.iter().map(|c| u32::from(*c)).sum::<u32>() > 380);
    let ink = if dark_ink { Rgb([0, 0, 0]) } else { WHITE };
    for (position, character) in words.chars().enumerate() {
        let Some(glyph) = BASIC_FONTS.get(character) else { continue };
        for (y, bits) in glyph.iter().enumerate() {
            for x in (0..8).filter(|x| bits & (1 << x) != 0) {
                for dy in 0..scale {
                    for dx in 0..scale {
                        let px = left + i64::from((position as u32 * 8 + x) * scale + dx);
                        let py = top + i64::from(y as u32 * scale + dy);
                        if px >= 0 && py >= 0 && px < i64::from(canvas.width()) && py < i64::from(canvas.height()) {
                            canvas.put_pixel(px as u32, py as u32, ink);
                        }
                    }
                }
            }
        }
    }
}
