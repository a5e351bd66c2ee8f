//! Where the photos are taken from.

use super::noise::{normal, signed};
use super::plant::PlantTruth;
use heliomap_mapping::geometry::{Camera, Pose};
use heliomap_mapping::reconstruction::Shot;
use nalgebra::{Matrix3, Rotation3, Unit, Vector2, Vector3};
use rand::{RngExt, rngs::StdRng};

/// A flight over the plant in parallel strips, photos in a regular grid.
#[derive(Debug, Clone, PartialEq)]
pub struct Flight {
    /// Camera of every photo; must be free of distortion.
    pub camera: Camera,
    /// Height above the plant's mean module, metres.
    pub altitude_m: f64,
    /// Share of a photo that the next one of its strip shows again, 0 to below 1.
    pub forward_overlap: f64,
    /// Share of a photo that the next strip shows again, 0 to below 1.
    pub side_overlap: f64,
    /// Share of a photo that lies outside of the plant at its borders, 0 to 1.
    pub overhang: f64,
    /// Compass direction of the strips and of the top of the photos, clockwise from north.
    pub heading_rad: f64,
    /// Whether every second strip is flown, and photographed, the other way round.
    pub both_directions: bool,
    /// Largest angle between the optical axis and the vertical; every photo has its own, in its own direction.
    pub tilt_rad: f64,
    /// Standard deviation of each coordinate of the camera about its place in the grid, metres.
    pub position_jitter_m: f64,
    /// Standard deviation of the direction of the top of the photo.
    pub yaw_jitter_rad: f64,
    /// Standard deviation of each coordinate of the GNSS position, metres.
    pub gnss_sigma_m: f64,
}

impl Flight {
    /// A generous flight for small plants: 2736 x 1824 pixels at 45 m, 60 % overlaps.
    pub fn plain() -> Self {
        Self {
            camera: Camera::pinhole(2736, 1824, 0.777),
            altitude_m: 45.0,
            forward_overlap: 0.6,
            side_overlap: 0.6,
            overhang: 0.5,
            heading_rad: 0.0,
            both_directions: true,
            tilt_rad: 0.05,
            position_jitter_m: 1.0,
            yaw_jitter_rad: 0.03,
            gnss_sigma_m: 1.5,
        }
    }

    /// [`Flight::plain`] in any direction, up to 20 degrees off the vertical, one way or both ways, 35 to 60 m high.
    pub fn random(rng: &mut StdRng) -> Self {
        Self {
            altitude_m: rng.random_range(35.0..60.0),
            heading_rad: std::f64::consts::PI * signed(rng),
            both_directions: rng.random_bool(0.7),
            tilt_rad: rng.random_range(0.0..=20.0_f64.to_radians()),
            yaw_jitter_rad: rng.random_range(0.0..0.15),
            ..Self::plain()
        }
    }

    /// About as many photos as the paper took of its first plant (Table 1), with its camera at half resolution (4),
    /// from so high that every module is in two photos at least.
    pub fn paper_pp1() -> Self {
        Self { altitude_m: 115.0, forward_overlap: 0.5, side_overlap: 0.5, ..Self::plain() }
    }

    /// About as many photos as the paper took of its second plant, with its camera (Table 1, 4).
    pub fn paper_pp2() -> Self {
        Self {
            camera: Camera::pinhole(4056, 3040, 0.73),
            altitude_m: 82.0,
            forward_overlap: 0.5,
            side_overlap: 0.5,
            ..Self::plain()
        }
    }

    /// For plants of any size, [`super::PlantSpec::sized`]: about one photo per 250 modules.
    pub fn sized() -> Self {
        Self { altitude_m: 76.0, forward_overlap: 0.62, side_overlap: 0.6, overhang: 0.5, ..Self::plain() }
    }

    /// The same flight with photos so much closer that about `factor` times as many are taken.
    pub fn denser(&self, factor: f64) -> Self {
        let closer = |overlap: f64| 1.0 - (1.0 - overlap) / factor.sqrt();
        Self { forward_overlap: closer(self.forward_overlap), side_overlap: closer(self.side_overlap), ..self.clone() }
    }

    /// The shots with their true poses, in the order of flight, named so that they sort in that order.
    pub fn shots(&self, truth: &PlantTruth, rng: &mut StdRng) -> Vec<Shot> {
        let focal_px = self.camera.focal_px();
        let across_m = f64::from(self.camera.width_px) / focal_px * self.altitude_m;
        let forward_m = f64::from(self.camera.height_px) / focal_px * self.altitude_m;
        let (sin, cos) = self.heading_rad.sin_cos();
        let (forward, right) = (Vector2::new(sin, cos), Vector2::new(cos, -sin));
        let mut low = Vector2::repeat(f64::INFINITY);
        let mut high = -low;
        let mut height_m = 0.0;
        for module in &truth.modules {
            let place = module.center_enu_m.xy();
            let place = Vector2::new(place.dot(&right), place.dot(&forward));
            low = low.inf(&place);
            high = high.sup(&place);
            height_m += module.center_enu_m.z / truth.modules.len() as f64;
        }
        let strips = grid(low.x, high.x, across_m, self.side_overlap, self.overhang);
        let along = grid(low.y, high.y, forward_m, self.forward_overlap, self.overhang);
        let mut shots = Vec::with_capacity(strips.len() * along.len());
        for (strip, x) in strips.iter().enumerate() {
            let turned = self.both_directions && strip % 2 == 1;
            for k in 0..along.len() {
                let y = along[if turned { along.len() - 1 - k } else { k }];
                let target = (right * *x + forward * y).push(height_m);
                let yaw = self.heading_rad
                    + if turned { std::f64::consts::PI } else { 0.0 }
                    + self.yaw_jitter_rad * normal(rng);
                let tilt = self.tilt_rad * rng.random::<f64>();
                let towards = std::f64::consts::PI * signed(rng);
                let world_from_camera = looking_down(yaw, tilt, towards);
                // The camera stands where its axis meets the target, so that tilted photos show the same ground.
                let axis = world_from_camera * Vector3::z();
                let jitter = Vector3::new(normal(rng), normal(rng), normal(rng)) * self.position_jitter_m;
                let center = target - axis * (self.altitude_m / -axis.z) + jitter;
                let gnss = Vector3::new(normal(rng), normal(rng), normal(rng)) * self.gnss_sigma_m;
                shots.push(Shot {
                    name: format!("SIM_{:05}.jpg", shots.len() + 1),
                    camera: self.camera,
                    pose: pose_at(world_from_camera.inverse(), center),
                    gnss_enu_m: Some(center + gnss),
                });
            }
        }
        shots
    }
}

/// The pose of a camera that stands at `center`.
pub(super) fn pose_at(camera_from_world: Rotation3<f64>, center: Vector3<f64>) -> Pose {
    Pose { camera_from_world, translation_m: -(camera_from_world * center) }
}

/// Even positions of views of extent `footprint` so that `low` to `high` is covered with at least the given overlap.
fn grid(low: f64, high: f64, footprint: f64, overlap: f64, overhang: f64) -> Vec<f64> {
    let (first, last) = (low + (0.5 - overhang) * footprint, high - (0.5 - overhang) * footprint);
    if last <= first {
        return vec![(low + high) / 2.0];
    }
    let steps = ((last - first) / (footprint * (1.0 - overlap))).ceil().max(1.0);
    (0..=steps as usize).map(|k| first + (last - first) * k as f64 / steps).collect()
}

/// World from camera of a view straight down with its top towards the compass direction `yaw`, then tilted off the
/// vertical by `tilt` about the horizontal axis at `towards`. Radians.
fn looking_down(yaw: f64, tilt: f64, towards: f64) -> Rotation3<f64> {
    let (sin, cos) = yaw.sin_cos();
    let nadir = Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[
        Vector3::new(cos, -sin, 0.0),
        Vector3::new(-sin, -cos, 0.0),
        -Vector3::z(),
    ]));
    let axis = Unit::new_unchecked(Vector3::new(towards.cos(), towards.sin(), 0.0));
    Rotation3::from_axis_angle(&axis, tilt) * nadir
}
