//! Detections of one image become rows, benches, bench gaps and hypotheses (paper, 3.3).
//!
//! The paper draws RANSAC lines over the whole image, groups them by the Hausdorff distance of their ends at the image
//! border, and needs the number of rows. Here benches grow as lattices from module to module instead: every module has
//! two side vectors, its neighbours stand one side further, and the links between them span benches of any number of
//! rows, straight or curved, of any azimuth. See `docs/PIPELINE.md` for the comparison.

mod cut;
pub mod grow;
mod join;
pub mod keypoints;
pub mod lattice;
mod params;
pub mod transition;

use crate::detection::ImageDetections;
use crate::geometry::Quad;
use image::GrayImage;
pub use lattice::LatticeMap;
use nalgebra::Vector2;
pub use params::LayoutParams;
use serde::{Deserialize, Serialize};

/// What the inference may be told.
#[derive(Debug, Clone, Copy)]
pub struct LayoutOptions {
    /// How much further than usual neighbours must stand apart for a bench gap to lie between them, as a share of the
    /// shorter module pitch (`th` of equation 2).
    pub gap_threshold: f64,
    /// Most modules missing in a run that are taken for missed detections (equation 3).
    pub max_missing: i32,
    pub params: LayoutParams,
}

impl Default for LayoutOptions {
    fn default() -> Self {
        Self { gap_threshold: 0.1, max_missing: 8, params: LayoutParams::default() }
    }
}

/// A place in the lattice of a piece.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
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
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum End {
    /// The next module would lie wholly inside the image, and none is there.
    Closed,
    /// The image ends before the bench may do, or more of the same lattice follows after a distance of whole modules.
    Cut,
}

/// The part of one bench that one image shows. Cells are sorted by row and column; both start at 0.
#[derive(Debug, Clone, Serialize, Deserialize)]
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
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
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
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Layout {
    pub image: String,
    pub width_px: u32,
    pub height_px: u32,
    pub pieces: Vec<Piece>,
    pub gaps: Vec<Gap>,
    /// Detections that belong to no piece.
    pub loose: Vec<usize>,
    /// Whether some of the benches in the image were left out: then its silence on a bench says nothing.
    #[serde(default)]
    pub partial: bool,
}

impl Layout {
    /// Leaves out all pieces but those marked, and the gaps beside them.
    pub fn keep_pieces(&mut self, kept: &[bool]) {
        let mut next = 0;
        let number: Vec<Option<usize>> = kept
            .iter()
            .map(|keep| {
                let own = keep.then_some(next);
                next += usize::from(*keep);
                own
            })
            .collect();
        let mut keep = kept.iter();
        self.pieces.retain(|_| keep.next().copied().unwrap_or(false));
        self.gaps.retain_mut(|gap| match (number[gap.west.0], number[gap.east.0]) {
            (Some(west), Some(east)) => {
                (gap.west.0, gap.east.0) = (west, east);
                true
            }
            _ => false,
        });
        self.partial = true;
    }
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
        partial: false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::detection::{Detection, Source};
    use proptest::prelude::*;

    /// A bench on the ground: where it begins, rows, columns, places left empty.
    struct Table {
        at: [f64; 2],
        rows: i32,
        cols: i32,
        missing: Vec<(i32, i32)>,
    }

    fn table(x: f64, y: f64, rows: i32, cols: i32) -> Table {
        Table { at: [x, y], rows, cols, missing: vec![] }
    }

    /// Modules of 24 x 38 px (pitch 24.5 x 38.5) seen with some perspective, turned about the middle of a 1200 x 900
    /// frame. Modules not wholly inside are left out, as detectors do.
    fn image(tables: &[Table], turn_deg: f64, perspective: f64) -> ImageDetections {
        let (sin, cos) = turn_deg.to_radians().sin_cos();
        let look = |p: Vector2<f64>| {
            let p = p - Vector2::new(600.0, 450.0);
            let w = 1.0 + perspective * (0.3 * p.x + p.y) / 900.0;
            Vector2::new(cos * p.x - sin * p.y, sin * p.x + cos * p.y) / w + Vector2::new(600.0, 450.0)
        };
        let mut detections = Vec::new();
        for table in tables {
            for row in 0..table.rows {
                for col in 0..table.cols {
                    if table.missing.contains(&(row, col)) {
                        continue;
                    }
                    let center = Vector2::new(table.at[0] + 24.5 * f64::from(col), table.at[1] + 38.5 * f64::from(row));
                    let quad = Quad::from_center(center, Vector2::new(12.0, 0.0), Vector2::new(0.0, 19.0)).map(look);
                    let inside = quad.corners.iter().all(|c| c.x > 2.0 && c.y > 2.0 && c.x < 1197.0 && c.y < 897.0);
                    if inside {
                        let quad = Quad::from_unordered(quad.corners).unwrap();
                        detections.push(Detection { quad, score: 1.0, source: Source::External });
                    }
                }
            }
        }
        ImageDetections { image: "a.jpg".to_owned(), width_px: 1200, height_px: 900, detections }
    }

    fn shapes(layout: &Layout) -> Vec<(i32, i32)> {
        let mut shapes: Vec<(i32, i32)> = layout.pieces.iter().map(|p| (p.rows, p.cols)).collect();
        shapes.sort_unstable();
        shapes
    }

    #[test]
    fn two_benches_with_a_narrow_gap_are_two_pieces_and_a_keypoint_per_row() {
        // The gap is 0.15 of the pitch wider than a seam.
        let tables = [table(300.0, 300.0, 2, 10), table(300.0 + 245.0 + 3.7, 300.0, 2, 12)];
        let layout = infer(&image(&tables, 0.0, 0.0), None, &LayoutOptions::default());
        assert_eq!(shapes(&layout), [(2, 10), (2, 12)]);
        assert_eq!(layout.gaps.len(), 2);
        assert!(layout.gaps.iter().all(|gap| (gap.pitches - 1.15).abs() < 0.02));
        assert!(layout.pieces.iter().all(|p| [p.west, p.east, p.north, p.south] == [End::Closed; 4]));
        assert!(layout.loose.is_empty());
    }

    #[test]
    fn a_missed_module_becomes_a_hypothesis_where_it_should_be() {
        let mut hole = table(300.0, 300.0, 3, 10);
        hole.missing = vec![(1, 4), (1, 5)];
        let layout = infer(&image(&[hole], 0.0, 0.1), None, &LayoutOptions::default());
        assert_eq!(shapes(&layout), [(3, 10)]);
        let guesses: Vec<(i32, i32)> =
            layout.pieces[0].cells.iter().filter(|c| c.detection.is_none()).map(|c| (c.row, c.col)).collect();
        assert_eq!(guesses, [(1, 4), (1, 5)]);
        let whole = image(&[table(300.0, 300.0, 3, 10)], 0.0, 0.1);
        let guess = layout.pieces[0].cell(1, 4).unwrap().quad;
        let best = whole.detections.iter().map(|d| d.quad.iou(&guess)).fold(0.0, f64::max);
        assert!(best > 0.9, "{best}");
    }

    #[test]
    fn the_frame_cuts_and_does_not_close() {
        let layout = infer(&image(&[table(700.0, 400.0, 2, 40)], 0.0, 0.0), None, &LayoutOptions::default());
        let piece = &layout.pieces[0];
        assert_eq!(
            (piece.west, piece.east, piece.north, piece.south),
            (End::Closed, End::Cut, End::Closed, End::Closed)
        );
    }

    #[test]
    fn one_row_bridges_a_missed_module_and_two_rows_do_not_bridge_an_empty_column() {
        let mut single = table(200.0, 200.0, 1, 20);
        single.missing = vec![(0, 7)];
        let mut double = table(200.0, 500.0, 2, 20);
        double.missing = vec![(0, 7), (1, 7)];
        let layout = infer(&image(&[single, double], 0.0, 0.0), None, &LayoutOptions::default());
        assert_eq!(shapes(&layout), [(1, 20), (2, 7), (2, 12)]);
        let single = layout.pieces.iter().find(|p| p.rows == 1).unwrap();
        assert_eq!(single.bridges, [6]);
    }

    #[test]
    fn tables_one_above_the_other_are_two_pieces() {
        // Between their rows there are 6 pixels more than a seam.
        let tables = [table(300.0, 300.0, 2, 12), table(300.0, 300.0 + 77.0 + 6.0, 2, 12)];
        let layout = infer(&image(&tables, 0.0, 0.0), None, &LayoutOptions::default());
        assert_eq!(shapes(&layout), [(2, 12), (2, 12)]);
    }

    #[test]
    fn tables_that_lean_away_from_each_other_are_two_pieces() {
        // As at the ridge of a roof seen from one side: the far rows are shorter, and 5 pixels lie between.
        let mut both = image(&[table(300.0, 300.0, 2, 12)], 0.0, 0.0);
        let top = 300.0 + 38.5 + 19.0;
        let far = image(&[table(300.0, top + 5.0 + 19.0, 2, 12)], 0.0, 0.0).detections;
        let shorten = |p: Vector2<f64>| Vector2::new(p.x, top + 5.0 + 0.88 * (p.y - top - 5.0));
        both.detections.extend(far.into_iter().map(|d| Detection { quad: d.quad.map(shorten), ..d }));
        let layout = infer(&both, None, &LayoutOptions::default());
        assert_eq!(shapes(&layout), [(2, 12), (2, 12)]);
    }

    #[test]
    fn nothing_gives_nothing() {
        let layout = infer(&image(&[], 0.0, 0.0), None, &LayoutOptions::default());
        assert!(layout.pieces.is_empty() && layout.gaps.is_empty() && layout.loose.is_empty());
    }

    #[test]
    fn a_module_alone_is_loose() {
        let layout = infer(&image(&[table(600.0, 400.0, 1, 1)], 0.0, 0.0), None, &LayoutOptions::default());
        assert_eq!(layout.loose, [0]);
    }

    proptest! {
        #[test]
        fn structure_does_not_depend_on_rotation_perspective_or_order(
            turn in 0.0..360.0_f64, perspective in -0.15..0.15_f64, seed in any::<u64>(),
        ) {
            let mut hole = table(430.0, 380.0, 2, 9);
            hole.missing = vec![(0, 3)];
            let tables =
                [table(400.0, 250.0, 3, 14), hole, table(430.0 + 220.5 + 8.0, 380.0, 2, 6), table(450.0, 560.0, 1, 12)];
            let mut detections = image(&tables, turn, perspective);
            let count = detections.detections.len() as u64;
            // A fixed shuffle by the seed.
            detections.detections.sort_by_key(|d| {
                ((d.quad.center().x * 1e3) as u64 ^ seed).wrapping_mul(0x9E37_79B9_7F4A_7C15) % (count * 97)
            });
            let layout = infer(&detections, None, &LayoutOptions::default());
            prop_assert_eq!(shapes(&layout), vec![(1, 12), (2, 6), (2, 9), (3, 14)]);
            prop_assert_eq!(layout.gaps.len(), 2);
            prop_assert!(layout.loose.is_empty());
        }
    }
}
