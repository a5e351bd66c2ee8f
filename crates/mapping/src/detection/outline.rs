//! Outlines of whole benches: the four straight sides of a connected area of modules.
//!
//! Where no network sees the seams between modules, it still sees where the bench ends and the ground begins.

use super::lattice::median;
use super::mask_to_boxes::Run;
use super::probability::ProbabilityMap;
use imageproc::geometry::min_area_rect;
use imageproc::point::Point;
use nalgebra::{Matrix2, Rotation2, Vector2};

/// A pixel belongs to a bench above this probability.
pub(super) const FACE: f32 = 0.5;
/// Points belong to a side within this distance, in parts of the shorter side, and so many pixels more.
const BAND: (f64, f64) = (0.15, 3.0);
/// Part of a side at each of its corners whose points may be of the next side.
const CORNER: f64 = 0.03;
/// Least part of a side that has points, and points that lie on one line, for it to be a bench's end and not the frame's.
const SEEN: f64 = 0.4;
const STRAIGHT: f64 = 0.35;
/// Distance from the line up to which a point is on it, pixels.
const ON_LINE_PX: f64 = 1.2;
/// Length of the stretches by which a side is covered with points, pixels.
const STRETCH_PX: f64 = 3.0;
/// Rounds of weighting of a line.
const ROUNDS: i32 = 15;
/// Least sine of the angle of two sides that meet.
const LEAST_SINE: f64 = 0.3;

/// A bench as a quadrilateral in pixels of the map (pixel centres at whole numbers).
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Outline {
    /// The first and the last are of an end of the bench, the first two of a long side.
    pub corners: [Vector2<f64>; 4],
    /// Whether the other end, of the second and third corner, is one as well; the frame may cut the bench.
    pub is_whole: bool,
}

struct Line {
    point: Vector2<f64>,
    direction: Vector2<f64>,
}

impl Outline {
    /// The sides of an area given by its runs of pixels; `None` where it is no bench with both long sides and one end in view.
    pub fn of(map: &ProbabilityMap, runs: &[Run]) -> Option<Self> {
        let ends: Vec<Point<i32>> =
            runs.iter().flat_map(|run| [run.x0, run.x1 - 1].map(|x| Point::new(x as i32, run.y as i32))).collect();
        let mut rectangle = min_area_rect(&ends).map(|p| Vector2::new(f64::from(p.x), f64::from(p.y)));
        if (rectangle[1] - rectangle[0]).norm() < (rectangle[2] - rectangle[1]).norm() {
            rectangle.rotate_left(1);
        }
        let short_px = (rectangle[2] - rectangle[1]).norm();
        if short_px < 1.0 {
            return None;
        }
        let points = border(map, runs);
        let side = |k: usize| Line::along(rectangle[k], rectangle[(k + 1) % 4], &points, short_px);
        let (upper, lower) = (side(0)?, side(2)?);
        let (right, left) = (side(1), side(3));
        let is_whole = right.is_some() && left.is_some();
        // The end that the frame cuts is taken as parallel to the other, where the bench is seen last.
        let parallel = |end: &Line, k: usize| Line { point: rectangle[k], direction: -end.direction };
        let (right, left, is_turned) = match (right, left) {
            (Some(right), Some(left)) => (right, left, false),
            (None, Some(left)) => (parallel(&left, 1), left, false),
            (Some(right), None) => {
                let left = parallel(&right, 3);
                (right, left, true)
            }
            (None, None) => return None,
        };
        let sides = [upper, right, lower, left];
        let mut corners = [Vector2::zeros(); 4];
        for (k, corner) in corners.iter_mut().enumerate() {
            *corner = sides[(k + 3) % 4].crossing(&sides[k])?;
        }
        if is_turned {
            corners.rotate_left(2);
        }
        Some(Self { corners, is_whole })
    }
}

impl Outline {
    /// With the second end turned by an angle about its middle, the long sides as they are.
    pub fn turned(&self, angle_rad: f64) -> Option<Self> {
        if angle_rad == 0.0 {
            return Some(self.clone());
        }
        let [a, b, c, d] = self.corners;
        let through = |point: Vector2<f64>, to: Vector2<f64>| Line { point, direction: (to - point).normalize() };
        let end = Line { point: (b + c) / 2.0, direction: Rotation2::new(angle_rad) * (c - b).normalize() };
        Some(Self { corners: [a, through(a, b).crossing(&end)?, through(d, c).crossing(&end)?, d], ..*self })
    }
}

impl Line {
    /// The line near the stretch from `a` to `b` on which most of the points there lie; `None` where too few do.
    fn along(a: Vector2<f64>, b: Vector2<f64>, points: &[Vector2<f64>], short_px: f64) -> Option<Self> {
        let length = (b - a).norm();
        let direction = (b - a).try_normalize(1e-9)?;
        let aside = Vector2::new(-direction.y, direction.x);
        let near: Vec<Vector2<f64>> = points
            .iter()
            .map(|p| Vector2::new((p - a).dot(&direction), (p - a).dot(&aside)))
            .filter(|p| {
                (CORNER * length..=(1.0 - CORNER) * length).contains(&p.x) && p.y.abs() < BAND.0 * short_px + BAND.1
            })
            .collect();
        if covered(near.iter().map(|p| p.x)) < SEEN * length {
            return None;
        }
        // Distance from the stretch at its middle, and slope.
        let mut line = Vector2::new(median(&mut near.iter().map(|p| p.y).collect::<Vec<_>>()), 0.0);
        let off = |line: &Vector2<f64>, p: &Vector2<f64>| p.y - line.x - line.y * (p.x - length / 2.0);
        for round in 0..ROUNDS {
            let scale_px = (4.0 * 0.6_f64.powi(round)).max(1.0);
            let (mut normal, mut right) = (Matrix2::zeros(), Vector2::zeros());
            for p in &near {
                let terms = Vector2::new(1.0, p.x - length / 2.0);
                let weight = 1.0 / (1.0 + (off(&line, p) / scale_px).powi(2));
                normal += terms * terms.transpose() * weight;
                right += terms * (p.y * weight);
            }
            line = normal.try_inverse()? * right;
        }
        if covered(near.iter().filter(|p| off(&line, p).abs() < ON_LINE_PX).map(|p| p.x)) < STRAIGHT * length {
            return None;
        }
        let point = a + direction * (length / 2.0) + aside * line.x;
        Some(Self { point, direction: (direction + aside * line.y).normalize() })
    }

    fn crossing(&self, other: &Self) -> Option<Vector2<f64>> {
        let sine = self.direction.perp(&other.direction);
        let along = (other.point - self.point).perp(&other.direction) / sine;
        (sine.abs() > LEAST_SINE).then(|| self.point + self.direction * along)
    }
}

/// Length in pixels of the stretches that hold one of the places.
fn covered(places: impl Iterator<Item = f64>) -> f64 {
    let mut stretches: Vec<i64> = places.map(|place| (place / STRETCH_PX) as i64).collect();
    stretches.sort_unstable();
    stretches.dedup();
    stretches.len() as f64 * STRETCH_PX
}

/// Where the probability falls through [`FACE`] between a pixel of the area and one outside of it; the frame is no border.
fn border(map: &ProbabilityMap, runs: &[Run]) -> Vec<Vector2<f64>> {
    let mut points = Vec::new();
    let mut cross = |x: usize, y: usize, to_x: isize, to_y: isize| {
        let (Some(other_x), Some(other_y)) = (x.checked_add_signed(to_x), y.checked_add_signed(to_y)) else { return };
        if other_x >= map.width() || other_y >= map.height() {
            return;
        }
        let (inside, outside) = (map.get(x, y), map.get(other_x, other_y));
        if outside <= FACE {
            let part = f64::from((inside - FACE) / (inside - outside).max(f32::EPSILON)).clamp(0.0, 1.0);
            points.push(Vector2::new(x as f64 + part * to_x as f64, y as f64 + part * to_y as f64));
        }
    };
    for run in runs {
        cross(run.x0, run.y, -1, 0);
        cross(run.x1 - 1, run.y, 1, 0);
        for x in run.x0..run.x1 {
            cross(x, run.y, 0, -1);
            cross(x, run.y, 0, 1);
        }
    }
    points
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::detection::mask_to_boxes::Components;
    use crate::geometry::Quad;

    const CORNERS: [Vector2<f64>; 4] =
        [Vector2::new(30.0, 40.0), Vector2::new(210.0, 62.0), Vector2::new(205.0, 110.0), Vector2::new(27.0, 92.0)];

    /// Probability of a face on a quadrilateral, in a map of the given size.
    fn map(corners: [Vector2<f64>; 4], width: usize, height: usize) -> ProbabilityMap {
        let quad = Quad { corners };
        ProbabilityMap::from_fn(width, height, |x, y| {
            let fine = |k: usize| k as f64 / 5.0 - 0.4;
            let inside =
                (0..25).filter(|k| quad.contains(Vector2::new(x as f64 + fine(k % 5), y as f64 + fine(k / 5))));
            inside.count() as f32 / 25.0
        })
    }

    fn outline(map: &ProbabilityMap) -> Option<Outline> {
        let components = Components::above(map, ProbabilityMap::level(FACE));
        Outline::of(map, components.iter().next().unwrap())
    }

    fn assert_near(found: &Outline, expected: Vector2<f64>) {
        let distance = found.corners.iter().map(|corner| (corner - expected).norm()).fold(f64::INFINITY, f64::min);
        assert!(distance < 0.5, "{expected:?} is off by {distance} px: {found:?}");
    }

    #[test]
    fn a_whole_bench_has_four_sides() {
        let found = outline(&map(CORNERS, 240, 140)).unwrap();
        assert!(found.is_whole);
        CORNERS.iter().for_each(|corner| assert_near(&found, *corner));
    }

    #[test]
    fn a_bench_that_the_frame_cuts_begins_at_its_own_end() {
        let found = outline(&map(CORNERS, 150, 140)).unwrap();
        assert!(!found.is_whole);
        assert_near(&found, CORNERS[0]);
        let first = [found.corners[0], found.corners[3]];
        assert!(first.iter().all(|corner| corner.x < 40.0), "{found:?}");
        // Cut at both ends, or along its length, it tells nothing.
        assert_eq!(outline(&map(CORNERS.map(|c| c - Vector2::new(60.0, 0.0)), 100, 140)), None);
        assert_eq!(outline(&map(CORNERS, 240, 70)), None);
    }
}
