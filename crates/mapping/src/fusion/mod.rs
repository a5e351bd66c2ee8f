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

/// How geometry decides which modules are the same. Values are measured on the twins of the paper's plants and on
/// simulated flights unless another source is given.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FusionParams {
    /// Standard deviation of the centre of a box, pixels, before it is measured.
    pub box_sigma_px: f64,
    /// Least standard deviation of what all boxes of a piece have in common, pixels (detectors see the edge of a table
    /// otherwise than a seam).
    pub shared_sigma_px: f64,
    /// How well a piece's depth is known by cloud or ground before its pitch tells, metres: sparse points lie on the ground,
    /// one to two metres below the tables.
    pub depth_sigma_m: f64,
    /// Slope of a row against the cloud's surface, radians: terrain.
    pub slope_sigma: f64,
    /// How far a bench bends from straight over half its length, metres.
    pub bend_sigma_m: f64,
    /// How far from a right angle a table may be, as the cosine.
    pub square_sigma: f64,
    /// Boxes that a piece needs to take part in measuring the pitch.
    pub pitch_least_boxes: usize,
    /// Least angle between the rays of two views that measure it, radians.
    pub pitch_least_angle_rad: f64,
    /// Most pairs of pieces that are triangulated for it.
    pub pitch_most_pairs: usize,
    /// How far shifts are tried about the positions by the cloud, metres.
    pub pitch_reach_m: f64,
    /// Most mean squared residual of a triangulated pair, in variances of a box.
    pub pitch_most_residual: f64,
    /// Relative width in which pitches count as equal.
    pub pitch_window: f64,
    /// Relative standard deviation of a pitch by the cloud's depth alone.
    pub pitch_rough_sigma: f64,
    /// Least number and share of the pairs that make a type of bench.
    pub pitch_least_pairs: usize,
    pub pitch_least_share: f64,
    /// Share of the pairs left that must agree; by mere chance 5 to 16 % do.
    pub pitch_agreeing_share: f64,
    /// Least relative standard deviation of a pitch.
    pub pitch_least_sigma: f64,
    /// Least standard deviation of the rise of a table across its rows, as the sine of its tilt.
    pub rise_least_sigma: f64,
    /// Most types of bench.
    pub most_types: usize,
    /// Degrees of freedom of the disagreement of two lattices (Student's t): boxes may err together in ways not foreseen.
    pub disagreement_dof: f64,
    /// Cameras are good where they disagree by no more than this share of a pitch: then one pair of pieces decides by itself
    /// (integer ambiguities are fixed at 0.15 cycles, Teunissen 1998).
    pub good_camera_pitches: f64,
    /// Least standard deviation of the disagreement of two cameras on the ground, metres.
    pub camera_least_m: f64,
    /// Share of the bench ends that a view sees wrongly (boxes missed in clusters): no end weighs more than its logarithm.
    pub false_end_share: f64,
}

impl Default for FusionParams {
    fn default() -> Self {
        Self {
            box_sigma_px: 1.0,
            shared_sigma_px: 0.3,
            depth_sigma_m: 3.0,
            slope_sigma: 0.05,
            bend_sigma_m: 0.1,
            square_sigma: 0.003,
            pitch_least_boxes: 8,
            pitch_least_angle_rad: 0.1,
            pitch_most_pairs: 3000,
            pitch_reach_m: 2.5,
            pitch_most_residual: 25.0,
            pitch_window: 0.002,
            pitch_rough_sigma: 0.04,
            pitch_least_pairs: 6,
            pitch_least_share: 0.1,
            pitch_agreeing_share: 0.25,
            pitch_least_sigma: 0.0015,
            rise_least_sigma: 0.03,
            most_types: 8,
            disagreement_dof: 8.0,
            good_camera_pitches: 0.15,
            camera_least_m: 0.02,
            false_end_share: 0.03,
        }
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
    let benches = benches::assemble(views, &pieces, &clusters, &mut doubts);
    go_on()?;
    let benches = benches::without_ghosts(views, benches, &mut doubts);
    let (lines, benches) = lines::arrange(benches, &mut doubts);
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
