//! What structure from motion makes of the flight: a world a little turned, scaled and bent, poses that disagree a
//! little with each other, and a noisy cloud with holes.

use super::Errors;
use super::flight::pose_at;
use super::noise::{horizontal, normal, normal_pair, signed, stream};
use super::observe::View;
use super::plant::{ModuleGrid, PlantTruth, TruthModule};
use heliomap_mapping::geometry::{PointCloud, Similarity};
use heliomap_mapping::reconstruction::{Reconstruction, Shot};
use nalgebra::{Rotation3, Vector2, Vector3};
use rand::{RngExt, rngs::StdRng};
use rayon::prelude::*;

/// The true world -> the world of the reconstruction: a similarity about the middle of the plant and a smooth drift.
pub(super) struct Warp {
    similarity: Similarity,
    drift_m: f64,
    /// Wave number and phase of each coordinate's two waves.
    waves: [[(Vector2<f64>, f64); 2]; 3],
}

impl Warp {
    fn new(truth: &PlantTruth, errors: &Errors, rng: &mut StdRng) -> Self {
        let (low, high) = truth.bounds_m();
        let middle = (low + high) / 2.0;
        let scale = 1.0 + signed(rng) * errors.scale_error;
        let rotation = Rotation3::new(Vector3::new(
            signed(rng) * errors.levelling_error_rad,
            signed(rng) * errors.levelling_error_rad,
            signed(rng) * errors.heading_error_rad,
        ));
        let shift = Vector3::new(signed(rng), signed(rng), signed(rng)) * errors.shift_m;
        let similarity = Similarity { scale, rotation, translation_m: middle + shift - scale * (rotation * middle) };
        let mut wave = || {
            let (sin, cos) = (std::f64::consts::PI * signed(rng)).sin_cos();
            let number = std::f64::consts::TAU / (errors.drift_wavelength_m * rng.random_range(1.0..1.5));
            (Vector2::new(cos, sin) * number, std::f64::consts::PI * signed(rng))
        };
        let waves = [[wave(), wave()], [wave(), wave()], [wave(), wave()]];
        Self { similarity, drift_m: errors.drift_m, waves }
    }

    /// Drift at a place, and how it changes towards east and north.
    fn drift(&self, place_m: Vector2<f64>) -> (Vector3<f64>, [Vector3<f64>; 2]) {
        let mut value = Vector3::zeros();
        let mut slope = [Vector3::zeros(); 2];
        for (k, waves) in self.waves.iter().enumerate() {
            for (number, phase) in waves {
                let (sin, cos) = (number.dot(&place_m) + phase).sin_cos();
                value[k] += self.drift_m / 2.0 * sin;
                slope[0][k] += self.drift_m / 2.0 * cos * number.x;
                slope[1][k] += self.drift_m / 2.0 * cos * number.y;
            }
        }
        (value, slope)
    }

    /// Where the reconstruction would have a point of the plant if all its views agreed.
    pub(super) fn apply(&self, point_m: &Vector3<f64>) -> Vector3<f64> {
        self.similarity.apply(&(point_m + self.drift(point_m.xy()).0))
    }

    /// The pose that a camera at a height above its target has in the warped world: it moves and turns with the ground
    /// that it looks at.
    fn shot(&self, shot: &Shot, ground_z_m: f64) -> Shot {
        let center = shot.pose.center();
        let target = target_of(shot, ground_z_m);
        let (drift, [east, north]) = self.drift(target.xy());
        let turn = Rotation3::new(Vector3::new(north.z, -east.z, (east.y - north.x) / 2.0));
        let moved = target + drift + turn * (center - target);
        let camera_from_world = shot.pose.camera_from_world * turn.inverse() * self.similarity.rotation.inverse();
        Shot {
            pose: pose_at(camera_from_world, self.similarity.apply(&moved)),
            gnss_enu_m: shot.gnss_enu_m,
            name: shot.name.clone(),
            camera: shot.camera,
        }
    }
}

/// The point at a height that the optical axis meets.
fn target_of(shot: &Shot, ground_z_m: f64) -> Vector3<f64> {
    let center = shot.pose.center();
    let axis = shot.pose.direction_to_world(&Vector3::z());
    center + axis * ((ground_z_m - center.z) / axis.z)
}

/// A small error of its own for one view, such that it moves what the view shows by at most the given distance.
fn disturbed(shot: &Shot, ground_z_m: f64, largest_m: f64, rng: &mut StdRng) -> Shot {
    let center = shot.pose.center();
    let target = target_of(shot, ground_z_m);
    let distance_m = (center - target).norm();
    let half_diagonal_m =
        f64::from(shot.camera.width_px).hypot(f64::from(shot.camera.height_px)) / 2.0 / shot.camera.focal_px()
            * distance_m;
    // Shares of the allowance: the view shifted, turned in its plane, tilted about its target, nearer or farther.
    let shift = horizontal(rng, 0.7 * largest_m);
    let spin = signed(rng) * 0.2 * largest_m / half_diagonal_m;
    let tilt = horizontal(rng, 0.05 * largest_m) / half_diagonal_m;
    let nearer_m = signed(rng) * 0.05 * largest_m * distance_m / half_diagonal_m;
    let turn = Rotation3::new(tilt + Vector3::z() * spin);
    let moved = target + shift + turn * (center - target) + Vector3::z() * nearer_m;
    Shot {
        pose: pose_at(shot.pose.camera_from_world * turn.inverse(), moved),
        gnss_enu_m: shot.gnss_enu_m,
        name: shot.name.clone(),
        camera: shot.camera,
    }
}

/// The reconstruction of the flight.
pub(super) fn reconstruct(
    truth: &PlantTruth,
    grid: &ModuleGrid,
    shots: &[Shot],
    views: &[View],
    errors: &Errors,
    seed: u64,
) -> Reconstruction {
    let warp = Warp::new(truth, errors, &mut stream(seed, 4, 0));
    let ground_z_m = truth.modules.iter().map(|m| m.center_enu_m.z).sum::<f64>() / truth.modules.len() as f64;
    let estimated: Vec<Shot> = shots
        .iter()
        .enumerate()
        .map(|(index, shot)| {
            let warped = warp.shot(shot, ground_z_m);
            let ground_z_m = warp.apply(&target_of(shot, ground_z_m)).z;
            disturbed(&warped, ground_z_m, errors.view_disagreement_m / 2.0, &mut stream(seed, 5, index))
        })
        .collect();
    let world = World { truth, grid, shots, estimated: &estimated, views, errors, scale: warp.similarity.scale };
    let nearest = Nearest::new(truth, shots, ground_z_m);
    let sparse = world.sparse(&nearest, seed);
    let dense = (errors.cloud_points_per_m2 > 0.0).then(|| world.cloud(&nearest, seed));
    Reconstruction { reference: truth.reference, georeferenced: true, sparse_points_m: sparse, dense, shots: estimated }
}

/// Which view looks most directly at a place, by square tiles.
struct Nearest {
    low_m: Vector2<f64>,
    size: [usize; 2],
    views: Vec<u32>,
}

/// Side of a tile of ground, metres.
const TILE_M: f64 = 8.0;
/// Ground around the plant that the cloud covers, metres.
const SURROUNDINGS_M: f64 = 15.0;

impl Nearest {
    fn new(truth: &PlantTruth, shots: &[Shot], ground_z_m: f64) -> Self {
        let (low, high) = truth.bounds_m();
        let low_m = low.xy() - Vector2::repeat(SURROUNDINGS_M);
        let size = [0, 1].map(|k| ((high[k] + SURROUNDINGS_M - low_m[k]) / TILE_M).ceil() as usize);
        let targets: Vec<Vector2<f64>> = shots.iter().map(|shot| target_of(shot, ground_z_m).xy()).collect();
        let views = (0..size[0] * size[1])
            .into_par_iter()
            .map(|tile| {
                let offset = Vector2::new((tile % size[0]) as f64 + 0.5, (tile / size[0]) as f64 + 0.5);
                let place = low_m + offset * TILE_M;
                let distance = |view: &usize| (targets[*view] - place).norm_squared();
                (0..targets.len()).min_by(|a, b| distance(a).total_cmp(&distance(b))).unwrap_or(0) as u32
            })
            .collect();
        Self { low_m, size, views }
    }

    fn view_at(&self, place_m: Vector2<f64>) -> usize {
        let [x, y] = [0, 1].map(|k| (((place_m[k] - self.low_m[k]) / TILE_M).max(0.0) as usize).min(self.size[k] - 1));
        self.views[y * self.size[0] + x] as usize
    }
}

struct World<'a> {
    truth: &'a PlantTruth,
    grid: &'a ModuleGrid,
    shots: &'a [Shot],
    estimated: &'a [Shot],
    views: &'a [View],
    errors: &'a Errors,
    scale: f64,
}

impl World<'_> {
    /// Where the depth map of a view puts a true point, with an error along the viewing ray; `None` where the view does
    /// not show it or glare hides it.
    fn seen(&self, view: usize, point_m: &Vector3<f64>, depth_error_m: f64) -> Option<Vector3<f64>> {
        let shot = &self.shots[view];
        let in_camera = shot.pose.to_camera(point_m);
        let pixel = shot.camera.project(&in_camera)?;
        let inside = pixel.x >= 0.0
            && pixel.y >= 0.0
            && pixel.x < f64::from(shot.camera.width_px)
            && pixel.y < f64::from(shot.camera.height_px);
        if !inside || self.views[view].glare.iter().any(|patch| patch.contains(pixel)) {
            return None;
        }
        let estimated = &self.estimated[view].pose;
        let distance_m = in_camera.norm();
        let in_camera = in_camera * (self.scale * (1.0 + depth_error_m / distance_m));
        Some(estimated.camera_from_world.inverse_transform_vector(&(in_camera - estimated.translation_m)))
    }

    fn cloud(&self, nearest: &Nearest, seed: u64) -> PointCloud {
        /// Modules in one part of the work.
        const CHUNK: usize = 512;
        /// Parts worked on before they are joined to the cloud, so that it is not in memory twice.
        const BATCH: usize = 512;
        let modules = self.truth.modules.len();
        let chunks = modules.div_ceil(CHUNK);
        let part = |index: usize| {
            let mut part = PointCloud::default();
            if index < chunks {
                let mut rng = stream(seed, 6, index);
                for module in index * CHUNK..((index + 1) * CHUNK).min(modules) {
                    self.face(module, nearest, &mut part, &mut rng);
                }
            } else {
                let tile = index - chunks;
                self.ground(tile, nearest, &mut part, &mut stream(seed, 7, tile));
            }
            part
        };
        let mut cloud = PointCloud::default();
        let indices: Vec<usize> = (0..chunks + nearest.views.len()).collect();
        for batch in indices.chunks(BATCH) {
            let parts: Vec<PointCloud> = batch.par_iter().map(|&index| part(index)).collect();
            for part in parts {
                cloud.positions_m.extend(part.positions_m);
                cloud.normals.extend(part.normals);
            }
        }
        cloud
    }

    fn push(&self, cloud: &mut PointCloud, point_m: Vector3<f64>, normal: Vector3<f64>, rng: &mut StdRng) {
        // Even draws with the stated deviation: there are millions of them, and normal ones cost more.
        let noise =
            Vector3::new(signed(rng), signed(rng), signed(rng)) * (self.errors.normal_noise_rad * 3.0_f64.sqrt());
        let normal = (normal + noise).normalize();
        cloud.positions_m.push(point_m.cast::<f32>().into());
        cloud.normals.push(normal.cast::<f32>().into());
    }

    /// Points on a module's face. Half of the variance of their depth is common to the module, as in a depth map.
    fn face(&self, module: usize, nearest: &Nearest, cloud: &mut PointCloud, rng: &mut StdRng) {
        let module = &self.truth.modules[module];
        let area_m2 = 4.0 * module.half_along_m.norm() * module.half_up_m.norm();
        let count = whole(area_m2 * self.errors.cloud_points_per_m2, rng);
        let view = nearest.view_at(module.center_enu_m.xy());
        let normal_enu = module.normal_enu();
        let sigma_m = self.errors.cloud_noise_m * std::f64::consts::FRAC_1_SQRT_2;
        let common_m = sigma_m * normal(rng);
        for _ in 0..count {
            let point = module.center_enu_m + module.half_along_m * signed(rng) + module.half_up_m * signed(rng);
            if let Some(point) = self.seen(view, &point, common_m + sigma_m * normal(rng)) {
                self.push(cloud, point, normal_enu, rng);
            }
        }
    }

    /// Points on the ground of one tile that no module hides from above.
    fn ground(&self, tile: usize, nearest: &Nearest, cloud: &mut PointCloud, rng: &mut StdRng) {
        let corner =
            nearest.low_m + Vector2::new((tile % nearest.size[0]) as f64, (tile / nearest.size[0]) as f64) * TILE_M;
        let view = nearest.views[tile] as usize;
        // Modules that may hide a place, by sixteen parts of the tile.
        let mut hiding: [Vec<&TruthModule>; 16] = Default::default();
        let part = |offset_m: f64| ((offset_m / TILE_M * 4.0).max(0.0) as usize).min(3);
        for module in self.grid.within(corner - Vector2::repeat(2.0), corner + Vector2::repeat(TILE_M + 2.0)) {
            let module = &self.truth.modules[module];
            let middle = module.center_enu_m.xy() - corner;
            let reach = module.half_along_m.xy().abs() + module.half_up_m.xy().abs();
            for y in part(middle.y - reach.y)..=part(middle.y + reach.y) {
                for x in part(middle.x - reach.x)..=part(middle.x + reach.x) {
                    hiding[4 * y + x].push(module);
                }
            }
        }
        for _ in 0..whole(TILE_M * TILE_M * self.errors.cloud_points_per_m2, rng) {
            let offset = Vector2::new(rng.random::<f64>(), rng.random::<f64>()) * TILE_M;
            let place = corner + offset;
            let depth_error_m = self.errors.cloud_noise_m * normal(rng);
            let near = &hiding[4 * part(offset.y) + part(offset.x)];
            if near.iter().any(|module| module.place_on_face(place).amax() <= 1.0) {
                continue;
            }
            let point = place.push(self.truth.terrain.height_m(place));
            if let Some(point) = self.seen(view, &point, depth_error_m) {
                self.push(cloud, point, Vector3::z(), rng);
            }
        }
    }

    /// Tie points: corners of modules and spots on the ground, a few hundred for each view.
    fn sparse(&self, nearest: &Nearest, seed: u64) -> Vec<Vector3<f64>> {
        let per_view = self.errors.sparse_points_per_view;
        let parts: Vec<Vec<Vector3<f64>>> = (0..self.shots.len())
            .into_par_iter()
            .map(|view| {
                let mut rng = stream(seed, 8, view);
                let shot = &self.shots[view];
                let owners: Vec<usize> = self.views[view].owners.iter().flatten().copied().collect();
                let mut points = Vec::with_capacity(per_view);
                for _ in 0..per_view {
                    let on_module = rng.random_bool(0.5) && !owners.is_empty();
                    let point = if on_module {
                        let module = &self.truth.modules[owners[rng.random_range(0..owners.len())]];
                        module.corners_enu_m()[rng.random_range(0..4)]
                    } else {
                        let z = self.truth.modules.first().map_or(0.0, |m| m.center_enu_m.z);
                        let (u, v) = (rng.random::<f64>(), rng.random::<f64>());
                        let pixel =
                            Vector2::new(u * f64::from(shot.camera.width_px), v * f64::from(shot.camera.height_px));
                        let ray = shot.pose.direction_to_world(&shot.camera.bearing(pixel));
                        let center = shot.pose.center();
                        let place = (center + ray * ((z - center.z) / ray.z.min(-0.05))).xy();
                        place.push(self.truth.terrain.height_m(place))
                    };
                    let (along_m, _) = normal_pair(&mut rng);
                    let source = nearest.view_at(point.xy());
                    points.extend(self.seen(source, &point, along_m * self.errors.cloud_noise_m / 2.0));
                }
                points
            })
            .collect();
        parts.concat()
    }
}

/// A whole number with the given mean.
fn whole(mean: f64, rng: &mut StdRng) -> usize {
    (mean + rng.random::<f64>()) as usize
}
