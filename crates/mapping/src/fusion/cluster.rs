//! Which pieces form one bench, under which shifts of whole columns and rows: the evidence of all pairs together.
//!
//! Every pair of pieces states what each shift between them would cost, and what it would cost if they were no part of
//! one bench. Sets of pieces are joined where the sum over all pairs between them is clearest (greedy additive edge
//! contraction, Keuper et al. 2015, with shifts for labels); then every piece is tried at every other place that its
//! pairs allow, until none would stand better elsewhere.

use super::{FusionParams, LocatedPiece};
use std::cmp::Ordering;
use std::collections::{BTreeMap, BTreeSet, BinaryHeap, HashMap};

/// Columns and rows.
pub(super) type Shift = (i32, i32);

/// What two pieces say of each other. Costs are negative log-likelihoods.
#[derive(Debug, Clone)]
pub(super) struct Link {
    pub a: usize,
    pub b: usize,
    pub table: Table,
}

/// Costs of the shifts between two pieces, or two sets of pieces: coordinates of the second are those of the first plus
/// the shift.
#[derive(Debug, Clone, Default)]
pub(super) struct Table {
    /// Cost of each shift, less that of any other.
    shifts: BTreeMap<Shift, f64>,
    /// Cost of any shift that is not listed.
    other: f64,
    /// Cost of being no part of one bench.
    apart: f64,
}

/// The cheapest shift.
#[derive(Debug, Clone, Copy)]
pub(super) struct Best {
    pub shift: Shift,
    pub cost: f64,
    /// The cheapest other shift that is listed.
    pub second: Option<Shift>,
    /// By how much the best beats every other choice, being apart included.
    pub margin: f64,
}

impl Table {
    pub(super) fn new(costs: impl IntoIterator<Item = (Shift, f64)>, other: f64, apart: f64) -> Self {
        Self { shifts: costs.into_iter().map(|(shift, cost)| (shift, cost - other)).collect(), other, apart }
    }

    pub(super) fn cost(&self, shift: Shift) -> f64 {
        self.other + self.shifts.get(&shift).copied().unwrap_or(0.0)
    }

    pub(super) fn apart(&self) -> f64 {
        self.apart
    }

    pub(super) fn best(&self) -> Option<Best> {
        let mut best: Option<(f64, Shift)> = None;
        let mut second: Option<(f64, Shift)> = None;
        for (shift, delta) in &self.shifts {
            if best.is_none_or(|(least, _)| *delta < least) {
                second = best;
                best = Some((*delta, *shift));
            } else if second.is_none_or(|(least, _)| *delta < least) {
                second = Some((*delta, *shift));
            }
        }
        let (delta, shift) = best?;
        let rival = second.map_or(0.0, |(delta, _)| delta.min(0.0)) + self.other;
        let cost = self.other + delta;
        Some(Best { shift, cost, second: second.map(|(_, shift)| shift), margin: rival.min(self.apart) - cost })
    }

    /// Adds the costs of `table`, each of whose shifts is turned into one of this table's by `map`.
    pub(super) fn add(&mut self, table: &Self, map: impl Fn(Shift) -> Shift) {
        for (shift, delta) in &table.shifts {
            *self.shifts.entry(map(*shift)).or_default() += delta;
        }
        self.other += table.other;
        self.apart += table.apart;
    }
}

/// Where each piece stands: the coordinates of its set are its own plus its shift.
#[derive(Debug)]
pub(super) struct Partition {
    pub set: Vec<usize>,
    pub shift: Vec<Shift>,
    /// Pieces of each set; empty for sets that were joined to others.
    pub members: Vec<Vec<usize>>,
    /// By how much each piece stands better where it is than anywhere else; infinite where it stands alone.
    pub margin: Vec<f64>,
}

/// Joins as long as a joint beats every other choice by the least margin that counts, then settles every piece.
pub(super) fn partition(pieces: &[LocatedPiece], links: &[Link], params: &FusionParams) -> Partition {
    let mut contraction = Contraction::new(pieces, links);
    contraction.run(params.likely_margin);
    let mut partition = contraction.partition;
    let mut of_piece: Vec<Vec<usize>> = vec![Vec::new(); pieces.len()];
    for (index, link) in links.iter().enumerate() {
        of_piece[link.a].push(index);
        of_piece[link.b].push(index);
    }
    for _ in 0..4 {
        let moved = (0..pieces.len())
            .filter(|piece| partition.settle(pieces, links, &of_piece[*piece], *piece, params.least_gain))
            .count();
        if moved == 0 {
            break;
        }
    }
    partition.margin = of_piece.iter().enumerate().map(|(piece, own)| partition.margin_of(links, own, piece)).collect();
    partition
}

impl Partition {
    /// The shift from one piece to another of the same set.
    pub(super) fn between(&self, a: usize, b: usize) -> Option<Shift> {
        let (from, to) = (self.shift[a], self.shift[b]);
        (self.set[a] == self.set[b]).then_some((from.0 - to.0, from.1 - to.1))
    }

    /// What the links of one piece say of each set: shifts from the piece to the set.
    fn tables(&self, links: &[Link], of_piece: &[usize], piece: usize) -> BTreeMap<usize, Table> {
        let mut tables: BTreeMap<usize, Table> = BTreeMap::new();
        for &index in of_piece {
            let link = &links[index];
            let forwards = link.a == piece;
            let other = if forwards { link.b } else { link.a };
            let (col, row) = self.shift[other];
            let table = tables.entry(self.set[other]).or_default();
            if forwards {
                table.add(&link.table, |s| (s.0 + col, s.1 + row));
            } else {
                table.add(&link.table, |s| (col - s.0, row - s.1));
            }
        }
        tables
    }

    /// Moves a piece to where it stands best, if that is clearly elsewhere.
    fn settle(
        &mut self,
        pieces: &[LocatedPiece],
        links: &[Link],
        of_piece: &[usize],
        piece: usize,
        least_gain: f64,
    ) -> bool {
        let tables = self.tables(links, of_piece, piece);
        let (home, here) = (self.set[piece], self.shift[piece]);
        let gain = |set: usize, shift: Shift| tables.get(&set).map_or(0.0, |table| table.apart - table.cost(shift));
        let now = if self.members[home].len() > 1 { gain(home, here) } else { 0.0 };
        // Standing alone gains nothing.
        let mut choices: Vec<(f64, Option<(usize, Shift)>)> = vec![(0.0, None)];
        for (set, table) in &tables {
            for shift in table.shifts.keys() {
                choices.push((gain(*set, *shift), Some((*set, *shift))));
            }
        }
        choices.retain(|(gain, _)| *gain > now + least_gain);
        choices.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        for (_, choice) in choices {
            match choice {
                Some((set, shift)) if !self.collides_one(pieces, piece, set, shift) => {
                    self.move_to(piece, set, shift);
                    return true;
                }
                Some(_) => {}
                None if self.members[home].len() > 1 => {
                    let set = self.members.len();
                    self.members.push(Vec::new());
                    self.move_to(piece, set, (0, 0));
                    return true;
                }
                None => {}
            }
        }
        false
    }

    fn move_to(&mut self, piece: usize, set: usize, shift: Shift) {
        let home = self.set[piece];
        self.members[home].retain(|member| *member != piece);
        self.members[set].push(piece);
        self.set[piece] = set;
        self.shift[piece] = shift;
    }

    fn margin_of(&self, links: &[Link], of_piece: &[usize], piece: usize) -> f64 {
        let home = self.set[piece];
        if self.members[home].len() < 2 {
            return f64::INFINITY;
        }
        let tables = self.tables(links, of_piece, piece);
        let Some(table) = tables.get(&home) else { return 0.0 };
        let cost = table.cost(self.shift[piece]);
        let rival = table
            .shifts
            .iter()
            .filter(|(shift, _)| **shift != self.shift[piece])
            .map(|(_, delta)| table.other + delta)
            .fold(table.other.min(table.apart), f64::min);
        rival - cost
    }

    /// Whether a piece would show a module where another piece of its view in the set does.
    fn collides_one(&self, pieces: &[LocatedPiece], piece: usize, set: usize, shift: Shift) -> bool {
        self.members[set].iter().any(|&other| {
            other != piece && pieces[other].view == pieces[piece].view && {
                let (col, row) = self.shift[other];
                overlap(&pieces[piece], &pieces[other], (shift.0 - col, shift.1 - row))
            }
        })
    }
}

/// Whether two pieces of one view show two modules at one place, coordinates of `b` being those of `a` plus `shift`.
fn overlap(a: &LocatedPiece, b: &LocatedPiece, shift: Shift) -> bool {
    let (small, large, sign) = if a.cells.len() <= b.cells.len() { (a, b, 1) } else { (b, a, -1) };
    small.cells.iter().any(|cell| {
        cell.detection.is_some()
            && large
                .cell(cell.row + sign * shift.1, cell.col + sign * shift.0)
                .is_some_and(|other| other.detection.is_some())
    })
}

/// A joint that may be made; stale once its table has changed.
struct Candidate {
    margin: f64,
    sets: (usize, usize),
    version: u32,
}

impl Ord for Candidate {
    fn cmp(&self, other: &Self) -> Ordering {
        self.margin.total_cmp(&other.margin).then(other.sets.cmp(&self.sets)).then(self.version.cmp(&other.version))
    }
}

impl PartialOrd for Candidate {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl PartialEq for Candidate {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other) == Ordering::Equal
    }
}

impl Eq for Candidate {}

/// Sets of pieces and the tables between them.
struct Contraction<'a> {
    pieces: &'a [LocatedPiece],
    partition: Partition,
    /// Between the lower and the higher set, with the number of its last change.
    tables: HashMap<(usize, usize), (Table, u32)>,
    neighbours: Vec<BTreeSet<usize>>,
    /// Pieces of each view in each set.
    by_view: Vec<BTreeMap<usize, Vec<usize>>>,
    queue: BinaryHeap<Candidate>,
    version: u32,
}

impl<'a> Contraction<'a> {
    fn new(pieces: &'a [LocatedPiece], links: &[Link]) -> Self {
        let count = pieces.len();
        let mut contraction = Self {
            pieces,
            partition: Partition {
                set: (0..count).collect(),
                shift: vec![(0, 0); count],
                members: (0..count).map(|piece| vec![piece]).collect(),
                margin: vec![f64::INFINITY; count],
            },
            tables: HashMap::with_capacity(links.len()),
            neighbours: vec![BTreeSet::new(); count],
            by_view: pieces.iter().enumerate().map(|(piece, p)| BTreeMap::from([(p.view, vec![piece])])).collect(),
            queue: BinaryHeap::with_capacity(links.len()),
            version: 0,
        };
        for link in links {
            contraction.add(link.a, link.b, &link.table);
        }
        for link in links {
            contraction.offer(link.a.min(link.b), link.a.max(link.b));
        }
        contraction
    }

    /// Adds a table between two sets, whose shifts lead from `from` to `to`.
    fn add(&mut self, from: usize, to: usize, table: &Table) {
        let entry = &mut self.tables.entry((from.min(to), from.max(to))).or_default().0;
        if from < to {
            entry.add(table, |s| s);
        } else {
            entry.add(table, |s| (-s.0, -s.1));
        }
        self.neighbours[from].insert(to);
        self.neighbours[to].insert(from);
    }

    fn offer(&mut self, low: usize, high: usize) {
        self.version += 1;
        if let Some((table, version)) = self.tables.get_mut(&(low, high)) {
            *version = self.version;
            if let Some(best) = table.best().filter(|best| best.margin > 0.0) {
                self.queue.push(Candidate { margin: best.margin, sets: (low, high), version: self.version });
            }
        }
    }

    fn run(&mut self, least_margin: f64) {
        while let Some(candidate) = self.queue.pop() {
            if candidate.margin < least_margin {
                break;
            }
            let (low, high) = candidate.sets;
            let Some((table, version)) = self.tables.get_mut(&(low, high)) else { continue };
            let Some(best) = table.best().filter(|_| *version == candidate.version) else { continue };
            if self.collides(low, high, best.shift) {
                // Two modules of one photo cannot be one: this shift is out, another may do.
                if let Some((table, _)) = self.tables.get_mut(&(low, high)) {
                    let never = 1e3 - table.other;
                    table.shifts.insert(best.shift, never);
                }
                self.offer(low, high);
                continue;
            }
            self.merge(low, high, best.shift);
        }
    }

    fn collides(&self, low: usize, high: usize, shift: Shift) -> bool {
        let place = |piece: usize| self.partition.shift[piece];
        self.by_view[low].iter().any(|(view, mine)| {
            self.by_view[high].get(view).is_some_and(|theirs| {
                mine.iter().any(|&p| {
                    theirs.iter().any(|&q| {
                        // Set of `high` = set of `low` + shift, so q's own = p's own + p's place + shift - q's place.
                        let between = (place(p).0 + shift.0 - place(q).0, place(p).1 + shift.1 - place(q).1);
                        overlap(&self.pieces[p], &self.pieces[q], between)
                    })
                })
            })
        })
    }

    fn merge(&mut self, low: usize, high: usize, shift: Shift) {
        // Coordinates of `drop`'s set are those of `keep`'s plus `shift`.
        let (keep, drop, shift) = if self.partition.members[low].len() >= self.partition.members[high].len() {
            (low, high, shift)
        } else {
            (high, low, (-shift.0, -shift.1))
        };
        self.tables.remove(&(low, high));
        self.neighbours[keep].remove(&drop);
        self.neighbours[drop].remove(&keep);
        let moved = std::mem::take(&mut self.partition.members[drop]);
        for &piece in &moved {
            self.partition.set[piece] = keep;
            let own = &mut self.partition.shift[piece];
            *own = (own.0 - shift.0, own.1 - shift.1);
        }
        self.partition.members[keep].extend(moved);
        for (view, theirs) in std::mem::take(&mut self.by_view[drop]) {
            self.by_view[keep].entry(view).or_default().extend(theirs);
        }
        for third in std::mem::take(&mut self.neighbours[drop]) {
            self.neighbours[third].remove(&drop);
            let Some((table, _)) = self.tables.remove(&(drop.min(third), drop.max(third))) else { continue };
            // From `keep` to `third`: first to `drop`, then on.
            let mut turned = Table::default();
            if drop < third {
                turned.add(&table, |s| (s.0 + shift.0, s.1 + shift.1));
            } else {
                turned.add(&table, |s| (shift.0 - s.0, shift.1 - s.1));
            }
            self.add(keep, third, &turned);
            self.offer(keep.min(third), keep.max(third));
        }
    }
}
