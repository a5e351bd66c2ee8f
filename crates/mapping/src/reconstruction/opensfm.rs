//! Reads what OpenSfM leaves in its project folder.

use super::error::ReconstructionError;
use super::photo::{Photo, PhotoError, PhotoHeader, file_name};
use super::{Project, ProjectFolder, Reconstruction, Shot, ply};
use crate::geometry::camera::Lens;
use crate::geometry::{Camera, Pose};
use heliomap_model::{GeodeticReference, Lla};
use nalgebra::Vector3;
use serde::Deserialize;
use serde::de::DeserializeOwned;
use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

const MAX_JSON_BYTES: u64 = 4 << 30;
const MAX_REFERENCE_BYTES: u64 = 1 << 20;

#[derive(Deserialize)]
struct Component {
    cameras: BTreeMap<String, CameraEntry>,
    shots: BTreeMap<String, ShotEntry>,
    #[serde(default)]
    points: BTreeMap<String, PointEntry>,
    #[serde(default)]
    reference_lla: Option<ReferenceEntry>,
}

#[derive(Deserialize)]
struct CameraEntry {
    projection_type: String,
    width: u32,
    height: u32,
    focal: Option<f64>,
    focal_x: Option<f64>,
    focal_y: Option<f64>,
    c_x: Option<f64>,
    c_y: Option<f64>,
    k1: Option<f64>,
    k2: Option<f64>,
    k3: Option<f64>,
    k4: Option<f64>,
    p1: Option<f64>,
    p2: Option<f64>,
}

#[derive(Deserialize)]
struct ShotEntry {
    rotation: [f64; 3],
    translation: [f64; 3],
    camera: String,
    #[serde(default)]
    gps_position: Option<[f64; 3]>,
    #[serde(default)]
    gps_dop: Option<f64>,
}

#[derive(Deserialize)]
struct PointEntry {
    coordinates: [f64; 3],
}

#[derive(Deserialize, Clone, Copy)]
struct ReferenceEntry {
    latitude: f64,
    longitude: f64,
    altitude: f64,
}

/// Reads the project in `folder`: poses, cameras, reference, points, and which photo belongs to which shot. Photos are
/// checked by their headers, not decoded.
///
/// # Errors
/// What is missing, broken or does not fit together, by file and with what to do.
pub fn read(project: &dyn ProjectFolder, max_pixels: u64) -> Result<Project, super::ReadError> {
    let folder = project.path();
    let original = folder.join("reconstruction.json");
    let undistorted = folder.join("undistorted").join("reconstruction.json");
    if !original.is_file() && !undistorted.is_file() {
        return Err(ReconstructionError::Missing { path: original }.into());
    }
    let source = if original.is_file() { &original } else { &undistorted };
    let components: Vec<Component> = read_json(source, MAX_JSON_BYTES)?;
    let undistorted_components: Option<Vec<Component>> =
        if original.is_file() && undistorted.is_file() { Some(read_json(&undistorted, MAX_JSON_BYTES)?) } else { None };
    let mut notes = Vec::new();
    let reference = read_reference(folder, source, &components)?;
    let shot_count: usize = components.iter().map(|component| component.shots.len()).sum();
    if shot_count < 2 {
        return Err(ReconstructionError::TooFewShots { path: source.clone(), found: shot_count }.into());
    }
    if components.len() > 1 {
        let sizes: Vec<String> = components.iter().map(|component| component.shots.len().to_string()).collect();
        notes.push(crate::reconstruction::Note {
            code: "several_components",
            message: format!(
                "reconstruction.json holds {} components of {} shots, tied to each other by GNSS alone: benches seen from \
                 two of them may not fit together; fly with more overlap and reconstruct again",
                components.len(),
                sizes.join(" and ")
            ),
        });
    }

    let cameras_of_file =
        |components: &[Component], path: &Path| -> Result<BTreeMap<String, Camera>, ReconstructionError> {
            let mut cameras = BTreeMap::new();
            for component in components {
                for (name, entry) in &component.cameras {
                    cameras.insert(name.clone(), camera(path, name, entry)?);
                }
            }
            Ok(cameras)
        };
    let cameras = cameras_of_file(&components, source)?;
    // The camera of a shot's undistorted image, where the undistorted set says it.
    let mut undistorted_camera_of: BTreeMap<&str, Camera> = BTreeMap::new();
    if let Some(set) = &undistorted_components {
        let set_cameras = cameras_of_file(set, &undistorted)?;
        for (name, shot) in set.iter().flat_map(|component| &component.shots) {
            if let Some(camera) = set_cameras.get(&shot.camera) {
                undistorted_camera_of.insert(name, *camera);
            }
        }
    }

    let mut shots = Vec::with_capacity(shot_count);
    let mut photos = Vec::with_capacity(shot_count);
    let mut missing: Vec<&str> = Vec::new();
    let mut seen = BTreeSet::new();
    let mut sparse_points_m = Vec::new();
    for component in &components {
        for (name, entry) in &component.shots {
            if !seen.insert(name.as_str()) {
                continue;
            }
            let finite = entry.rotation.iter().chain(&entry.translation).all(|value| value.is_finite());
            if !finite {
                return Err(ReconstructionError::NotFinite {
                    path: source.clone(),
                    value: "a number that is not finite".to_owned(),
                    place: format!("pose of shot {name}"),
                }
                .into());
            }
            let own = *cameras.get(&entry.camera).ok_or_else(|| ReconstructionError::Malformed {
                path: source.clone(),
                what: format!("shot {name} names camera `{}`, which is not there", entry.camera),
            })?;
            let flat = undistorted_camera_of.get(name.as_str()).copied().unwrap_or_else(|| own.undistorted());
            let Some((place, stored, header)) = find_photo(project, name, own, flat, max_pixels)? else {
                missing.push(name);
                continue;
            };
            let camera = fitted(&stored, name, header, &mut notes);
            let photo = Photo { shot: name.clone(), path: folder.join(place), header, camera };
            shots.push(Shot {
                name: name.clone(),
                camera: photo.undistorted_camera(),
                pose: Pose::from_axis_angle(entry.rotation.into(), entry.translation.into()),
                gnss_enu_m: entry
                    .gps_position
                    .filter(|position| position.iter().all(|value| value.is_finite()))
                    .filter(|_| entry.gps_dop.is_none_or(|dop| dop < 999.0))
                    .map(Vector3::from),
            });
            photos.push(photo);
        }
        sparse_points_m.extend(
            component
                .points
                .values()
                .map(|point| Vector3::from(point.coordinates))
                .filter(|point| point.iter().all(|value| value.is_finite())),
        );
    }
    if !missing.is_empty() {
        return Err(missing_photos(project, source, &missing, shot_count));
    }
    shots.sort_by(|a, b| a.name.cmp(&b.name));
    photos.sort_by(|a, b| a.shot.cmp(&b.shot));

    let cloud_path = folder.join("undistorted").join("depthmaps").join("merged.ply");
    let dense = if cloud_path.is_file() { Some(ply::read(&cloud_path)?) } else { None };
    if dense.is_none() {
        if sparse_points_m.len() < 16 {
            return Err(ReconstructionError::NoPoints { cloud: cloud_path, reconstruction: source.clone() }.into());
        }
        notes.push(crate::reconstruction::Note {
            code: "no_dense_cloud",
            message: "undistorted/depthmaps/merged.ply is not there: modules are located by the sparse points and by \
                      triangulation alone"
                .to_owned(),
        });
    }
    let reconstruction = Reconstruction { reference, shots, sparse_points_m, dense };
    notes.extend(implausible_gnss(&reconstruction));
    Ok(Project { reconstruction, photos, notes })
}

/// Reads a JSON file whole, its size bounded.
fn read_json<T: DeserializeOwned>(path: &Path, limit: u64) -> Result<T, ReconstructionError> {
    let unreadable = |source| ReconstructionError::Unreadable { path: path.to_owned(), source };
    let file = File::open(path).map_err(unreadable)?;
    let bytes = file.metadata().map_err(unreadable)?.len();
    if bytes > limit {
        return Err(ReconstructionError::TooLarge { path: path.to_owned(), bytes, limit });
    }
    let mut text = Vec::with_capacity(bytes as usize);
    file.take(limit).read_to_end(&mut text).map_err(unreadable)?;
    serde_json::from_slice(&text).map_err(|error| {
        // Python writes NaN and Infinity, which JSON does not know.
        let line = text.split(|byte| *byte == b'\n').nth(error.line().saturating_sub(1)).unwrap_or(&[]);
        let around = &line[error.column().saturating_sub(12).min(line.len())..(error.column() + 12).min(line.len())];
        for word in ["NaN", "Infinity"] {
            if error.is_syntax() && around.windows(word.len()).any(|window| window == word.as_bytes()) {
                return ReconstructionError::NotFinite {
                    path: path.to_owned(),
                    value: word.to_owned(),
                    place: format!("line {}, column {}", error.line(), error.column()),
                };
            }
        }
        ReconstructionError::Malformed { path: path.to_owned(), what: error.to_string() }
    })
}

fn read_reference(
    folder: &Path,
    source: &Path,
    components: &[Component],
) -> Result<GeodeticReference, ReconstructionError> {
    let path = folder.join("reference_lla.json");
    let (entry, path) = if path.is_file() {
        (read_json::<ReferenceEntry>(&path, MAX_REFERENCE_BYTES)?, path)
    } else if let Some(entry) = components.iter().find_map(|component| component.reference_lla) {
        (entry, source.to_owned())
    } else {
        return Err(ReconstructionError::Missing { path });
    };
    let finite = [entry.latitude, entry.longitude, entry.altitude].iter().all(|value| value.is_finite());
    if !finite || entry.latitude.abs() > 90.0 || entry.longitude.abs() > 360.0 || entry.altitude.abs() > 1e5 {
        return Err(ReconstructionError::Malformed { path, what: "its reference is no place on earth".to_owned() });
    }
    Ok(GeodeticReference::new(Lla {
        latitude_deg: entry.latitude,
        longitude_deg: entry.longitude,
        height_m: entry.altitude,
    }))
}

fn camera(path: &Path, name: &str, entry: &CameraEntry) -> Result<Camera, ReconstructionError> {
    let zero = |value: Option<f64>| value.unwrap_or(0.0);
    let lens = match entry.projection_type.as_str() {
        "perspective" | "simple_radial" | "radial" | "brown" => Lens::Radial {
            k1: zero(entry.k1),
            k2: zero(entry.k2),
            k3: zero(entry.k3),
            p1: zero(entry.p1),
            p2: zero(entry.p2),
        },
        "fisheye" | "fisheye_opencv" => {
            Lens::Fisheye { k: [zero(entry.k1), zero(entry.k2), zero(entry.k3), zero(entry.k4)] }
        }
        other => {
            return Err(ReconstructionError::UnknownCameraModel {
                path: path.to_owned(),
                camera: name.to_owned(),
                model: other.chars().take(64).collect(),
            });
        }
    };
    let malformed =
        |what: &str| ReconstructionError::Malformed { path: path.to_owned(), what: format!("camera `{name}` {what}") };
    let focal_x = entry.focal_x.or(entry.focal).ok_or_else(|| malformed("has no focal length"))?;
    let focal_y = entry.focal_y.unwrap_or(focal_x);
    let camera = Camera {
        width_px: entry.width,
        height_px: entry.height,
        focal_x,
        focal_y,
        principal_x: zero(entry.c_x),
        principal_y: zero(entry.c_y),
        lens,
    };
    let numbers = [zero(entry.k1), zero(entry.k2), zero(entry.k3), zero(entry.k4), zero(entry.p1), zero(entry.p2)];
    let sound = |focal: f64| focal.is_finite() && (1e-3..1e3).contains(&focal);
    if !sound(focal_x) || !sound(focal_y) || !camera.principal_x.is_finite() || !camera.principal_y.is_finite() {
        return Err(malformed("has a focal length or principal point that no camera has"));
    }
    if numbers.iter().any(|k| !k.is_finite() || k.abs() > 1e3) || entry.width == 0 || entry.height == 0 {
        return Err(malformed("has a distortion or size that no camera has"));
    }
    Ok(camera)
}

/// The file that shows a shot, relative to the folder, with the camera of that file and its header: the undistorted image
/// first, then the original one.
fn find_photo(
    project: &dyn ProjectFolder,
    shot: &str,
    original: Camera,
    flat: Camera,
    max_pixels: u64,
) -> Result<Option<(PathBuf, Camera, PhotoHeader)>, PhotoError> {
    if Path::new(shot).file_name().and_then(|name| name.to_str()) != Some(shot) {
        return Ok(None);
    }
    let undistorted = Path::new("undistorted").join("images");
    let undistorted = ["", ".jpg", ".tif", ".png"].map(|suffix| (undistorted.join(format!("{shot}{suffix}")), flat));
    for (place, camera) in undistorted.into_iter().chain([(Path::new("images").join(shot), original)]) {
        if let Some(header) = project.inspect(&place, max_pixels)? {
            return Ok(Some((place, camera, header)));
        }
    }
    Ok(None)
}

/// The camera at the size that the file really has; a note where the shape disagrees.
fn fitted(camera: &Camera, shot: &str, header: PhotoHeader, notes: &mut Vec<super::Note>) -> Camera {
    let (expected, found) = (
        f64::from(camera.width_px) / f64::from(camera.height_px),
        f64::from(header.width_px) / f64::from(header.height_px),
    );
    if (expected / found - 1.0).abs() > 0.01 {
        notes.push(super::Note {
            code: "image_shape_differs",
            message: format!(
                "{shot} is {} x {} pixels, but its camera was calibrated at {} x {}: is it rotated or cropped?",
                header.width_px, header.height_px, camera.width_px, camera.height_px
            ),
        });
    }
    camera.resized(header.width_px, header.height_px)
}

fn missing_photos(project: &dyn ProjectFolder, source: &Path, missing: &[&str], shots: usize) -> super::ReadError {
    let source = file_name(source);
    if missing.len() == shots {
        return super::ReadError::OtherImages {
            reconstruction: source,
            shot: missing[0].to_owned(),
            image: project.images().into_iter().next().unwrap_or_else(|| "none at all".to_owned()),
        };
    }
    super::ReadError::ShotWithoutImage {
        reconstruction: source,
        shots: missing.iter().take(5).map(|name| (*name).to_owned()).collect::<Vec<_>>().join(", "),
        count: missing.len(),
    }
}

/// Says so where the camera centres are far from where the GNSS receiver put them.
fn implausible_gnss(reconstruction: &Reconstruction) -> Option<super::Note> {
    let mut offsets: Vec<f64> =
        reconstruction.shots.iter().filter_map(|shot| Some((shot.pose.center() - shot.gnss_enu_m?).norm())).collect();
    offsets.sort_by(f64::total_cmp);
    let median = *offsets.get(offsets.len() / 2)?;
    (median > 20.0).then(|| super::Note {
        code: "far_from_gnss",
        message: format!(
            "camera centres lie {median:.0} m (median) from their GNSS positions: is reference_lla.json of the same project?"
        ),
    })
}

impl From<PhotoError> for super::ReadError {
    fn from(error: PhotoError) -> Self {
        Self::Photo(error)
    }
}
