//! The result as an OpenSfM project, and the report beside it.

use crate::ReconstructError;
use crate::engine::{Outcome, OutcomeComponent};
use crate::photos::{FocalSource, MIN_PHOTOS, Survey};
use nalgebra::{Matrix3, Rotation3, Vector3};
use serde::Serialize;
use serde_json::{Map, Value, json};
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

/// How well the photos were reconstructed.
#[derive(Debug, Clone, Serialize)]
pub struct Report {
    pub photos: usize,
    pub placed: usize,
    /// Shots of each component, the largest first. More than one do not hang together by common points.
    pub components: Vec<usize>,
    /// Mean residual of the points of the largest component, pixels.
    pub reprojection_px: f64,
    /// Median and largest distance of the camera centres from their GNSS positions, metres.
    pub gnss_median_m: f64,
    pub gnss_max_m: f64,
    pub cameras: Vec<CameraReport>,
    /// The placed photos, by name.
    pub shots: Vec<ShotReport>,
    /// Photos that could not be placed.
    pub not_placed: Vec<String>,
    /// What a person should know, a sentence each.
    pub warnings: Vec<String>,
}

/// A camera as it was used.
#[derive(Debug, Clone, Serialize)]
pub struct CameraReport {
    pub name: String,
    /// Pixels over the longer side.
    pub focal: f64,
    pub focal_from: FocalSource,
    pub k1: f64,
    pub k2: f64,
}

/// A placed photo.
#[derive(Debug, Clone, Serialize)]
pub struct ShotReport {
    pub name: String,
    /// Points of the reconstruction that it shows.
    pub points: usize,
    /// Median residual of these, pixels.
    pub reprojection_px: Option<f64>,
    /// Distance of its centre from the GNSS position, metres.
    pub gnss_m: Option<f64>,
}

impl Report {
    /// # Errors
    /// A result that GNSS does not place, or that names what was not asked for.
    pub(crate) fn of(survey: &Survey, outcome: &Outcome) -> Result<Self, ReconstructError> {
        let known = |component: &&OutcomeComponent| {
            component.aligned && component.shots.iter().all(|shot| shot.image < survey.photos.len())
        };
        let components: Vec<&OutcomeComponent> = outcome.components.iter().filter(known).collect();
        let largest = components.first().ok_or(ReconstructError::NotAligned)?;
        let mut shots: Vec<ShotReport> = Vec::new();
        for shot in components.iter().flat_map(|component| &component.shots) {
            let photo = &survey.photos[shot.image];
            let gnss_m = photo.gnss_enu_m.map(|gnss| (center(shot.rotation, shot.translation) - gnss).norm());
            let (points, reprojection_px) = (shot.points, shot.reprojection_px);
            shots.push(ShotReport { name: photo.name.clone(), points, reprojection_px, gnss_m });
        }
        shots.sort_by(|a, b| a.name.cmp(&b.name));
        shots.dedup_by(|a, b| a.name == b.name);
        let is_placed = |name: &str| shots.binary_search_by(|shot| shot.name.as_str().cmp(name)).is_ok();
        let names = survey.photos.iter().map(|photo| photo.name.clone());
        let not_placed: Vec<String> = names.filter(|name| !is_placed(name)).collect();
        let mut distances: Vec<f64> = shots.iter().filter_map(|shot| shot.gnss_m).collect();
        distances.sort_by(f64::total_cmp);
        let cameras = survey.cameras.iter().zip(&outcome.cameras).filter_map(|(camera, made)| {
            let made = (*made)?;
            let focal = made.focal_px / f64::from(camera.size_px.into_iter().max()?);
            Some(CameraReport { name: camera.name.clone(), focal, focal_from: camera.source, k1: made.k1, k2: made.k2 })
        });
        let mut report = Self {
            photos: survey.photos.len(),
            placed: shots.len(),
            components: components.iter().map(|component| component.shots.len()).collect(),
            reprojection_px: largest.reprojection_px,
            gnss_median_m: distances.get(distances.len() / 2).copied().unwrap_or(0.0),
            gnss_max_m: distances.last().copied().unwrap_or(0.0),
            cameras: cameras.collect(),
            shots,
            not_placed,
            warnings: Vec::new(),
        };
        report.warnings = report.warn();
        Ok(report)
    }

    fn warn(&self) -> Vec<String> {
        let mut warnings = Vec::new();
        if !self.not_placed.is_empty() {
            let some: Vec<&str> = self.not_placed.iter().take(5).map(String::as_str).collect();
            warnings.push(format!(
                "{} of {} photos could not be placed ({}): too little in them is seen in others; fly with more overlap",
                self.not_placed.len(),
                self.photos,
                some.join(", ")
            ));
        }
        if self.components.len() > 1 {
            let sizes: Vec<String> = self.components.iter().map(usize::to_string).collect();
            warnings.push(format!(
                "the photos fell apart into {} components of {}, tied to each other by GNSS alone: benches seen from two of \
                 them may not fit together; fly with more overlap",
                sizes.len(),
                sizes.join(" and ")
            ));
        }
        if self.cameras.iter().any(|camera| camera.focal_from == FocalSource::FilmEquivalent) {
            warnings.push(
                "the focal length is the photos' 35-mm equivalent, in whole millimetres: heights and shapes are a little off \
                 with it; give it with --focal where you know it better"
                    .to_owned(),
            );
        }
        warnings
    }
}

fn center(rotation: [[f64; 3]; 3], translation: [f64; 3]) -> Vector3<f64> {
    -(matrix(rotation).transpose() * Vector3::from(translation))
}

fn matrix(rows: [[f64; 3]; 3]) -> Matrix3<f64> {
    Matrix3::from_fn(|row, column| rows[row][column])
}

/// Writes the project's files, each whole or not at all, `reconstruction.json` last.
pub(crate) fn write(
    folder: &Path,
    survey: &Survey,
    outcome: &Outcome,
    report: &Report,
) -> Result<(), ReconstructError> {
    let components: Vec<Value> = outcome
        .components
        .iter()
        .filter(|component| component.aligned && component.shots.len() >= MIN_PHOTOS.min(report.placed))
        .map(|component| component_json(survey, outcome, component))
        .collect();
    let origin = survey.reference.origin;
    let reference = json!({
        "latitude": origin.latitude_deg, "longitude": origin.longitude_deg, "altitude": origin.height_m,
    });
    let files = [
        ("reconstruction-report.json", json!(report)),
        ("reference_lla.json", reference),
        ("reconstruction.json", Value::Array(components)),
    ];
    for (name, content) in files {
        let path = folder.join(name);
        let not_writable = |source| ReconstructError::NotWritable { path: path.clone(), source };
        // As any new file: what the user's mask leaves of this.
        let readable = std::fs::Permissions::from_mode(0o666);
        let mut file = tempfile::Builder::new().permissions(readable).tempfile_in(folder).map_err(not_writable)?;
        serde_json::to_writer(std::io::BufWriter::new(&mut file), &content)
            .map_err(|error| not_writable(std::io::Error::other(error)))?;
        file.persist(&path).map_err(|error| not_writable(error.error))?;
    }
    Ok(())
}

/// A component as OpenSfM writes it. COLMAP's camera, whose pixels have their corners at whole numbers, is OpenSfM's
/// `perspective` with the same coefficients.
fn component_json(survey: &Survey, outcome: &Outcome, component: &OutcomeComponent) -> Value {
    let mut cameras = Map::new();
    for (camera, made) in survey.cameras.iter().zip(&outcome.cameras) {
        if let Some(made) = made {
            let [width, height] = camera.size_px;
            let focal = made.focal_px / f64::from(width.max(height));
            let entry = json!({
                "projection_type": "perspective", "width": width, "height": height, "focal": focal, "k1": made.k1, "k2": made.k2,
            });
            cameras.insert(camera.name.clone(), entry);
        }
    }
    let mut shots = Map::new();
    for shot in &component.shots {
        let photo = &survey.photos[shot.image];
        let rotation = Rotation3::from_matrix(&matrix(shot.rotation)).scaled_axis();
        let mut entry = json!({
            "rotation": rotation.as_slice(), "translation": shot.translation, "camera": survey.cameras[photo.camera].name,
            "orientation": 1,
        });
        if let Some(gnss) = photo.gnss_enu_m {
            entry["gps_position"] = json!(gnss.as_slice());
        }
        shots.insert(photo.name.clone(), entry);
    }
    let points: Map<String, Value> = component
        .points
        .iter()
        .enumerate()
        .map(|(index, point)| (index.to_string(), json!({ "coordinates": point, "color": [0, 0, 0] })))
        .collect();
    json!({ "cameras": cameras, "shots": shots, "points": points })
}
