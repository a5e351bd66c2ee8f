//! The whole story on one page: what structure from motion left in a folder becomes a model of every module.

use crate::detection::external::{self, BoxError};
use crate::detection::{DetectionError, Detector, ImageDetections};
use crate::fusion::{self, Fused, FusionOptions, View};
use crate::geometry::PointCloud;
use crate::layout::{self, Layout, LayoutOptions};
use crate::plant::assemble::{Identity, assemble};
use crate::plant::{PlantId, PlantModel, Warning};
use crate::reconstruction::{self, Photo, Project, ReadError, Shot};
use crate::refinement::{self, Control, ControlError, Refined, RefinementOptions};
use nalgebra::Vector3;
use serde::{Deserialize, Serialize};
use std::collections::HashMap;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

pub mod search;

pub use search::{Loaded, Sought};

/// Images coarser than this do not resolve modules well enough to be searched, metres per pixel: a module of 1 m is then
/// 16 pixels wide.
const DEFAULT_MAX_GSD_M: f64 = 0.06;

/// The stages in the order in which they run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Stage {
    /// Reconstruction, point cloud and image headers read and checked.
    Read,
    /// Images decoded and modules detected, image by image (paper, 3.2).
    Detect,
    /// Rows, benches, gaps and hypotheses of each image (3.3).
    Layout,
    /// Pixels to 3D (3.4).
    Locate,
    /// Layouts of all images matched and merged (3.4, 3.5).
    Fuse,
    /// Positions refined (3.6).
    Refine,
    /// Identifiers given, model assembled.
    Assemble,
}

impl Stage {
    /// All stages, in order.
    pub const ALL: [Self; 7] =
        [Self::Read, Self::Detect, Self::Layout, Self::Locate, Self::Fuse, Self::Refine, Self::Assemble];

    /// The word in progress reports.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Read => "read",
            Self::Detect => "detect",
            Self::Layout => "layout",
            Self::Locate => "locate",
            Self::Fuse => "fuse",
            Self::Refine => "refine",
            Self::Assemble => "assemble",
        }
    }
}

/// What a mapping may be told.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MapOptions {
    /// Rows of modules per bench, if all benches have the same known number; inferred where it is not given.
    pub rows_per_bench: Option<u32>,
    /// Ground sampling distance in metres per pixel above which an image does not resolve modules and is left out of
    /// detection.
    pub max_gsd_m_per_px: Option<f64>,
    /// Known spacing of module centres along and across the row, metres (last paragraph of 4.3.1): fixes the scale.
    pub spacing_m: Option<[f64; 2]>,
    /// Known width (along the row) and height (across it) of a module's face, metres: fixes the scale likewise.
    pub module_size_m: Option<[f64; 2]>,
    /// Places that are known, to align the model by.
    pub control: Option<Control>,
    /// Whether known places set the scale too; where it is not given, they do unless a spacing or module size does.
    pub control_scale: Option<bool>,
    /// What heights refer to, where the user knows it.
    pub vertical_datum: Option<String>,
    /// How positions are refined.
    pub refinement: refinement::Method,
    /// Most pixels that an image may have.
    pub max_image_pixels: u64,
    /// Seed of every random choice.
    pub seed: u64,
}

impl Default for MapOptions {
    fn default() -> Self {
        Self {
            rows_per_bench: None,
            max_gsd_m_per_px: None,
            spacing_m: None,
            module_size_m: None,
            control: None,
            control_scale: None,
            vertical_datum: None,
            refinement: refinement::Method::default(),
            max_image_pixels: reconstruction::photo::DEFAULT_MAX_PIXELS,
            seed: 1,
        }
    }
}

impl MapOptions {
    /// Refuses values that make no sense.
    ///
    /// # Errors
    /// The first option that cannot be used, and why.
    pub fn check(&self) -> Result<(), MapError> {
        let refuse = |message: &str| {
            Err(MapError::Input { code: "option_invalid", message: format!("{message}; leave it out or correct it") })
        };
        if self.rows_per_bench.is_some_and(|rows| !(1..=64).contains(&rows)) {
            return refuse("rows_per_bench must be 1 to 64");
        }
        if self.max_gsd_m_per_px.is_some_and(|gsd| !(0.001..=1.0).contains(&gsd)) {
            return refuse("max_gsd_m_per_px must be 0.001 to 1 metre per pixel");
        }
        if self.spacing_m.is_some_and(|spacing| spacing.iter().any(|s| !(0.1..=10.0).contains(s))) {
            return refuse("spacing_m must be two lengths of 0.1 to 10 metres, along and across the row");
        }
        if self.module_size_m.is_some_and(|size| size.iter().any(|s| !(0.1..=10.0).contains(s))) {
            return refuse("module_size_m must be two lengths of 0.1 to 10 metres, width along the row and height");
        }
        if self.spacing_m.is_some() && self.module_size_m.is_some() {
            return refuse("spacing_m and module_size_m both fix the scale: give one of them");
        }
        if self.vertical_datum.as_ref().is_some_and(|datum| datum.is_empty() || datum.len() > 200) {
            return refuse("vertical_datum must be a name of 1 to 200 bytes");
        }
        if let Some(control) = &self.control {
            control.check()?;
        }
        Ok(())
    }
}

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

/// Told of progress, asked whether to stop. Called from several threads.
pub trait Observer: Sync {
    /// `done` of `total` units of a stage are finished (images, or one unit where a stage has no parts).
    fn progress(&self, stage: Stage, done: usize, total: usize);
    /// Whether the mapping should end early with [`MapError::Cancelled`].
    fn cancelled(&self) -> bool {
        false
    }
    /// What an earlier run of this very mapping (equal input, options and program) found in an image.
    fn recall(&self, _image: &str) -> Option<Found> {
        None
    }
    /// Told of what was found in an image, for a later run to recall.
    fn found(&self, _found: &Found) {}
    /// Told which images are to be searched, in order, so that others may help. Their paths lie in the mapping's folder.
    fn offer(&self, _images: &[Sought]) {}
    /// What is next about the images that were offered: `left`, never empty, are those that were not given out here and
    /// that nobody else has found something in, by their place among the offered, in order.
    fn next(&self, left: &[usize]) -> Turn {
        Turn::Search(left[0])
    }
}

/// What is next about the images of a mapping, by their place among those that were offered.
#[derive(Debug, Clone)]
pub enum Turn {
    /// This one is to be searched here.
    Search(usize),
    /// Someone else has searched this one, as it would have been here.
    Found(usize, Box<Found>),
    /// Others are at work on all that are left.
    Wait,
}

/// What one image shows.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Found {
    pub detections: ImageDetections,
    pub layout: Layout,
}

/// What one stage cost.
#[derive(Debug, Clone, Copy)]
pub struct StageTiming {
    pub stage: Stage,
    pub wall: Duration,
    /// Highest resident memory of the process so far, bytes; `None` where the system does not say.
    pub peak_memory_bytes: Option<u64>,
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

/// Why a mapping could not be made.
#[derive(Debug, thiserror::Error)]
pub enum MapError {
    #[error("the mapping was cancelled")]
    Cancelled,
    /// Bad input: the sentence names the file and says what to do. Trying again does not help.
    #[error("{message}")]
    Input { code: &'static str, message: String },
    /// Something outside the input failed (a full disk, a missing runtime); trying again may help.
    #[error("{message}")]
    Environment { message: String },
}

impl From<ReadError> for MapError {
    fn from(error: ReadError) -> Self {
        Self::Input { code: error.code(), message: error.to_string() }
    }
}

impl From<ControlError> for MapError {
    fn from(error: ControlError) -> Self {
        Self::Input { code: "control_invalid", message: error.to_string() }
    }
}

impl From<BoxError> for MapError {
    fn from(error: BoxError) -> Self {
        Self::Input { code: "boxes_invalid", message: error.to_string() }
    }
}

impl From<DetectionError> for MapError {
    fn from(error: DetectionError) -> Self {
        Self::Environment { message: error.to_string() }
    }
}

/// Measures stages and reports them.
struct Clock<'a> {
    observer: &'a dyn Observer,
    timings: Vec<StageTiming>,
}

impl Clock<'_> {
    /// Runs a stage that has no parts.
    fn stage<T>(&mut self, stage: Stage, work: impl FnOnce() -> T) -> Result<T, MapError> {
        if self.observer.cancelled() {
            return Err(MapError::Cancelled);
        }
        self.observer.progress(stage, 0, 1);
        let start = Instant::now();
        let value = work();
        self.add(stage, start.elapsed());
        self.observer.progress(stage, 1, 1);
        Ok(value)
    }

    fn add(&mut self, stage: Stage, wall: Duration) {
        self.timings.push(StageTiming { stage, wall, peak_memory_bytes: peak_memory_bytes() });
    }
}

/// Maps the plant in a folder as OpenSfM leaves it: `reconstruction.json`, `reference_lla.json`, `images/`, and
/// `undistorted/` with `images/` and `depthmaps/merged.ply`. Equal input gives an equal model, whatever the number of
/// threads.
///
/// # Errors
/// Broken input (by file, and with what to do), a failing environment, or cancellation.
pub fn map_folder(
    folder: &Path,
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
    let cloud = cloud_of(&mut project);
    let gsd_m = ground_sampling_distances(&project.reconstruction.shots, &cloud);

    let seen = match boxes {
        Boxes::Detector(detector) => {
            let chosen = resolving_images(&project, &gsd_m, options, &mut warnings);
            search_images(&project, &chosen, &gsd_m, detector, options.max_image_pixels, &mut clock)?
        }
        Boxes::File(path) => read_boxes(&project, path, &mut clock, &mut warnings)?,
    };
    let found: usize = seen.iter().map(|image| image.detections.detections.len()).sum();
    if found == 0 {
        return Err(MapError::Input {
            code: "no_modules",
            message: format!(
                "no module was found in any of {} images: are these photos of a photovoltaic plant, taken at 20 to 100 m \
                 above it?",
                seen.len()
            ),
        });
    }
    let empty: Vec<String> =
        seen.iter().filter(|s| s.layout.pieces.is_empty()).map(|s| s.detections.image.clone()).collect();
    if !empty.is_empty() {
        warnings.push(Warning::new(
            "image_without_modules",
            format!("no benches were found in {} of {} images", empty.len(), seen.len()),
            empty,
        ));
    }

    let shots: Vec<Shot> = seen.iter().map(|s| project.reconstruction.shots[s.shot].clone()).collect();
    let photos: Vec<Photo> = seen.iter().map(|s| project.photos[s.shot].clone()).collect();
    let (detections, layouts): (Vec<_>, Vec<_>) = seen.into_iter().map(|s| (s.detections, s.layout)).unzip();
    let views: Vec<View<'_>> = shots
        .iter()
        .zip(&detections)
        .zip(&layouts)
        .map(|((shot, detections), layout)| View { shot, detections, layout })
        .collect();
    let located = clock.stage(Stage::Locate, || fusion::locate::locate(&views, &cloud))?;
    let fusion_options = FusionOptions { rows_per_bench: options.rows_per_bench, ..FusionOptions::default() };
    let fused = clock.stage(Stage::Fuse, || fusion::fuse(&views, located, &fusion_options))?;
    if fused.benches.is_empty() {
        return Err(MapError::Input {
            code: "no_benches",
            message: format!(
                "{found} modules were found, but no two of them form a bench that the reconstruction can place: is \
                 reconstruction.json of these images?"
            ),
        });
    }
    let refinement_options = RefinementOptions {
        method: options.refinement,
        spacing_m: options.spacing_m,
        module_size_m: options.module_size_m,
        seed: options.seed,
    };
    let reference = project.reconstruction.reference;
    let refined = clock.stage(Stage::Refine, || -> Result<Refined, MapError> {
        let mut refined = refinement::refine(&views, &fused, &refinement_options);
        if let Some(control) = &options.control {
            let scale_known = options.spacing_m.is_some() || options.module_size_m.is_some();
            let with_scale = options.control_scale.unwrap_or(!scale_known);
            refinement::alignment::align(&views, &fused, &mut refined, reference, control, with_scale)?;
        }
        Ok(refined)
    })??;
    let identity = Identity {
        plant: subject.plant,
        plant_name: &subject.plant_name,
        survey: &subject.survey,
        previous: subject.previous.as_deref(),
    };
    let model = clock.stage(Stage::Assemble, || {
        assemble(&views, &fused, &refined, reference, vertical_datum(options), &identity, warnings)
    })?;
    let timings = clock.timings;
    Ok(Mapping { model, timings, photos, shots, detections, layouts, fused, refined })
}

/// The photos of a folder as OpenSfM leaves it that [`map_folder`] searches, those too coarse to resolve modules left out,
/// with the ground sampling distance of each in metres per pixel where the reconstruction tells.
///
/// # Errors
/// Broken input, by file.
pub fn photos_of(folder: &Path, max_image_pixels: u64) -> Result<Vec<(Photo, Option<f64>)>, MapError> {
    let mut project = reconstruction::opensfm::read(folder, max_image_pixels)?;
    let cloud = cloud_of(&mut project);
    let gsd_m = ground_sampling_distances(&project.reconstruction.shots, &cloud);
    let chosen = resolving_images(&project, &gsd_m, &MapOptions::default(), &mut Vec::new());
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

/// Metres on the ground per pixel of each shot, by the depth of the points that it shows; `None` where it shows none.
fn ground_sampling_distances(shots: &[Shot], cloud: &PointCloud) -> Vec<Option<f64>> {
    let stride = (cloud.positions_m.len() / 4000).max(1);
    let samples: Vec<Vector3<f64>> = cloud
        .positions_m
        .iter()
        .step_by(stride)
        .map(|p| Vector3::new(f64::from(p[0]), f64::from(p[1]), f64::from(p[2])))
        .collect();
    shots
        .iter()
        .map(|shot| {
            let mut depths: Vec<f64> = samples
                .iter()
                .filter_map(|point| {
                    let camera_m = shot.pose.to_camera(point);
                    let pixel = shot.camera.project(&camera_m)?;
                    let inside = (0.0..f64::from(shot.camera.width_px)).contains(&pixel.x)
                        && (0.0..f64::from(shot.camera.height_px)).contains(&pixel.y);
                    inside.then_some(camera_m.z)
                })
                .collect();
            depths.sort_by(f64::total_cmp);
            Some(depths.get(depths.len() / 2)? / shot.camera.focal_px())
        })
        .collect()
}

/// Indices of the shots whose images resolve modules. The others helped the reconstruction (the paper's supplementary
/// images) and are left out, with a note.
fn resolving_images(
    project: &Project,
    gsd_m: &[Option<f64>],
    options: &MapOptions,
    warnings: &mut Vec<Warning>,
) -> Vec<usize> {
    let mut limit = options.max_gsd_m_per_px.unwrap_or(DEFAULT_MAX_GSD_M);
    let resolves =
        |limit: f64| -> Vec<usize> { (0..gsd_m.len()).filter(|k| gsd_m[*k].is_none_or(|gsd| gsd <= limit)).collect() };
    let mut chosen = resolves(limit);
    if chosen.len() < 2 && options.max_gsd_m_per_px.is_none() {
        // All were taken from high up: search the finest there are, and say so.
        let finest = gsd_m.iter().flatten().copied().fold(f64::INFINITY, f64::min);
        limit = finest * 1.3;
        chosen = resolves(limit);
        warnings.push(Warning::new(
            "images_coarse",
            format!(
                "all images are coarser than {DEFAULT_MAX_GSD_M} m per pixel; those up to {limit:.3} are searched all the \
                 same: expect missed modules, or fly lower"
            ),
            [],
        ));
    }
    let shots = &project.reconstruction.shots;
    let left_out: Vec<usize> = (0..shots.len()).filter(|k| gsd_m[*k].is_some_and(|gsd| gsd > limit)).collect();
    if !left_out.is_empty() {
        let coarsest = left_out.iter().filter_map(|k| gsd_m[*k]).fold(0.0, f64::max);
        warnings.push(Warning::new(
            "images_supplementary",
            format!(
                "{} of {} images are too coarse to resolve modules (up to {coarsest:.3} m per pixel, limit {limit:.3}): \
                 they served the reconstruction and are not searched",
                left_out.len(),
                shots.len()
            ),
            left_out.iter().map(|k| shots[*k].name.clone()),
        ));
    }
    chosen
}

/// An image that was searched.
struct Seen {
    shot: usize,
    detections: ImageDetections,
    layout: Layout,
}

impl Seen {
    fn new(shot: usize, found: Found) -> Self {
        Self { shot, detections: found.detections, layout: found.layout }
    }
}

/// How long the mapping waits before it looks again whether others have found something.
const WAIT_FOR_OTHERS: Duration = Duration::from_millis(50);

/// Detects and lays out image by image, those apart that an earlier run or others have searched.
fn search_images(
    project: &Project,
    chosen: &[usize],
    gsd_m: &[Option<f64>],
    detector: &dyn Detector,
    max_pixels: u64,
    clock: &mut Clock<'_>,
) -> Result<Vec<Seen>, MapError> {
    let observer = clock.observer;
    let start = Instant::now();
    let total = chosen.len();
    let (seen, shots): (Vec<Seen>, Vec<usize>) = recalled(project, chosen, observer);
    observer.progress(Stage::Detect, seen.len(), total);
    let sought: Vec<Sought> = shots
        .iter()
        .map(|&shot| {
            let Photo { shot: image, path, camera, .. } = project.photos[shot].clone();
            Sought { image, path, camera, gsd_m: gsd_m[shot], max_pixels }
        })
        .collect();
    observer.offer(&sought);
    let seen = Mutex::new(seen);
    let keep = |image: usize, found: Found| {
        let mut seen = seen.lock().unwrap_or_else(PoisonError::into_inner);
        seen.push(Seen::new(shots[image], found));
        observer.progress(Stage::Detect, seen.len(), total);
    };
    let mut left: Vec<usize> = (0..sought.len()).collect();
    let next = || loop {
        if left.is_empty() {
            return None;
        }
        if observer.cancelled() {
            return Some(Err(MapError::Cancelled));
        }
        match observer.next(&left) {
            Turn::Search(image) => {
                left.retain(|other| *other != image);
                let shot = shots[image];
                let pixels = project.photos[shot].load().map_err(|error| ReadError::Photo(error).into());
                let name = sought[image].image.clone();
                return Some(pixels.map(|pixels| Loaded { key: image, image: name, pixels, gsd_m: gsd_m[shot] }));
            }
            Turn::Found(image, found) => {
                left.retain(|other| *other != image);
                keep(image, *found);
            }
            Turn::Wait => std::thread::sleep(WAIT_FOR_OTHERS),
        }
    };
    let found = |image: usize, found: Found| {
        observer.found(&found);
        keep(image, found);
    };
    let layout_time = search::search(detector, next, found, || observer.cancelled())?;
    // In the order of the shots, whichever was done first.
    let mut seen = seen.into_inner().unwrap_or_else(PoisonError::into_inner);
    seen.sort_by_key(|image| image.shot);
    clock.add(Stage::Detect, start.elapsed().saturating_sub(layout_time));
    clock.add(Stage::Layout, layout_time);
    observer.progress(Stage::Layout, total, total);
    Ok(seen)
}

/// What an earlier run found in these shots, and the shots in which it had not looked.
fn recalled(project: &Project, chosen: &[usize], observer: &dyn Observer) -> (Vec<Seen>, Vec<usize>) {
    let (mut seen, mut sought) = (Vec::new(), Vec::new());
    for &shot in chosen {
        match observer.recall(&project.reconstruction.shots[shot].name) {
            Some(found) => seen.push(Seen::new(shot, found)),
            None => sought.push(shot),
        }
    }
    (seen, sought)
}

/// Takes the boxes of a file instead of searching; images are decoded only to look at the ground between modules.
fn read_boxes(
    project: &Project,
    path: &Path,
    clock: &mut Clock<'_>,
    warnings: &mut Vec<Warning>,
) -> Result<Vec<Seen>, MapError> {
    let given = clock.stage(Stage::Detect, || external::read(path))??;
    let by_name: HashMap<&str, usize> =
        project.reconstruction.shots.iter().enumerate().map(|(index, shot)| (shot.name.as_str(), index)).collect();
    let mut seen: Vec<(usize, ImageDetections)> = Vec::new();
    let mut unknown = Vec::new();
    for detections in given {
        let Some(&shot) = by_name.get(detections.image.as_str()) else {
            unknown.push(detections.image);
            continue;
        };
        let camera = &project.reconstruction.shots[shot].camera;
        if (detections.width_px, detections.height_px) != (camera.width_px, camera.height_px) {
            return Err(MapError::Input {
                code: "boxes_invalid",
                message: format!(
                    "the boxes of {} are for {} x {} pixels, but its undistorted image has {} x {}: give boxes in pixels of \
                     that image",
                    detections.image, detections.width_px, detections.height_px, camera.width_px, camera.height_px
                ),
            });
        }
        seen.push((shot, detections));
    }
    if !unknown.is_empty() {
        warnings.push(Warning::new(
            "boxes_without_shot",
            format!("{} images with boxes are not in the reconstruction and are left out", unknown.len()),
            unknown,
        ));
    }
    seen.sort_by_key(|(shot, _)| *shot);
    seen.dedup_by_key(|(shot, _)| *shot);
    clock.stage(Stage::Layout, || {
        use rayon::prelude::*;
        seen.into_par_iter()
            .map(|(shot, detections)| {
                let grey = project.photos[shot].load().map(|image| image::imageops::grayscale(&image));
                let grey = grey.map_err(ReadError::Photo)?;
                let layout = layout::infer(&detections, Some(&grey), &LayoutOptions::default());
                Ok(Seen { shot, detections, layout })
            })
            .collect()
    })?
}

/// What heights refer to: as the user says, else as the control does, else what is known of drones.
fn vertical_datum(options: &MapOptions) -> String {
    let of_control = || options.control.as_ref().and_then(|control| control.vertical_datum.clone());
    options.vertical_datum.clone().or_else(of_control).unwrap_or_else(|| {
        if options.control.is_some() {
            return "as the control that the model was aligned to".to_owned();
        }
        "as the image positions that the reconstruction was aligned to (for drones usually height above the WGS84 ellipsoid or \
     a barometric height; not checked)"
            .to_owned()
    })
}

/// Highest resident memory of this process so far, bytes, where `/proc` tells it.
fn peak_memory_bytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|line| line.starts_with("VmHWM:"))?;
    Some(line.split_ascii_whitespace().nth(1)?.parse::<u64>().ok()? * 1024)
}
