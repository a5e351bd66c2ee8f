//! The whole story on one page: what structure from motion left in a folder becomes a model of every module.

use crate::assembly::{Identity, assemble};
use crate::detection::{Detector, ImageDetections};
use crate::fusion::{self, Fused, FusionOptions, View};
use crate::geometry::PointCloud;
use crate::layout::Layout;
use crate::reconstruction::{self, Photo, Project, ProjectFolder, Shot};
use crate::refinement::{self, Refined, RefinementOptions};
use heliomap_model::{PlantId, PlantModel, Warning};
use parameters::Parameters;
use progress::Clock;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::io::{self, Write};
use std::path::Path;
use std::sync::Arc;

mod coverage;
mod error;
mod images;
mod options;
mod parameters;
mod progress;
pub mod search;

pub use error::MapError;
pub use options::MapOptions;
pub use progress::{NextImage, Observer, Stage, StageTiming};
pub use search::{ImageRequest, Loaded};

/// What the model is of.
#[derive(Debug, Clone)]
pub struct Subject {
    pub plant: PlantId,
    pub plant_name: String,
    pub survey: String,
    /// The plant's newest model, whose identifiers live on where the same modules are found again.
    pub previous: Option<Arc<PlantModel>>,
}

/// Where the boxes of modules come from.
#[derive(Clone, Copy)]
pub enum Boxes<'a> {
    /// A detector searches the images.
    Detector(&'a dyn Detector),
    /// A file made by another program, or corrected by a person.
    File(&'a Path),
}

/// What one image shows.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Found {
    pub detections: ImageDetections,
    pub layout: Layout,
}

/// A finished mapping, with what a person may want to see of its making.
#[derive(Debug)]
pub struct Mapping {
    pub model: PlantModel,
    pub timings: Vec<StageTiming>,
    /// The images that were searched: shots with their detections and layouts, in the same order.
    pub photos: Vec<Photo>,
    pub shots: Vec<Shot>,
    pub detections: Vec<ImageDetections>,
    pub layouts: Vec<Layout>,
    pub fused: Fused,
    pub refined: Refined,
}

/// Maps the plant in a folder as OpenSfM leaves it: `reconstruction.json`, `reference_lla.json`, `images/`, and
/// `undistorted/` with `images/` and `depthmaps/merged.ply`. Equal input gives an equal model, whatever the number of
/// threads.
///
/// # Errors
/// Broken input (by file, and with what to do), a failing environment, or cancellation.
pub fn map_folder(
    folder: &dyn ProjectFolder,
    boxes: Boxes<'_>,
    options: &MapOptions,
    subject: &Subject,
    observer: &dyn Observer,
) -> Result<Mapping, MapError> {
    options.check()?;
    let mut clock = Clock { observer, timings: Vec::new() };
    let mut project =
        clock.stage(Stage::Read, || reconstruction::opensfm::read(folder, options.max_image_pixels))??;
    let mut warnings: Vec<Warning> =
        project.notes.iter().map(|note| Warning::new(note.code, note.message.clone(), [])).collect();
    if !project.reconstruction.georeferenced && options.control.is_none() {
        return Err(MapError::Input {
            code: "no_gnss",
            message: "no photo has a GNSS position, so place, heading and scale of the plant are unknown: give photos as the \
                      camera wrote them (with EXIF), or control points"
                .to_owned(),
        });
    }
    let cloud = cloud_of(&mut project);
    let gsd_m = images::ground_sampling_distances(&project.reconstruction.shots, &cloud);

    let seen = match boxes {
        Boxes::Detector(detector) => {
            let search = images::Search { folder, project: &project, gsd_m: &gsd_m, detector, options };
            images::search_all(&search, &cloud, &mut clock, &mut warnings)?
        }
        Boxes::File(path) => images::from_boxes(folder, &project, path, &gsd_m, options, &mut clock, &mut warnings)?,
    };
    let found = images::modules_in(&seen, &mut warnings)?;

    let shots: Vec<Shot> = seen.iter().map(|s| project.reconstruction.shots[s.shot].clone()).collect();
    let photos: Vec<Photo> = seen.iter().map(|s| project.photos[s.shot].clone()).collect();
    let (detections, layouts): (Vec<_>, Vec<_>) = seen.into_iter().map(|s| (s.detections, s.layout)).unzip();
    let views: Vec<View<'_>> = shots
        .iter()
        .zip(&detections)
        .zip(&layouts)
        .map(|((shot, detections), layout)| View { shot, detections, layout })
        .collect();
    let of = digest(&detections, &layouts);
    let mut fused = match observer.load_structure(&of) {
        Some(fused) => fused,
        None => {
            let located = clock.stage(Stage::Locate, || fusion::locate::locate(&views, &cloud))?;
            let fusion_options = FusionOptions { rows_per_bench: options.rows_per_bench, ..FusionOptions::default() };
            let stopped = || observer.cancelled();
            let fused = clock.stage(Stage::Fuse, || fusion::fuse_unless(&views, located, &fusion_options, stopped))?;
            let fused = fused.ok_or(MapError::Cancelled)?;
            observer.save_structure(&fused, &of);
            fused
        }
    };
    if fused.benches.is_empty() {
        return Err(MapError::Input {
            code: "no_benches",
            message: format!(
                "{found} modules were found, but no two of them form a bench that the reconstruction can place: is \
                 reconstruction.json of these images?"
            ),
        });
    }
    warnings.extend(options.rows_contradicted(&fused));
    let refinement_options = RefinementOptions {
        method: options.refinement,
        spacing_m: options.spacing_m,
        module_size_m: options.module_size_m,
        seed: options.seed,
        ..RefinementOptions::default()
    };
    let reference = project.reconstruction.reference;
    let refined = clock.stage(Stage::Refine, || -> Result<Refined, MapError> {
        let mut refined = refinement::refine_verified(&views, &mut fused, &refinement_options);
        if let Some(control) = &options.control {
            let scale_known = options.spacing_m.is_some() || options.module_size_m.is_some();
            let with_scale = options.control_scale.unwrap_or(!scale_known);
            refinement::alignment::align(&views, &fused, &mut refined, reference, control, with_scale)?;
        }
        Ok(refined)
    })??;
    warnings.extend(options.scale_contradicted(&refined)?);
    let identity = Identity {
        plant: subject.plant,
        plant_name: &subject.plant_name,
        survey: &subject.survey,
        previous: subject.previous.as_deref(),
    };
    let mut model = clock.stage(Stage::Assemble, || {
        assemble(&views, &fused, &refined, reference, options.datum(), &identity, warnings)
    })?;
    model.parameters = Some(Parameters::usual().digest());
    let timings = clock.timings;
    Ok(Mapping { model, timings, photos, shots, detections, layouts, fused, refined })
}

/// Changes with what [`Fused`] holds, so that checkpoints of an older program are discarded and not misread.
const STRUCTURE_VERSION: u32 = 3;

/// SHA-256 of the detections and layouts, hexadecimal: the key of the structure's checkpoint.
fn digest(detections: &[ImageDetections], layouts: &[Layout]) -> String {
    let mut hashed = Hashed(Sha256::new());
    // Writing to a hash cannot fail.
    let _ = ciborium::into_writer(&(STRUCTURE_VERSION, detections, layouts), &mut hashed);
    hashed.0.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
}

/// A writer that hashes what is written.
struct Hashed(Sha256);

impl Write for Hashed {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.update(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// The photos of a folder as OpenSfM leaves it that [`map_folder`] searches, those too coarse to resolve modules left out,
/// with the ground sampling distance of each in metres per pixel where it is known.
///
/// # Errors
/// Broken input, by file.
pub fn photos_of(folder: &dyn ProjectFolder, max_image_pixels: u64) -> Result<Vec<(Photo, Option<f64>)>, MapError> {
    let mut project = reconstruction::opensfm::read(folder, max_image_pixels)?;
    let cloud = cloud_of(&mut project);
    let gsd_m = images::ground_sampling_distances(&project.reconstruction.shots, &cloud);
    let chosen = images::resolving(&gsd_m, &MapOptions::default(), &mut Vec::new());
    Ok(chosen.into_iter().map(|shot| (project.photos[shot].clone(), gsd_m[shot])).collect())
}

/// The points that modules are located by: the dense cloud, taken out of the project, or the sparse points where there is
/// none.
fn cloud_of(project: &mut Project) -> PointCloud {
    match project.reconstruction.dense.take() {
        Some(dense) => dense,
        None => PointCloud {
            positions_m: project
                .reconstruction
                .sparse_points_m
                .iter()
                .map(|p| [p.x as f32, p.y as f32, p.z as f32])
                .collect(),
            normals: Vec::new(),
        },
    }
}
