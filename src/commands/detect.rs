//! `heliomap detect`: photos in, boxes of modules out.

use super::output::{Output, notify, prepare_folder};
use anyhow::{Context, bail};
use clap::Args;
use heliomap::config::{DetectorArgs, ImageSizeArgs};
use heliomap_mapping::detection::{Detector, ImageDetections, external, scale};
use heliomap_mapping::geometry::Camera;
use heliomap_mapping::pipeline;
use heliomap_mapping::reconstruction::{Photo, photo};
use heliomap_overlay as overlay;
use image::RgbImage;
use std::collections::HashSet;
use std::path::{Path, PathBuf};
use std::sync::mpsc::sync_channel;
use std::time::Instant;

/// Find the modules in photos.
///
/// Writes {"images": [{"image", "width", "height", "boxes": [{"corners", "score", "source"}]}]}, which `heliomap map
/// --detections` takes again, corrected or not.
#[derive(Debug, Args)]
#[command(
    after_help = "A folder that holds reconstruction.json is searched as `heliomap map` does it: its photos are \
                        undistorted, and the reconstruction gives their scale. The photos of any other folder, and single \
                        photos, are searched as they are.\n\n\
                        Example: heliomap detect my-survey --out boxes.json --overlay pictures"
)]
pub struct DetectArgs {
    /// Photos, folders of photos, or folders as OpenSfM leaves them
    #[arg(required = true, value_name = "IMAGE")]
    images: Vec<PathBuf>,
    /// File to write the boxes to, instead of standard output
    #[arg(short, long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Draw the boxes on the photos, into this folder
    #[arg(long, value_name = "DIR")]
    overlay: Option<PathBuf>,
    /// Metres on the ground per pixel of the photos. If absent, it comes from the reconstruction or the drone's metadata, or else
    /// from the size of the modules
    #[arg(long, value_name = "M", value_parser = parse_gsd)]
    gsd: Option<f64>,
    #[command(flatten)]
    detector: DetectorArgs,
    /// Threads to use; all cores if absent
    #[arg(long, env = "HELIOMAP_THREADS", value_name = "N")]
    threads: Option<usize>,
    #[command(flatten)]
    image_size: ImageSizeArgs,
    /// Print seconds per photo
    #[arg(long)]
    timings: bool,
}

/// Metres per pixel, within what any photo of a plant may have.
pub fn parse_gsd(text: &str) -> Result<f64, String> {
    text.parse()
        .ok()
        .filter(|gsd: &f64| (0.001..=1.0).contains(gsd))
        .ok_or_else(|| "0.001 to 1 metre per pixel is expected".to_owned())
}

/// A photo to search, and what is known of its scale.
struct Task {
    photo: Photo,
    gsd_m: Option<f64>,
}

/// Runs the command.
pub fn run(args: &DetectArgs) -> anyhow::Result<()> {
    let output = args.out.as_deref().map_or(Ok(Output::Stdout), Output::named)?;
    if let Some(folder) = &args.overlay {
        prepare_folder(folder)?;
    }
    let threads = args.threads.unwrap_or(0);
    rayon::ThreadPoolBuilder::new().num_threads(threads).build_global().context("starting the threads")?;
    let tasks = tasks(args)?;
    let detector = args.detector.open(threads)?;
    tracing::info!("{}", detector.describe());
    let mut results: Vec<ImageDetections> = Vec::with_capacity(tasks.len());
    let start = Instant::now();
    each_decoded(&tasks, |task, picture| {
        let begun = Instant::now();
        let gsd_m = scale_of(args.gsd.or(task.gsd_m), &task.photo, &picture, &*detector)?;
        let detections = detector.detect(&picture, gsd_m)?;
        if args.timings {
            let seconds = begun.elapsed().as_secs_f64();
            notify(format_args!("{}: {} modules, {seconds:.2} s", task.photo.shot, detections.len()));
        }
        if let Some(folder) = &args.overlay {
            let stem = Path::new(&task.photo.shot).file_stem().unwrap_or_default().to_string_lossy().into_owned();
            let name = format!("{stem}.png");
            overlay::write_into(folder, &name, &overlay::draw_boxes(&picture, &detections, &[], &[]))?;
        }
        results.push(ImageDetections {
            image: task.photo.shot.clone(),
            width_px: picture.width(),
            height_px: picture.height(),
            detections,
        });
        Ok(())
    })?;
    if args.timings {
        notify(format_args!("{} photos: {:.2} s", tasks.len(), start.elapsed().as_secs_f64()));
    }
    output.write_json(&external::to_file(&results))?;
    let found: usize = results.iter().map(|image| image.detections.len()).sum();
    tracing::info!("{found} modules in {} photos", results.len());
    Ok(())
}

/// Decodes photo by photo, the next while `work` has the last.
fn each_decoded(tasks: &[Task], mut work: impl FnMut(&Task, RgbImage) -> anyhow::Result<()>) -> anyhow::Result<()> {
    std::thread::scope(|scope| {
        let (sender, decoded) = sync_channel(1);
        scope.spawn(move || {
            for task in tasks {
                if sender.send((task, task.photo.load())).is_err() {
                    break;
                }
            }
        });
        decoded.iter().try_for_each(|(task, picture)| work(task, picture?))
    })
}

/// Metres per pixel: as known, else by the file's metadata, else by the look of the modules.
pub fn scale_of(
    known_m: Option<f64>,
    photo: &Photo,
    picture: &RgbImage,
    detector: &dyn Detector,
) -> anyhow::Result<Option<f64>> {
    if let Some(gsd_m) = known_m.or_else(|| scale::from_metadata(&photo.path, picture.width(), picture.height())) {
        return Ok(Some(gsd_m));
    }
    let gsd_m = scale::by_look(detector, picture)?;
    match gsd_m {
        Some(gsd_m) => tracing::debug!("{}: {gsd_m:.4} m per pixel by the look of its modules", photo.shot),
        None => tracing::warn!("{}: its scale is unknown, and hardly any module is seen; try --gsd", photo.shot),
    }
    Ok(gsd_m)
}

fn tasks(args: &DetectArgs) -> anyhow::Result<Vec<Task>> {
    let max_pixels = args.image_size.max_pixels();
    let mut tasks = Vec::new();
    for path in &args.images {
        if path.join("reconstruction.json").is_file() {
            let photos = pipeline::photos_of(path, max_pixels)?;
            tasks.extend(photos.into_iter().map(|(photo, gsd_m)| Task { photo, gsd_m }));
        } else if path.is_dir() {
            for file in photos_in(path)? {
                tasks.push(Task { photo: photo_as_it_is(&file, max_pixels)?, gsd_m: None });
            }
        } else {
            tasks.push(Task { photo: photo_as_it_is(path, max_pixels)?, gsd_m: None });
        }
    }
    let mut names = HashSet::new();
    for task in &tasks {
        if !names.insert(task.photo.shot.as_str()) {
            bail!("two photos are named {}: search them in two runs, or rename one", task.photo.shot);
        }
    }
    Ok(tasks)
}

/// The photos of a folder, or of `images/` in it, by name.
fn photos_in(folder: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let beneath = folder.join("images");
    let folder = if beneath.is_dir() { &beneath } else { folder };
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).with_context(|| format!("reading {}", folder.display()))? {
        let path = entry?.path();
        let ending = path.extension().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
        if ["jpg", "jpeg", "png", "tif", "tiff"].contains(&ending.as_str()) && path.is_file() {
            files.push(path);
        }
    }
    files.sort();
    if files.is_empty() {
        bail!("there is no photo (JPEG, PNG or TIFF) in {}", folder.display());
    }
    Ok(files)
}

/// A photo whose pixels are taken as they are.
pub fn photo_as_it_is(path: &Path, max_pixels: u64) -> anyhow::Result<Photo> {
    let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let header = photo::inspect(path, &path.display().to_string(), max_pixels)?;
    let camera = Camera::pinhole(header.width_px, header.height_px, 1.0);
    Ok(Photo { shot: name, path: path.to_owned(), header, camera })
}
