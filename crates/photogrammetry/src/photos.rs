//! The photos of a survey, their cameras and where they were taken, by what stands in their files.

use crate::{Options, ReconstructError, sensors};
use heliomap_mapping::reconstruction::{ProjectFolder, exif, photo, xmp};
use heliomap_model::{GeodeticReference, Lla};
use nalgebra::Vector3;
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Fewest photos, and photos with GNSS positions, that place a reconstruction on earth.
pub(crate) const MIN_PHOTOS: usize = 3;
/// Photos closer together than this show no depth, metres.
const MIN_SPREAD_M: f64 = 2.0;
/// A calibrated focal length this far from that of the 35-mm equivalent is of another size of the photo.
const MAX_FOCAL_RATIO: f64 = 1.15;

/// 36 mm x 24 mm film.
const FILM_WIDTH_MM: f64 = 36.0;
const FILM_DIAGONAL_MM: f64 = 43.27;
/// Focal lengths that differ by less than this share are the same: half a millimetre of rounding is more.
const SAME_FOCAL: f64 = 0.005;

/// Where a focal length comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum FocalSource {
    /// `--focal`.
    Given,
    /// The manufacturer's calibration in the photo's XMP.
    Calibrated,
    /// The focal length in millimetres in EXIF and the sensor of a known camera.
    Sensor,
    /// The 35-mm equivalent in EXIF, in whole millimetres: off by up to 2 % for wide lenses.
    FilmEquivalent,
}

/// One camera at one size and focal length.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct SurveyCamera {
    /// Make, model, size: its name in the reconstruction.
    pub(crate) name: String,
    pub(crate) size_px: [u32; 2],
    pub(crate) focal_px: f64,
    /// Another reading of what the photos state; the reconstruction decides.
    pub(crate) other_focal_px: Option<f64>,
    pub(crate) source: FocalSource,
}

/// One photo.
#[derive(Debug, Clone)]
pub(crate) struct SurveyPhoto {
    pub(crate) name: String,
    pub(crate) path: PathBuf,
    /// Index of its camera.
    pub(crate) camera: usize,
    /// By GNSS, in the local frame, metres.
    pub(crate) gnss_enu_m: Option<Vector3<f64>>,
}

/// What is reconstructed.
#[derive(Debug)]
pub(crate) struct Survey {
    pub(crate) reference: GeodeticReference,
    pub(crate) cameras: Vec<SurveyCamera>,
    /// Sorted by name.
    pub(crate) photos: Vec<SurveyPhoto>,
}

/// A photo as its file describes it.
struct Described {
    path: PathBuf,
    camera: SurveyCamera,
    position: Option<Lla>,
}

impl Survey {
    /// The photos in `folder/images` and the folders below it. Files of other kinds there are passed over.
    pub(crate) fn read(folder: &Path, options: &Options) -> Result<Self, ReconstructError> {
        let project = folder.to_owned();
        let mut described: BTreeMap<String, Described> = BTreeMap::new();
        for place in project.images() {
            let path = folder.join(&place);
            let name = place.file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned());
            let Some(one) = describe(path, &name, options)? else { continue };
            if let Some(first) = described.get(&name) {
                return Err(ReconstructError::SameName { first: first.path.clone(), second: one.path });
            }
            described.insert(name, one);
        }
        if described.len() < MIN_PHOTOS {
            let images = folder.join("images");
            return Err(ReconstructError::TooFewPhotos { folder: images, found: described.len(), needed: MIN_PHOTOS });
        }
        let reference = reference_of(&described)?;
        let mut cameras: Vec<SurveyCamera> = Vec::new();
        let mut photos = Vec::new();
        for (name, one) in described {
            let camera = cameras.iter().position(|known| *known == one.camera).unwrap_or_else(|| {
                cameras.push(one.camera);
                cameras.len() - 1
            });
            let gnss_enu_m = one.position.map(|position| reference.enu_from_lla(position));
            photos.push(SurveyPhoto { name, path: one.path, camera, gnss_enu_m });
        }
        let survey = Self { reference, cameras, photos };
        let spread_m = survey.spread_m();
        if spread_m < MIN_SPREAD_M {
            return Err(ReconstructError::OnePlace { spread_m });
        }
        Ok(survey)
    }

    /// The longest side of the box about all GNSS positions, metres.
    fn spread_m(&self) -> f64 {
        let places = self.photos.iter().filter_map(|photo| photo.gnss_enu_m);
        let (mut low, mut high) = (Vector3::repeat(f64::INFINITY), Vector3::repeat(f64::NEG_INFINITY));
        for place in places {
            low = low.inf(&place);
            high = high.sup(&place);
        }
        (high - low).max()
    }
}

/// The mean position, on the ellipsoid: heights stay as the drone wrote them.
fn reference_of(described: &BTreeMap<String, Described>) -> Result<GeodeticReference, ReconstructError> {
    let known: Vec<Lla> = described.values().filter_map(|one| one.position).collect();
    let Some(first) = known.first().filter(|_| known.len() >= MIN_PHOTOS) else {
        let (found, photos) = (known.len(), described.len());
        return Err(ReconstructError::TooFewPositions { found, photos, needed: MIN_PHOTOS });
    };
    let count = known.len() as f64;
    // Longitudes are averaged about the first one: a survey may cross the antimeridian.
    let east = |lla: &Lla| (lla.longitude_deg - first.longitude_deg + 540.0).rem_euclid(360.0) - 180.0;
    let longitude_deg = first.longitude_deg + known.iter().map(east).sum::<f64>() / count;
    Ok(GeodeticReference::new(Lla {
        latitude_deg: known.iter().map(|lla| lla.latitude_deg).sum::<f64>() / count,
        longitude_deg: (longitude_deg + 540.0).rem_euclid(360.0) - 180.0,
        height_m: 0.0,
    }))
}

/// A photo by its file; `None` where the file's name is none of a photo.
fn describe(path: PathBuf, name: &str, options: &Options) -> Result<Option<Described>, ReconstructError> {
    if !photo::is_photo_name(name) {
        return Ok(None);
    }
    let header = photo::inspect(&path, name, options.max_image_pixels)?;
    let exposure = exif::read(&path);
    let size_px = [header.width_px, header.height_px];
    let model = exposure.camera.unwrap_or_else(|| "unknown camera".to_owned());
    let (focal_px, source) = focal_of(&path, &model, size_px, options.focal_share)
        .ok_or_else(|| ReconstructError::NoFocalLength { photo: name.to_owned() })?;
    let [width, height] = size_px;
    let other_focal_px = match source {
        FocalSource::FilmEquivalent => other_film_px(focal_px, size_px),
        _ => None,
    };
    let name = format!("{model} {width} x {height} {focal_px:.1}");
    let camera = SurveyCamera { name, size_px, focal_px, other_focal_px, source };
    let position = exposure.position.and_then(|position| {
        let height_m = position.height_m?;
        Some(Lla { latitude_deg: position.latitude_deg, longitude_deg: position.longitude_deg, height_m })
    });
    Ok(Some(Described { path, camera, position }))
}

/// The 35-mm equivalent compares diagonals (CIPA DCG-001); some programs compare the longer sides, 36 mm on film. For photos of
/// film's own shape both are the same, `None`.
fn other_film_px(by_diagonal_px: f64, [width, height]: [u32; 2]) -> Option<f64> {
    let (longer_px, diagonal_px) = (f64::from(width.max(height)), f64::from(width).hypot(f64::from(height)));
    let by_side_px = by_diagonal_px * (FILM_DIAGONAL_MM / FILM_WIDTH_MM) * longer_px / diagonal_px;
    ((by_side_px / by_diagonal_px - 1.0).abs() > SAME_FOCAL).then_some(by_side_px)
}

/// The focal length of a photo, pixels, and where it comes from.
fn focal_of(
    path: &Path,
    camera: &str,
    [width, height]: [u32; 2],
    given_share: Option<f64>,
) -> Option<(f64, FocalSource)> {
    let longer_px = f64::from(width.max(height));
    if let Some(share) = given_share {
        return Some((share * longer_px, FocalSource::Given));
    }
    let film_px = exif::film_focal_px(path, width, height);
    // Both are of the whole sensor at full size: of a photo that was scaled or cropped they say nothing.
    let agrees =
        |px: &f64| film_px.is_none_or(|film_px| (1.0 / MAX_FOCAL_RATIO..MAX_FOCAL_RATIO).contains(&(px / film_px)));
    let calibrated_px =
        xmp::number(path, "drone-dji:CalibratedFocalLength").filter(|px| film_px.is_some() && agrees(px));
    if let Some(px) = calibrated_px {
        return Some((px, FocalSource::Calibrated));
    }
    let sensor_px =
        sensors::longer_side_mm(camera).and_then(|side_mm| Some(exif::focal_mm(path)? / side_mm * longer_px));
    match sensor_px.filter(agrees) {
        Some(px) => Some((px, FocalSource::Sensor)),
        None => film_px.map(|px| (px, FocalSource::FilmEquivalent)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn readings_of_the_35_mm_equivalent_differ_by_the_shape_of_the_photo() {
        assert_eq!(other_film_px(1000.0, [1368, 912]), None);
        let other = other_film_px(1000.0, [2433, 1824]).unwrap();
        assert!((other / 1000.0 - 0.9615).abs() < 1e-3, "{other}");
    }
}
