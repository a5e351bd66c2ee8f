//! What a detector finds in each photo: most of the modules, not quite where they are, and some that are none.

use super::Errors;
use super::noise::{normal_pair, poisson, signed, stream};
use super::plant::{ModuleGrid, PlantTruth};
use heliomap_mapping::detection::{Detection, ImageDetections, Source};
use heliomap_mapping::geometry::Quad;
use heliomap_mapping::reconstruction::Shot;
use nalgebra::Vector2;
use rand::{RngExt, rngs::StdRng, seq::SliceRandom};
use rayon::prelude::*;
use std::collections::HashSet;

/// A patch of one photo in which the sun blinds the camera: an upright ellipse, pixels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Glare {
    pub center_px: Vector2<f64>,
    pub radii_px: [f64; 2],
}

impl Glare {
    /// Whether a pixel lies in the patch.
    pub fn contains(&self, pixel: Vector2<f64>) -> bool {
        let d = pixel - self.center_px;
        (d.x / self.radii_px[0]).powi(2) + (d.y / self.radii_px[1]).powi(2) <= 1.0
    }
}

/// One photo as the detector saw it.
pub(super) struct View {
    pub(super) detections: ImageDetections,
    pub(super) owners: Vec<Option<usize>>,
    pub(super) glare: Vec<Glare>,
}

/// All photos. The same whatever the number of threads.
pub(super) fn observe(truth: &PlantTruth, grid: &ModuleGrid, shots: &[Shot], errors: &Errors, seed: u64) -> Vec<View> {
    let (low, high) = truth.bounds_m();
    shots
        .par_iter()
        .enumerate()
        .map(|(index, shot)| view(truth, grid, [low.z - 2.0, high.z + 2.0], shot, errors, &mut stream(seed, 3, index)))
        .collect()
}

/// Modules that lie wholly in the frame and show their face, with their true outlines.
pub(super) fn in_frame(
    truth: &PlantTruth,
    grid: &ModuleGrid,
    heights_m: [f64; 2],
    shot: &Shot,
    margin_px: f64,
) -> Vec<(usize, Quad)> {
    let camera = &shot.camera;
    let center = shot.pose.center();
    let (width, height) = (f64::from(camera.width_px), f64::from(camera.height_px));
    // What the frame can show: its four corners met with the lowest and the highest module.
    let mut low = Vector2::repeat(f64::INFINITY);
    let mut high = -low;
    for (u, v) in [(0.0, 0.0), (width, 0.0), (width, height), (0.0, height)] {
        let ray = shot.pose.direction_to_world(&camera.bearing(Vector2::new(u, v)));
        for z in heights_m {
            let reach = if ray.z < -0.05 { (z - center.z) / ray.z } else { 20.0 * (center.z - z).abs() };
            let place = (center + ray * reach).xy();
            low = low.inf(&place);
            high = high.sup(&place);
        }
    }
    let mut modules: Vec<usize> = grid.within(low, high).collect();
    modules.sort_unstable();
    let inside = |p: &Vector2<f64>| {
        p.x >= margin_px - 0.5
            && p.y >= margin_px - 0.5
            && p.x <= width - 0.5 - margin_px
            && p.y <= height - 0.5 - margin_px
    };
    modules
        .into_iter()
        .filter_map(|index| {
            let module = &truth.modules[index];
            if module.half_along_m.cross(&module.half_up_m).dot(&(center - module.center_enu_m)) <= 0.0 {
                return None;
            }
            let mut corners = [Vector2::zeros(); 4];
            for (pixel, corner) in corners.iter_mut().zip(module.corners_enu_m()) {
                *pixel = camera.project(&shot.pose.to_camera(&corner)).filter(inside)?;
            }
            Some((index, Quad { corners }))
        })
        .collect()
}

fn view(
    truth: &PlantTruth,
    grid: &ModuleGrid,
    heights_m: [f64; 2],
    shot: &Shot,
    errors: &Errors,
    rng: &mut StdRng,
) -> View {
    let visible = in_frame(truth, grid, heights_m, shot, errors.frame_margin_px);
    let glare = glare_of(&visible, errors, rng);
    let dropped = beside_gaps(truth, &visible, errors, rng);
    let mut found: Vec<(Detection, Option<usize>)> = Vec::with_capacity(visible.len() + 4);
    for (module, outline) in &visible {
        // Drawn for every module, so that one error does not change what is drawn for the others.
        let kept = rng.random_bool(errors.detection_rate);
        let jittered = jitter(outline, errors, rng);
        let score = rng.random_range(0.75..1.0);
        let source = if rng.random_bool(0.85) { Source::Unet } else { Source::Yolo };
        let blinded = glare.iter().any(|patch| patch.contains(outline.center()));
        if kept
            && !blinded
            && !dropped.contains(module)
            && let Some(quad) = Quad::from_unordered(jittered.corners)
        {
            found.push((Detection { quad, score, source }, Some(*module)));
        }
    }
    for quad in false_quads(shot, &visible, errors, rng) {
        found.push((Detection { quad, score: rng.random_range(0.5..0.95), source: Source::Yolo }, None));
    }
    found.shuffle(rng);
    let (detections, owners) = found.into_iter().unzip();
    let (image, width_px, height_px) = (shot.name.clone(), shot.camera.width_px, shot.camera.height_px);
    View { detections: ImageDetections { image, width_px, height_px, detections }, owners, glare }
}

/// Patches of glare on modules of the view.
fn glare_of(visible: &[(usize, Quad)], errors: &Errors, rng: &mut StdRng) -> Vec<Glare> {
    let count = poisson(rng, errors.glare_per_image);
    if visible.is_empty() {
        return Vec::new();
    }
    (0..count)
        .map(|_| {
            let quad = &visible[rng.random_range(0..visible.len())].1;
            let module_px = quad.area_px2().sqrt();
            let [low, high] = errors.glare_radius_modules;
            let radii_px = [0, 1].map(|_| module_px * rng.random_range(low..=high));
            Glare { center_px: quad.center(), radii_px }
        })
        .collect()
}

/// Modules missed because they stand at a gap: so many that, together with the common misses, the stated share of the
/// gaps keeps both neighbours.
fn beside_gaps(truth: &PlantTruth, visible: &[(usize, Quad)], errors: &Errors, rng: &mut StdRng) -> HashSet<usize> {
    let spoilt = (1.0 - errors.gap_detection_rate / errors.detection_rate.powi(2)).clamp(0.0, 1.0);
    let mut dropped = HashSet::new();
    for (index, _) in visible {
        let module = &truth.modules[*index];
        let bench = &truth.benches[module.bench as usize];
        if module.col > 0 || bench.index == 0 {
            continue;
        }
        let before = &truth.benches[module.bench as usize - 1];
        if let Some(neighbour) = before.module(module.row, before.columns - 1) {
            let (spoil, which) = (rng.random_bool(spoilt), rng.random::<bool>());
            if spoil {
                dropped.insert(if which { *index } else { neighbour });
            }
        }
    }
    dropped
}

fn jitter(outline: &Quad, errors: &Errors, rng: &mut StdRng) -> Quad {
    let center = outline.center();
    let [u, v] = outline.sides();
    let (along, up) = normal_pair(rng);
    let (along, up) = (along * errors.size_jitter / 2.0, up * errors.size_jitter / 2.0);
    let shift = Vector2::from(<[f64; 2]>::from(normal_pair(rng))) * errors.center_jitter_px;
    let mut corners = outline.corners;
    for corner in &mut corners {
        let d = *corner - center;
        let noise = Vector2::from(<[f64; 2]>::from(normal_pair(rng))) * errors.corner_jitter_px;
        *corner += u * (along * d.dot(&u).signum()) + v * (up * d.dot(&v).signum()) + shift + noise;
    }
    Quad { corners }
}

/// Boxes about as large as a module where none is, inside the frame, overlapping nothing.
fn false_quads(shot: &Shot, visible: &[(usize, Quad)], errors: &Errors, rng: &mut StdRng) -> Vec<Quad> {
    let count = poisson(rng, errors.false_per_image);
    let Some((_, like)) = visible.get(visible.len() / 2) else { return Vec::new() };
    let [u, v] = like.sides();
    let (width, height) = (f64::from(shot.camera.width_px), f64::from(shot.camera.height_px));
    let mut quads: Vec<Quad> = Vec::new();
    for _ in 0..count {
        // A photo full of modules may have no room: then there is one less.
        for _ in 0..20 {
            let (sin, cos) = (std::f64::consts::PI * signed(rng)).sin_cos();
            let turn = |d: Vector2<f64>| Vector2::new(cos * d.x - sin * d.y, sin * d.x + cos * d.y);
            let (half_u, half_v) = (turn(u) * rng.random_range(0.35..0.65), turn(v) * rng.random_range(0.35..0.65));
            let center = Vector2::new(rng.random_range(0.0..width), rng.random_range(0.0..height));
            let quad = Quad::from_center(center, half_u, half_v);
            let in_frame = quad.corners.iter().all(|c| c.x >= 0.0 && c.y >= 0.0 && c.x < width && c.y < height);
            let reach = 1.5 * (u.norm() + v.norm());
            let clear = |other: &Quad| (other.center() - center).norm() > reach || quad.overlap_px2(other) <= 0.0;
            if in_frame && visible.iter().all(|(_, other)| clear(other)) && quads.iter().all(clear) {
                quads.extend(Quad::from_unordered(quad.corners));
                break;
            }
        }
    }
    quads
}
