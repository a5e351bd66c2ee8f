//! The photos of a survey, their cameras and where they were taken, by what stands in their files.

use crate::{Options, ReconstructError};
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

/// Where a focal length comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum FocalSource {
    /// `--focal`.
    Given,
    /// The manufacturer's calibration in the photo's XMP.
    Calibrated,
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
    let (focal_px, source) = focal_of(&path, size_px, options.focal_share)
        .ok_or_else(|| ReconstructError::NoFocalLength { photo: name.to_owned() })?;
    let [width, height] = size_px;
    let model = exposure.camera.unwrap_or_else(|| "unknown camera".to_owned());
    let camera = SurveyCamera { name: format!("{model} {width} x {height} {focal_px:.1}"), size_px, focal_px, source };
    let position = exposure.position.and_then(|position| {
        let height_m = position.height_m?;
        Some(Lla { latitude_deg: position.latitude_deg, longitude_deg: position.longitude_deg, height_m })
    });
    Ok(Some(Described { path, camera, position }))
}

/// The focal length of a photo, pixels, and where it comes from.
fn focal_of(path: &Path, [width, height]: [u32; 2], given_share: Option<f64>) -> Option<(f64, FocalSource)> {
    if let Some(share) = given_share {
        return Some((share * f64::from(width.max(height)), FocalSource::Given));
    }
    let film_px = exif::film_focal_px(path, width, height)?;
    // Drones write it in pixels of the whole sensor: of a photo that was scaled or cropped it says nothing.
    let calibrated_px = xmp::number(path, "drone-dji:CalibratedFocalLength")
        .filter(|px| (1.0 / MAX_FOCAL_RATIO..MAX_FOCAL_RATIO).contains(&(px / film_px)));
    Some(match calibrated_px {
        Some(focal_px) => (focal_px, FocalSource::Calibrated),
        None => (film_px, FocalSource::FilmEquivalent),
    })
}
