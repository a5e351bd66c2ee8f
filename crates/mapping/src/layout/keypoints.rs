//! Bench gaps: the keypoints that images are matched by (paper, 3.3, equation 2).

use super::{Gap, LayoutOptions, Piece, transition};
use crate::geometry::Quad;
use image::GrayImage;

/// The gaps between the pieces of one image, one for each row that both benches have, sorted by piece and row.
pub(super) fn find(pieces: &[Piece], grey: Option<&GrayImage>, options: &LayoutOptions) -> Vec<Gap> {
    let mut gaps = Vec::new();
    for (west_index, west) in pieces.iter().enumerate() {
        let seams = usual_seams(west);
        for row in 0..west.rows {
            let Some(from) = (0..west.cols).rev().find_map(|col| west.cell(row, col).filter(|c| c.detection.is_some()))
            else {
                continue;
            };
            // The nearest piece that the row, drawn on, meets.
            let mut nearest: Option<Gap> = None;
            for (east_index, east) in pieces.iter().enumerate() {
                if east_index == west_index {
                    continue;
                }
                let Some((to, pitches)) = facing(west, from.row, from.col, east) else { continue };
                if pitches <= 1.0 + options.gap_threshold * 0.5 || pitches > options.params.widest_gap {
                    continue;
                }
                if nearest.as_ref().is_none_or(|gap| pitches < gap.pitches) {
                    let pair = (from.quad, to.quad);
                    nearest = Some(Gap {
                        west: (west_index, from.row, from.col),
                        east: (east_index, to.row, to.col),
                        center_px: (pair.0.center() + pair.1.center()) / 2.0,
                        pitches,
                        darker: grey.and_then(|grey| transition::darkness(grey, &[pair], &seams)),
                    });
                }
            }
            gaps.extend(nearest);
        }
    }
    gaps
}

/// The first module of `east` that the row of `west` runs into, and how many pitches away it stands.
fn facing<'a>(west: &Piece, row: i32, col: i32, east: &'a Piece) -> Option<(&'a super::Cell, f64)> {
    east.cells
        .iter()
        .filter(|cell| cell.detection.is_some() && cell.col <= 1)
        .filter_map(|cell| {
            let from = west.cell(row, col)?.quad.center();
            let [u, v] = west.map.pitch(f64::from(col), f64::from(row));
            let offset = cell.quad.center() - from;
            let determinant = u.perp(&v);
            let (along, across) = (offset.perp(&v) / determinant, u.perp(&offset) / determinant);
            // The row may bend a little towards the next bench.
            (along > 0.5 && across.abs() < 0.3 + 0.05 * along).then_some((cell, along))
        })
        .min_by(|a, b| a.1.total_cmp(&b.1))
}

/// Pairs of neighbours within a piece.
fn usual_seams(piece: &Piece) -> Vec<(Quad, Quad)> {
    piece
        .cells
        .iter()
        .filter(|cell| cell.detection.is_some())
        .filter_map(|cell| {
            let next = piece.cell(cell.row, cell.col + 1).filter(|next| next.detection.is_some())?;
            Some((cell.quad, next.quad))
        })
        .take(40)
        .collect()
}
