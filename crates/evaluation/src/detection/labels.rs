//! Polygon labels: a `truth.json` with its cameras, or polygons in pixels that a person checked.

use crate::EvaluateError;
use heliomap_mapping::geometry::Quad;
use heliomap_mapping::reconstruction::photo;
use nalgebra::{Matrix3, Vector2, Vector3};
use serde::Deserialize;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufReader, Read};
use std::path::{Path, PathBuf};

const MAX_BYTES: u64 = 1 << 30;
/// A label of a photo has no coordinate beyond this, pixels.
const MAX_COORDINATE_PX: f64 = 1e6;

/// A photo whose modules are known.
#[derive(Debug, Clone)]
pub struct LabelledPhoto {
    /// File name.
    pub image: String,
    /// The plant or the set that it belongs to.
    pub group: String,
    pub path: PathBuf,
    /// Modules that reach into the frame, in pixels of the photo as it is.
    pub modules: Vec<Quad>,
    /// Areas in which boxes count neither way, pixels.
    pub ignore: Vec<Vec<Vector2<f64>>>,
    /// Words for the light, the modules and the view.
    pub conditions: Vec<String>,
    /// Ground sampling distance in metres per pixel that the truth's cameras have.
    pub gsd_m: Option<f64>,
}

#[derive(Deserialize)]
struct Polygons {
    modules: Vec<[[f64; 2]; 4]>,
    #[serde(default)]
    ignore: Vec<Vec<[f64; 2]>>,
}

#[derive(Deserialize)]
struct Truth {
    camera: TruthCamera,
    modules: Vec<TruthModule>,
    shots: Vec<TruthShot>,
    #[serde(default)]
    conditions: Option<Conditions>,
}

#[derive(Deserialize)]
struct TruthCamera {
    /// In units of the photo's larger side.
    focal_norm: f64,
    #[serde(default)]
    k1: f64,
    #[serde(default)]
    k2: f64,
}

#[derive(Deserialize)]
struct TruthModule {
    /// Metres, east, north, up.
    corners: [[f64; 3]; 4],
}

#[derive(Deserialize)]
struct TruthShot {
    name: String,
    /// World to camera.
    #[serde(rename = "R")]
    camera_from_world: [[f64; 3]; 3],
    center: [f64; 3],
}

#[derive(Deserialize)]
struct Conditions {
    #[serde(default)]
    style: Option<String>,
    #[serde(default)]
    dirt: f64,
    #[serde(default)]
    sun: Sun,
    #[serde(default)]
    finish: Finish,
}

#[derive(Deserialize)]
struct Sun {
    /// Degrees.
    elevation: f64,
}

impl Default for Sun {
    fn default() -> Self {
        Self { elevation: 90.0 }
    }
}

#[derive(Deserialize, Default)]
#[serde(default)]
struct Finish {
    blur: f64,
    motion: f64,
    haze: f64,
    noise: f64,
}

impl Conditions {
    /// Words for what is out of the ordinary.
    fn words(&self) -> Vec<String> {
        let finish = &self.finish;
        [
            (self.dirt > 0.0, "dirt"),
            (self.sun.elevation < 25.0, "low sun"),
            (finish.blur > 0.0, "blur"),
            (finish.motion > 0.0, "motion blur"),
            (finish.haze > 0.0, "haze"),
            (finish.noise > 3.0, "noise"),
        ]
        .iter()
        .filter(|(holds, _)| *holds)
        .map(|(_, word)| (*word).to_owned())
        .chain(self.style.clone())
        .collect()
    }
}

impl TruthShot {
    /// The view in words, after the angle of its axis to the vertical and its ground sampling distance.
    fn words(&self, gsd_m: Option<f64>) -> Vec<String> {
        let down = -self.camera_from_world[2][2];
        let oblique = down.clamp(-1.0, 1.0).acos().to_degrees() > 8.0;
        let coarse = gsd_m.is_some_and(|gsd| gsd > 0.05);
        [(oblique, "off nadir"), (coarse, "coarse")]
            .iter()
            .filter(|(holds, _)| *holds)
            .map(|(_, word)| (*word).to_owned())
            .collect()
    }
}

/// Reads labels: a `truth.json`, a folder that holds one, or a file `{"photo": {"modules": [[[x, y] x 4]], "ignore":
/// [polygon]}}`. The photos are looked for in `images`, else in `images/` beside the file, else beside it. Shots of a truth
/// that have no photo there are left out.
///
/// # Errors
/// A file that is of neither form, holds what is no number, or labels photos of which none is there.
pub fn read_labels(path: &Path, images: Option<&Path>) -> Result<Vec<LabelledPhoto>, EvaluateError> {
    let path = if path.is_dir() { path.join("truth.json") } else { path.to_owned() };
    let read_error = |error: std::io::Error| EvaluateError::Read { path: path.clone(), reason: error.to_string() };
    let file = File::open(&path).map_err(read_error)?;
    if file.metadata().map_err(read_error)?.len() > MAX_BYTES {
        return Err(EvaluateError::TooLarge { path, limit_bytes: MAX_BYTES });
    }
    let wrong = |what: String| EvaluateError::WrongShape {
        path: path.clone(),
        what,
        remedy: "give a truth.json with camera, modules and shots, or {\"photo\": {\"modules\": [[[x, y] x 4]], \"ignore\": \
                 [polygon]}}",
    };
    let value: serde_json::Value =
        serde_json::from_reader(BufReader::new(file.take(MAX_BYTES))).map_err(|error| EvaluateError::NotJson {
            path: path.clone(),
            line: error.line(),
            column: error.column(),
            reason: error.to_string(),
        })?;
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let beside = folder.join("images");
    let images = images.unwrap_or(if beside.is_dir() { &beside } else { folder });
    let group = group_name(folder);
    let unlike = |error: serde_json::Error| wrong(error.to_string());
    let photos = if value.get("shots").is_some() {
        of_truth(&serde_json::from_value(value).map_err(unlike)?, images, &group)?
    } else {
        of_polygons(serde_json::from_value(value).map_err(unlike)?, images, &group, &wrong)?
    };
    if photos.is_empty() {
        return Err(wrong(format!("none of its photos is in {}", images.display())));
    }
    Ok(photos)
}

/// The folder's own name.
fn group_name(folder: &Path) -> String {
    let whole = folder.canonicalize().unwrap_or_else(|_| folder.to_owned());
    whole.file_name().map_or_else(|| whole.display().to_string(), |name| name.to_string_lossy().into_owned())
}

fn size_of(path: &Path, name: &str) -> Result<(u32, u32), EvaluateError> {
    photo::inspect(path, name, photo::DEFAULT_MAX_PIXELS)
        .map(|header| (header.width_px, header.height_px))
        .map_err(|error| EvaluateError::Read { path: path.to_owned(), reason: error.to_string() })
}

fn of_truth(truth: &Truth, images: &Path, group: &str) -> Result<Vec<LabelledPhoto>, EvaluateError> {
    let conditions = truth.conditions.as_ref().map(Conditions::words).unwrap_or_default();
    let heights = truth.modules.iter().flat_map(|module| module.corners.map(|corner| corner[2]));
    let ground_m = heights.sum::<f64>() / (4 * truth.modules.len().max(1)) as f64;
    let mut photos = Vec::new();
    for shot in &truth.shots {
        let path = images.join(Path::new(&shot.name).file_name().unwrap_or_default());
        if !path.is_file() {
            continue;
        }
        let (width, height) = size_of(&path, &shot.name)?;
        let focal_px = truth.camera.focal_norm * f64::from(width.max(height));
        let gsd_m = Some((shot.center[2] - ground_m) / focal_px).filter(|gsd| gsd.is_finite() && *gsd > 0.0);
        let modules = truth
            .modules
            .iter()
            .filter_map(|module| {
                let corners = module.corners.map(|corner| project(corner, shot, &truth.camera, width, height));
                let [Some(a), Some(b), Some(c), Some(d)] = corners else { return None };
                Quad::from_unordered([a, b, c, d]).filter(|quad| reaches_in(quad, width, height))
            })
            .collect();
        photos.push(LabelledPhoto {
            image: shot.name.clone(),
            group: group.to_owned(),
            path,
            modules,
            ignore: Vec::new(),
            conditions: conditions.iter().cloned().chain(shot.words(gsd_m)).collect(),
            gsd_m,
        });
    }
    Ok(photos)
}

/// The pixel of a point in metres, by the truth's camera; `None` behind it, and far outside of the frame, where the lens's
/// polynomial folds back into it.
fn project(point_m: [f64; 3], shot: &TruthShot, camera: &TruthCamera, width: u32, height: u32) -> Option<Vector2<f64>> {
    let rotation = Matrix3::from_fn(|row, column| shot.camera_from_world[row][column]);
    let p = rotation * (Vector3::from(point_m) - Vector3::from(shot.center));
    if p.z <= 0.5 {
        return None;
    }
    let (x, y) = (p.x / p.z, p.y / p.z);
    let (w, h) = (f64::from(width), f64::from(height));
    let focal_px = camera.focal_norm * w.max(h);
    let r2 = x * x + y * y;
    let reach = 1.3 * w.hypot(h) / 2.0 / focal_px;
    let bend = 1.0 + camera.k1 * r2 + camera.k2 * r2 * r2;
    let pixel = Vector2::new(focal_px * bend * x + w / 2.0 - 0.5, focal_px * bend * y + h / 2.0 - 0.5);
    (r2 < reach * reach && pixel.x.is_finite() && pixel.y.is_finite()).then_some(pixel)
}

fn reaches_in(quad: &Quad, width: u32, height: u32) -> bool {
    let low = quad.corners.iter().copied().reduce(|a, b| a.inf(&b)).unwrap_or_default();
    let high = quad.corners.iter().copied().reduce(|a, b| a.sup(&b)).unwrap_or_default();
    high.x > 0.0 && high.y > 0.0 && low.x < f64::from(width) - 1.0 && low.y < f64::from(height) - 1.0
}

fn of_polygons(
    polygons: BTreeMap<String, Polygons>,
    images: &Path,
    group: &str,
    wrong: &dyn Fn(String) -> EvaluateError,
) -> Result<Vec<LabelledPhoto>, EvaluateError> {
    let mut photos = Vec::new();
    for (name, labels) in polygons {
        // Names may come without the photo's ending.
        let plain = Path::new(&name).file_name().unwrap_or_default();
        let named = images.join(plain);
        let candidates = ["", "jpg", "JPG", "jpeg", "png"];
        let Some(path) = candidates
            .iter()
            .map(|ending| if ending.is_empty() { named.clone() } else { named.with_extension(ending) })
            .find(|path| path.is_file())
        else {
            continue;
        };
        let (width, height) = size_of(&path, &name)?;
        let points = labels.modules.iter().flatten().chain(labels.ignore.iter().flatten());
        if let Some([x, y]) = points.copied().find(|point| point.iter().any(|value| value.abs() > MAX_COORDINATE_PX)) {
            return Err(wrong(format!("the point ({x}, {y}) of {name} lies beyond any photo")));
        }
        let modules = labels
            .modules
            .iter()
            .enumerate()
            .map(|(index, corners)| {
                Quad::from_unordered(corners.map(Into::into))
                    .ok_or_else(|| wrong(format!("module {index} of {name} is no quadrilateral")))
            })
            .collect::<Result<Vec<_>, _>>()?
            .into_iter()
            .filter(|quad| reaches_in(quad, width, height))
            .collect();
        let ignore: Vec<Vec<Vector2<f64>>> =
            labels.ignore.iter().map(|polygon| polygon.iter().map(|p| Vector2::from(*p)).collect()).collect();
        photos.push(LabelledPhoto {
            image: path.file_name().unwrap_or_default().to_string_lossy().into_owned(),
            group: group.to_owned(),
            path,
            modules,
            ignore,
            conditions: Vec::new(),
            gsd_m: None,
        });
    }
    Ok(photos)
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn folder_with(labels: &serde_json::Value, photos: &[&str]) -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("truth.json"), labels.to_string()).unwrap();
        for name in photos {
            image::RgbImage::new(200, 100).save(folder.path().join(name)).unwrap();
        }
        folder
    }

    #[test]
    fn a_truth_is_projected_with_its_lens() {
        // Ten metres above the ground, looking down: x east, y south.
        let truth = json!({
            "camera": {"focal_norm": 0.5, "k1": 0.1, "k2": 0.0},
            "modules": [{"corners": [[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [2.0, 1.0, 0.0], [0.0, 1.0, 0.0]]},
                        {"corners": [[90.0, 0.0, 0.0], [92.0, 0.0, 0.0], [92.0, 1.0, 0.0], [90.0, 1.0, 0.0]]}],
            "shots": [{"name": "a.png", "R": [[1, 0, 0], [0, -1, 0], [0, 0, -1]], "center": [0.0, 0.0, 10.0]},
                      {"name": "gone.png", "R": [[1, 0, 0], [0, -1, 0], [0, 0, -1]], "center": [0.0, 0.0, 10.0]}],
            "conditions": {"style": "poly", "dirt": 0.2, "sun": {"elevation": 12.0}},
        });
        let folder = folder_with(&truth, &["a.png"]);
        let photos = read_labels(folder.path(), None).unwrap();
        assert_eq!(photos.len(), 1);
        assert_eq!(photos[0].conditions, ["dirt", "low sun", "poly", "coarse"]);
        assert!((photos[0].gsd_m.unwrap() - 0.1).abs() < 1e-12);
        assert_eq!(photos[0].modules.len(), 1, "what lies outside of the frame is no label");
        // The far corner lies at x = 0.2, y = -0.1 of the image plane, so r2 = 0.05.
        let far = photos[0].modules[0].corners.iter().map(|c| c.x).fold(0.0, f64::max);
        assert!((far - (100.0 * (1.0 + 0.1 * 0.05) * 0.2 + 99.5)).abs() < 1e-9);
    }

    #[test]
    fn polygons_are_found_with_or_without_the_photos_ending() {
        let labels = json!({
            "a": {"modules": [[[10, 10], [30, 10], [30, 20], [10, 20]]], "ignore": [[[0, 0], [5, 0], [5, 5]]]},
            "b.png": {"modules": []},
            "missing": {"modules": []},
        });
        let folder = folder_with(&labels, &["a.png", "b.png"]);
        let photos = read_labels(&folder.path().join("truth.json"), None).unwrap();
        let names: Vec<&str> = photos.iter().map(|photo| photo.image.as_str()).collect();
        assert_eq!(names, ["a.png", "b.png"]);
        assert_eq!((photos[0].modules.len(), photos[0].ignore[0].len()), (1, 3));
    }

    #[test]
    fn what_is_no_label_file_is_refused() {
        let flat = json!({"a": {"modules": [[[10, 10], [10, 10], [10, 10], [10, 10]]]}});
        for (labels, words) in [
            (json!({"a": {"modules": "many"}}), "invalid type"),
            (json!({"shots": []}), "missing field"),
            (flat, "no quadrilateral"),
            (json!({"a": {"modules": [[[0, 0], [1e300, 0], [1e300, 1e300], [0, 1e300]]]}}), "beyond any photo"),
            (json!({"b": {"modules": []}}), "none of its photos"),
        ] {
            let folder = folder_with(&labels, &["a.png"]);
            let error = read_labels(folder.path(), None).unwrap_err().to_string();
            assert!(error.contains(words), "{error}");
        }
    }
}
