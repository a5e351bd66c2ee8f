//! The frame of a reconstruction: OpenSfM's own is local, east-north-up about the reference; ODM rewrites it to UTM.

use super::gnss;
use super::json::Component;
use crate::geometry::Pose;
use crate::reconstruction::ReconstructionError;
use heliomap_model::{GeodeticReference, Lla};
use nalgebra::{Matrix3, Rotation3, Vector3};
use proj4rs::Proj;
use proj4rs::transform::transform;
use std::path::Path;

/// Coordinates larger than this are not local, metres: they count from the origin of a projection.
const MAX_LOCAL_M: f64 = 100_000.0;
/// How far whole UTM coordinates may lie from the reference, metres.
const MAX_FROM_REFERENCE_M: f64 = 50_000.0;
/// Step by which the frame's axes are measured, metres.
const STEP_M: f64 = 100.0;
/// A convergence below this is not looked for, radians (0.02 degrees): it moves a plant of 500 m by less than 0.1 m.
const MIN_CONVERGENCE_RAD: f64 = 3.5e-4;
/// Fewest shots with GNSS that show a turn.
const MIN_GNSS_SHOTS: usize = 4;

/// From the world of the file to the local east-north-up frame.
pub(super) enum Frame {
    /// The world is the local frame.
    Local,
    Projected(Box<Projected>),
}

/// A world in UTM less an offset.
pub(super) struct Projected {
    projection: Proj,
    geographic: Proj,
    /// What was taken off easting, northing and height.
    offset_m: Vector3<f64>,
    reference: GeodeticReference,
    /// Rotation of the local frame against the world's axes (the grid's convergence), at the origin of the world.
    local_from_world: Rotation3<f64>,
}

impl Frame {
    /// The frame of `components`, read from `path`. `georeferencing` is ODM's `odm_georeferencing` folder, where `path` is the
    /// reconstruction that ODM has rewritten.
    ///
    /// # Errors
    /// Coordinates that are not local and belong to no UTM zone about the reference.
    pub(super) fn of(
        path: &Path,
        components: &[Component],
        reference: GeodeticReference,
        georeferencing: Option<&Path>,
    ) -> Result<Self, ReconstructionError> {
        if let Some(folder) = georeferencing
            && let Some((definition, offset_m)) = coords(&folder.join("coords.txt"))
        {
            let offset_m = Vector3::new(offset_m[0], offset_m[1], 0.0);
            return Ok(Self::Projected(Box::new(Projected::new(path, &definition, offset_m, reference)?)));
        }
        let centers: Vec<Vector3<f64>> = components
            .iter()
            .flat_map(|component| component.shots.values())
            .map(|shot| Pose::from_axis_angle(shot.rotation.into(), shot.translation.into()).center())
            .collect();
        let mean = centers.iter().sum::<Vector3<f64>>() / centers.len().max(1) as f64;
        if mean.xy().norm() <= MAX_LOCAL_M {
            let shifted = Projected::with_unknown_offset(path, components, reference)?;
            return Ok(shifted.map_or(Self::Local, |projected| Self::Projected(Box::new(projected))));
        }
        let projected = Projected::new(path, &utm_of(reference), Vector3::zeros(), reference)?;
        let from_reference_m = projected.enu_m(mean).map_or(f64::INFINITY, |enu_m| enu_m.xy().norm());
        if from_reference_m > MAX_FROM_REFERENCE_M {
            return Err(ReconstructionError::NotLocal { path: path.to_owned(), east_m: mean.x, north_m: mean.y });
        }
        Ok(Self::Projected(Box::new(projected)))
    }

    /// A point of the world in the local frame, metres; `None` where it is nowhere on earth.
    pub(super) fn point(&self, world_m: Vector3<f64>) -> Option<Vector3<f64>> {
        match self {
            Self::Local => Some(world_m),
            Self::Projected(projected) => projected.enu_m(world_m),
        }
    }

    /// A pose of the world in the local frame.
    pub(super) fn pose(&self, pose: Pose) -> Option<Pose> {
        match self {
            Self::Local => Some(pose),
            Self::Projected(projected) => {
                let rotation = pose.camera_from_world * projected.local_from_world.inverse();
                let center_m = projected.enu_m(pose.center())?;
                Some(Pose { camera_from_world: rotation, translation_m: -(rotation * center_m) })
            }
        }
    }
}

impl Projected {
    fn new(
        path: &Path,
        definition: &str,
        offset_m: Vector3<f64>,
        reference: GeodeticReference,
    ) -> Result<Self, ReconstructionError> {
        let parsed = |text: &str| {
            Proj::from_proj_string(text).map_err(|error| ReconstructionError::Malformed {
                path: path.to_owned(),
                what: format!(
                    "its projection `{}` cannot be used: {error}",
                    text.chars().take(100).collect::<String>()
                ),
            })
        };
        let mut frame = Self {
            projection: parsed(definition)?,
            geographic: parsed("+proj=longlat +datum=WGS84 +no_defs")?,
            offset_m,
            reference,
            local_from_world: Rotation3::identity(),
        };
        let origin = frame.world_at(reference.origin);
        let axis =
            |direction: Vector3<f64>| Some((frame.enu_m(origin + direction * STEP_M)? - frame.enu_m(origin)?) / STEP_M);
        let axes = [axis(Vector3::x()), axis(Vector3::y()), axis(Vector3::z())];
        let [Some(x), Some(y), Some(z)] = axes else {
            return Err(ReconstructionError::NotLocal { path: path.to_owned(), east_m: origin.x, north_m: origin.y });
        };
        // Scale and shear of the projection stay in the positions; a camera takes the rotation alone.
        let svd = Matrix3::from_columns(&[x, y, z]).svd(true, true);
        if let (Some(u), Some(v_t)) = (svd.u, svd.v_t) {
            frame.local_from_world = Rotation3::from_matrix_unchecked(u * v_t);
        }
        Ok(frame)
    }

    /// UTM less an offset that no file states, as OpenSfM's `export_geocoords` leaves it; `None` where the world is local.
    /// OpenSfM aligns a local world with GNSS, so its cameras are not turned against their GNSS positions. In UTM they are
    /// turned by the grid's convergence. The offset follows from the GNSS positions.
    fn with_unknown_offset(
        path: &Path,
        components: &[Component],
        reference: GeodeticReference,
    ) -> Result<Option<Self>, ReconstructionError> {
        let shots = components.iter().flat_map(|component| component.shots.values());
        let pairs: Vec<(Vector3<f64>, Vector3<f64>)> = shots
            .filter_map(|shot| {
                let center = Pose::from_axis_angle(shot.rotation.into(), shot.translation.into()).center();
                Some((center, gnss(shot)?)).filter(|_| center.iter().all(|value| value.is_finite()))
            })
            .collect();
        if pairs.len() < MIN_GNSS_SHOTS {
            return Ok(None);
        }
        let mut frame = Self::new(path, &utm_of(reference), Vector3::zeros(), reference)?;
        let east = frame.local_from_world * Vector3::x();
        let convergence_rad = east.y.atan2(east.x);
        let (world, gnss_enu_m) = means(&pairs);
        let turn_rad = turn(&pairs, world, gnss_enu_m);
        if convergence_rad.abs() < MIN_CONVERGENCE_RAD || (turn_rad - convergence_rad).abs() > turn_rad.abs() / 3.0 {
            return Ok(None);
        }
        frame.offset_m = frame.world_at(reference.lla_from_enu(gnss_enu_m)) - world;
        Ok(Some(frame))
    }

    /// A place in the world, metres.
    fn world_at(&self, place: Lla) -> Vector3<f64> {
        let mut point = (place.longitude_deg.to_radians(), place.latitude_deg.to_radians(), 0.0);
        match transform(&self.geographic, &self.projection, &mut point) {
            Ok(()) => Vector3::new(point.0, point.1, place.height_m) - self.offset_m,
            Err(_) => Vector3::zeros(),
        }
    }

    fn enu_m(&self, world_m: Vector3<f64>) -> Option<Vector3<f64>> {
        let projected_m = world_m + self.offset_m;
        let mut point = (projected_m.x, projected_m.y, 0.0);
        transform(&self.projection, &self.geographic, &mut point).ok()?;
        let position =
            Lla { longitude_deg: point.0.to_degrees(), latitude_deg: point.1.to_degrees(), height_m: projected_m.z };
        let enu_m = self.reference.enu_from_lla(position);
        enu_m.iter().all(|value| value.is_finite()).then_some(enu_m)
    }
}

/// Means of both sides of `pairs`, metres.
fn means(pairs: &[(Vector3<f64>, Vector3<f64>)]) -> (Vector3<f64>, Vector3<f64>) {
    let sum =
        |sums: (Vector3<f64>, Vector3<f64>), pair: &(Vector3<f64>, Vector3<f64>)| (sums.0 + pair.0, sums.1 + pair.1);
    let (first, second) = pairs.iter().fold((Vector3::zeros(), Vector3::zeros()), sum);
    let count = pairs.len().max(1) as f64;
    (first / count, second / count)
}

/// The angle about the vertical that turns the first points of `pairs` onto the second by least squares, radians.
fn turn(pairs: &[(Vector3<f64>, Vector3<f64>)], first_mean: Vector3<f64>, second_mean: Vector3<f64>) -> f64 {
    let (mut sine, mut cosine) = (0.0, 0.0);
    for (first, second) in pairs {
        let (first, second) = (first - first_mean, second - second_mean);
        cosine += first.x * second.x + first.y * second.y;
        sine += first.x * second.y - first.y * second.x;
    }
    sine.atan2(cosine)
}

/// The projection and offset of ODM's `coords.txt`: `WGS84 UTM 33N`, then the offset east and north, metres.
fn coords(path: &Path) -> Option<(String, [f64; 2])> {
    let text = std::fs::read_to_string(path).ok()?;
    let mut lines = text.lines();
    let zone = lines.next()?.trim().strip_prefix("WGS84 UTM ")?;
    let (number, south) = match zone.strip_suffix('S') {
        Some(number) => (number, true),
        None => (zone.strip_suffix('N')?, false),
    };
    let number: u8 = number.parse().ok().filter(|number| (1..=60).contains(number))?;
    let mut offsets = lines.next()?.split_ascii_whitespace().map(str::parse::<f64>);
    let offset_m = [offsets.next()?.ok()?, offsets.next()?.ok()?];
    Some((utm(number, south), offset_m))
}

/// The UTM zone of a place.
fn utm_of(reference: GeodeticReference) -> String {
    let longitude_deg = (reference.origin.longitude_deg + 180.0).rem_euclid(360.0) - 180.0;
    let number = ((longitude_deg + 180.0) / 6.0).floor().clamp(0.0, 59.0) as u8 + 1;
    utm(number, reference.origin.latitude_deg < 0.0)
}

fn utm(zone: u8, south: bool) -> String {
    let south = if south { " +south" } else { "" };
    format!("+proj=utm +zone={zone}{south} +datum=WGS84 +units=m +no_defs")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn utm_is_undone_to_a_millimetre_and_a_microradian() {
        // PROJ 9 gives (428979.8554, 5519085.3154) for longitude 14.0127, latitude 49.82 in EPSG:32633.
        let reference = GeodeticReference::new(Lla { latitude_deg: 49.82, longitude_deg: 14.0127, height_m: 0.0 });
        let frame = Projected::new(
            Path::new("r.json"),
            &utm_of(reference),
            Vector3::new(428_000.0, 5_518_000.0, 0.0),
            reference,
        )
        .unwrap();
        let origin = frame.world_at(reference.origin);
        assert!((origin - Vector3::new(979.8554, 1085.3154, 0.0)).norm() < 1e-3, "{origin}");
        assert!(frame.enu_m(origin).unwrap().norm() < 1e-3);
        // East of the grid is turned by the convergence, (longitude - 15) * sin(latitude), against east.
        let convergence = (14.0127_f64 - 15.0).to_radians() * 49.82_f64.to_radians().sin();
        let east = frame.local_from_world * Vector3::x();
        assert!((east.y.atan2(east.x).abs() - convergence.abs()).abs() < 1e-5, "{east} against {convergence}");
        let scale = (frame.enu_m(origin + Vector3::x() * 100.0).unwrap().norm() - 100.0) / 100.0;
        assert!((scale - 0.0003).abs() < 0.0002, "{scale}");
    }
}
