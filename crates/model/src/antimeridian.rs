//! Polygons across the line of 180 degrees, cut there as RFC 7946, 3.1.9 asks: each part lies on one side.

use crate::geodesy::Lla;

/// Half of the globe, degrees: neighbours further apart than this are nearer the other way round.
const HALF_DEG: f64 = 180.0;
/// The globe, degrees.
const WHOLE_DEG: f64 = 360.0;

/// A polygon by its corners, in order and not closed, as one part or, across the line of 180 degrees, as two.
pub fn cut(corners: &[Lla]) -> Vec<Vec<Lla>> {
    let Some(first) = corners.first() else { return Vec::new() };
    // Longitudes that go on beyond the line instead of round the globe.
    let onward: Vec<Lla> = corners
        .iter()
        .map(|corner| {
            let turns = ((first.longitude_deg - corner.longitude_deg) / WHOLE_DEG).round();
            Lla { longitude_deg: corner.longitude_deg + turns * WHOLE_DEG, ..*corner }
        })
        .collect();
    for line_deg in [-HALF_DEG, HALF_DEG] {
        let beyond = |corner: &Lla| (corner.longitude_deg - line_deg) * line_deg.signum() > 0.0;
        if !onward.iter().any(beyond) {
            continue;
        }
        let back = |part: Vec<Lla>| {
            part.into_iter()
                .map(|corner| Lla { longitude_deg: corner.longitude_deg - line_deg.signum() * WHOLE_DEG, ..corner })
                .collect()
        };
        let sides = [half(&onward, line_deg, -line_deg.signum()), back(half(&onward, line_deg, line_deg.signum()))];
        // A part that only touches the line is none.
        return sides.into_iter().filter(|side| width_deg(side) > 0.0).collect();
    }
    vec![onward]
}

fn width_deg(corners: &[Lla]) -> f64 {
    let longitudes = || corners.iter().map(|corner| corner.longitude_deg);
    longitudes().fold(f64::NEG_INFINITY, f64::max) - longitudes().fold(f64::INFINITY, f64::min)
}

/// The part of a convex polygon on one side of a meridian: east of it where `side` is positive.
fn half(corners: &[Lla], line_deg: f64, side: f64) -> Vec<Lla> {
    let inward = |corner: &Lla| (corner.longitude_deg - line_deg) * side;
    let mut part = Vec::with_capacity(corners.len() + 2);
    for (from, to) in corners.iter().zip(corners.iter().cycle().skip(1)) {
        let (a, b) = (inward(from), inward(to));
        if a >= 0.0 {
            part.push(*from);
        }
        if a * b < 0.0 {
            let share = a / (a - b);
            let between = |from: f64, to: f64| from + share * (to - from);
            part.push(Lla {
                longitude_deg: line_deg,
                latitude_deg: between(from.latitude_deg, to.latitude_deg),
                height_m: between(from.height_m, to.height_m),
            });
        }
    }
    part
}

#[cfg(test)]
mod tests {
    use super::*;

    fn square(west: f64, east: f64) -> Vec<Lla> {
        [(west, 0.0), (east, 0.0), (east, 2.0), (west, 2.0)]
            .map(|(longitude_deg, latitude_deg)| Lla { latitude_deg, longitude_deg, height_m: longitude_deg.abs() })
            .to_vec()
    }

    fn places(parts: &[Vec<Lla>]) -> Vec<Vec<[f64; 2]>> {
        let place = |corner: &Lla| [corner.longitude_deg, corner.latitude_deg];
        parts.iter().map(|part| part.iter().map(place).collect()).collect()
    }

    #[test]
    fn a_square_across_is_two() {
        let west = vec![[179.0, 0.0], [180.0, 0.0], [180.0, 2.0], [179.0, 2.0]];
        let east = vec![[-180.0, 0.0], [-177.0, 0.0], [-177.0, 2.0], [-180.0, 2.0]];
        assert_eq!(places(&cut(&square(179.0, -177.0))), [west.clone(), east]);
        // From the other side on.
        let mut turned = square(179.0, -177.0);
        turned.rotate_left(1);
        let parts = cut(&turned);
        assert_eq!(parts.len(), 2);
        let widths: Vec<f64> = parts.iter().map(|part| width_deg(part)).collect();
        assert_eq!(widths, [3.0, 1.0]);
        // Heights go on evenly from 179 m to 177 m.
        assert!(parts[0].iter().any(|corner| (corner.height_m - 178.5).abs() < 1e-9), "{parts:?}");
    }

    #[test]
    fn one_that_touches_the_line_or_is_elsewhere_stays_one() {
        for (west, east) in
            [(8.0, 9.0), (-0.5, 0.5), (179.0, 180.0), (-180.0, -179.0), (179.0, -180.0), (180.0, -179.0)]
        {
            let parts = cut(&square(west, east));
            assert_eq!(parts.len(), 1, "{west} to {east}: {parts:?}");
            assert!(width_deg(&parts[0]) < 2.0, "{west} to {east}: {parts:?}");
        }
        assert!(cut(&[]).is_empty());
    }
}
