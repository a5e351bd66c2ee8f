//! Detects the modules in images and lays them out, image by image; used by a mapping and by workers that help one.

use super::{Found, MapError};
use crate::detection::{Detector, ImageDetections};
use crate::geometry::Camera;
use crate::layout::{self, LayoutOptions};
use crate::reconstruction::Photo;
use image::RgbImage;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use std::sync::mpsc::{SyncSender, sync_channel};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Images that are searched at once: while the boxes of one are measured, the networks run on the next.
const IN_FLIGHT: usize = 2;

/// An image to be searched: all that a process with its file needs to know.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ImageRequest {
    /// The shot's name.
    pub image: String,
    /// The photo.
    pub path: PathBuf,
    /// The camera of the photo as it is, distorted or not.
    pub camera: Camera,
    /// Metres on the ground per pixel, where it is known.
    pub gsd_m: Option<f64>,
    /// Most pixels that the photo may have.
    pub max_pixels: u64,
}

impl ImageRequest {
    /// Decodes the photo, which lies at `path`, and undistorts it. H x W, 8-bit RGB.
    ///
    /// # Errors
    /// A photo that differs from the request, or does not decode.
    pub fn load(&self, path: &Path) -> Result<RgbImage, MapError> {
        let header = crate::reconstruction::photo::inspect(path, &self.file_name(), self.max_pixels);
        let header = header.map_err(crate::reconstruction::ReadError::Photo)?;
        let photo = Photo { shot: self.image.clone(), path: path.to_owned(), header, camera: self.camera };
        Ok(photo.load().map_err(crate::reconstruction::ReadError::Photo)?)
    }

    fn file_name(&self) -> String {
        self.path.file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned())
    }
}

/// An image that is searched next.
pub struct Loaded<K> {
    /// Identifies this image.
    pub key: K,
    /// The shot's name.
    pub image: String,
    /// Free of distortion.
    pub pixels: RgbImage,
    /// Metres on the ground per pixel, where it is known.
    pub gsd_m: Option<f64>,
}

/// An image between two steps.
struct Passed<K> {
    key: K,
    pixels: RgbImage,
    detections: ImageDetections,
}

/// Searches and lays out the images that `next` gives until it gives no more, and hands each to `found`: while some are
/// searched, the next is loaded and the last is laid out, so that no more than a few are in memory at once. How long laying
/// out took.
///
/// # Errors
/// The first that `next` gives or the detector has; cancellation.
pub fn search<K: Send>(
    detector: &dyn Detector,
    mut next: impl FnMut() -> Option<Result<Loaded<K>, MapError>> + Send,
    mut found: impl FnMut(K, Found) + Send,
    cancelled: impl Fn() -> bool + Sync,
) -> Result<Duration, MapError> {
    let (loaded_sender, loaded) = sync_channel::<Result<Loaded<K>, MapError>>(1);
    let (passed_sender, passed) = sync_channel::<Passed<K>>(1);
    // Taken away by the first worker that fails, so that loading ends, too.
    let loaded = Mutex::new(Some(loaded));
    let take = || loaded.lock().unwrap_or_else(PoisonError::into_inner).as_ref()?.recv().ok();
    let detect = |passed: &SyncSender<Passed<K>>| -> Result<(), MapError> {
        while let Some(image) = take() {
            if cancelled() {
                return Err(MapError::Cancelled);
            }
            let Loaded { key, image, pixels, gsd_m } = image?;
            let (width_px, height_px) = pixels.dimensions();
            let detections = detector.detect(&pixels, gsd_m)?;
            let detections = ImageDetections { image, width_px, height_px, detections };
            if passed.send(Passed { key, pixels, detections }).is_err() {
                break;
            }
        }
        Ok(())
    };
    let end_loading = || drop(loaded.lock().unwrap_or_else(PoisonError::into_inner).take());
    let work = |passed: SyncSender<Passed<K>>| detect(&passed).inspect_err(|_| end_loading());
    let unexpected = |what: &str| MapError::Environment { message: format!("{what} an image failed unexpectedly") };
    std::thread::scope(|scope| {
        scope.spawn(move || {
            while let Some(image) = next() {
                if loaded_sender.send(image).is_err() {
                    break;
                }
            }
        });
        let laying_out = scope.spawn(move || {
            let mut spent = Duration::ZERO;
            for Passed { key, pixels, detections } in passed {
                let start = Instant::now();
                let grey = image::imageops::grayscale(&pixels);
                let layout = layout::infer(&detections, Some(&grey), &LayoutOptions::default());
                spent += start.elapsed();
                found(key, Found { detections, layout });
            }
            spent
        });
        let workers: Vec<_> = (0..IN_FLIGHT)
            .map(|_| {
                let (work, passed) = (&work, passed_sender.clone());
                scope.spawn(move || work(passed))
            })
            .collect();
        drop(passed_sender);
        let outcomes: Vec<Result<(), MapError>> =
            workers.into_iter().map(|worker| worker.join().unwrap_or_else(|_| Err(unexpected("searching")))).collect();
        end_loading();
        outcomes.into_iter().collect::<Result<(), MapError>>()?;
        laying_out.join().map_err(|_| unexpected("laying out"))
    })
}
