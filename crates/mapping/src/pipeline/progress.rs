//! Progress of a mapping, its checkpoints, and the sharing of its images with other workers.

use super::{Found, ImageRequest, MapError};
use crate::fusion::Fused;
use std::time::{Duration, Instant};

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

/// What one stage cost.
#[derive(Debug, Clone, Copy)]
pub struct StageTiming {
    pub stage: Stage,
    pub wall: Duration,
    /// Highest resident memory of the process so far, bytes; `None` where the system does not report it.
    pub peak_memory_bytes: Option<u64>,
}

/// Receives the progress of a mapping, and keeps its checkpoints. Called from several threads.
pub trait Observer: Sync {
    /// `done` of `total` units of a stage are finished (images, or one unit where a stage has no parts).
    fn progress(&self, stage: Stage, done: usize, total: usize);
    /// Whether the mapping should end early with [`MapError::Cancelled`].
    fn cancelled(&self) -> bool {
        false
    }
    /// The checkpoint of an image that an earlier run of the same mapping (equal input, options and program) saved.
    fn load_checkpoint(&self, _image: &str) -> Option<Found> {
        None
    }
    /// Saves what was found in an image, so that a later run need not search it again.
    fn save_checkpoint(&self, _found: &Found) {}
    /// The fused structure that an earlier run of the same mapping saved; `of` is the digest of the layouts it was fused from.
    fn load_structure(&self, _of: &str) -> Option<Fused> {
        None
    }
    /// Saves the fused structure with the digest of the layouts it was fused from.
    fn save_structure(&self, _fused: &Fused, _of: &str) {}
    /// Publishes the images to be searched, in order, so that other workers may help. Their paths lie in the mapping's folder.
    fn offer(&self, _images: &[ImageRequest]) {}
    /// What to do next with the offered images. `left`, never empty, holds the indices of those that were neither searched here
    /// nor finished by another worker, in order.
    fn next(&self, left: &[usize]) -> NextImage {
        NextImage::Search(left[0])
    }
}

/// What to do next with the offered images, by index.
#[derive(Debug, Clone)]
pub enum NextImage {
    /// Search this one here.
    Search(usize),
    /// Another worker has searched this one, with the same result as here.
    Found(usize, Box<Found>),
    /// Other workers are searching all that are left.
    Wait,
}

/// Measures stages and reports them.
pub(super) struct Clock<'a> {
    pub(super) observer: &'a dyn Observer,
    pub(super) timings: Vec<StageTiming>,
}

impl Clock<'_> {
    /// Runs a stage that has no parts.
    pub(super) fn stage<T>(&mut self, stage: Stage, work: impl FnOnce() -> T) -> Result<T, MapError> {
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

    pub(super) fn add(&mut self, stage: Stage, wall: Duration) {
        self.timings.push(StageTiming { stage, wall, peak_memory_bytes: peak_memory_bytes() });
    }
}

/// Highest resident memory of this process so far, bytes, from `/proc`.
fn peak_memory_bytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|line| line.starts_with("VmHWM:"))?;
    Some(line.split_ascii_whitespace().nth(1)?.parse::<u64>().ok()? * 1024)
}
