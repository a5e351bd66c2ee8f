//! `heliomap reconstruct`: photos in, a reconstruction beside them out.

use super::output::{notify, print};
use super::progress::Progress;
use anyhow::ensure;
use clap::Args;
use heliomap::config::{ImageSizeArgs, ReconstructionArgs};
use heliomap_photogrammetry::{self as photogrammetry, Observer, Options, Report, Stage};
use std::path::{Path, PathBuf};

/// The same photos give the same reconstruction.
const SEED: u64 = 1;

/// Reconstruct photos: where each was taken and which points it shows.
///
/// Writes reconstruction.json, reference_lla.json and reconstruction-report.json into the folder, which `heliomap map` then
/// takes.
#[derive(Debug, Args)]
#[command(after_help = "The folder holds the photos as the camera wrote them, in images/.\n\n\
                        Example: heliomap reconstruct my-survey && heliomap map my-survey")]
pub struct ReconstructArgs {
    /// Folder with images/
    folder: PathBuf,
    #[command(flatten)]
    reconstruction: ReconstructionArgs,
    /// Replace a reconstruction that is there
    #[arg(long)]
    overwrite: bool,
    /// Threads to use; all cores if absent
    #[arg(long, env = "HELIOMAP_THREADS", value_name = "N")]
    threads: Option<usize>,
    #[command(flatten)]
    image_size: ImageSizeArgs,
    /// Print the report as JSON
    #[arg(long)]
    json: bool,
}

/// Runs the command.
pub fn run(args: &ReconstructArgs) -> anyhow::Result<()> {
    let there = args.folder.join("reconstruction.json");
    ensure!(args.overwrite || !there.exists(), "{} is there already: --overwrite replaces it", there.display());
    let report = reconstruct(&args.folder, &args.reconstruction, args.threads, args.image_size)?;
    if args.json {
        print(format_args!("{}\n", serde_json::to_string_pretty(&report)?))
    } else {
        print(summary(&report))
    }
}

/// Reconstructs the photos of `folder` with progress on standard error.
pub(super) fn reconstruct(
    folder: &Path,
    args: &ReconstructionArgs,
    threads: Option<usize>,
    image_size: ImageSizeArgs,
) -> anyhow::Result<Report> {
    let cores = std::thread::available_parallelism().map_or(2, usize::from);
    let options = Options {
        python: args.python(),
        focal_share: args.focal,
        max_image_pixels: image_size.max_pixels(),
        threads: threads.unwrap_or(cores).max(1),
        seed: SEED,
    };
    let shown = Shown(Progress::new());
    let report = photogrammetry::reconstruct(folder, &options, &shown)?;
    shown.0.finish();
    Ok(report)
}

struct Shown(Progress);

impl Observer for Shown {
    fn progress(&self, stage: Stage, done: usize, total: usize) {
        self.0.show(stage.as_str(), done, total);
    }
}

/// The report in a few lines.
pub(super) fn summary(report: &Report) -> String {
    let mut lines: Vec<String> = report.warnings.iter().map(|warning| format!("warning: {warning}")).collect();
    lines.extend(report.cameras.iter().map(|camera| {
        format!(
            "{}: focal length {:.4} of the longer side, k1 {:.4}, k2 {:.4}",
            camera.name, camera.focal, camera.k1, camera.k2
        )
    }));
    lines.push(format!(
        "{} of {} photos placed; {:.2} px of residual, {:.2} m from GNSS in the median, {:.2} m at most",
        report.placed, report.photos, report.reprojection_px, report.gnss_median_m, report.gnss_max_m
    ));
    lines.join("\n") + "\n"
}

/// Says what was found, beside the output of another command.
pub(super) fn announce(report: &Report) {
    notify(summary(report).trim_end());
}
