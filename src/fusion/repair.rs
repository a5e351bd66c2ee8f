//! Keypoints that one image missed are inserted where the others see them (paper, 3.5 and Fig. 10).

use super::LocatedPiece;
use super::associate::Clusters;
use crate::layout::End;
use std::collections::{BTreeMap, BTreeSet};

/// A piece that runs over a bench gap: it is to end after this column.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Split {
    pub piece: usize,
    pub after_col: i32,
}

/// Finds the pieces that run over a gap. In each bench, every view that shows both sides of a place between two columns
/// votes: its piece ends there on one side (and the next begins), or its rows run through. A bridge over missing modules
/// is no vote against.
pub fn missed_gaps(pieces: &[LocatedPiece], clusters: &Clusters) -> Vec<Split> {
    let mut splits = Vec::new();
    for members in &clusters.members {
        // Column after which a piece ends, and after which the next one begins -> views that say so.
        let mut ends: BTreeMap<i32, BTreeSet<usize>> = BTreeMap::new();
        let mut begins: BTreeMap<i32, BTreeSet<usize>> = BTreeMap::new();
        for &member in members {
            let (piece, place) = (&pieces[member], clusters.placements[member]);
            if piece.east == End::Closed {
                ends.entry(place.col + piece.cols - 1).or_default().insert(piece.view);
            }
            if piece.west == End::Closed {
                begins.entry(place.col - 1).or_default().insert(piece.view);
            }
        }
        let places: BTreeSet<i32> = ends.keys().chain(begins.keys()).copied().collect();
        for after in places {
            let ending = ends.get(&after).cloned().unwrap_or_default();
            let mut beginning = begins.get(&after).cloned().unwrap_or_default();
            if !ending.is_empty() {
                // A gap of more than half a module puts the next bench a column further.
                beginning.extend(begins.get(&(after + 1)).into_iter().flatten());
            }
            let mut through = BTreeSet::new();
            let mut spanning = Vec::new();
            for &member in members {
                let (piece, place) = (&pieces[member], clusters.placements[member]);
                let col = after - place.col;
                if col < 0 || col + 1 > piece.cols - 1 {
                    continue;
                }
                spanning.push(Split { piece: member, after_col: col });
                let bridged = piece.bridges.iter().any(|&bridge| {
                    let next = (bridge + 1..piece.cols)
                        .find(|c| piece.cells.iter().any(|cell| cell.col == *c && cell.detection.is_some()));
                    bridge <= col && next.is_some_and(|next| col < next)
                });
                if !bridged {
                    through.insert(piece.view);
                }
            }
            if spanning.is_empty() {
                continue;
            }
            // A view that sees both benches end here is worth more than one that sees a row stop: a missed module makes
            // a row stop, nothing makes the next bench begin.
            let both = ending.intersection(&beginning).count();
            let either = ending.union(&beginning).count();
            let against = through.iter().filter(|view| !(ending.contains(view) && beginning.contains(view))).count();
            let for_gap = if both > 0 { 2 * both + (either - both) } else { either };
            if (both > 0 || either > 1) && for_gap > 2 * against {
                splits.extend(spanning);
            }
        }
    }
    splits.extend(clusters.members.iter().flat_map(|members| empty_columns(pieces, clusters, members)));
    splits.sort_unstable();
    splits.dedup();
    splits
}

/// Columns that two views or more bridge, or at which two or more see the benches end, and in which none ever saw a
/// module: missed modules would be seen by some view, so this is a gap.
fn empty_columns(pieces: &[LocatedPiece], clusters: &Clusters, members: &[usize]) -> Vec<Split> {
    if members.iter().all(|member| pieces[*member].bridges.is_empty()) {
        return Vec::new();
    }
    let mut seen: BTreeSet<i32> = BTreeSet::new();
    for &member in members {
        let cells = pieces[member].cells.iter().filter(|cell| cell.detection.is_some());
        seen.extend(cells.map(|cell| cell.col + clusters.placements[member].col));
    }
    let (Some(&first), Some(&last)) = (seen.first(), seen.last()) else { return Vec::new() };
    let mut splits = Vec::new();
    for col in (first..last).filter(|col| seen.contains(col) && !seen.contains(&(col + 1))) {
        let across: Vec<Split> = members
            .iter()
            .map(|&piece| Split { piece, after_col: col - clusters.placements[piece].col })
            .filter(|split| (0..pieces[split.piece].cols - 1).contains(&split.after_col))
            .collect();
        let next = seen.range(col + 1..).next().copied().unwrap_or(last);
        let ending = members.iter().filter(|&&member| {
            let (piece, place) = (&pieces[member], clusters.placements[member]);
            (piece.east == End::Closed && place.col + piece.cols - 1 == col)
                || (piece.west == End::Closed && place.col == next)
        });
        let bridging = across.iter().map(|split| split.piece);
        let views: BTreeSet<usize> = ending.copied().chain(bridging).map(|piece| pieces[piece].view).collect();
        if views.len() > 1 {
            splits.extend(across);
        }
    }
    splits
}

/// The pieces with those of `splits` cut in two, both ends at the cut closed.
pub fn split(pieces: Vec<LocatedPiece>, splits: &[Split]) -> Vec<LocatedPiece> {
    let mut result = Vec::with_capacity(pieces.len() + splits.len());
    for (index, piece) in pieces.into_iter().enumerate() {
        let mut rest = Some(piece);
        // Column of the original piece at which `rest` begins.
        let mut start = 0;
        for split in splits.iter().filter(|split| split.piece == index) {
            let Some(current) = rest.take() else { break };
            let after = split.after_col - start;
            if after < 0 {
                rest = Some(current);
                continue;
            }
            let last = current.cols - 1;
            if let Some((mut left, _)) = part(&current, 0, after.min(last)) {
                left.east = End::Closed;
                result.push(left);
            }
            if let Some((mut right, low)) = part(&current, after + 1, last) {
                right.west = End::Closed;
                start += low;
                rest = Some(right);
            }
        }
        result.extend(rest);
    }
    result
}

/// The columns `from` to `to` of a piece, trimmed to those with a detection, and the column where they begin.
fn part(piece: &LocatedPiece, from: i32, to: i32) -> Option<(LocatedPiece, i32)> {
    let detected =
        || piece.cells.iter().filter(|c| c.detection.is_some() && (from..=to).contains(&c.col)).map(|c| c.col);
    let (low, high) = (detected().min()?, detected().max()?);
    let mut part = piece.clone();
    part.cells.retain(|cell| (low..=high).contains(&cell.col));
    for cell in &mut part.cells {
        cell.col -= low;
    }
    part.cols = high - low + 1;
    part.bridges = piece.bridges.iter().map(|b| b - low).filter(|b| (0..part.cols - 1).contains(b)).collect();
    part.refit(piece.pitch_m());
    Some((part, low))
}
