//! Keypoints that one image missed are inserted where the others see them (paper, 3.5 and Fig. 10).

use super::LocatedPiece;
use super::associate::Clusters;
use crate::layout::End;
use std::collections::{BTreeMap, BTreeSet};

/// A piece that runs over a bench gap, or ends at one: it is to end after this column (its last if it ends there, -1 if it
/// begins there).
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
        // Likewise of views that show the next bench behind the end, which need not have come into this set.
        let mut faced: BTreeMap<i32, BTreeSet<usize>> = BTreeMap::new();
        for &member in members {
            let (piece, place) = (&pieces[member], clusters.placements[member]);
            if piece.east == End::Closed {
                let after = place.col + piece.cols - 1;
                ends.entry(after).or_default().insert(piece.view);
                if clusters.faced[member][1] {
                    faced.entry(after).or_default().insert(piece.view);
                }
            }
            if piece.west == End::Closed {
                begins.entry(place.col - 1).or_default().insert(piece.view);
                if clusters.faced[member][0] {
                    faced.entry(place.col - 1).or_default().insert(piece.view);
                }
            }
        }
        let places: BTreeSet<i32> = ends.keys().chain(begins.keys()).copied().collect();
        for after in places {
            let mut ending = ends.get(&after).cloned().unwrap_or_default();
            let mut beginning = begins.get(&after).cloned().unwrap_or_default();
            for view in faced.get(&after).into_iter().flatten() {
                ending.insert(*view);
                beginning.insert(*view);
            }
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

/// Columns in which no view ever saw a module, though two views or more show modules on both sides of them: missed modules
/// would be seen by some view, so this is a gap. Pieces that run over it are cut, and those that end at it end there for
/// good.
fn empty_columns(pieces: &[LocatedPiece], clusters: &Clusters, members: &[usize]) -> Vec<Split> {
    let mut seen: BTreeSet<i32> = BTreeSet::new();
    for &member in members {
        let cells = pieces[member].cells.iter().filter(|cell| cell.detection.is_some());
        seen.extend(cells.map(|cell| cell.col + clusters.placements[member].col));
    }
    let (Some(&first), Some(&last)) = (seen.first(), seen.last()) else { return Vec::new() };
    let mut splits = Vec::new();
    for col in (first..last).filter(|col| seen.contains(col) && !seen.contains(&(col + 1))) {
        let next = seen.range(col + 1..).next().copied().unwrap_or(last);
        // Views that show something west of it, or see the next bench begin; and east of it likewise.
        let (mut west, mut east) = (BTreeSet::new(), BTreeSet::new());
        let mut cuts = Vec::new();
        for &member in members {
            let (piece, place) = (&pieces[member], clusters.placements[member]);
            let (low, high) = (place.col, place.col + piece.cols - 1);
            if low <= col || (low == next && piece.west == End::Closed) {
                west.insert(piece.view);
            }
            if high >= next || (high == col && piece.east == End::Closed) {
                east.insert(piece.view);
            }
            let ends_open = (high == col && piece.east == End::Cut) || (low == next && piece.west == End::Cut);
            if (low <= col && high >= next) || ends_open {
                let after_col = if low == next { -1 } else { col - low };
                cuts.push(Split { piece: member, after_col });
            }
        }
        if west.intersection(&east).count() > 1 {
            splits.extend(cuts);
        }
    }
    splits
}

/// The pieces with those of `splits`, which are sorted, cut in two, both ends at the cut closed.
pub fn split(pieces: Vec<LocatedPiece>, splits: &[Split]) -> Vec<LocatedPiece> {
    let mut result = Vec::with_capacity(pieces.len() + splits.len());
    let mut splits = splits.chunk_by(|a, b| a.piece == b.piece).peekable();
    for (index, piece) in pieces.into_iter().enumerate() {
        let own = splits.next_if(|own| own[0].piece == index).unwrap_or_default();
        let mut rest = Some(piece);
        // Column of the original piece at which `rest` begins.
        let mut start = 0;
        for split in own {
            let Some(current) = rest.take() else { break };
            let after = split.after_col - start;
            if after < -1 {
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
    part.lattice = piece.lattice.as_ref().map(|lattice| Box::new(lattice.starting_at(low)));
    part.refit(piece.pitch_m());
    Some((part, low))
}
