//! The frame of a reconstruction: OpenSfM's own is local, east-north-up about the reference; ODM rewrites it to UTM.

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
    offset_m: [f64; 2],
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
            return Ok(Self::Projected(Box::new(Projected::new(path, &definition, offset_m, reference)?)));
        }
        let centers: Vec<Vector3<f64>> = components
            .iter()
            .flat_map(|component| component.shots.values())
            .map(|shot| Pose::from_axis_angle(shot.rotation.into(), shot.translation.into()).center())
            .collect();
        let mean = centers.iter().sum::<Vector3<f64>>() / centers.len().max(1) as f64;
        if mean.xy().norm() <= MAX_LOCAL_M {
            return Ok(Self::Local);
        }
        let projected = Projected::new(path, &utm_of(reference), [0.0; 2], reference)?;
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
        offset_m: [f64; 2],
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
        let origin = frame.world_at(reference);
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

    /// The reference in the world, metres.
    fn world_at(&self, reference: GeodeticReference) -> Vector3<f64> {
        let origin = reference.origin;
        let mut point = (origin.longitude_deg.to_radians(), origin.latitude_deg.to_radians(), 0.0);
        match transform(&self.geographic, &self.projection, &mut point) {
            Ok(()) => Vector3::new(point.0 - self.offset_m[0], point.1 - self.offset_m[1], origin.height_m),
            Err(_) => Vector3::zeros(),
        }
    }

    fn enu_m(&self, world_m: Vector3<f64>) -> Option<Vector3<f64>> {
        let mut point = (world_m.x + self.offset_m[0], world_m.y + self.offset_m[1], 0.0);
        transform(&self.projection, &self.geographic, &mut point).ok()?;
        let position =
            Lla { longitude_deg: point.0.to_degrees(), latitude_deg: point.1.to_degrees(), height_m: world_m.z };
        let enu_m = self.reference.enu_from_lla(position);
        enu_m.iter().all(|value| value.is_finite()).then_some(enu_m)
    }
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
        let frame =
            Projected::new(Path::new("r.json"), &utm_of(reference), [428_000.0, 5_518_000.0], reference).unwrap();
        let origin = frame.world_at(reference);
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
