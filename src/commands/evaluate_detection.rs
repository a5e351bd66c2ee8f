//! `heliomap evaluate-detection`: boxes against labelled photos.

use super::detect::{parse_gsd, photo_as_it_is, scale_of};
use super::output::{Output, prepare_folder, print};
use anyhow::{Context, bail};
use clap::Args;
use heliomap::config::DetectorArgs;
use heliomap_evaluation::detection::{DetectionReport, LabelledPhoto, PhotoScore, compare, read_labels};
use heliomap_mapping::detection::{Detector, ImageDetections, external};
use heliomap_mapping::geometry::Quad;
use heliomap_mapping::reconstruction::photo::DEFAULT_MAX_PIXELS;
use heliomap_overlay as overlay;
use std::path::{Path, PathBuf};

/// Measure a detector, or a file of boxes, against labelled photos.
///
/// Recall, precision, mean intersection over union, centre error, splits and merges of the modules wholly inside the frame,
/// per plant, condition and photo; modules under glare are counted separately.
#[derive(Debug, Args)]
#[command(after_help = "Labels are a truth.json with camera, modules and shots, a folder that holds one, or a file\n\
                        {\"photo\": {\"modules\": [[[x, y] x 4]], \"ignore\": [polygon]}} in pixels of the photo.\n\n\
                        Example: heliomap evaluate-detection data/train/1? --overlay pictures")]
pub struct EvaluateDetectionArgs {
    /// Labels: one or more
    #[arg(required = true, value_name = "LABELS")]
    labels: Vec<PathBuf>,
    /// Folder of the photos, if they are not beside the labels
    #[arg(long, value_name = "DIR")]
    images: Option<PathBuf>,
    /// Measure these boxes (pixels of the photos as they are) instead of running a detector
    #[arg(long, value_name = "FILE")]
    detections: Option<PathBuf>,
    /// Metres on the ground per pixel of the photos. If absent, it comes from the truth's cameras, as from a reconstruction when
    /// a plant is mapped, or else as in `heliomap detect`
    #[arg(long, value_name = "M", value_parser = parse_gsd)]
    gsd: Option<f64>,
    /// Ignore the scale that the truth's cameras give
    #[arg(long)]
    unknown_scale: bool,
    /// Print the figures of every photo, too
    #[arg(long)]
    photos: bool,
    /// Write everything as JSON too; `-` prints it instead of the text
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Draw boxes on the photos into this folder: missed modules red, false boxes orange
    #[arg(long, value_name = "DIR")]
    overlay: Option<PathBuf>,
    #[command(flatten)]
    detector: DetectorArgs,
    /// Threads to use; all cores if absent
    #[arg(long, env = "HELIOMAP_THREADS", value_name = "N")]
    threads: Option<usize>,
}

/// Runs the comparison and prints it.
pub fn run(args: &EvaluateDetectionArgs) -> anyhow::Result<()> {
    let json = args.json.as_deref().map(Output::named).transpose()?;
    if let Some(folder) = &args.overlay {
        prepare_folder(folder)?;
    }
    let threads = args.threads.unwrap_or(0);
    rayon::ThreadPoolBuilder::new().num_threads(threads).build_global().context("starting the threads")?;
    let mut labelled = Vec::new();
    for path in &args.labels {
        labelled.extend(read_labels(path, args.images.as_deref())?);
    }
    let (given, detector) = match &args.detections {
        Some(path) => (given_boxes(path)?, None),
        None => (Vec::new(), Some(args.detector.open(threads)?)),
    };
    let mut scores = Vec::with_capacity(labelled.len());
    for labels in &labelled {
        scores.push(measure(args, labels, &given, detector.as_deref())?);
    }
    let what = match (&args.detections, &detector) {
        (Some(path), _) => format!("boxes of {}", path.display()),
        (None, detector) => detector.as_ref().map_or_else(String::new, |detector| detector.describe()),
    };
    let report = DetectionReport::new(what, scores);
    match &json {
        Some(Output::Stdout) => print(format_args!("{}\n", serde_json::to_string_pretty(&report)?))?,
        json => {
            if args.photos {
                print(format_args!("{}\n", report.photo_table()))?;
            }
            print(&report)?;
            json.as_ref().map_or(Ok(()), |json| json.write_json(&report))?;
        }
    }
    Ok(())
}

/// The boxes of a file; unusable ones are logged and left out.
fn given_boxes(path: &Path) -> anyhow::Result<Vec<ImageDetections>> {
    let read = external::read(path)?;
    for (image, count) in &read.left_out {
        tracing::warn!("{count} boxes of {image} lie outside of it or have no area, and are left out");
    }
    Ok(read.images)
}

/// The score of one photo.
fn measure(
    args: &EvaluateDetectionArgs,
    labels: &LabelledPhoto,
    given: &[ImageDetections],
    detector: Option<&dyn Detector>,
) -> anyhow::Result<PhotoScore> {
    let photo = photo_as_it_is(&labels.path, DEFAULT_MAX_PIXELS)?;
    let picture = photo.load()?;
    let detections = match detector {
        Some(detector) => {
            let known_m = args.gsd.or(labels.gsd_m.filter(|_| !args.unknown_scale));
            let gsd_m = scale_of(known_m, &photo, &picture, detector)?;
            detector.detect(&picture, gsd_m)?
        }
        None => {
            let Some(boxes) = given.iter().find(|boxes| is_same_photo(&boxes.image, &labels.image)) else {
                bail!("the boxes hold none for {}: give boxes of all labelled photos", labels.image);
            };
            if (boxes.width_px, boxes.height_px) != picture.dimensions() {
                bail!(
                    "the boxes of {} are for {} x {} pixels, but the photo has {} x {}",
                    labels.image,
                    boxes.width_px,
                    boxes.height_px,
                    picture.width(),
                    picture.height()
                );
            }
            boxes.detections.clone()
        }
    };
    let score = compare(labels, &picture, &detections);
    if let Some(folder) = &args.overlay {
        let quads = |corners: &[[[f64; 2]; 4]]| -> Vec<Quad> {
            corners.iter().map(|corners| Quad { corners: corners.map(Into::into) }).collect()
        };
        let drawn = overlay::draw_boxes(&picture, &detections, &quads(&score.missed), &quads(&score.wrong));
        let stem = Path::new(&labels.image).file_stem().unwrap_or_default().to_string_lossy().into_owned();
        overlay::write_into(folder, &format!("{}-{stem}.png", labels.group), &drawn)?;
    }
    Ok(score)
}

/// Compares the names of photos, with or without the ending.
fn is_same_photo(a: &str, b: &str) -> bool {
    a == b || Path::new(a).file_stem() == Path::new(b).file_stem()
}
