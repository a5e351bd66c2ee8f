//! Which pieces of different images show the same bench, and which of their columns and rows are the same.
//!
//! The paper matches bench gaps by their distance in 3D. A gap is one kind of evidence; here every pair of overlapping
//! pieces is scored under every shift of whole columns and rows that their positions allow: bench ends (gaps or free)
//! must agree, holes must agree, and the disagreement of the positions must be like that of other pieces of the same two
//! views. What the evidence decides beyond doubt joins first and tells how the views are displaced against each other;
//! that decides the rest.

use super::apart::{Facing, aisle_between, facing, gap_between};
use super::cameras::CameraQuality;
use super::cluster::{Best, Link, Partition, Shift, Table, partition};
use super::disparity::{Disparity, DisparityField};
use super::{Doubt, FusionOptions, FusionParams, LocatedPiece, OpenDoubt, View};
use crate::layout::End;
use nalgebra::{Matrix3, Vector2, Vector3};
use rayon::prelude::*;
use rstar::{AABB, RTree, primitives::GeomWithData};
use std::collections::BTreeMap;
use std::f64::consts::SQRT_2;

/// A shift under which two pieces may be the same: column and row of `b` are those of `a` plus this.
#[derive(Debug, Clone, Copy)]
struct Hypothesis {
    col: i32,
    row: i32,
    /// Cost of everything but positions.
    structure_cost: f64,
    /// Whether both show some of the same modules; otherwise they stand beside each other in one bench, and the shift
    /// tells nothing that joins them.
    shares: bool,
    /// Position of a cell in `b` less that of the same cell in `a`, metres east and north.
    disparity_m: Vector2<f64>,
    /// The same by their lattices in space, with its covariance, where both have one.
    in_space: Option<(Vector3<f64>, Matrix3<f64>)>,
}

/// Two pieces of different views that overlap.
#[derive(Debug, Clone)]
struct Pair {
    a: usize,
    b: usize,
    at_m: Vector2<f64>,
    hypotheses: Vec<Hypothesis>,
}

/// Where a piece stands in its bench.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Placement {
    /// Which bench.
    pub cluster: usize,
    /// Added to the piece's columns to give the bench's.
    pub col: i32,
    /// Added to the piece's rows to give the bench's.
    pub row: i32,
}

/// Something that the evidence does not decide.
#[derive(Debug, Clone)]
pub(super) enum Undecided {
    /// Two pieces that by themselves belong elsewhere against each other than all the others say; how many such pairs
    /// the bench has.
    Conflict { a: usize, b: usize, columns: i32, rows: i32, pairs: usize },
    /// Two sets of pieces over each other, and the likeliest shifts between the two pieces.
    Unsure { a: usize, b: usize, choices: Vec<Shift>, margin: f64 },
}

impl Undecided {
    fn pairs(&self) -> usize {
        match self {
            Self::Conflict { pairs, .. } => *pairs,
            Self::Unsure { .. } => 1,
        }
    }

    fn count(&mut self, number: usize) {
        if let Self::Conflict { pairs, .. } = self {
            *pairs = number;
        }
    }

    /// The sentence for a person.
    pub(super) fn describe(&self, views: &[View<'_>], pieces: &[LocatedPiece], clusters: &Clusters) -> OpenDoubt {
        let (Self::Conflict { a, b, .. } | Self::Unsure { a, b, .. }) = self;
        OpenDoubt {
            doubt: self.doubt(views, pieces),
            clusters: [a, b].map(|piece| clusters.placements[*piece].cluster).to_vec(),
        }
    }

    fn doubt(&self, views: &[View<'_>], pieces: &[LocatedPiece]) -> Doubt {
        let name = |piece: usize| views[pieces[piece].view].shot.name.clone();
        let at = |piece: usize| {
            let middle = pieces[piece].middle();
            format!("{:.1} m east, {:.1} m north", middle.x, middle.y)
        };
        let (Self::Conflict { a, b, .. } | Self::Unsure { a, b, .. }) = self;
        let places_m = vec![pieces[*a].middle(), pieces[*b].middle()];
        match self {
            Self::Conflict { a, b, columns, rows, pairs } => Doubt {
                code: "bench_conflict".into(),
                message: format!(
                    "the bench at {} is seen differently in {} and {} (and in {} more pairs of images): by what the two \
                     show, columns differ by {columns:+} and rows by {rows:+}, by all images together they do not; check \
                     how many modules its rows have",
                    at(*a),
                    name(*a),
                    name(*b),
                    pairs - 1
                ),
                images: vec![name(*a), name(*b)],
                benches: Vec::new(),
                sightings: Vec::new(),
                places_m,
            },
            Self::Unsure { a, b, choices, margin } => {
                let choices: Vec<String> =
                    choices.iter().map(|(col, row)| format!("column {} row {}", 1 + col, 1 + row)).collect();
                Doubt {
                    code: "bench_shift_unsure".into(),
                    message: format!(
                        "the bench at {} shows no end that both {} and {} see: column 1, row 1 of what the first shows may \
                         be {} of the second (margin {margin:.1}); they are not joined, and what lies over the other is \
                         left out",
                        at(*a),
                        name(*a),
                        name(*b),
                        choices.join(" or ")
                    ),
                    images: vec![name(*a), name(*b)],
                    benches: Vec::new(),
                    sightings: Vec::new(),
                    places_m,
                }
            }
        }
    }
}

/// The outcome: where each piece stands in which bench.
#[derive(Debug)]
pub struct Clusters {
    pub placements: Vec<Placement>,
    /// Pieces of each bench.
    pub members: Vec<Vec<usize>>,
    /// How sure each bench is: by how much its least sure piece stands better where it is than anywhere else (infinite
    /// with one member).
    pub margins: Vec<f64>,
    /// Whether, in the same image, another piece stands behind each one's west end, and behind its east end.
    pub faced: Vec<[bool; 2]>,
    pub(super) doubts: Vec<Undecided>,
}

/// Finds the benches.
pub(super) fn associate(pieces: &[LocatedPiece], cameras: Option<&CameraQuality>, options: &FusionOptions) -> Clusters {
    let params = &options.params;
    let near = near_pairs(pieces, options);
    let mut pairs: Vec<Pair> =
        near.par_iter().filter_map(|&(a, b)| pair(a, b, pieces, Vector2::zeros(), options)).collect();
    let facing: Vec<Facing> = near.par_iter().filter_map(|&(a, b)| facing(a, b, pieces, params)).collect();
    let mut apart: Vec<Link> = facing.iter().filter_map(|facing| gap_between(facing, params)).collect();
    apart.par_extend(near.par_iter().filter_map(|&(a, b)| aisle_between(a, b, pieces, params)));
    let views = pieces.iter().map(|piece| piece.view + 1).max().unwrap_or(0);
    let prior_m = cameras.map_or(params.view_sigma_m, |cameras| SQRT_2 * cameras.typical_m);
    let mut field = DisparityField::unknown(views, prior_m, params);
    let weigh = |k: usize, pair: &Pair, field: &DisparityField| match cameras {
        Some(cameras) => geometric_table(k, pair, pieces, field, cameras, options),
        None => table(k, pair, pieces, field, params),
    };
    for needed in [params.sure_margin, params.likely_margin, params.likely_margin] {
        let known = disparities(&pairs, pieces, |k| {
            let best = weigh(k, &pairs[k], &field).best()?;
            (best.margin >= needed).then_some(best.shift)
        });
        field = DisparityField::fit(views, &known, prior_m, params);
    }
    let mut outcome = None;
    for _ in 0..2 {
        look_about(&mut pairs, &field, pieces, options);
        let mut links: Vec<Link> = pairs
            .par_iter()
            .enumerate()
            .map(|(k, pair)| Link { a: pair.a, b: pair.b, table: weigh(k, pair, &field) })
            .collect();
        links.extend(apart.iter().cloned());
        let joined = partition(pieces, &links, params);
        // All joints together know more of the displacements than single pairs did.
        let known = disparities(&pairs, pieces, |k| joined.between(pairs[k].a, pairs[k].b));
        field = DisparityField::fit(views, &known, prior_m, params);
        outcome = Some((joined, links));
    }
    match outcome {
        Some((joined, links)) => clusters(&joined, &links, &facing, params),
        None => Clusters {
            placements: Vec::new(),
            members: Vec::new(),
            margins: Vec::new(),
            faced: Vec::new(),
            doubts: Vec::new(),
        },
    }
}

/// Looks for shifts of pieces about the displacement that is known of their views, where it is large.
fn look_about(pairs: &mut [Pair], field: &DisparityField, pieces: &[LocatedPiece], options: &FusionOptions) {
    pairs.par_iter_mut().enumerate().for_each(|(k, known)| {
        let views = (pieces[known.a].view, pieces[known.b].view);
        let (expected_m, _) = field.expected(k, views, known.at_m);
        if expected_m.norm() > options.params.displaced_share * options.max_disparity_m
            && let Some(wider) = pair(known.a, known.b, pieces, expected_m, options)
        {
            *known = wider;
        }
    });
}

/// What the pairs with a known shift, under which they share modules, say of the displacements of their views.
fn disparities(
    pairs: &[Pair],
    pieces: &[LocatedPiece],
    shift: impl Fn(usize) -> Option<Shift> + Sync,
) -> Vec<Disparity> {
    pairs
        .par_iter()
        .enumerate()
        .filter_map(|(k, pair)| {
            let shift = shift(k)?;
            let hypothesis = pair.hypotheses.iter().find(|h| (h.col, h.row) == shift && h.shares)?;
            let views = (pieces[pair.a].view, pieces[pair.b].view);
            Some(Disparity { pair: k, views, at_m: pair.at_m, value_m: hypothesis.disparity_m })
        })
        .collect()
}

/// What a pair says of every shift.
fn table(index: usize, pair: &Pair, pieces: &[LocatedPiece], field: &DisparityField, params: &FusionParams) -> Table {
    let dof = params.position_dof;
    let (a, b) = (&pieces[pair.a], &pieces[pair.b]);
    let (expected, field_sigma) = field.expected(index, (a.view, b.view), pair.at_m);
    let sigma = (field_sigma.powi(2) + a.sigma_m.powi(2) + b.sigma_m.powi(2)).sqrt();
    let cost = |hypothesis: &Hypothesis| {
        let off = (hypothesis.disparity_m - expected).norm() / sigma;
        // Student's t in the plane: positions may be wrong by far more than they admit.
        hypothesis.structure_cost + (dof + 2.0) / 2.0 * (1.0 + off * off / dof).ln()
    };
    // Two that show no module in common need not be of one bench, wherever they stand.
    let apart = pair.hypotheses.iter().filter(|h| !h.shares).map(&cost).fold(params.different_cost, f64::min);
    Table::new(pair.hypotheses.iter().map(|h| ((h.col, h.row), cost(h))), params.far_cost, apart)
}

/// What a pair says of every shift where cameras are good: rays of the same module meet, those of neighbours do not.
fn geometric_table(
    index: usize,
    pair: &Pair,
    pieces: &[LocatedPiece],
    field: &DisparityField,
    cameras: &CameraQuality,
    options: &FusionOptions,
) -> Table {
    let (a, b) = (&pieces[pair.a], &pieces[pair.b]);
    let (expected, field_sigma) = field.expected(index, (a.view, b.view), pair.at_m);
    // A view that is worse than the others stays so.
    let extra = (cameras.between(a.view, b.view).powi(2) - 2.0 * cameras.typical_m.powi(2)).max(0.0);
    let sigma = (field_sigma.powi(2) + extra).sqrt();
    let dof = options.params.disagreement_dof;
    let cost = |hypothesis: &Hypothesis| {
        let off = match &hypothesis.in_space {
            Some((off, covariance)) => {
                let off = off - Vector3::new(expected.x, expected.y, 0.0);
                let height = options.params.height_factor * sigma;
                let shared = Vector3::new(sigma * sigma, sigma * sigma, height * height);
                (covariance + Matrix3::from_diagonal(&shared)).cholesky().map_or(0.0, |c| off.dot(&c.solve(&off)))
            }
            None => {
                let sigma = (sigma.powi(2) + a.sigma_m.powi(2) + b.sigma_m.powi(2)).sqrt();
                ((hypothesis.disparity_m - expected).norm() / sigma).powi(2)
            }
        };
        hypothesis.structure_cost + (dof + 3.0) / 2.0 * (1.0 + off / dof).ln()
    };
    let apart = pair.hypotheses.iter().filter(|h| !h.shares).map(&cost).fold(options.params.different_cost, f64::min);
    Table::new(pair.hypotheses.iter().map(|h| ((h.col, h.row), cost(h))), options.params.far_cost, apart)
}

/// Where the lattice of `b` has a place that both show, or that lies between them, less where that of `a` has it, metres, with
/// the covariance.
fn in_space(a: &LocatedPiece, b: &LocatedPiece, col: i32, row: i32) -> Option<(Vector3<f64>, Matrix3<f64>)> {
    let (first, second) = (a.lattice.as_ref()?, b.lattice.as_ref()?);
    // The middle of what is common, or of what lies between.
    let middle = |size: i32, other: i32, shift: i32| f64::from(0.max(-shift) + (size - 1).min(other - 1 - shift)) / 2.0;
    let (at_col, at_row) = (middle(a.cols, b.cols, col), middle(a.rows, b.rows, row));
    let (other_col, other_row) = (at_col + f64::from(col), at_row + f64::from(row));
    let off = second.position(other_col, other_row) - first.position(at_col, at_row);
    Some((off, first.covariance(at_col, at_row) + second.covariance(other_col, other_row)))
}

/// The benches of a partition, numbered by their first piece, with what it leaves open.
fn clusters(joined: &Partition, links: &[Link], facing: &[Facing], params: &FusionParams) -> Clusters {
    let mut faced = vec![[false; 2]; joined.set.len()];
    for pair in facing {
        faced[pair.west][1] = true;
        faced[pair.east][0] = true;
    }
    let mut number: BTreeMap<usize, usize> = BTreeMap::new();
    let mut members: Vec<Vec<usize>> = Vec::new();
    let mut margins: Vec<f64> = Vec::new();
    let mut placements = Vec::with_capacity(joined.set.len());
    for (piece, set) in joined.set.iter().enumerate() {
        let cluster = *number.entry(*set).or_insert_with(|| {
            members.push(Vec::new());
            margins.push(f64::INFINITY);
            members.len() - 1
        });
        members[cluster].push(piece);
        margins[cluster] = margins[cluster].min(joined.margin[piece]);
        let (col, row) = joined.shift[piece];
        placements.push(Placement { cluster, col, row });
    }
    for group in &members {
        let low_col = group.iter().map(|p| placements[*p].col).min().unwrap_or(0);
        let low_row = group.iter().map(|p| placements[*p].row).min().unwrap_or(0);
        for piece in group {
            placements[*piece].col -= low_col;
            placements[*piece].row -= low_row;
        }
    }
    let doubts = undecided(joined, links, &number, params);
    Clusters { placements, members, margins, faced, doubts }
}

/// What is left open: in each bench the clearest pair that contradicts it, and sets of pieces that lie over each other
/// without a sure shift.
fn undecided(
    joined: &Partition,
    links: &[Link],
    number: &BTreeMap<usize, usize>,
    params: &FusionParams,
) -> Vec<Undecided> {
    let mut conflicts: BTreeMap<usize, (f64, Undecided)> = BTreeMap::new();
    let mut open: BTreeMap<(usize, usize), (usize, usize, Table)> = BTreeMap::new();
    for link in links {
        let (a, b) = (number[&joined.set[link.a]], number[&joined.set[link.b]]);
        if a == b {
            let (Some(best), Some(placed)) = (link.table.best(), joined.between(link.a, link.b)) else { continue };
            if best.margin < params.sure_margin || best.shift == placed {
                continue;
            }
            let pairs = conflicts.get(&a).map_or(0, |(_, doubt)| doubt.pairs()) + 1;
            let (columns, rows) = (best.shift.0 - placed.0, best.shift.1 - placed.1);
            let new = (best.margin, Undecided::Conflict { a: link.a, b: link.b, columns, rows, pairs });
            match conflicts.get_mut(&a) {
                Some(known) if known.0 >= new.0 => known.1.count(pairs),
                _ => {
                    conflicts.insert(a, new);
                }
            }
        } else {
            // All that is known between two sets, as shifts between the two pieces that come first.
            let (from, to, forwards) = if a < b { (link.a, link.b, true) } else { (link.b, link.a, false) };
            let (first, second, table) =
                open.entry((a.min(b), a.max(b))).or_insert_with(|| (from, to, Table::default()));
            let moved =
                |p: usize, q: usize| (joined.shift[p].0 - joined.shift[q].0, joined.shift[p].1 - joined.shift[q].1);
            // first -> from -> to -> second
            let (start, end) = (moved(*first, from), moved(to, *second));
            table.add(&link.table, |s| {
                let s = if forwards { s } else { (-s.0, -s.1) };
                (start.0 + s.0 + end.0, start.1 + s.1 + end.1)
            });
        }
    }
    let mut doubts: Vec<Undecided> = conflicts.into_values().map(|(_, doubt)| doubt).collect();
    for (a, b, table) in open.into_values() {
        let Some(Best { shift, cost, second, margin }) = table.best() else { continue };
        // What joins them costs less than what keeps them apart, and yet no shift is sure.
        if cost + 1.0 < table.apart() && margin < params.likely_margin {
            let choices = [Some(shift), second].into_iter().flatten().collect();
            doubts.push(Undecided::Unsure { a, b, choices, margin });
        }
    }
    doubts
}

/// All pairs of pieces whose footprints come near each other.
pub(super) fn near_pairs(pieces: &[LocatedPiece], options: &FusionOptions) -> Vec<(usize, usize)> {
    let boxes: Vec<GeomWithData<rstar::primitives::Rectangle<[f64; 2]>, usize>> = pieces
        .iter()
        .enumerate()
        .map(|(index, piece)| {
            let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
            for col in [-0.5, f64::from(piece.cols) / 2.0, f64::from(piece.cols) - 0.5] {
                for row in [-0.5, f64::from(piece.rows) - 0.5] {
                    let at = piece.ground.pixel(col, row);
                    low = [low[0].min(at.x), low[1].min(at.y)];
                    high = [high[0].max(at.x), high[1].max(at.y)];
                }
            }
            let half = options.max_disparity_m / 2.0;
            GeomWithData::new(
                rstar::primitives::Rectangle::from_corners(
                    [low[0] - half, low[1] - half],
                    [high[0] + half, high[1] + half],
                ),
                index,
            )
        })
        .collect();
    let tree = RTree::bulk_load(boxes.clone());
    let mut near: Vec<(usize, usize)> = Vec::new();
    for item in &boxes {
        let (a, corners) = (item.data, item.geom());
        let envelope = AABB::from_corners(corners.lower(), corners.upper());
        for other in tree.locate_in_envelope_intersecting(envelope) {
            if other.data > a {
                near.push((a, other.data));
            }
        }
    }
    near.sort_unstable();
    near
}

/// Where one cell of a piece stands in the lattice of another.
struct CellShift {
    /// Columns and rows by which it stands outside the other piece.
    outside: f64,
    /// Its column and row there less its own.
    col: f64,
    row: f64,
    at_m: Vector2<f64>,
}

/// The shifts that are possible between two pieces of different views, or `None` if there is none: those that displace them
/// little against each other, or nearly as is expected of their views.
fn pair(
    a: usize,
    b: usize,
    pieces: &[LocatedPiece],
    expected_m: Vector2<f64>,
    options: &FusionOptions,
) -> Option<Pair> {
    let (first, second) = (&pieces[a], &pieces[b]);
    if first.view == second.view {
        return None;
    }
    let [u, v] = first.pitch_m();
    let [other_u, other_v] = second.pitch_m();
    let alike = |p: Vector2<f64>, q: Vector2<f64>| {
        let ratio = p.norm() / q.norm();
        (0.75..1.33).contains(&ratio) && p.dot(&q) > 0.9 * p.norm() * q.norm()
    };
    // A single row hardly knows its pitch across; its direction is enough.
    let rows_known = first.rows > 1 && second.rows > 1;
    if !alike(u, other_u) || (rows_known && !alike(v, other_v)) {
        return None;
    }
    // Where the lattice of `a` lies in that of `b`, at the cells of `a` nearest to the middle of what they share.
    let mut shifts: Vec<CellShift> = Vec::new();
    let stride = (first.cells.len() / 24).max(1);
    for cell in first.cells.iter().step_by(stride) {
        let Some(at) = second.ground.coordinate(cell.position_m.xy()) else { continue };
        let outside_col = (-at.x).max(at.x - f64::from(second.cols - 1)).max(0.0);
        let outside_row = (-at.y).max(at.y - f64::from(second.rows - 1)).max(0.0);
        shifts.push(CellShift {
            outside: outside_col + outside_row,
            col: at.x - f64::from(cell.col),
            row: at.y - f64::from(cell.row),
            at_m: cell.position_m.xy(),
        });
    }
    shifts.sort_by(|p, q| p.outside.total_cmp(&q.outside));
    let nearest = shifts.first()?.outside;
    let reach = options.max_disparity_m / other_u.norm().min(other_v.norm()) + 0.5;
    if nearest > reach {
        return None;
    }
    shifts.retain(|shift| shift.outside <= nearest + 0.5);
    let median = |f: fn(&CellShift) -> f64| {
        let mut values: Vec<f64> = shifts.iter().map(f).collect();
        values.sort_by(f64::total_cmp);
        values[values.len() / 2]
    };
    let (col_shift, row_shift) = (median(|s| s.col), median(|s| s.row));
    let at_m = shifts.iter().map(|s| s.at_m).sum::<Vector2<f64>>() / shifts.len() as f64;
    let (col_reach, row_reach) =
        (options.max_disparity_m / other_u.norm(), (options.max_disparity_m / other_v.norm()).max(0.5));
    // The expected displacement in columns and rows.
    let area = other_u.perp(&other_v);
    let expected = [expected_m.perp(&other_v) / area, other_u.perp(&expected_m) / area];
    let range = |shift: f64, reach: f64, expected: f64| {
        (shift + expected.min(0.0) - reach).ceil() as i32..=(shift + expected.max(0.0) + reach).floor() as i32
    };
    let mut hypotheses = Vec::new();
    for col in range(col_shift, col_reach, expected[0]) {
        for row in range(row_shift, row_reach, expected[1]) {
            // The same cell by both: `b` sees it where `a` would be at the fractional rest of the shift.
            let disparity_m = other_u * (f64::from(col) - col_shift) + other_v * (f64::from(row) - row_shift);
            if disparity_m.norm().min((disparity_m - expected_m).norm()) > options.max_disparity_m {
                continue;
            }
            let in_space = in_space(first, second, col, row);
            let disparity_m = in_space.map_or(disparity_m, |(off, _)| off.xy());
            let (mut structure_cost, shares) = structure_cost(first, second, col, row, options);
            if !shares {
                // Beside each other they may as well be two benches: nothing is contradicted.
                structure_cost = structure_cost.min(options.params.beside_cost);
            }
            hypotheses.push(Hypothesis { col, row, structure_cost, shares, disparity_m, in_space });
        }
    }
    hypotheses.iter().any(|hypothesis| hypothesis.shares).then_some(Pair { a, b, at_m, hypotheses })
}

/// What the ends and holes of two pieces cost under a shift, and whether they share a detected place.
fn structure_cost(a: &LocatedPiece, b: &LocatedPiece, col: i32, row: i32, options: &FusionOptions) -> (f64, bool) {
    let mut cost = 0.0;
    let mut shared = 0;
    let mut holes = 0;
    for cell in &a.cells {
        if let Some(other) = b.cell(cell.row + row, cell.col + col) {
            match (cell.detection.is_some(), other.detection.is_some()) {
                (true, true) => shared += 1,
                (true, false) | (false, true) => holes += 1,
                (false, false) => {}
            }
        }
    }
    let params = &options.params;
    cost += (f64::from(holes) * params.hole_cost).min(3.0 * params.hole_cost + 0.1 * f64::from(holes));
    // `beyond` columns of one piece lie past the end of the other.
    // Where geometry speaks no end weighs more than the share of ends that are seen wrongly, however far off it is.
    let most =
        if a.lattice.is_some() && b.lattice.is_some() { -options.params.false_end_share.ln() } else { f64::INFINITY };
    let mut end = |mine: End, theirs: End, beyond: i32| {
        let before = cost;
        let contradicted = if beyond > 0 { mine } else { theirs };
        if beyond != 0 && contradicted == End::Closed {
            cost += params.end_cost + params.end_column_cost * f64::from(beyond.abs() - 1).min(4.0);
            // Both see an end, and not the same.
            if mine == End::Closed && theirs == End::Closed {
                cost += 1.0;
            }
        }
        cost = cost.min(before + most);
    };
    end(a.west, b.west, col);
    end(a.east, b.east, (b.cols - 1) - (a.cols - 1 + col));
    end(a.north, b.north, row);
    end(a.south, b.south, (b.rows - 1) - (a.rows - 1 + row));
    if let Some(known) = options.rows_per_bench {
        let (low, high) = (0.min(row), (a.rows - 1 + row).max(b.rows - 1));
        if high - low + 1 > known as i32 {
            cost += params.end_cost;
        }
    }
    (cost, shared > 0)
}
