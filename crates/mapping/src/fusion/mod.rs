//! The layouts of all images become one plant: pixels to 3D, pieces of benches matched between images, their structures
//! merged, mended and confirmed (paper, 3.4 and 3.5).

mod apart;
pub mod associate;
pub mod benches;
mod cameras;
mod cluster;
mod disparity;
pub mod lines;
pub mod locate;
mod params;
mod piece_lattice;
mod pitch;
mod relocate;
pub mod repair;

use crate::detection::ImageDetections;
use crate::layout::Layout;
use crate::reconstruction::Shot;
pub use benches::{FusedBench, FusedModule, Observation};
use cameras::CameraQuality;
pub use lines::FusedLine;
pub use locate::{Located, LocatedPiece};
use nalgebra::Vector2;
pub use params::FusionParams;
use serde::{Deserialize, Serialize};
use std::borrow::Cow;
use std::collections::HashMap;

/// One image with all that is known of it.
#[derive(Debug, Clone, Copy)]
pub struct View<'a> {
    pub shot: &'a Shot,
    pub detections: &'a ImageDetections,
    pub layout: &'a Layout,
}

/// What may be told to the fusion.
#[derive(Debug, Clone, Copy)]
pub struct FusionOptions {
    /// Rows per bench, if every bench has the same known number.
    pub rows_per_bench: Option<u32>,
    /// How far the same point, located from two images, may lie apart, metres (the paper's raw models err by 0.6 m).
    pub max_disparity_m: f64,
    pub params: FusionParams,
}

impl Default for FusionOptions {
    fn default() -> Self {
        Self { rows_per_bench: None, max_disparity_m: 1.3, params: FusionParams::default() }
    }
}

/// A doubt that a person can settle.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Doubt {
    /// A stable word.
    pub code: Cow<'static, str>,
    /// One sentence with the choices in it.
    pub message: String,
    /// Images concerned.
    pub images: Vec<String>,
    /// Benches of [`Fused::benches`] concerned, sorted; those that were left out have no number.
    pub benches: Vec<usize>,
    /// Where: the middle of everything concerned, left out or not, east and north in metres.
    pub places_m: Vec<Vector2<f64>>,
    /// What was left out: view, and index into the view's detections.
    #[serde(default)]
    pub sightings: Vec<(usize, usize)>,
}

/// A doubt while benches have no numbers yet: it names the sets of pieces that they are made of.
#[derive(Debug)]
struct OpenDoubt {
    doubt: Doubt,
    clusters: Vec<usize>,
}

/// Benches get their numbers, and doubts name them.
fn close(doubts: Vec<OpenDoubt>, benches: &[FusedBench]) -> Vec<Doubt> {
    let number: HashMap<usize, usize> =
        benches.iter().enumerate().map(|(number, bench)| (bench.cluster, number)).collect();
    doubts
        .into_iter()
        .map(|OpenDoubt { mut doubt, clusters }| {
            doubt.benches = clusters.iter().filter_map(|cluster| number.get(cluster).copied()).collect();
            doubt.benches.sort_unstable();
            doubt.benches.dedup();
            doubt
        })
        .collect()
}

/// The structure of the whole plant.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub struct Fused {
    /// Lines from the north (or, where rows run north-south, from the east).
    pub lines: Vec<FusedLine>,
    pub benches: Vec<FusedBench>,
    pub doubts: Vec<Doubt>,
    /// How well each view's camera is known: standard deviation of what it displaces on the ground, metres. Empty where that
    /// could not be measured.
    pub camera_sigma_m: Vec<f64>,
}

impl Fused {
    /// Leaves out all benches but those marked; doubts about those that go name the others alone.
    pub fn keep_benches(&mut self, kept: &[bool]) {
        let mut next = 0;
        let number: Vec<Option<usize>> = kept
            .iter()
            .map(|keep| {
                let own = keep.then_some(next);
                next += usize::from(*keep);
                own
            })
            .collect();
        let renumber =
            |benches: &mut Vec<usize>| *benches = benches.iter().filter_map(|bench| number[*bench]).collect();
        let mut keep = kept.iter();
        self.benches.retain(|_| keep.next().copied().unwrap_or(false));
        for line in &mut self.lines {
            renumber(&mut line.benches);
        }
        self.lines.retain(|line| !line.benches.is_empty());
        for doubt in &mut self.doubts {
            renumber(&mut doubt.benches);
        }
    }
}

/// Fuses located pieces into the structure of the plant. The result does not depend on the order of the views.
pub fn fuse(views: &[View<'_>], located: Located, options: &FusionOptions) -> Fused {
    fuse_unless(views, located, options, || false).unwrap_or_default()
}

/// As [`fuse`]; `None` soon after `stopped` is true, which is asked between the steps.
pub fn fuse_unless(
    views: &[View<'_>],
    located: Located,
    options: &FusionOptions,
    stopped: impl Fn() -> bool,
) -> Option<Fused> {
    let go_on = || (!stopped()).then_some(());
    let mut doubts = Vec::new();
    go_on()?;
    let (mut pieces, cameras) = by_geometry(views, located.pieces, options);
    go_on()?;
    let mut clusters = associate::associate(&pieces, cameras.as_ref(), options);
    // A keypoint missed in one image lets one piece run over two benches; the other images tell where to split it.
    for _ in 0..3 {
        let splits = repair::missed_gaps(&pieces, &clusters);
        if splits.is_empty() {
            break;
        }
        pieces = repair::split(pieces, &splits);
        go_on()?;
        clusters = associate::associate(&pieces, cameras.as_ref(), options);
    }
    doubts.extend(clusters.doubts.iter().map(|doubt| doubt.describe(views, &pieces, &clusters)));
    go_on()?;
    let benches = benches::assemble(views, &pieces, &clusters, &options.params, &mut doubts);
    go_on()?;
    let benches = benches::without_ghosts(views, benches, &mut doubts);
    let (lines, benches) = lines::arrange(benches, &options.params, &mut doubts);
    let doubts = close(doubts, &benches);
    let camera_sigma_m = cameras.map_or_else(Vec::new, |cameras| cameras.sigma_m);
    Some(Fused { lines, benches, doubts, camera_sigma_m })
}

/// Pieces where their boxes and the pitch of their type put them, and how well the cameras agree; where the cameras are too
/// poor for that, or pitches cannot be measured, the pieces as they are.
fn by_geometry(
    views: &[View<'_>],
    pieces: Vec<LocatedPiece>,
    options: &FusionOptions,
) -> (Vec<LocatedPiece>, Option<CameraQuality>) {
    let params = &options.params;
    let near = associate::near_pairs(&pieces, options);
    let types = pitch::types(views, &pieces, &near, params);
    if types.is_empty() {
        return (pieces, None);
    }
    let mut moved = pieces.clone();
    relocate::relocate(views, &mut moved, &types, params);
    let near = associate::near_pairs(&moved, options);
    let cameras = cameras::measure(views.len(), &moved, &near, params);
    match cameras.filter(|cameras| cameras.pitches < params.good_camera_pitches) {
        Some(cameras) => (moved, Some(cameras)),
        None => (pieces, None),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::cell::Cell;

    #[test]
    fn fusing_ends_at_the_next_step_where_it_is_stopped() {
        let fused = |steps: usize| {
            let left = Cell::new(steps);
            let stopped = || left.replace(left.get().saturating_sub(1)) == 0;
            fuse_unless(&[], Located { pieces: Vec::new() }, &FusionOptions::default(), stopped)
        };
        assert_eq!((0..5).map(|steps| fused(steps).is_some()).collect::<Vec<_>>(), [false, false, false, false, true]);
    }
}
