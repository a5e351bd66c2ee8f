//! Pieces of one image that are two benches: gaps and aisles lie between them. The pixels of one image tell that more finely
//! than positions do.

use super::cluster::{Link, Table};
use super::locate::LocatedCell;
use super::{FusionParams, LocatedPiece};
use nalgebra::Vector2;

/// Two pieces of one image, one behind the other.
pub(super) struct Facing {
    pub(super) west: usize,
    pub(super) east: usize,
    /// Where the nearest module of the smaller piece stands on the lattice of the larger one, columns from its end.
    beyond: f64,
    /// In how many rows that was measured in the image itself; in none where the cloud alone tells.
    rows: usize,
}

/// The larger of two pieces and the other one, where both are of one image.
fn larger_first(a: usize, b: usize, pieces: &[LocatedPiece]) -> Option<(usize, usize)> {
    let (first, second) = (&pieces[a], &pieces[b]);
    (first.view == second.view).then_some(if first.cells.len() >= second.cells.len() { (a, b) } else { (b, a) })
}

/// Whether two pieces are of one image and stand one behind the other.
pub(super) fn facing(a: usize, b: usize, pieces: &[LocatedPiece], params: &FusionParams) -> Option<Facing> {
    let (base_piece, part_piece) = larger_first(a, b, pieces)?;
    let (base, part) = (&pieces[base_piece], &pieces[part_piece]);
    let outside = |at: &Vector2<f64>| (-at.x).max(at.x - f64::from(base.cols - 1));
    let (nearest, cell) = part
        .cells
        .iter()
        .filter(|cell| cell.detection.is_some())
        .filter_map(|cell| Some((base.ground.coordinate(cell.position_m.xy())?, cell)))
        .filter(|(at, _)| (-0.4..f64::from(base.rows) - 0.6).contains(&at.y))
        .min_by(|p, q| outside(&p.0).total_cmp(&outside(&q.0)))?;
    let is_west = nearest.x < 0.0;
    let (west, east) = if is_west { (part_piece, base_piece) } else { (base_piece, part_piece) };
    let row_shift = nearest.y.round() as i32 - cell.row;
    let shift = if is_west { row_shift } else { -row_shift };
    let (beyond, rows) =
        steps_between(&pieces[west], &pieces[east], 0, shift, params.pitch_span).unwrap_or((outside(&nearest), 0));
    (0.5..params.gap_reach).contains(&beyond).then_some(Facing { west, east, beyond, rows })
}

/// How many columns (axis 0) or rows (axis 1) apart the facing sides of two pieces of one image stand, by the pixels of the
/// rows or columns that both have, and how many these are; `None` where neither shows its pitch. Their numbers in `second`
/// are those in `first` plus the shift.
fn steps_between(
    first: &LocatedPiece,
    second: &LocatedPiece,
    axis: usize,
    shift: i32,
    span: i32,
) -> Option<(f64, usize)> {
    let place = |cell: &LocatedCell| if axis == 0 { (cell.col, cell.row) } else { (cell.row, cell.col) };
    let size = |piece: &LocatedPiece| if axis == 0 { (piece.cols, piece.rows) } else { (piece.rows, piece.cols) };
    // The outermost module, how far within the piece it stands, and pixels per step there.
    let end = |piece: &LocatedPiece, aside: i32, at_last: bool| {
        let cells = piece.cells.iter().filter(|cell| place(cell).1 == aside && cell.detection.is_some());
        let inwards = |cell: &LocatedCell| if at_last { size(piece).0 - 1 - place(cell).0 } else { place(cell).0 };
        let outermost = cells.clone().min_by_key(|cell| inwards(cell))?;
        let steps = |cell: &LocatedCell| place(cell).0 - place(outermost).0;
        let inner = cells.filter(|cell| (1..=span).contains(&steps(cell).abs())).max_by_key(|cell| steps(cell).abs());
        let pitch = inner.map(|cell| (cell.center_px - outermost.center_px) / f64::from(steps(cell)));
        Some((outermost.center_px, f64::from(inwards(outermost)), pitch))
    };
    let mut apart: Vec<f64> = (0..size(first).1)
        .filter_map(|aside| {
            let (from, from_inwards, from_pitch) = end(first, aside, true)?;
            let (to, to_inwards, to_pitch) = end(second, aside + shift, false)?;
            let pitch = match (from_pitch, to_pitch) {
                (Some(from), Some(to)) => (from + to) / 2.0,
                (from, to) => from.or(to)?,
            };
            Some((to - from).dot(&pitch) / pitch.norm_squared() - from_inwards - to_inwards)
        })
        .collect();
    apart.sort_by(f64::total_cmp);
    let middle = |k: usize| apart.get(k).copied();
    Some(((middle(apart.len() / 2)? + middle(apart.len().saturating_sub(1) / 2)?) / 2.0, apart.len()))
}

/// Two pieces of one image, one beside the other, with more than a seam between their rows: tables that face each other, or
/// stand one above the other.
pub(super) fn aisle_between(a: usize, b: usize, pieces: &[LocatedPiece], params: &FusionParams) -> Option<Link> {
    let (base_piece, part_piece) = larger_first(a, b, pieces)?;
    let (base, part) = (&pieces[base_piece], &pieces[part_piece]);
    let cell = part.cells.iter().filter(|cell| cell.detection.is_some()).find_map(|cell| {
        let at = base.ground.coordinate(cell.position_m.xy())?;
        let beside = (-0.4..f64::from(base.cols) - 0.6).contains(&at.x);
        (beside && !(-0.5..f64::from(base.rows) - 0.5).contains(&at.y)).then_some((cell.col, at))
    });
    let (col, at) = cell?;
    let shift = at.x.round() as i32 - col;
    let (apart, columns) = if at.y < 0.0 {
        steps_between(part, base, 1, shift, params.pitch_span)
    } else {
        steps_between(base, part, 1, -shift, params.pitch_span)
    }?;
    let [u, v] = base.pitch_m();
    let narrow = (u.norm() / v.norm()).min(1.0);
    (columns >= params.aisle_least_columns && ((1.0 + params.aisle * narrow)..2.0).contains(&apart)).then(|| Link {
        a: base_piece,
        b: part_piece,
        table: Table::new([], params.gap_cost, 0.0),
    })
}

/// Two pieces of one image, one behind the other, that no one lattice fits: a gap lies between them, and they are two
/// benches. Pixels tell that more finely than the cloud.
pub(super) fn gap_between(facing: &Facing, params: &FusionParams) -> Option<Link> {
    let Facing { west, east, beyond, rows } = *facing;
    let off = (beyond - beyond.round()).abs();
    // One row alone errs by as much as a narrow gap.
    let least = if rows > 1 { 0.1 + 0.02 * beyond } else { 0.15 + 0.03 * beyond };
    (off >= least).then(|| Link { a: west, b: east, table: Table::new([], params.gap_cost, 0.0) })
}
