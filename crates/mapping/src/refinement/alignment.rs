//! The model brought onto points whose true place is known: control points seen in images, or modules that were surveyed.

use super::Refined;
use crate::fusion::{Fused, View};
use crate::geometry::Similarity;
use heliomap_model::{AlignedPlace, Alignment, GeodeticReference, Lla};
use nalgebra::{Matrix3, Rotation3, Vector2, Vector3};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeSet, HashMap};

/// Most points and modules together, and most sights of one point.
const MOST_POINTS: usize = 10_000;
const MOST_SIGHTS: usize = 10_000;
/// Rays must cross at this angle at least, radians, for their point to be known.
const LEAST_ANGLE_RAD: f64 = 0.02;
/// A sight further off the triangulated point than this is of another point, pixels.
const FARTHEST_PX: f64 = 50.0;

/// What is known of places in the plant.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Control {
    /// What the heights of these places refer to, for example `EGM2008 height`; the model then states it as its own.
    pub vertical_datum: Option<String>,
    /// Points marked in images.
    pub points: Vec<ControlPoint>,
    /// Modules by label, known from a survey or a drawing.
    pub modules: Vec<ControlModule>,
}

/// A point marked in at least two images. One of `wgs84` and `enu_m` says where it is.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ControlPoint {
    pub name: String,
    /// Longitude and latitude in degrees, height in metres.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub wgs84: Option<[f64; 3]>,
    /// East, north and up in the frame of the reconstruction's reference, metres.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub enu_m: Option<[f64; 3]>,
    /// Only compared with, not used: an independent check.
    #[serde(default)]
    pub check: bool,
    pub observations: Vec<PointSight>,
}

/// Where a point is in an image.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PointSight {
    pub image: String,
    /// In the undistorted image, pixel centres at whole numbers.
    pub pixel: [f64; 2],
}

/// The middle of a module's face. One of `wgs84` and `enu_m` says where it is.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ControlModule {
    /// As the model has it, for example `L01-B02-R1-003`.
    pub label: String,
    /// Longitude and latitude in degrees, height in metres.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub wgs84: Option<[f64; 3]>,
    /// East, north and up in the frame of the reconstruction's reference, metres.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub enu_m: Option<[f64; 3]>,
    /// Only compared with, not used: an independent check.
    #[serde(default)]
    pub check: bool,
}

/// Why control cannot be used. Each sentence names the point and says what to do.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ControlError {
    #[error("control holds {found} points and modules, more than the {MOST_POINTS} allowed: give the best of them")]
    TooMany { found: usize },
    #[error("control holds no point and no module to align by: give one at least that is no check")]
    Nothing,
    #[error("control names `{name}` twice, or not at all: give every point and module a name of its own")]
    Name { name: String },
    #[error(
        "control point `{name}` needs its place in one form: `wgs84` (longitude, latitude in degrees, height in metres) or \
         `enu_m` (metres), all finite numbers"
    )]
    Place { name: String },
    #[error("control point `{name}` has {found} sights; mark it in 2 to {MOST_SIGHTS} images")]
    Sights { name: String, found: usize },
    #[error(
        "control point `{name}` is marked in {image}, which is not among the reconstructed images: correct the name"
    )]
    UnknownImage { name: String, image: String },
    #[error("control point `{name}`: pixel {x}, {y} lies outside of {image} ({width} x {height} pixels)")]
    OutsideImage { name: String, image: String, x: f64, y: f64, width: u32, height: u32 },
    #[error(
        "control point `{name}` is seen from nearly the same place in all its images: mark it in one taken elsewhere too"
    )]
    NoBase { name: String },
    #[error(
        "control point `{name}`: its mark in {image} is {off_px:.0} pixels off where the other images have it: correct it"
    )]
    Disagrees { name: String, image: String, off_px: f64 },
    #[error(
        "control names module `{label}`, which the model does not have: take a label of the model, like L01-B02-R1-003"
    )]
    UnknownModule { label: String },
    #[error(
        "the known places lie {scale:.3} times as far apart as in the reconstruction: are they of this plant, and is their \
         order longitude, latitude, height?"
    )]
    Scale { scale: f64 },
}

impl Control {
    /// Refuses what makes no sense, before any work is done.
    ///
    /// # Errors
    /// The first point or module that cannot be used, and why.
    pub fn check(&self) -> Result<(), ControlError> {
        let found = self.points.len() + self.modules.len();
        if found > MOST_POINTS {
            return Err(ControlError::TooMany { found });
        }
        if self.points.iter().all(|p| p.check) && self.modules.iter().all(|m| m.check) {
            return Err(ControlError::Nothing);
        }
        let mut names = BTreeSet::new();
        let places = self.points.iter().map(|p| (&p.name, p.wgs84, p.enu_m));
        for (name, wgs84, enu_m) in places.chain(self.modules.iter().map(|m| (&m.label, m.wgs84, m.enu_m))) {
            if name.is_empty() || !names.insert(name) {
                return Err(ControlError::Name { name: name.clone() });
            }
            let sound = match (wgs84, enu_m) {
                (Some([longitude, latitude, height]), None) => {
                    longitude.abs() <= 180.0 && latitude.abs() <= 90.0 && height.abs() <= 1e5
                }
                (None, Some(enu_m)) => enu_m.iter().all(|value| value.abs() <= 1e6),
                _ => false,
            };
            if !sound {
                return Err(ControlError::Place { name: name.clone() });
            }
        }
        for point in &self.points {
            let found = point.observations.len();
            if !(2..=MOST_SIGHTS).contains(&found) {
                return Err(ControlError::Sights { name: point.name.clone(), found });
            }
        }
        Ok(())
    }
}

/// A place in the model and where it truly is, local frame, metres.
struct Pair {
    name: String,
    used: bool,
    model_m: Vector3<f64>,
    known_m: Vector3<f64>,
}

/// Moves and turns the refined plant, and scales it if `with_scale`, so that it fits the known places best (least
/// squares), and notes what was done in `refined.alignment`. Three places off one line fix all of it; two, or several on one line, fix all but the tilt, which is kept; one
/// fixes the place alone.
///
/// # Errors
/// A place that cannot be found in the model or in the images, or that contradicts itself.
pub fn align(
    views: &[View<'_>],
    fused: &Fused,
    refined: &mut Refined,
    reference: GeodeticReference,
    control: &Control,
    with_scale: bool,
) -> Result<(), ControlError> {
    control.check()?;
    let known = |wgs84: Option<[f64; 3]>, enu_m: Option<[f64; 3]>| match (wgs84, enu_m) {
        (Some([longitude_deg, latitude_deg, height_m]), _) => {
            reference.enu_from_lla(Lla { latitude_deg, longitude_deg, height_m })
        }
        (None, enu_m) => Vector3::from(enu_m.unwrap_or_default()),
    };
    let by_name: HashMap<&str, usize> =
        views.iter().enumerate().map(|(index, view)| (view.shot.name.as_str(), index)).collect();
    let mut pairs = Vec::with_capacity(control.points.len() + control.modules.len());
    for point in &control.points {
        pairs.push(Pair {
            name: point.name.clone(),
            used: !point.check,
            model_m: triangulate(point, &by_name, views, refined)?,
            known_m: known(point.wgs84, point.enu_m),
        });
    }
    for module in &control.modules {
        let model_m = find_module(&module.label, fused, refined)
            .ok_or_else(|| ControlError::UnknownModule { label: module.label.clone() })?;
        pairs.push(Pair {
            name: module.label.clone(),
            used: !module.check,
            model_m,
            known_m: known(module.wgs84, module.enu_m),
        });
    }
    let used: Vec<(Vector3<f64>, Vector3<f64>)> =
        pairs.iter().filter(|pair| pair.used).map(|pair| (pair.model_m, pair.known_m)).collect();
    let motion = fit(&used, with_scale);
    if !(0.5..2.0).contains(&motion.scale) {
        return Err(ControlError::Scale { scale: motion.scale });
    }
    let middle = refined.middle();
    let translation_m = motion.apply(&middle) - middle;
    refined.transform(&motion);
    let places: Vec<AlignedPlace> = pairs
        .into_iter()
        .map(|pair| AlignedPlace {
            name: pair.name,
            used: pair.used,
            residual_enu_m: motion.apply(&pair.model_m) - pair.known_m,
        })
        .collect();
    let squares: f64 = places.iter().filter(|p| p.used).map(|p| p.residual_enu_m.norm_squared()).sum();
    refined.alignment = Some(Alignment {
        with_scale,
        scale: motion.scale,
        rotation_deg: motion.rotation.angle().to_degrees(),
        translation_m,
        rms_m: (squares / used.len() as f64).sqrt(),
        places,
    });
    Ok(())
}

/// The point that all rays pass nearest, in the adjusted poses.
fn triangulate(
    point: &ControlPoint,
    by_name: &HashMap<&str, usize>,
    views: &[View<'_>],
    refined: &Refined,
) -> Result<Vector3<f64>, ControlError> {
    let mut rays: Vec<(Vector3<f64>, Vector3<f64>)> = Vec::with_capacity(point.observations.len());
    for sight in &point.observations {
        let name = || point.name.clone();
        let Some(&view) = by_name.get(sight.image.as_str()) else {
            return Err(ControlError::UnknownImage { name: name(), image: sight.image.clone() });
        };
        let (camera, [x, y]) = (&views[view].shot.camera, sight.pixel);
        let (width, height) = (camera.width_px, camera.height_px);
        if !(-0.5..f64::from(width)).contains(&x) || !(-0.5..f64::from(height)).contains(&y) {
            return Err(ControlError::OutsideImage { name: name(), image: sight.image.clone(), x, y, width, height });
        }
        let pose = &refined.poses[view];
        rays.push((pose.center(), pose.direction_to_world(&camera.bearing(Vector2::new(x, y)))));
    }
    let widest = rays.iter().map(|(_, direction)| direction.angle(&rays[0].1)).fold(0.0, f64::max);
    let no_base = || ControlError::NoBase { name: point.name.clone() };
    if widest < LEAST_ANGLE_RAD {
        return Err(no_base());
    }
    let mut normal = Matrix3::zeros();
    let mut right = Vector3::zeros();
    for (center, direction) in &rays {
        let across = Matrix3::identity() - direction * direction.transpose();
        normal += across;
        right += across * center;
    }
    let place = normal.try_inverse().ok_or_else(no_base)? * right;
    for sight in &point.observations {
        let view = by_name[sight.image.as_str()];
        let seen = views[view].shot.camera.project(&refined.poses[view].to_camera(&place));
        let off_px = seen.map_or(f64::INFINITY, |seen| (seen - Vector2::from(sight.pixel)).norm());
        if off_px > FARTHEST_PX {
            return Err(ControlError::Disagrees { name: point.name.clone(), image: sight.image.clone(), off_px });
        }
    }
    Ok(place)
}

/// The middle of a module by its label.
fn find_module(label: &str, fused: &Fused, refined: &Refined) -> Option<Vector3<f64>> {
    let mut numbers = label.split('-').zip(["L", "B", "R", ""]).map(|(word, kind)| {
        let number: usize = word.strip_prefix(kind)?.parse().ok()?;
        number.checked_sub(1)
    });
    let (line, bench, row, col) = (numbers.next()??, numbers.next()??, numbers.next()??, numbers.next()??);
    if label.split('-').count() != 4 {
        return None;
    }
    let bench = *fused.lines.get(line)?.benches.get(bench)?;
    let place = (i32::try_from(row).ok()?, i32::try_from(col).ok()?);
    let module = fused.benches[bench].modules.binary_search_by_key(&place, |m| (m.row, m.col)).ok()?;
    Some(refined.benches[bench].modules[module].center_m)
}

/// The motion that the pairs (model, known) fix.
fn fit(pairs: &[(Vector3<f64>, Vector3<f64>)], with_scale: bool) -> Similarity {
    let (model, known): (Vec<_>, Vec<_>) = pairs.iter().copied().unzip();
    let count = pairs.len() as f64;
    let (from, to) = (model.iter().sum::<Vector3<f64>>() / count, known.iter().sum::<Vector3<f64>>() / count);
    // How far the places spread across their main direction: on a line they leave the tilt about it open.
    let mut scatter = Matrix3::zeros();
    for place in &model {
        scatter += (place - from) * (place - from).transpose();
    }
    let mut spread: Vec<f64> = scatter.symmetric_eigenvalues().iter().map(|value| value.max(0.0).sqrt()).collect();
    spread.sort_by(f64::total_cmp);
    if spread[1] > 0.05 * spread[2]
        && spread[1] > 1.0
        && let Some(motion) = Similarity::fit(&model, &known, with_scale)
    {
        return motion;
    }
    // About the vertical alone.
    let (mut cos, mut sin, mut size) = (0.0, 0.0, 0.0);
    for (m, k) in pairs {
        let (m, k) = ((m - from).xy(), (k - to).xy());
        cos += m.dot(&k);
        sin += m.perp(&k);
        size += m.norm_squared();
    }
    let fixed = size > 1.0;
    let rotation = Rotation3::from_axis_angle(&Vector3::z_axis(), if fixed { sin.atan2(cos) } else { 0.0 });
    let scale = if fixed && with_scale { cos.hypot(sin) / size } else { 1.0 };
    Similarity { scale, rotation, translation_m: to - scale * (rotation * from) }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn motion() -> Similarity {
        Similarity {
            scale: 1.004,
            rotation: Rotation3::new(Vector3::new(0.0, 0.0, 0.02)),
            translation_m: Vector3::new(0.8, -1.1, 2.5),
        }
    }

    fn pairs(places: &[[f64; 3]]) -> Vec<(Vector3<f64>, Vector3<f64>)> {
        places.iter().map(|p| (Vector3::from(*p), motion().apply(&Vector3::from(*p)))).collect()
    }

    #[test]
    fn few_places_fix_what_they_can() {
        let spread = pairs(&[[0.0, 0.0, 0.0], [50.0, 3.0, 1.0], [10.0, 40.0, 2.0]]);
        let line = &spread[..2];
        for given in [&spread[..], line] {
            let found = fit(given, true);
            for (model, known) in given {
                assert!((found.apply(model) - known).norm() < 1e-9);
            }
            assert!((found.scale - 1.004).abs() < 1e-4);
        }
        assert_eq!(fit(&spread, false).scale, 1.0);
        let alone = fit(&spread[1..2], true);
        assert_eq!((alone.scale, alone.rotation.angle()), (1.0, 0.0));
        assert!((alone.apply(&spread[1].0) - spread[1].1).norm() < 1e-9);
    }

    #[test]
    fn nonsense_is_refused_by_name() {
        let point = |name: &str| ControlPoint {
            name: name.to_owned(),
            wgs84: Some([14.0, 49.8, 400.0]),
            enu_m: None,
            check: false,
            observations: vec![PointSight { image: "a.jpg".to_owned(), pixel: [1.0, 2.0] }; 2],
        };
        let control = |points: Vec<ControlPoint>| Control { points, ..Control::default() };
        assert_eq!(control(vec![point("A")]).check(), Ok(()));
        assert_eq!(control(vec![]).check(), Err(ControlError::Nothing));
        assert!(matches!(control(vec![point("A"), point("A")]).check(), Err(ControlError::Name { .. })));
        let both = ControlPoint { enu_m: Some([0.0; 3]), ..point("A") };
        assert!(matches!(control(vec![both]).check(), Err(ControlError::Place { .. })));
        let swapped = ControlPoint { wgs84: Some([49.8, 114.0, 400.0]), ..point("A") };
        assert!(matches!(control(vec![swapped]).check(), Err(ControlError::Place { .. })));
        let once = ControlPoint { observations: vec![], ..point("A") };
        assert!(matches!(control(vec![once]).check(), Err(ControlError::Sights { found: 0, .. })));
        let only_check = ControlPoint { check: true, ..point("A") };
        assert_eq!(control(vec![only_check]).check(), Err(ControlError::Nothing));
    }
}
