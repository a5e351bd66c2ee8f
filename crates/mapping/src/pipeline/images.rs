//! Which images are searched, and the boxes in them: from a detector, a checkpoint, another worker, or a file.

use super::coverage::{Coverage, CoverageParams};
use super::progress::Clock;
use super::search::{self, ImageRequest, Loaded};
use super::{Found, MapError, MapOptions, NextImage, Observer, Stage};
use crate::detection::external;
use crate::detection::{Detector, ImageDetections};
use crate::geometry::PointCloud;
use crate::layout::{self, Layout, LayoutOptions};
use crate::reconstruction::{Photo, Project, ProjectFolder, Shot};
use heliomap_model::Warning;
use nalgebra::Vector3;
use rayon::prelude::*;
use std::collections::{BTreeSet, HashMap, HashSet};
use std::path::Path;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Images coarser than this do not resolve modules well enough to be searched, metres per pixel: a module of 1 m is then
/// 16 pixels wide.
const DEFAULT_MAX_GSD_M: f64 = 0.06;
/// How long the mapping waits before it looks again whether others have found something.
const WAIT_FOR_OTHERS: Duration = Duration::from_millis(50);

/// Metres on the ground per pixel of each shot, by the depth of the points that it shows; `None` where it shows none.
pub(super) fn ground_sampling_distances(shots: &[Shot], cloud: &PointCloud) -> Vec<Option<f64>> {
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
/// images) and are left out, but where they alone show something.
pub(super) fn resolving(gsd_m: &[Option<f64>], options: &MapOptions, warnings: &mut Vec<Warning>) -> Vec<usize> {
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
    chosen
}

/// What is searched, and by what.
pub(super) struct Search<'a> {
    pub(super) folder: &'a dyn ProjectFolder,
    pub(super) project: &'a Project,
    pub(super) gsd_m: &'a [Option<f64>],
    pub(super) detector: &'a dyn Detector,
    pub(super) options: &'a MapOptions,
}

/// Searches the images that resolve modules, and coarser ones for what these alone show.
pub(super) fn search_all(
    search: &Search<'_>,
    cloud: &PointCloud,
    clock: &mut Clock<'_>,
    warnings: &mut Vec<Warning>,
) -> Result<Vec<Seen>, MapError> {
    let Search { project, gsd_m, options, .. } = *search;
    let chosen = resolving(gsd_m, options, warnings);
    let shots = &project.reconstruction.shots;
    let mut seen = search_images(search, &chosen, Vec::new(), clock)?;
    let fine: BTreeSet<usize> = chosen.iter().copied().collect();
    // Where the limit is given it holds.
    if options.max_gsd_m_per_px.is_none() && chosen.len() < shots.len() {
        let coverage = Coverage::new(shots, gsd_m, cloud, CoverageParams::default());
        for _ in 0..coverage.params().most_rounds {
            let coarser = coverage.missing(&seen);
            if coarser.is_empty() {
                break;
            }
            seen = search_images(search, &coarser, seen, clock)?;
            for image in seen.iter_mut().filter(|image| coarser.contains(&image.shot)) {
                coverage.keep_lacking(image, &fine);
            }
        }
    }
    clock.observer.progress(Stage::Layout, seen.len(), seen.len());
    let coarser: Vec<usize> = seen.iter().map(|image| image.shot).filter(|shot| !fine.contains(shot)).collect();
    warnings.extend(coarser_used(shots, gsd_m, &coarser));
    let left_out: Vec<usize> =
        (0..shots.len()).filter(|shot| !fine.contains(shot) && !coarser.contains(shot)).collect();
    warnings.extend(supplementary(shots, gsd_m, &left_out));
    Ok(seen)
}

/// The images that were searched for what they alone show.
fn coarser_used(shots: &[Shot], gsd_m: &[Option<f64>], coarser: &[usize]) -> Option<Warning> {
    let coarsest = coarser
        .iter()
        .filter_map(|shot| gsd_m[*shot])
        .fold(None, |most: Option<f64>, gsd| Some(most.map_or(gsd, |most| most.max(gsd))))?;
    let message = format!(
        "{} images of up to {coarsest:.3} m per pixel were searched for benches that no finer image shows: modules there are \
         less sure",
        coarser.len()
    );
    Some(Warning::new("images_coarse", message, coarser.iter().map(|shot| shots[*shot].name.clone())))
}

/// The images that were not searched.
fn supplementary(shots: &[Shot], gsd_m: &[Option<f64>], left_out: &[usize]) -> Option<Warning> {
    let coarsest = left_out.iter().filter_map(|shot| gsd_m[*shot]).fold(0.0, f64::max);
    (!left_out.is_empty()).then(|| {
        let message = format!(
            "{} of {} images are too coarse to resolve modules (up to {coarsest:.3} m per pixel): they served the \
             reconstruction and are not searched",
            left_out.len(),
            shots.len()
        );
        Warning::new("images_supplementary", message, left_out.iter().map(|shot| shots[*shot].name.clone()))
    })
}

/// An image that was searched.
#[derive(Clone)]
pub(super) struct Seen {
    pub(super) shot: usize,
    pub(super) detections: ImageDetections,
    pub(super) layout: Layout,
}

impl Seen {
    fn new(shot: usize, found: Found) -> Self {
        Self { shot, detections: found.detections, layout: found.layout }
    }
}

/// Detects and lays out image by image, those apart that an earlier run or others have searched; `seen` are those that were
/// before.
fn search_images(
    search: &Search<'_>,
    chosen: &[usize],
    mut seen: Vec<Seen>,
    clock: &mut Clock<'_>,
) -> Result<Vec<Seen>, MapError> {
    let Search { folder, project, gsd_m, detector, options } = *search;
    let max_pixels = options.max_image_pixels;
    let observer = clock.observer;
    let start = Instant::now();
    let total = seen.len() + chosen.len();
    let (known, shots): (Vec<Seen>, Vec<usize>) = from_checkpoints(project, chosen, observer);
    seen.extend(known);
    observer.progress(Stage::Detect, seen.len(), total);
    let requests: Vec<ImageRequest> = shots
        .iter()
        .map(|&shot| {
            let Photo { shot: image, path, camera, .. } = project.photos[shot].clone();
            ImageRequest { image, path, camera, gsd_m: gsd_m[shot], max_pixels }
        })
        .collect();
    observer.offer(&requests);
    let seen = Mutex::new(seen);
    let keep = |image: usize, found: Found| {
        let mut seen = seen.lock().unwrap_or_else(PoisonError::into_inner);
        seen.push(Seen::new(shots[image], found));
        observer.progress(Stage::Detect, seen.len(), total);
    };
    let mut left: Vec<usize> = (0..requests.len()).collect();
    let next = || loop {
        if left.is_empty() {
            return None;
        }
        if observer.cancelled() {
            return Some(Err(MapError::Cancelled));
        }
        match observer.next(&left) {
            NextImage::Search(image) => {
                left.retain(|other| *other != image);
                let shot = shots[image];
                let pixels = folder.load(&project.photos[shot]).map_err(MapError::from);
                let name = requests[image].image.clone();
                return Some(pixels.map(|pixels| Loaded { key: image, image: name, pixels, gsd_m: gsd_m[shot] }));
            }
            // What was found twice counts once.
            NextImage::Found(image, found)
                if left.contains(&image) && found.detections.image == requests[image].image =>
            {
                left.retain(|other| *other != image);
                keep(image, *found);
            }
            NextImage::Found(..) => {}
            NextImage::Wait => std::thread::sleep(WAIT_FOR_OTHERS),
        }
    };
    let found = |image: usize, found: Found| {
        observer.save_checkpoint(&found);
        keep(image, found);
    };
    let layout_time = search::search(detector, next, found, || observer.cancelled())?;
    // In the order of the shots, whichever was done first.
    let mut seen = seen.into_inner().unwrap_or_else(PoisonError::into_inner);
    seen.sort_by_key(|image| image.shot);
    clock.add(Stage::Detect, start.elapsed().saturating_sub(layout_time));
    clock.add(Stage::Layout, layout_time);
    Ok(seen)
}

/// What an earlier run found in these shots, and the shots in which it had not looked.
fn from_checkpoints(project: &Project, chosen: &[usize], observer: &dyn Observer) -> (Vec<Seen>, Vec<usize>) {
    let (mut seen, mut requests) = (Vec::new(), Vec::new());
    for &shot in chosen {
        match observer.load_checkpoint(&project.reconstruction.shots[shot].name) {
            Some(found) => seen.push(Seen::new(shot, found)),
            None => requests.push(shot),
        }
    }
    (seen, requests)
}

/// Takes the boxes of a file instead of searching; images are decoded only to look at the ground between modules.
pub(super) fn from_boxes(
    folder: &dyn ProjectFolder,
    project: &Project,
    path: &Path,
    gsd_m: &[Option<f64>],
    options: &MapOptions,
    clock: &mut Clock<'_>,
    warnings: &mut Vec<Warning>,
) -> Result<Vec<Seen>, MapError> {
    let observer = clock.observer;
    let read = clock.stage(Stage::Detect, || external::read(path))??;
    let by_name: HashMap<&str, usize> =
        project.reconstruction.shots.iter().enumerate().map(|(index, shot)| (shot.name.as_str(), index)).collect();
    let mut seen: Vec<(usize, ImageDetections)> = Vec::new();
    let mut unknown = Vec::new();
    let mut doubles: Vec<(String, usize)> = Vec::new();
    for mut detections in read.images {
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
        let given = detections.detections.len();
        detections.detections = external::without_doubles(detections.detections);
        if detections.detections.len() < given {
            doubles.push((detections.image.clone(), given - detections.detections.len()));
        }
        seen.push((shot, detections));
    }
    if seen.is_empty() {
        let shot = project.reconstruction.shots.first().map_or("", |shot| shot.name.as_str());
        let named = unknown.first().map_or_else(
            || "it names no image".to_owned(),
            |image| format!("none of its {} images is in the reconstruction, such as `{image}`", unknown.len()),
        );
        return Err(MapError::Input {
            code: "boxes_invalid",
            message: format!(
                "{}: {named}; name images as the reconstruction names its shots, such as `{shot}`",
                path.display()
            ),
        });
    }
    let left_out = read.left_out.into_iter().filter(|(image, _)| by_name.contains_key(image.as_str()));
    let (images, counts): (Vec<String>, Vec<usize>) = left_out.unzip();
    if !images.is_empty() {
        warnings.push(Warning::new(
            "boxes_unusable",
            format!(
                "{} boxes in {} images lie outside of their image or have no area, and are left out",
                counts.iter().sum::<usize>(),
                images.len()
            ),
            images,
        ));
    }
    if !doubles.is_empty() {
        let (images, counts): (Vec<String>, Vec<usize>) = doubles.into_iter().unzip();
        let message = format!(
            "{} boxes in {} images lie on better ones, and are left out: a module has one box",
            counts.iter().sum::<usize>(),
            images.len()
        );
        warnings.push(Warning::new("boxes_double", message, images));
    }
    // What those notes say of a search does not hold here.
    let expected = resolving(gsd_m, options, &mut Vec::new());
    let given: HashSet<usize> = seen.iter().map(|(shot, _)| *shot).collect();
    let without: Vec<String> = expected
        .into_iter()
        .filter(|shot| !given.contains(shot))
        .map(|shot| project.reconstruction.shots[shot].name.clone())
        .collect();
    if !without.is_empty() {
        warnings.push(Warning::new(
            "images_without_boxes",
            format!(
                "{} images that resolve modules are not in the file of boxes, and count for nothing",
                without.len()
            ),
            without,
        ));
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
        seen.into_par_iter()
            .map(|(shot, detections)| {
                if observer.cancelled() {
                    return Err(MapError::Cancelled);
                }
                if let Some(found) = observer.load_checkpoint(&detections.image) {
                    return Ok(Seen::new(shot, found));
                }
                let grey = image::imageops::grayscale(&folder.load(&project.photos[shot])?);
                let layout = layout::infer(&detections, Some(&grey), &LayoutOptions::default());
                let found = Found { detections, layout };
                observer.save_checkpoint(&found);
                Ok(Seen::new(shot, found))
            })
            .collect()
    })?
}

/// How many modules were seen. Images without a bench are told.
///
/// # Errors
/// No image shows any module.
pub(super) fn modules_in(seen: &[Seen], warnings: &mut Vec<Warning>) -> Result<usize, MapError> {
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
    let loose: usize = seen.iter().map(|s| s.layout.loose.len()).sum();
    // Here and there a false box is no news.
    if loose >= 3 && 500 * loose > found {
        let images = seen.iter().filter(|s| !s.layout.loose.is_empty()).map(|s| s.detections.image.clone());
        warnings.push(Warning::new(
            "boxes_alone",
            format!(
                "{loose} of {found} boxes stand in no bench and are left out: false ones, modules that stand alone, or \
                 benches of which too little was found"
            ),
            images,
        ));
    }
    Ok(found)
}
