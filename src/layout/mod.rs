//! Detections of one image become rows, benches, bench gaps and hypotheses (paper, 3.3).
//!
//! The paper draws RANSAC lines over the whole image, groups them by the Hausdorff distance of their ends at the image
//! border, and needs the number of rows. Here benches grow as lattices from module to module instead: every module has
//! two side vectors, its neighbours stand one side further, and the links between them span benches of any number of
//! rows, straight or curved, of any azimuth. See `docs/PIPELINE.md` for the comparison.

pub mod grow;
pub mod keypoints;
pub mod lattice;
pub mod transition;

use crate::detection::ImageDetections;
use crate::geometry::Quad;
use image::GrayImage;
pub use lattice::LatticeMap;
use nalgebra::Vector2;

/// What the inference may be told.
#[derive(Debug, Clone, Copy)]
pub struct LayoutOptions {
    /// How much further than usual neighbours must stand apart for a bench gap to lie between them, as a share of the
    /// shorter module pitch (`th` of equation 2).
    pub gap_threshold: f64,
    /// Most modules missing in a run that are taken for missed detections (equation 3).
    pub max_missing: i32,
}

impl Default for LayoutOptions {
    fn default() -> Self {
        Self { gap_threshold: 0.1, max_missing: 8 }
    }
}

/// A place in the lattice of a piece.
#[derive(Debug, Clone, PartialEq)]
pub struct Cell {
    /// 0 is the top row of the piece (as oriented in the image).
    pub row: i32,
    /// 0 is the left column of the piece.
    pub col: i32,
    pub quad: Quad,
    /// Index into the detections; `None` for a hypothesis: a module that should be here but was not detected.
    pub detection: Option<usize>,
}

/// What bounds a piece on one side.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum End {
    /// The next module would lie wholly inside the image, and none is there.
    Closed,
    /// The image ends before the bench may do.
    Cut,
}

/// The part of one bench that one image shows. Cells are sorted by row and column; both start at 0.
#[derive(Debug, Clone)]
pub struct Piece {
    pub rows: i32,
    pub cols: i32,
    pub cells: Vec<Cell>,
    /// Lattice coordinates (column, row) to pixels.
    pub map: LatticeMap,
    pub west: End,
    pub east: End,
    pub north: End,
    pub south: End,
    /// Columns `c` with nothing detected between column `c` and the next detected one: joined because the distance is a
    /// whole number of modules, not because a row runs through.
    pub bridges: Vec<i32>,
}

impl Piece {
    /// The cell at a place, detected or not.
    pub fn cell(&self, row: i32, col: i32) -> Option<&Cell> {
        self.cells.binary_search_by_key(&(row, col), |cell| (cell.row, cell.col)).ok().map(|index| &self.cells[index])
    }

    /// Cells with a detection.
    pub fn detected(&self) -> impl Iterator<Item = (&Cell, usize)> {
        self.cells.iter().filter_map(|cell| Some((cell, cell.detection?)))
    }
}

/// A visually significant keypoint: the gap between two benches of one line, at one row (equation 2).
#[derive(Debug, Clone, PartialEq)]
pub struct Gap {
    /// Piece and cell on the left.
    pub west: (usize, i32, i32),
    /// Piece and cell on the right.
    pub east: (usize, i32, i32),
    pub center_px: Vector2<f64>,
    /// Distance of the two modules in units of the pitch along the row.
    pub pitches: f64,
    /// How much darker the ground between them is than the seams of the two benches, in grey levels of 0 to 1; `None`
    /// without an image.
    pub darker: Option<f64>,
}

/// The structure seen in one image.
#[derive(Debug, Clone)]
pub struct Layout {
    pub image: String,
    pub width_px: u32,
    pub height_px: u32,
    pub pieces: Vec<Piece>,
    pub gaps: Vec<Gap>,
    /// Detections that belong to no piece.
    pub loose: Vec<usize>,
}

/// Infers the structure of one image. `grey` is the undistorted image, used to look at the ground between modules;
/// without it distances alone decide.
pub fn infer(detections: &ImageDetections, grey: Option<&GrayImage>, options: &LayoutOptions) -> Layout {
    let (mut pieces, loose) = grow::grow(detections, grey, options);
    pieces.sort_by(|a, b| {
        let key = |piece: &Piece| piece.cells[0].quad.center();
        let (p, q) = (key(a), key(b));
        p.y.total_cmp(&q.y).then(p.x.total_cmp(&q.x))
    });
    let gaps = keypoints::find(&pieces, grey, options);
    Layout {
        image: detections.image.clone(),
        width_px: detections.width_px,
        height_px: detections.height_px,
        pieces,
        gaps,
        loose,
    }
}
