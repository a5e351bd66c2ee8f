//! Reads what OpenSfM leaves in its project folder, and the project folder of ODM, which holds that of OpenSfM.

mod cameras;
pub mod check;
mod frame;
mod json;
mod photos;

use super::error::ReconstructionError;
use super::photo::{Photo, PhotoError, file_name};
use super::{Note, Project, ProjectFolder, ReadError, Reconstruction, Shot, plausible, ply};
use crate::geometry::{Camera, Pose};
use cameras::{camera, is_known};
use frame::Frame;
use heliomap_model::{GeodeticReference, Lla};
use json::{CameraEntry, Component, ReferenceEntry, ShotEntry, read_components, read_small};
use nalgebra::Vector3;
use photos::{PhotoFinder, Undistorted};
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// Fewest sparse points by which modules can be placed without a dense cloud.
const MIN_SPARSE_POINTS: usize = 16;
/// A dilution of precision from here on says that there was no GNSS fix (OpenSfM writes 999999).
const NO_FIX_DOP: f64 = 999.0;

/// Where the files of a project lie.
struct ProjectFiles {
    /// Of the cameras, shots and points.
    reconstruction: PathBuf,
    reference: PathBuf,
    undistorted: PathBuf,
    /// The undistorted images, relative to the project folder.
    undistorted_images: PathBuf,
    /// ODM's offset and projection, where `reconstruction` is in them.
    georeferencing: Option<PathBuf>,
}

impl ProjectFiles {
    /// The files of OpenSfM in `folder`, or in its `opensfm/` where ODM made it.
    fn find(folder: &Path) -> Result<Self, ReconstructionError> {
        let missing = folder.join("reconstruction.json");
        for base in ["", "opensfm"] {
            let inner = folder.join(base);
            let undistorted = inner.join("undistorted");
            let files = |reconstruction: PathBuf, georeferencing: Option<PathBuf>| Self {
                reconstruction,
                reference: inner.join("reference_lla.json"),
                undistorted: undistorted.join("reconstruction.json"),
                undistorted_images: Path::new(base).join("undistorted").join("images"),
                georeferencing,
            };
            // ODM keeps the local frame aside when it rewrites reconstruction.json to UTM.
            let local = inner.join("reconstruction.topocentric.json");
            if local.is_file() {
                return Ok(files(local, None));
            }
            let plain = inner.join("reconstruction.json");
            if plain.is_file() {
                let georeferencing = folder.join("odm_georeferencing");
                return Ok(files(plain, georeferencing.is_dir().then_some(georeferencing)));
            }
            if undistorted.join("reconstruction.json").is_file() {
                return Ok(files(undistorted.join("reconstruction.json"), None));
            }
        }
        Err(ReconstructionError::Missing { path: missing })
    }

    fn cloud(&self) -> PathBuf {
        self.undistorted.with_file_name("depthmaps").join("merged.ply")
    }
}

/// Reads the project in `folder`: poses, cameras, reference, points, and which photo belongs to which shot. Photos are
/// checked by their headers, not decoded.
///
/// # Errors
/// What is missing, broken or does not fit together, by file and with what to do.
pub fn read(project: &dyn ProjectFolder, max_pixels: u64) -> Result<Project, ReadError> {
    let files = ProjectFiles::find(project.path())?;
    let source = &files.reconstruction;
    let components = read_components(source)?;
    let shot_count: usize = components.iter().map(|component| component.shots.len()).sum();
    if shot_count < 2 {
        return Err(ReconstructionError::TooFewShots { path: source.clone(), found: shot_count }.into());
    }
    let mut notes = Vec::new();
    notes.extend(several_components(&components));
    let reference = read_reference(&files.reference, source, &components)?;
    let frame = Frame::of(source, &components, reference, files.georeferencing.as_deref())?;
    let finder = PhotoFinder::new(project, undistorted(&files)?, max_pixels);
    let (shots, photos) = read_shots(project, source, &components, &frame, &finder, &mut notes)?;
    let sparse_points_m: Vec<Vector3<f64>> = components
        .iter()
        .flat_map(|component| component.points.values())
        .filter_map(|point| frame.point(point.coordinates.into()))
        .filter(|point| point.iter().all(|value| value.is_finite()))
        .collect();
    let cloud_path = files.cloud();
    let dense = if cloud_path.is_file() { Some(ply::read(&cloud_path)?) } else { None };
    if dense.is_none() {
        if sparse_points_m.len() < MIN_SPARSE_POINTS {
            return Err(ReconstructionError::NoPoints { cloud: cloud_path, reconstruction: source.clone() }.into());
        }
        notes.push(Note {
            code: "no_dense_cloud",
            message: "undistorted/depthmaps/merged.ply is not there: modules are located by the sparse points and by \
                      triangulation alone"
                .to_owned(),
        });
    }
    let georeferenced = is_georeferenced(reference, &shots);
    let reconstruction = Reconstruction { reference, georeferenced, shots, sparse_points_m, dense };
    plausible::check_cloud(&cloud_path, &reconstruction)?;
    notes.extend(plausible::far_from_gnss(&reconstruction));
    Ok(Project { reconstruction, photos, notes })
}

/// The shots with their photos, sorted by name. Shots of cameras that cannot be read are left out with a note.
fn read_shots(
    project: &dyn ProjectFolder,
    source: &Path,
    components: &[Component],
    frame: &Frame,
    finder: &PhotoFinder<'_>,
    notes: &mut Vec<Note>,
) -> Result<(Vec<Shot>, Vec<Photo>), ReadError> {
    let mut pairs: Vec<(Shot, Photo)> = Vec::new();
    let (mut missing, mut unreadable): (Vec<&str>, Vec<(&str, &str)>) = (Vec::new(), Vec::new());
    let mut names = BTreeSet::new();
    for component in components {
        for (name, entry) in component.shots.iter().filter(|(name, _)| names.insert(name.as_str())) {
            let camera_entry = camera_of(source, components, component, name, entry)?;
            if !is_known(camera_entry) {
                unreadable.push((name, &entry.camera));
                continue;
            }
            let original = camera(source, &entry.camera, camera_entry)?;
            let Some(found) = finder.find(name, &original, notes)? else {
                missing.push(name);
                continue;
            };
            let pose = pose(source, name, entry, frame)?;
            let path = project.path().join(found.place);
            let photo = Photo { shot: name.clone(), path, header: found.header, camera: found.camera };
            let shot = Shot { name: name.clone(), camera: photo.undistorted_camera(), pose, gnss_enu_m: gnss(entry) };
            pairs.push((shot, photo));
        }
    }
    if let Some((name, camera_name)) = unreadable.first() {
        if pairs.len() < 2 {
            // Refused by the name of the model.
            let entry = components.iter().find_map(|component| component.cameras.get(*camera_name));
            entry.map_or(Ok(()), |entry| camera(source, camera_name, entry).map(drop))?;
        }
        notes.push(Note {
            code: "shots_left_out",
            message: format!(
                "{} shots, such as {name}, were taken by a camera of a model that cannot be read (`{camera_name}`, perhaps a \
                 panorama) and are left out",
                unreadable.len()
            ),
        });
    }
    if !missing.is_empty() {
        return Err(missing_photos(project, source, &missing, names.len() - unreadable.len()));
    }
    pairs.sort_by(|a, b| a.0.name.cmp(&b.0.name));
    Ok(pairs.into_iter().unzip())
}

fn camera_of<'a>(
    source: &Path,
    components: &'a [Component],
    component: &'a Component,
    shot: &str,
    entry: &ShotEntry,
) -> Result<&'a CameraEntry, ReconstructionError> {
    let elsewhere = || components.iter().find_map(|component| component.cameras.get(&entry.camera));
    component.cameras.get(&entry.camera).or_else(elsewhere).ok_or_else(|| ReconstructionError::Malformed {
        path: source.to_owned(),
        what: format!("shot {shot} names camera `{}`, which is not there", entry.camera),
    })
}

fn pose(source: &Path, shot: &str, entry: &ShotEntry, frame: &Frame) -> Result<Pose, ReconstructionError> {
    let world = Pose::from_axis_angle(entry.rotation.into(), entry.translation.into());
    let finite = entry.rotation.iter().chain(&entry.translation).all(|value| value.is_finite());
    let local = if finite { frame.pose(world) } else { None };
    local.ok_or_else(|| ReconstructionError::NotFinite {
        path: source.to_owned(),
        value: "a number that is not finite".to_owned(),
        place: format!("pose of shot {shot}"),
    })
}

/// The GNSS position of a shot, local frame, metres, where there was a fix. OpenSfM keeps it local in every frame of the
/// reconstruction.
fn gnss(entry: &ShotEntry) -> Option<Vector3<f64>> {
    entry
        .gps_position
        .filter(|position| position.iter().all(|value| value.is_finite()))
        .filter(|_| entry.gps_dop.is_none_or(|dop| dop < NO_FIX_DOP))
        .map(Vector3::from)
}

/// Whether place and scale are known: OpenSfM leaves the reference at 0, 0 where no photo has a GNSS position, and the scale
/// to chance.
fn is_georeferenced(reference: GeodeticReference, shots: &[Shot]) -> bool {
    let Lla { latitude_deg, longitude_deg, .. } = reference.origin;
    shots.iter().any(|shot| shot.gnss_enu_m.is_some()) || latitude_deg != 0.0 || longitude_deg != 0.0
}

fn several_components(components: &[Component]) -> Option<Note> {
    let counts = components.iter().map(|component| component.shots.len()).filter(|shots| *shots > 0);
    let sizes: Vec<String> = counts.map(|shots| shots.to_string()).collect();
    (sizes.len() > 1).then(|| Note {
        code: "several_components",
        message: format!(
            "reconstruction.json holds {} components of {} shots, tied to each other by GNSS alone: benches seen from two of \
             them may not fit together; fly with more overlap and reconstruct again",
            sizes.len(),
            sizes.join(" and ")
        ),
    })
}

/// The undistorted images: their names and cameras, as far as files list them.
fn undistorted(files: &ProjectFiles) -> Result<Undistorted, ReconstructionError> {
    let mut undistorted = Undistorted { images: files.undistorted_images.clone(), ..Undistorted::default() };
    let names = files.undistorted.with_file_name("undistorted_shot_ids.json");
    if names.is_file() {
        undistorted.names = read_small(&names)?;
    }
    if files.undistorted.is_file() {
        let components = read_components(&files.undistorted)?;
        let mut known: BTreeMap<&str, Camera> = BTreeMap::new();
        for (name, entry) in components.iter().flat_map(|component| &component.cameras) {
            if is_known(entry) {
                known.insert(name, camera(&files.undistorted, name, entry)?);
            }
        }
        let shots = components.iter().flat_map(|component| &component.shots);
        let cameras = shots.filter_map(|(name, shot)| Some((name.clone(), *known.get(shot.camera.as_str())?)));
        undistorted.cameras = cameras.collect();
    }
    Ok(undistorted)
}

fn read_reference(
    path: &Path,
    source: &Path,
    components: &[Component],
) -> Result<GeodeticReference, ReconstructionError> {
    let (entry, path) = if path.is_file() {
        (read_small::<ReferenceEntry>(path)?, path.to_owned())
    } else if let Some(entry) = components.iter().find_map(|component| component.reference_lla) {
        (entry, source.to_owned())
    } else {
        return Err(ReconstructionError::Missing { path: path.to_owned() });
    };
    place_on_earth(entry, path)
}

/// The reference that `entry` of the file at `path` names.
fn place_on_earth(entry: ReferenceEntry, path: PathBuf) -> Result<GeodeticReference, ReconstructionError> {
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

fn missing_photos(project: &dyn ProjectFolder, source: &Path, missing: &[&str], shots: usize) -> ReadError {
    let source = file_name(source);
    if missing.len() == shots {
        return ReadError::OtherImages {
            reconstruction: source,
            shot: missing[0].to_owned(),
            image: project.images().first().map_or_else(|| "none at all".to_owned(), |place| file_name(place)),
        };
    }
    ReadError::ShotWithoutImage {
        reconstruction: source,
        shots: missing.iter().take(5).map(|name| (*name).to_owned()).collect::<Vec<_>>().join(", "),
        count: missing.len(),
    }
}

impl From<PhotoError> for ReadError {
    fn from(error: PhotoError) -> Self {
        Self::Photo(error)
    }
}
