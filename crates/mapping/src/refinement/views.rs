//! Views whose poses are adjusted: each may move and turn a little about the ground that it shows.

use crate::fusion::View;
use crate::geometry::Pose;
use crate::reconstruction::Shot;
use nalgebra::{Matrix2x3, Matrix3, Rotation3, Vector2, Vector3, Vector6};

/// A camera with a correction to its pose. A point at `p` in the camera's frame comes to stand at
/// `exp(turn) (p - pivot) + pivot + shift`: about the pivot, in the middle of what the view shows, moving and turning
/// have effects of their own in the image, so that each is well determined or not at all.
#[derive(Debug, Clone)]
pub(super) struct AdjustedView {
    rotation: Matrix3<f64>,
    translation: Vector3<f64>,
    focal_px: [f64; 2],
    principal_px: Vector2<f64>,
    /// Middle of what the view shows, camera frame, metres.
    pivot: Vector3<f64>,
    /// How far what it shows reaches about the pivot, metres (root mean square).
    reach_m: f64,
    /// How much the pose may err, in units of the typical view's.
    quality: f64,
    /// Turn (radians, camera axes) and shift (metres, camera axes).
    correction: Vector6<f64>,
    /// The corrected pose.
    adjusted_rotation: Matrix3<f64>,
    adjusted_translation: Vector3<f64>,
}

impl AdjustedView {
    /// A view as it is, about the middle of the points that it shows (world, metres).
    pub(super) fn new(view: &View<'_>, shown_m: impl Iterator<Item = Vector3<f64>>, quality: f64) -> Self {
        let Shot { pose, camera, .. } = view.shot;
        let (mut count, mut sum, mut squares) = (0.0_f64, Vector3::zeros(), 0.0);
        for point in shown_m {
            let point = pose.to_camera(&point);
            count += 1.0;
            sum += point;
            squares += point.norm_squared();
        }
        let pivot = sum / count.max(1.0);
        let reach_m = (squares / count.max(1.0) - pivot.norm_squared()).max(0.0).sqrt();
        let size = f64::from(camera.width_px.max(camera.height_px));
        let rotation = *pose.camera_from_world.matrix();
        Self {
            rotation,
            translation: pose.translation_m,
            focal_px: [camera.focal_x * size, camera.focal_y * size],
            principal_px: camera.pixel_from_normalised(0.0, 0.0),
            pivot,
            reach_m: reach_m.max(2.0),
            quality,
            correction: Vector6::zeros(),
            adjusted_rotation: rotation,
            adjusted_translation: pose.translation_m,
        }
    }

    /// The corrected pose.
    pub(super) fn pose(&self) -> Pose {
        Pose {
            camera_from_world: Rotation3::from_matrix_unchecked(self.adjusted_rotation),
            translation_m: self.adjusted_translation,
        }
    }

    /// Pixels per metre on the ground in the middle of the view.
    pub(super) fn px_per_m(&self) -> f64 {
        (self.focal_px[0] + self.focal_px[1]) / 2.0 / self.pivot.z.max(0.1)
    }

    /// What a small offset in the image is on the ground, in the middle of the view, metres east and north.
    pub(super) fn on_ground(&self, offset_px: Vector2<f64>) -> Vector2<f64> {
        let [fx, fy] = self.focal_px;
        let in_camera = Vector3::new(offset_px.x / fx, offset_px.y / fy, 0.0) * self.pivot.z;
        (self.adjusted_rotation.transpose() * in_camera).xy()
    }

    pub(super) fn correction(&self) -> &Vector6<f64> {
        &self.correction
    }

    /// What a correction that moves the ground by a metre amounts to in each of its numbers.
    pub(super) fn correction_scale(&self) -> Vector6<f64> {
        let turn = 1.0 / self.reach_m;
        Vector6::new(turn, turn, turn, 1.0, 1.0, 1.0)
    }

    /// What each number of the correction may be where the typical pose moves the ground by a metre.
    pub(super) fn prior_scale(&self) -> Vector6<f64> {
        self.correction_scale() * self.quality
    }

    pub(super) fn correct(&mut self, step: &Vector6<f64>) {
        self.correction += step;
        let turn = *Rotation3::new(self.correction.fixed_rows::<3>(0).into_owned()).matrix();
        self.adjusted_rotation = turn * self.rotation;
        self.adjusted_translation =
            turn * (self.translation - self.pivot) + self.pivot + self.correction.fixed_rows::<3>(3);
    }

    /// Where a point (world, metres) is seen; `None` behind the camera.
    pub(super) fn pixel(&self, point: &Vector3<f64>) -> Option<Vector2<f64>> {
        let p = self.adjusted_rotation * point + self.adjusted_translation;
        (p.z > 1e-6)
            .then(|| self.principal_px + Vector2::new(self.focal_px[0] * p.x / p.z, self.focal_px[1] * p.y / p.z))
    }

    /// Where a point is seen, and the pixel's derivative by the point (world) and by the turn of the view; that by its
    /// shift is the derivative by the point in camera axes, the last.
    pub(super) fn look(&self, point: &Vector3<f64>) -> Option<Look> {
        let p = self.adjusted_rotation * point + self.adjusted_translation;
        if p.z <= 1e-6 {
            return None;
        }
        let [fx, fy] = self.focal_px;
        let (x, y) = (fx * p.x / p.z, fy * p.y / p.z);
        let by_camera = Matrix2x3::new(fx / p.z, 0.0, -x / p.z, 0.0, fy / p.z, -y / p.z);
        let q = p - self.pivot - self.correction.fixed_rows::<3>(3);
        Some(Look {
            pixel: self.principal_px + Vector2::new(x, y),
            by_point: by_camera * self.adjusted_rotation,
            by_turn: -by_camera * q.cross_matrix(),
            by_shift: by_camera,
        })
    }

    /// The corrections that follow when the whole world is moved, turned (about `middle`) and scaled by one unit each:
    /// seven columns of which nothing in the images tells. Metres and radians.
    pub(super) fn gauge(&self, middle: &Vector3<f64>) -> [Vector6<f64>; 7] {
        let center = -(self.rotation.transpose() * self.translation);
        let pivot_world = self.rotation.transpose() * (self.pivot - self.translation);
        let column = |turn: Vector3<f64>, shift: Vector3<f64>| {
            let (turn, shift) = (-(self.rotation * turn), -(self.rotation * shift));
            Vector6::new(turn.x, turn.y, turn.z, shift.x, shift.y, shift.z)
        };
        let moved = |axis: Vector3<f64>| column(Vector3::zeros(), axis);
        let turned = |axis: Vector3<f64>| column(axis, axis.cross(&(pivot_world - middle)));
        let (x, y, z) = (Vector3::x(), Vector3::y(), Vector3::z());
        [moved(x), moved(y), moved(z), turned(x), turned(y), turned(z), column(Vector3::zeros(), center - middle)]
    }
}

/// A pixel and its derivatives, pixels per metre and per radian.
pub(super) struct Look {
    pub(super) pixel: Vector2<f64>,
    pub(super) by_point: Matrix2x3<f64>,
    pub(super) by_turn: Matrix2x3<f64>,
    pub(super) by_shift: Matrix2x3<f64>,
}
