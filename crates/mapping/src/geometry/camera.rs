//! Camera models: from a point in front of the camera to a pixel and back.

use nalgebra::{Vector2, Vector3};
use serde::{Deserialize, Serialize};

/// How a lens bends the normalised image plane. `x = X/Z`, `y = Y/Z`, `r2 = x^2 + y^2`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub enum Lens {
    /// `x (1 + k1 r2 + k2 r2^2 + k3 r2^3)` plus OpenCV's tangential terms (OpenSfM `perspective`, `radial`,
    /// `simple_radial`, `brown`).
    Radial { k1: f64, k2: f64, k3: f64, p1: f64, p2: f64 },
    /// `theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)` along the direction of the ray (OpenSfM `fisheye`,
    /// `fisheye_opencv`).
    Fisheye { k: [f64; 4] },
}

/// A calibrated camera. Focal lengths and principal point are in units of `max(width_px, height_px)`, the principal point
/// counted from the middle of the image, as OpenSfM has them.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Camera {
    pub width_px: u32,
    pub height_px: u32,
    pub focal_x: f64,
    pub focal_y: f64,
    pub principal_x: f64,
    pub principal_y: f64,
    pub lens: Lens,
}

impl Camera {
    /// A camera free of distortion with its principal point in the middle; `focal` in units of the larger side.
    pub fn pinhole(width_px: u32, height_px: u32, focal: f64) -> Self {
        Self {
            width_px,
            height_px,
            focal_x: focal,
            focal_y: focal,
            principal_x: 0.0,
            principal_y: 0.0,
            lens: Lens::Radial { k1: 0.0, k2: 0.0, k3: 0.0, p1: 0.0, p2: 0.0 },
        }
    }

    /// The same camera for an image of another resolution: all parameters are relative to the size.
    pub fn resized(&self, width_px: u32, height_px: u32) -> Self {
        Self { width_px, height_px, ..*self }
    }

    /// The camera that the undistorted image belongs to: the same size, focal lengths and principal point, no distortion.
    pub fn undistorted(&self) -> Self {
        Self { lens: Lens::Radial { k1: 0.0, k2: 0.0, k3: 0.0, p1: 0.0, p2: 0.0 }, ..*self }
    }

    /// Whether pixels are a perspective image of the world as they are.
    pub fn is_undistorted(&self) -> bool {
        matches!(self.lens, Lens::Radial { k1, k2, k3, p1, p2 } if [k1, k2, k3, p1, p2].iter().all(|k| *k == 0.0))
    }

    /// Mean focal length in pixels.
    pub fn focal_px(&self) -> f64 {
        (self.focal_x + self.focal_y) / 2.0 * self.size()
    }

    fn size(&self) -> f64 {
        f64::from(self.width_px.max(self.height_px))
    }

    fn distort(&self, x: f64, y: f64) -> Vector2<f64> {
        match self.lens {
            Lens::Radial { k1, k2, k3, p1, p2 } => {
                let r2 = x * x + y * y;
                let d = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
                Vector2::new(
                    x * d + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
                    y * d + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
                )
            }
            Lens::Fisheye { k } => {
                let r = x.hypot(y);
                if r < 1e-12 {
                    return Vector2::new(x, y);
                }
                let theta = r.atan();
                let t2 = theta * theta;
                let scale = theta * (1.0 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3])))) / r;
                Vector2::new(x * scale, y * scale)
            }
        }
    }

    /// The pixel (pixel centres at whole numbers) of a point in the camera frame, or `None` if it lies behind the camera.
    pub fn project(&self, camera_m: &Vector3<f64>) -> Option<Vector2<f64>> {
        (camera_m.z > 1e-9).then(|| self.pixel_from_normalised(camera_m.x / camera_m.z, camera_m.y / camera_m.z))
    }

    /// The pixel of normalised coordinates `x = X/Z`, `y = Y/Z`.
    pub fn pixel_from_normalised(&self, x: f64, y: f64) -> Vector2<f64> {
        let bent = self.distort(x, y);
        Vector2::new(
            (self.focal_x * bent.x + self.principal_x) * self.size() + f64::from(self.width_px) / 2.0 - 0.5,
            (self.focal_y * bent.y + self.principal_y) * self.size() + f64::from(self.height_px) / 2.0 - 0.5,
        )
    }

    /// The normalised coordinates `(X/Z, Y/Z)` that a pixel shows (Newton steps where the lens distorts).
    pub fn normalised_from_pixel(&self, pixel: Vector2<f64>) -> Vector2<f64> {
        let target = Vector2::new(
            ((pixel.x + 0.5 - f64::from(self.width_px) / 2.0) / self.size() - self.principal_x) / self.focal_x,
            ((pixel.y + 0.5 - f64::from(self.height_px) / 2.0) / self.size() - self.principal_y) / self.focal_y,
        );
        if self.is_undistorted() {
            return target;
        }
        let mut point = target;
        for _ in 0..20 {
            let residual = self.distort(point.x, point.y) - target;
            if residual.norm_squared() < 1e-24 {
                break;
            }
            let step = 1e-6;
            let dx = (self.distort(point.x + step, point.y) - self.distort(point.x - step, point.y)) / (2.0 * step);
            let dy = (self.distort(point.x, point.y + step) - self.distort(point.x, point.y - step)) / (2.0 * step);
            let determinant = dx.x * dy.y - dy.x * dx.y;
            if determinant.abs() < 1e-12 {
                break;
            }
            point -= Vector2::new(
                (residual.x * dy.y - residual.y * dy.x) / determinant,
                (residual.y * dx.x - residual.x * dx.y) / determinant,
            );
        }
        point
    }

    /// The unit vector in the camera frame that a pixel looks along.
    pub fn bearing(&self, pixel: Vector2<f64>) -> Vector3<f64> {
        let n = self.normalised_from_pixel(pixel);
        Vector3::new(n.x, n.y, 1.0).normalize()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn the_middle_of_the_image_looks_straight_ahead() {
        let camera = Camera::pinhole(1368, 912, 0.777);
        let pixel = camera.project(&Vector3::new(0.0, 0.0, 10.0)).unwrap();
        assert_eq!(pixel, Vector2::new(683.5, 455.5));
        assert!(camera.project(&Vector3::new(0.0, 0.0, -1.0)).is_none());
    }

    proptest! {
        #[test]
        fn pixel_and_bearing_agree(
            u in 0.0..1368.0_f64, v in 0.0..912.0_f64, k1 in -0.1..0.1_f64, k2 in -0.02..0.02_f64, p1 in -0.002..0.002_f64,
            fisheye in any::<bool>(),
        ) {
            let mut camera = Camera::pinhole(1368, 912, 0.8);
            camera.principal_x = 0.003;
            camera.lens = if fisheye {
                Lens::Fisheye { k: [k1, k2, 0.0, 0.0] }
            } else {
                Lens::Radial { k1, k2, k3: 0.001, p1, p2: -p1 }
            };
            let pixel = Vector2::new(u, v);
            let back = camera.project(&(camera.bearing(pixel) * 42.0)).unwrap();
            prop_assert!((back - pixel).norm() < 1e-6, "{} against {}", back, pixel);
        }
    }
}
