//! Convex quadrilaterals in the image: the oriented box of one module.

use nalgebra::Vector2;
use serde::{Deserialize, Serialize};

/// Four corners in order around a convex quadrilateral, in pixels (pixel centres at whole numbers, y down).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Quad {
    pub corners: [Vector2<f64>; 4],
}

impl Quad {
    /// A quadrilateral from corners in any order: sorted by angle around their mean, clockwise on the screen, starting
    /// at the corner nearest to the top left. `None` if a coordinate is not finite or the area is (nearly) nought.
    pub fn from_unordered(mut corners: [Vector2<f64>; 4]) -> Option<Self> {
        if corners.iter().any(|c| !c.x.is_finite() || !c.y.is_finite()) {
            return None;
        }
        let mean = corners.iter().sum::<Vector2<f64>>() / 4.0;
        corners.sort_by(|p, q| (p - mean).y.atan2((p - mean).x).total_cmp(&(q - mean).y.atan2((q - mean).x)));
        let first = (0..4).min_by(|&i, &j| (corners[i].x + corners[i].y).total_cmp(&(corners[j].x + corners[j].y)))?;
        corners.rotate_left(first);
        let quad = Self { corners };
        (quad.area_px2() > 1e-6).then_some(quad)
    }

    /// The parallelogram with the given centre and half side vectors.
    pub fn from_center(center: Vector2<f64>, half_u: Vector2<f64>, half_v: Vector2<f64>) -> Self {
        Self {
            corners: [
                center - half_u - half_v,
                center + half_u - half_v,
                center + half_u + half_v,
                center - half_u + half_v,
            ],
        }
    }

    /// The mean of the corners, pixels.
    pub fn center(&self) -> Vector2<f64> {
        self.corners.iter().sum::<Vector2<f64>>() / 4.0
    }

    /// The two mean side vectors, pixels: from corner 0 towards 1, and from corner 1 towards 2.
    pub fn sides(&self) -> [Vector2<f64>; 2] {
        let c = &self.corners;
        [(c[1] - c[0] + c[2] - c[3]) / 2.0, (c[2] - c[1] + c[3] - c[0]) / 2.0]
    }

    /// Area in square pixels.
    pub fn area_px2(&self) -> f64 {
        polygon_area(&self.corners).abs()
    }

    /// Shorter and longer mean side length, pixels.
    pub fn extent_px(&self) -> (f64, f64) {
        let [u, v] = self.sides();
        let (a, b) = (u.norm(), v.norm());
        (a.min(b), a.max(b))
    }

    /// Whether it turns the same way at every corner.
    pub fn is_convex(&self) -> bool {
        let c = &self.corners;
        let turns = [0, 1, 2, 3].map(|k| (c[(k + 1) % 4] - c[k]).perp(&(c[(k + 2) % 4] - c[(k + 1) % 4])));
        turns.iter().all(|turn| *turn > 0.0) || turns.iter().all(|turn| *turn < 0.0)
    }

    /// Whether the point lies inside or on the border.
    pub fn contains(&self, point: Vector2<f64>) -> bool {
        let mut positive = false;
        let mut negative = false;
        for k in 0..4 {
            let (a, b) = (self.corners[k], self.corners[(k + 1) % 4]);
            let side = (b - a).perp(&(point - a));
            positive |= side > 1e-12;
            negative |= side < -1e-12;
        }
        !(positive && negative)
    }

    /// Area shared with another quadrilateral, square pixels (Sutherland-Hodgman clipping; both must be convex).
    pub fn overlap_px2(&self, other: &Self) -> f64 {
        let orientation = polygon_area(&other.corners).signum();
        let mut polygon = self.corners.to_vec();
        for k in 0..4 {
            let (a, b) = (other.corners[k], other.corners[(k + 1) % 4]);
            let inside = |p: &Vector2<f64>| (b - a).perp(&(p - a)) * orientation >= 0.0;
            let mut clipped = Vec::with_capacity(polygon.len() + 1);
            for i in 0..polygon.len() {
                let (p, q) = (polygon[i], polygon[(i + 1) % polygon.len()]);
                if inside(&p) {
                    clipped.push(p);
                }
                if inside(&p) != inside(&q) {
                    let (from, to) = ((b - a).perp(&(p - a)), (b - a).perp(&(q - a)));
                    clipped.push(p + (q - p) * (from / (from - to)));
                }
            }
            polygon = clipped;
            if polygon.len() < 3 {
                return 0.0;
            }
        }
        polygon_area(&polygon).abs()
    }

    /// Intersection over union, 0 to 1.
    pub fn iou(&self, other: &Self) -> f64 {
        let shared = self.overlap_px2(other);
        let union = self.area_px2() + other.area_px2() - shared;
        if union > 0.0 { shared / union } else { 0.0 }
    }

    /// Every corner mapped.
    pub fn map(&self, f: impl Fn(Vector2<f64>) -> Vector2<f64>) -> Self {
        Self { corners: self.corners.map(f) }
    }
}

/// Signed area of a polygon (positive where the corners turn clockwise on the screen, y down).
fn polygon_area(corners: &[Vector2<f64>]) -> f64 {
    (0..corners.len()).map(|k| corners[k].perp(&corners[(k + 1) % corners.len()])).sum::<f64>() / 2.0
}

#[cfg(test)]
mod tests {
    use super::*;

    fn square(x: f64, y: f64, side: f64) -> Quad {
        Quad::from_center(Vector2::new(x, y), Vector2::new(side / 2.0, 0.0), Vector2::new(0.0, side / 2.0))
    }

    #[test]
    fn overlap_of_shifted_squares() {
        assert!((square(0.0, 0.0, 2.0).overlap_px2(&square(1.0, 0.0, 2.0)) - 2.0).abs() < 1e-12);
        assert!((square(0.0, 0.0, 2.0).iou(&square(0.0, 0.0, 2.0)) - 1.0).abs() < 1e-12);
        assert_eq!(square(0.0, 0.0, 2.0).iou(&square(5.0, 0.0, 2.0)), 0.0);
    }

    #[test]
    fn any_order_of_corners_gives_the_same_quad() {
        let corners = square(3.0, 4.0, 2.0).corners;
        let expected = Quad::from_unordered(corners).unwrap();
        for order in [[0, 2, 1, 3], [3, 2, 1, 0], [1, 3, 0, 2], [2, 0, 3, 1]] {
            assert_eq!(Quad::from_unordered(order.map(|k| corners[k])).unwrap(), expected);
        }
        assert!(Quad::from_unordered([Vector2::zeros(); 4]).is_none());
        assert!(Quad::from_unordered([Vector2::new(f64::NAN, 0.0); 4]).is_none());
    }

    #[test]
    fn inside_and_outside() {
        let quad = square(0.0, 0.0, 2.0);
        assert!(quad.contains(Vector2::new(0.9, -0.9)));
        assert!(!quad.contains(Vector2::new(1.1, 0.0)));
    }
}
