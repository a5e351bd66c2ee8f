//! Which pieces of different images show the same bench, and which of their columns and rows are the same.
//!
//! The paper matches bench gaps by their distance in 3D. A gap is one kind of evidence; here every pair of overlapping
//! pieces is scored under every shift of whole columns and rows that their positions allow: bench ends (gaps or free)
//! must agree, holes must agree, and the disagreement of the positions must be like that of other pieces of the same two
//! views. What the evidence decides beyond doubt joins first and tells how the views are displaced against each other;
//! that decides the rest.

use super::{Doubt, FusionOptions, LocatedPiece, View};
use crate::layout::End;
use nalgebra::Vector2;
use rayon::prelude::*;
use rstar::{AABB, RTree, primitives::GeomWithData};
use std::collections::BTreeMap;

/// Cost, in units of a negative log-likelihood, of one bench end that one view sees and the other contradicts.
const END_COST: f64 = 4.0;
/// Cost of each further column by which it is contradicted.
const END_COLUMN_COST: f64 = 1.0;
/// Cost of a place that is a module in one view and a hole in the other.
const HOLE_COST: f64 = 1.0;
/// Most that it costs two pieces to share no module at all.
const APART_COST: f64 = 0.5;
/// Margin between the best and the second best shift above which a pair is beyond doubt.
const SURE: f64 = 5.0;
/// Margin above which a pair counts at all.
const LIKELY: f64 = 2.5;
/// Standard deviation of the disagreement of two views before anything is known of them, metres.
const PRIOR_SIGMA_M: f64 = 0.35;

/// Degrees of freedom of the positions' errors: few, for local errors of structure from motion have long tails.
const TAIL: f64 = 4.0;

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
}

/// Two pieces of different views that overlap.
#[derive(Debug, Clone)]
struct Pair {
    a: usize,
    b: usize,
    at_m: Vector2<f64>,
    hypotheses: Vec<Hypothesis>,
}

/// A scored pair: the best shift, and by how much it beats the next.
#[derive(Debug, Clone, Copy)]
struct Choice {
    best: usize,
    margin: f64,
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
pub(super) struct Undecided {
    code: &'static str,
    a: usize,
    b: usize,
    choices: Vec<i32>,
    margin: f64,
}

impl Undecided {
    /// The sentence for a person.
    pub(super) fn describe(&self, views: &[View<'_>], pieces: &[LocatedPiece]) -> Doubt {
        let name = |piece: usize| views[pieces[piece].view].shot.name.clone();
        let at = pieces[self.a].middle();
        let shifts = |name: fn(&i32) -> String| self.choices.iter().map(name).collect::<Vec<_>>().join(" or ");
        let message = match self.code {
            "bench_conflict" => format!(
                "the bench at {:.1} m east, {:.1} m north is seen differently in {} and {}: by the structure their columns \
                 differ by {}, by the other images they do not; check how many modules its rows have",
                at.x,
                at.y,
                name(self.a),
                name(self.b),
                shifts(|shift| format!("{shift:+}"))
            ),
            _ => format!(
                "the bench at {:.1} m east, {:.1} m north shows no end in both {} and {}: column 1 of what the first shows \
                 may be column {} of the second (margin {:.1}); they are not joined, and what lies over the other is left out",
                at.x,
                at.y,
                name(self.a),
                name(self.b),
                shifts(|shift| (1 + shift).to_string()),
                self.margin
            ),
        };
        Doubt { code: self.code, message, images: vec![name(self.a), name(self.b)] }
    }
}

/// The outcome: where each piece stands in which bench.
#[derive(Debug)]
pub struct Clusters {
    pub placements: Vec<Placement>,
    /// Pieces of each bench.
    pub members: Vec<Vec<usize>>,
    /// How sure the joints of each bench are, as the smallest margin among them (infinite with one member).
    pub margins: Vec<f64>,
    pub(super) doubts: Vec<Undecided>,
}

/// Finds the benches.
pub fn associate(pieces: &[LocatedPiece], options: &FusionOptions) -> Clusters {
    let pairs = overlapping_pairs(pieces, options);
    let view_count = pieces.iter().map(|piece| piece.view + 1).max().unwrap_or(0);
    let mut field = DisparityField::unknown(view_count);
    let mut choices: Vec<Option<Choice>> = Vec::new();
    for round in 0..4 {
        choices = pairs.par_iter().map(|pair| choose(pair, pieces, &field)).collect();
        if round < 3 {
            let needed = if round == 0 { SURE } else { LIKELY };
            field = DisparityField::fit(view_count, pieces, &pairs, &choices, needed);
        }
    }
    let mut forest = Forest::new(pieces);
    let mut order: Vec<usize> = (0..pairs.len()).filter(|k| choices[*k].is_some()).collect();
    let margin_of = |k: usize| choices[k].map_or(0.0, |choice| choice.margin);
    order.sort_by(|&i, &j| margin_of(j).total_cmp(&margin_of(i)).then(i.cmp(&j)));
    let mut doubts = Vec::new();
    for &k in &order {
        let Some(choice) = choices[k].filter(|choice| choice.margin >= LIKELY) else { continue };
        let (pair, best) = (&pairs[k], pairs[k].hypotheses[choice.best]);
        match forest.join(pieces, pair.a, pair.b, best.col, best.row, choice.margin) {
            Joined::Conflict(shift) if choice.margin >= SURE => doubts.push(Undecided {
                code: "bench_conflict",
                a: pair.a,
                b: pair.b,
                choices: vec![shift],
                margin: choice.margin,
            }),
            _ => {}
        }
    }
    // What is left lies over each other without a sure shift. All its pairs together may still decide; where they do not,
    // a guess would invent modules: the pieces stay apart, the doubt is told, and the lesser one goes as a ghost.
    let mut left: BTreeMap<(usize, usize), Vec<usize>> = BTreeMap::new();
    for &k in &order {
        let (a, b) = (forest.root(pairs[k].a), forest.root(pairs[k].b));
        if a != b {
            left.entry((a.min(b), a.max(b))).or_default().push(k);
        }
    }
    for undecided in left.values() {
        let (a, b) = (pairs[undecided[0]].a, pairs[undecided[0]].b);
        if forest.root(a) == forest.root(b) {
            continue;
        }
        let Some((best, second, margin, margin_per_view)) =
            pooled_choice(undecided, &pairs, pieces, &field, &mut forest, (a, b))
        else {
            continue;
        };
        if margin >= LIKELY {
            forest.join(pieces, a, b, best.0, best.1, margin_per_view);
        } else {
            let mut shown = vec![best.0];
            shown.extend(second.map(|second| second.0).filter(|second| *second != best.0));
            doubts.push(Undecided { code: "bench_shift_unsure", a, b, choices: shown, margin });
        }
    }
    forest.clusters(doubts)
}

/// All pairs of pieces of different views whose footprints come near each other.
fn overlapping_pairs(pieces: &[LocatedPiece], options: &FusionOptions) -> Vec<Pair> {
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
            if other.data > a && pieces[other.data].view != pieces[a].view {
                near.push((a, other.data));
            }
        }
    }
    near.sort_unstable();
    near.par_iter().filter_map(|&(a, b)| pair(a, b, pieces, options)).collect()
}

/// Where one cell of a piece stands in the lattice of another.
struct Shift {
    /// Columns and rows by which it stands outside the other piece.
    outside: f64,
    /// Its column and row there less its own.
    col: f64,
    row: f64,
    at_m: Vector2<f64>,
}

/// The shifts that are possible between two pieces, or `None` if there is none.
fn pair(a: usize, b: usize, pieces: &[LocatedPiece], options: &FusionOptions) -> Option<Pair> {
    let (first, second) = (&pieces[a], &pieces[b]);
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
    let mut shifts: Vec<Shift> = Vec::new();
    let stride = (first.cells.len() / 24).max(1);
    for cell in first.cells.iter().step_by(stride) {
        let Some(at) = second.ground.coordinate(cell.position_m.xy()) else { continue };
        let outside_col = (-at.x).max(at.x - f64::from(second.cols - 1)).max(0.0);
        let outside_row = (-at.y).max(at.y - f64::from(second.rows - 1)).max(0.0);
        shifts.push(Shift {
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
    let median = |f: fn(&Shift) -> f64| {
        let mut values: Vec<f64> = shifts.iter().map(f).collect();
        values.sort_by(f64::total_cmp);
        values[values.len() / 2]
    };
    let (col_shift, row_shift) = (median(|s| s.col), median(|s| s.row));
    let at_m = shifts.iter().map(|s| s.at_m).sum::<Vector2<f64>>() / shifts.len() as f64;
    let (col_reach, row_reach) =
        (options.max_disparity_m / other_u.norm(), (options.max_disparity_m / other_v.norm()).max(0.5));
    let mut hypotheses = Vec::new();
    for col in (col_shift - col_reach).ceil() as i32..=(col_shift + col_reach).floor() as i32 {
        for row in (row_shift - row_reach).ceil() as i32..=(row_shift + row_reach).floor() as i32 {
            // The same cell by both: `b` sees it where `a` would be at the fractional rest of the shift.
            let disparity_m = other_u * (f64::from(col) - col_shift) + other_v * (f64::from(row) - row_shift);
            if disparity_m.norm() > options.max_disparity_m {
                continue;
            }
            let (mut structure_cost, shares) = structure_cost(first, second, col, row, options);
            if !shares {
                // Beside each other they may as well be two benches: nothing is contradicted.
                structure_cost = structure_cost.min(APART_COST);
            }
            hypotheses.push(Hypothesis { col, row, structure_cost, shares, disparity_m });
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
    cost += (f64::from(holes) * HOLE_COST).min(3.0 * HOLE_COST + 0.1 * f64::from(holes));
    // `beyond` columns of one piece lie past the end of the other.
    let mut end = |mine: End, theirs: End, beyond: i32| {
        let contradicted = if beyond > 0 { mine } else { theirs };
        if beyond != 0 && contradicted == End::Closed {
            cost += END_COST + END_COLUMN_COST * f64::from(beyond.abs() - 1).min(4.0);
            // Both see an end, and not the same.
            if mine == End::Closed && theirs == End::Closed {
                cost += 1.0;
            }
        }
    };
    end(a.west, b.west, col);
    end(a.east, b.east, (b.cols - 1) - (a.cols - 1 + col));
    end(a.north, b.north, row);
    end(a.south, b.south, (b.rows - 1) - (a.rows - 1 + row));
    if let Some(known) = options.rows_per_bench {
        let (low, high) = (0.min(row), (a.rows - 1 + row).max(b.rows - 1));
        if high - low + 1 > known as i32 {
            cost += END_COST;
        }
    }
    (cost, shared > 0)
}

/// A place, and what is left of the disparity there, metres.
type Residual = (Vector2<f64>, Vector2<f64>);

/// How the positions of two views disagree: one displacement for each view, and nearby pairs of the same two views.
struct DisparityField {
    offset_m: Vec<Vector2<f64>>,
    sigma_m: f64,
    /// Residual disparities of sure pairs for each pair of views.
    local: BTreeMap<(usize, usize), Vec<Residual>>,
}

impl DisparityField {
    fn unknown(views: usize) -> Self {
        Self { offset_m: vec![Vector2::zeros(); views], sigma_m: PRIOR_SIGMA_M, local: BTreeMap::new() }
    }

    /// Fits the displacement of each view to the pairs that are sure enough (Gauss-Seidel on the normal equations, with
    /// a weak pull to nought), robustly.
    fn fit(views: usize, pieces: &[LocatedPiece], pairs: &[Pair], choices: &[Option<Choice>], needed: f64) -> Self {
        let sure: Vec<(usize, usize, Vector2<f64>, Vector2<f64>)> = pairs
            .iter()
            .zip(choices)
            .filter_map(|(pair, choice)| {
                let choice = choice.filter(|choice| choice.margin >= needed)?;
                let disparity = pair.hypotheses[choice.best].disparity_m;
                Some((pieces[pair.a].view, pieces[pair.b].view, pair.at_m, disparity))
            })
            .collect();
        let mut field = Self::unknown(views);
        if sure.is_empty() {
            return field;
        }
        let mut of_view: Vec<Vec<usize>> = vec![Vec::new(); views];
        for (k, (a, b, _, _)) in sure.iter().enumerate() {
            of_view[*a].push(k);
            of_view[*b].push(k);
        }
        let mut spread = PRIOR_SIGMA_M;
        for _ in 0..30 {
            for (view, sure_of_view) in of_view.iter().enumerate() {
                let (mut sum, mut weight) = (Vector2::zeros(), 0.5);
                for &k in sure_of_view {
                    let (a, b, _, disparity) = sure[k];
                    let target = if b == view { field.offset_m[a] + disparity } else { field.offset_m[b] - disparity };
                    let robust = 1.0 / (1.0 + ((target - field.offset_m[view]).norm() / spread).powi(2));
                    sum += target * robust;
                    weight += robust;
                }
                field.offset_m[view] = sum / weight;
            }
        }
        let mut residuals: Vec<f64> = Vec::with_capacity(sure.len());
        for (a, b, at, disparity) in &sure {
            let rest = disparity - (field.offset_m[*b] - field.offset_m[*a]);
            residuals.push(rest.norm());
            field.local.entry((*a, *b)).or_default().push((*at, rest));
        }
        residuals.sort_by(f64::total_cmp);
        // Median of a Rayleigh distribution is 1.18 sigma.
        spread = residuals[residuals.len() / 2] / 1.18;
        let trust = sure.len() as f64 / (sure.len() as f64 + 6.0);
        field.sigma_m = (spread * trust + PRIOR_SIGMA_M * (1.0 - trust)).clamp(0.05, PRIOR_SIGMA_M);
        field
    }

    /// Expected disparity at a place, and its standard deviation, metres.
    fn expected(&self, view_a: usize, view_b: usize, at_m: Vector2<f64>) -> (Vector2<f64>, f64) {
        let base = self.offset_m[view_b] - self.offset_m[view_a];
        let Some(near) = self.local.get(&(view_a, view_b)) else { return (base, self.sigma_m) };
        let prior = 1.0;
        let (mut sum, mut weight) = (Vector2::zeros(), prior);
        for (at, rest) in near {
            // Disparities are alike within some 15 m.
            let w = 4.0 * (-(at - at_m).norm_squared() / (2.0 * 15.0 * 15.0)).exp();
            sum += rest * w;
            weight += w;
        }
        let knowledge = (weight - prior) / weight;
        (base + sum / weight, self.sigma_m * (1.0 - 0.5 * knowledge))
    }
}

/// Total cost of each hypothesis of a pair.
fn costs(pair: &Pair, pieces: &[LocatedPiece], field: &DisparityField) -> Vec<f64> {
    let (a, b) = (&pieces[pair.a], &pieces[pair.b]);
    let (expected, field_sigma) = field.expected(a.view, b.view, pair.at_m);
    let sigma = (field_sigma.powi(2) + a.sigma_m.powi(2) + b.sigma_m.powi(2)).sqrt();
    pair.hypotheses
        .iter()
        .map(|hypothesis| {
            let off = (hypothesis.disparity_m - expected).norm() / sigma;
            // Student's t in the plane: positions may be wrong by far more than they admit.
            let position = (TAIL + 2.0) / 2.0 * (1.0 + off * off / TAIL).ln();
            hypothesis.structure_cost + position
        })
        .collect()
}

fn choose(pair: &Pair, pieces: &[LocatedPiece], field: &DisparityField) -> Option<Choice> {
    let costs = costs(pair, pieces, field);
    let best = (0..costs.len()).min_by(|&i, &j| costs[i].total_cmp(&costs[j]))?;
    let second = (0..costs.len()).filter(|k| *k != best).min_by(|&i, &j| costs[i].total_cmp(&costs[j]));
    // That the two are different benches after all costs as much as two contradicted ends.
    let apart = 2.0 * END_COST + 2.0;
    let rival = second.map_or(apart, |second| costs[second].min(apart));
    (pair.hypotheses[best].shares && costs[best] < apart).then_some(Choice { best, margin: rival - costs[best] })
}

/// The shift between two benches-to-be that all their undecided pairs together favour: (column, row) from piece `base.0`
/// to `base.1`, the runner-up, and the margin.
#[allow(clippy::type_complexity)]
fn pooled_choice(
    undecided: &[usize],
    pairs: &[Pair],
    pieces: &[LocatedPiece],
    field: &DisparityField,
    forest: &mut Forest,
    base: (usize, usize),
) -> Option<((i32, i32), Option<(i32, i32)>, f64, f64)> {
    let mut totals: BTreeMap<(i32, i32), (f64, usize)> = BTreeMap::new();
    let mut counted = 0;
    let (from, to) = (forest.place(base.0), forest.place(base.1));
    for &k in undecided {
        let pair = &pairs[k];
        let (mut a, mut b) = (forest.place(pair.a), forest.place(pair.b));
        let mut sign = 1;
        if a.0 != from.0 {
            std::mem::swap(&mut a, &mut b);
            sign = -1;
        }
        if a.0 != from.0 || b.0 != to.0 {
            continue;
        }
        counted += 1;
        for (hypothesis, cost) in pair.hypotheses.iter().zip(costs(pair, pieces, field)) {
            // Shift between the two pieces -> shift between the two base pieces.
            let col = sign * hypothesis.col + (a.1 - from.1) - (b.1 - to.1);
            let row = sign * hypothesis.row + (a.2 - from.2) - (b.2 - to.2);
            let total = totals.entry((col, row)).or_insert((0.0, 0));
            total.0 += cost;
            total.1 += 1;
        }
    }
    let apart = 2.0 * END_COST + 2.0;
    let mut ranked: Vec<((i32, i32), f64)> =
        totals.into_iter().map(|(shift, (cost, times))| (shift, cost + apart * (counted - times) as f64)).collect();
    ranked.sort_by(|p, q| p.1.total_cmp(&q.1).then(p.0.cmp(&q.0)));
    let (best, cost) = *ranked.first()?;
    if cost >= apart * counted as f64 {
        return None;
    }
    let second = ranked.get(1).copied();
    let margin = second.map_or(apart * counted as f64, |(_, cost)| cost) - cost;
    Some((best, second.map(|(shift, _)| shift), margin, margin / counted as f64))
}

enum Joined {
    New,
    Already,
    Conflict(i32),
}

/// Disjoint sets of pieces, each with its shift against the root's lattice.
struct Forest {
    parent: Vec<usize>,
    /// Shift of a piece against its parent: parent's coordinate = own + shift.
    shift: Vec<(i32, i32)>,
    members: Vec<Vec<usize>>,
    margin: Vec<f64>,
}

impl Forest {
    fn new(pieces: &[LocatedPiece]) -> Self {
        let count = pieces.len();
        Self {
            parent: (0..count).collect(),
            shift: vec![(0, 0); count],
            members: (0..count).map(|k| vec![k]).collect(),
            margin: vec![f64::INFINITY; count],
        }
    }

    fn root(&mut self, piece: usize) -> usize {
        self.place(piece).0
    }

    /// Root, column shift and row shift of a piece; compresses the path.
    fn place(&mut self, piece: usize) -> (usize, i32, i32) {
        let parent = self.parent[piece];
        if parent == piece {
            return (piece, 0, 0);
        }
        let (root, col, row) = self.place(parent);
        let own = (self.shift[piece].0 + col, self.shift[piece].1 + row);
        self.parent[piece] = root;
        self.shift[piece] = own;
        (root, own.0, own.1)
    }

    /// Joins the sets of `a` and `b`, where column and row of `b` are those of `a` plus (`col`, `row`).
    fn join(&mut self, pieces: &[LocatedPiece], a: usize, b: usize, col: i32, row: i32, margin: f64) -> Joined {
        let ((root_a, col_a, row_a), (root_b, col_b, row_b)) = (self.place(a), self.place(b));
        if root_a == root_b {
            let off = (col_b + col - col_a, row_b + row - row_a);
            return if off == (0, 0) { Joined::Already } else { Joined::Conflict(off.0) };
        }
        // Coordinates of root_b's set in root_a's: x_a-root = x_b-root + offset.
        let offset = (col_a - col - col_b, row_a - row - row_b);
        if self.collides(pieces, root_a, root_b, offset) {
            return Joined::Conflict(0);
        }
        let (keep, drop, offset) = if self.members[root_a].len() >= self.members[root_b].len() {
            (root_a, root_b, offset)
        } else {
            (root_b, root_a, (-offset.0, -offset.1))
        };
        self.parent[drop] = keep;
        self.shift[drop] = offset;
        let moved = std::mem::take(&mut self.members[drop]);
        self.members[keep].extend(moved);
        self.margin[keep] = self.margin[keep].min(self.margin[drop]).min(margin);
        Joined::New
    }

    /// Whether two pieces of one view would show two modules at one place.
    fn collides(&mut self, pieces: &[LocatedPiece], a: usize, b: usize, offset: (i32, i32)) -> bool {
        let (small, large, sign) = if self.members[a].len() <= self.members[b].len() { (a, b, 1) } else { (b, a, -1) };
        // Coordinates of `large`'s set in `small`'s.
        let shift = if sign == 1 { offset } else { (-offset.0, -offset.1) };
        let members_small = self.members[small].clone();
        let members_large = self.members[large].clone();
        for p in members_small {
            for q in &members_large {
                if pieces[p].view != pieces[*q].view {
                    continue;
                }
                let ((_, pc, pr), (_, qc, qr)) = (self.place(p), self.place(*q));
                // q's cell (c, r) stands at p's cell (c + qc + shift - pc).
                let (dc, dr) = (qc + shift.0 - pc, qr + shift.1 - pr);
                let hit = pieces[*q].cells.iter().any(|cell| {
                    cell.detection.is_some()
                        && pieces[p].cell(cell.row + dr, cell.col + dc).is_some_and(|other| other.detection.is_some())
                });
                if hit {
                    return true;
                }
            }
        }
        false
    }

    /// Numbers the sets by their first piece and shifts each so that its lowest column and row are 0.
    fn clusters(mut self, doubts: Vec<Undecided>) -> Clusters {
        let count = self.parent.len();
        let mut number: BTreeMap<usize, usize> = BTreeMap::new();
        let mut members: Vec<Vec<usize>> = Vec::new();
        let mut margins = Vec::new();
        let mut placements = Vec::with_capacity(count);
        for piece in 0..count {
            let (root, col, row) = self.place(piece);
            let cluster = *number.entry(root).or_insert_with(|| {
                members.push(Vec::new());
                margins.push(self.margin[root]);
                members.len() - 1
            });
            members[cluster].push(piece);
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
        Clusters { placements, members, margins, doubts }
    }
}
