//! The layouts of all images become one plant: pixels to 3D, pieces of benches matched between images, their structures
//! merged, mended and confirmed (paper, 3.4 and 3.5).

mod apart;
pub mod associate;
pub mod benches;
mod cluster;
mod disparity;
pub mod lines;
pub mod locate;
pub mod repair;

use crate::detection::ImageDetections;
use crate::layout::Layout;
use crate::reconstruction::Shot;
pub use benches::{FusedBench, FusedModule, Observation};
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
}

impl Default for FusionOptions {
    fn default() -> Self {
        Self { rows_per_bench: None, max_disparity_m: 1.3 }
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
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Fused {
    /// Lines from the north (or, where rows run north-south, from the east).
    pub lines: Vec<FusedLine>,
    pub benches: Vec<FusedBench>,
    pub doubts: Vec<Doubt>,
}

/// Fuses located pieces into the structure of the plant. The result does not depend on the order of the views.
pub fn fuse(views: &[View<'_>], located: Located, options: &FusionOptions) -> Fused {
    let mut doubts = Vec::new();
    let mut pieces = located.pieces;
    let mut clusters = associate::associate(&pieces, options);
    // A keypoint missed in one image lets one piece run over two benches; the other images tell where to split it.
    for _ in 0..3 {
        let splits = repair::missed_gaps(&pieces, &clusters);
        if splits.is_empty() {
            break;
        }
        pieces = repair::split(pieces, &splits);
        clusters = associate::associate(&pieces, options);
    }
    doubts.extend(clusters.doubts.iter().map(|doubt| doubt.describe(views, &pieces, &clusters)));
    let benches = benches::assemble(views, &pieces, &clusters, &mut doubts);
    let benches = benches::without_ghosts(views, benches, &mut doubts);
    let (lines, benches) = lines::arrange(benches, &mut doubts);
    let doubts = close(doubts, &benches);
    Fused { lines, benches, doubts }
}
