//! Benches grow from module to module: links between neighbours, cuts where a gap lies between them, lattice
//! coordinates along the links, and hypotheses where a module is missing.

use super::lattice::{LatticeMap, Sample};
use super::transition;
use super::{Cell, End, LayoutOptions, Piece};
use crate::detection::ImageDetections;
use crate::geometry::Quad;
use image::GrayImage;
use nalgebra::Vector2;
use std::collections::{BTreeMap, BTreeSet, HashMap, VecDeque};

/// A module's neighbours stand 0.75 to this many of its own sides away; what is further is no neighbour.
const REACH: f64 = 1.45;
/// Share of the shorter pitch that a module may stand off its lattice (the paper's RANSAC threshold).
const INLIER: f64 = 0.25;
/// So many modules in a row are a row by themselves, whatever stands about.
const LONG: i32 = 12;

/// A detection as the growth sees it: its centre, and the side vectors of its box, `b` a quarter turn clockwise from `a`.
#[derive(Clone, Copy)]
struct Node {
    center: Vector2<f64>,
    sides: [Vector2<f64>; 2],
}

impl Node {
    /// Side vector of one of the four directions: a, b, -a, -b.
    fn direction(&self, d: usize) -> Vector2<f64> {
        if d % 4 < 2 { self.sides[d % 2] } else { -self.sides[d % 2] }
    }
}

/// A link to a neighbour: which, and by how many quarter turns its own frame is turned against ours.
type Link = Option<(usize, usize)>;

/// A connected set of modules with lattice coordinates.
struct Component {
    /// (column, row) of each node.
    places: BTreeMap<(i32, i32), usize>,
    /// Quarter turns of each node's frame against the component's.
    turns: HashMap<usize, usize>,
    bridges: Vec<i32>,
}

impl Component {
    fn sides(&self, nodes: &[Node]) -> [Vector2<f64>; 2] {
        [0, 1].map(|d| {
            let mut x: Vec<f64> = Vec::with_capacity(self.places.len());
            let mut y: Vec<f64> = Vec::with_capacity(self.places.len());
            for node in self.places.values() {
                let side = nodes[*node].direction(d + self.turns[node]);
                x.push(side.x);
                y.push(side.y);
            }
            Vector2::new(median(&mut x), median(&mut y))
        })
    }

    fn map(&self, nodes: &[Node]) -> LatticeMap {
        let samples: Vec<Sample> = self
            .places
            .iter()
            .map(|((col, row), node)| Sample { col: f64::from(*col), row: f64::from(*row), pixel: nodes[*node].center })
            .collect();
        let [u, v] = self.sides(nodes);
        LatticeMap::fit(&samples, u * 1.02, v * 1.02)
    }

    fn col_range(&self) -> (i32, i32) {
        range(self.places.keys().map(|place| place.0))
    }

    fn row_range(&self) -> (i32, i32) {
        range(self.places.keys().map(|place| place.1))
    }
}

fn range(values: impl Iterator<Item = i32>) -> (i32, i32) {
    values.fold((i32::MAX, i32::MIN), |(low, high), v| (low.min(v), high.max(v)))
}

fn median(values: &mut [f64]) -> f64 {
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

/// Grows the pieces of benches in one image; the second value lists detections that belong to none.
pub(super) fn grow(
    detections: &ImageDetections,
    grey: Option<&GrayImage>,
    options: &LayoutOptions,
) -> (Vec<Piece>, Vec<usize>) {
    let nodes: Vec<Node> = detections
        .detections
        .iter()
        .map(|detection| Node { center: detection.quad.center(), sides: detection.quad.sides() })
        .collect();
    let mut links = find_links(&nodes);
    let loose_components = components(&nodes, &links);
    for component in &loose_components {
        cut_gaps(component, &nodes, &mut links, detections, grey, options);
    }
    let mut grown: Vec<Component> = components(&nodes, &links);
    for component in &mut grown {
        drop_outliers(component, &nodes);
    }
    // What is joined is judged along the row, so the row must be known first; what was joined may tell more of it.
    orient(&mut grown, &nodes);
    join(&mut grown, &nodes, detections, grey, options);
    grown.retain(|component| component.places.len() >= 2);
    orient(&mut grown, &nodes);
    let mut used = vec![false; nodes.len()];
    let mut pieces: Vec<Piece> = grown
        .iter()
        .map(|component| {
            for node in component.places.values() {
                used[*node] = true;
            }
            piece(component, &nodes, detections)
        })
        .collect();
    open_torn_ends(&mut pieces);
    let loose = (0..nodes.len()).filter(|node| !used[*node]).collect();
    (pieces, loose)
}

/// Where another piece stands on the lattice of this one, a few whole columns further on, neither is sure to end: modules
/// may be missed between them as well as a gap may happen to be as wide.
fn open_torn_ends(pieces: &mut [Piece]) {
    /// Further off no lattice is known well enough, columns.
    const NEAR: f64 = 9.0;
    let mut open: Vec<(usize, bool)> = Vec::new();
    for (i, base) in pieces.iter().enumerate() {
        let [u, v] = base.map.pitch(f64::from(base.cols - 1) / 2.0, f64::from(base.rows - 1) / 2.0);
        let reach_px = u.norm() * (f64::from(base.cols) / 2.0 + NEAR) + v.norm() * f64::from(base.rows);
        let middle = base.map.pixel(f64::from(base.cols - 1) / 2.0, f64::from(base.rows - 1) / 2.0);
        for (j, part) in pieces.iter().enumerate() {
            if i == j || base.cells.len() < part.cells.len() {
                continue;
            }
            for (col, inner) in [(0, End::Closed), (part.cols - 1, End::Closed)] {
                let west_end = col == 0;
                if (if west_end { part.west } else { part.east }) != inner {
                    continue;
                }
                let ends = part.detected().filter(|(cell, _)| cell.col == col);
                let on_lattice = ends.into_iter().any(|(cell, _)| {
                    let center = cell.quad.center();
                    if (center - middle).norm() > reach_px {
                        return false;
                    }
                    let Some(at) = base.map.coordinate(center) else { return false };
                    let beyond = if west_end { at.x - f64::from(base.cols - 1) } else { -at.x };
                    let off = Vector2::new((at.x - at.x.round()) * u.norm(), (at.y - at.y.round()) * v.norm());
                    let allowed = (0.12 + 0.02 * beyond) * u.norm().min(v.norm());
                    (0.5..NEAR).contains(&beyond)
                        && (-0.5..f64::from(base.rows) - 0.5).contains(&at.y)
                        && off.x.abs() < allowed
                        && off.y.abs() < allowed
                });
                if on_lattice {
                    // The west end of one faces the east end of the other.
                    open.push((j, west_end));
                    open.push((i, !west_end));
                }
            }
        }
    }
    for (piece, west) in open {
        if west {
            pieces[piece].west = End::Cut;
        } else {
            pieces[piece].east = End::Cut;
        }
    }
}

/// The mutual nearest neighbours of every module in its four directions.
fn find_links(nodes: &[Node]) -> Vec<[Link; 4]> {
    let mut longest: Vec<f64> = nodes.iter().map(|node| node.sides[0].norm().max(node.sides[1].norm())).collect();
    if longest.is_empty() {
        return Vec::new();
    }
    let cell_px = (median(&mut longest) * REACH).max(1.0);
    let key = |p: Vector2<f64>| ((p.x / cell_px).floor() as i64, (p.y / cell_px).floor() as i64);
    let mut grid: HashMap<(i64, i64), Vec<usize>> = HashMap::new();
    for (index, node) in nodes.iter().enumerate() {
        grid.entry(key(node.center)).or_default().push(index);
    }
    let nearest: Vec<[Link; 4]> = nodes
        .iter()
        .enumerate()
        .map(|(i, node)| {
            let mut best: [(f64, Link); 4] = [(f64::INFINITY, None); 4];
            let home = key(node.center);
            for dx in -1..=1 {
                for dy in -1..=1 {
                    for &j in grid.get(&(home.0 + dx, home.1 + dy)).into_iter().flatten() {
                        if i == j {
                            continue;
                        }
                        let Some((d, turn, distance)) = neighbour(node, &nodes[j]) else { continue };
                        if distance < best[d].0 {
                            best[d] = (distance, Some((j, turn)));
                        }
                    }
                }
            }
            best.map(|(_, link)| link)
        })
        .collect();
    (0..nodes.len())
        .map(|i| {
            [0, 1, 2, 3].map(|d| {
                nearest[i][d]
                    .filter(|&(j, turn)| matches!(nearest[j][(d + 2 + turn) % 4], Some((back, _)) if back == i))
            })
        })
        .collect()
}

/// In which direction of `node` the other one is its neighbour, the quarter turns between their frames, and the distance.
fn neighbour(node: &Node, other: &Node) -> Option<(usize, usize, f64)> {
    let turn = (0..4).max_by(|&s, &t| {
        let cosine = |k: usize| node.sides[0].dot(&other.direction(k)) / other.direction(k).norm();
        cosine(s).total_cmp(&cosine(t))
    })?;
    let (a, b) = ((node.sides[0] + other.direction(turn)) / 2.0, (node.sides[1] + other.direction(turn + 1)) / 2.0);
    for (mine, theirs) in [(node.sides[0], other.direction(turn)), (node.sides[1], other.direction(turn + 1))] {
        let ratio = theirs.norm() / mine.norm();
        if !(0.65..1.55).contains(&ratio) || mine.dot(&theirs) < 0.85 * mine.norm() * theirs.norm() {
            return None;
        }
    }
    let offset = other.center - node.center;
    let determinant = a.perp(&b);
    if determinant.abs() < 1e-9 {
        return None;
    }
    let (along_a, along_b) = (offset.perp(&b) / determinant, a.perp(&offset) / determinant);
    let near = |main: f64, side: f64| (0.75..REACH).contains(&main.abs()) && side.abs() < 0.35;
    let d = if near(along_a, along_b) {
        if along_a > 0.0 { 0 } else { 2 }
    } else if near(along_b, along_a) {
        if along_b > 0.0 { 1 } else { 3 }
    } else {
        return None;
    };
    Some((d, turn, offset.norm()))
}

/// Connected components of the links, with lattice coordinates from a breadth-first walk.
fn components(nodes: &[Node], links: &[[Link; 4]]) -> Vec<Component> {
    const STEP: [(i32, i32); 4] = [(1, 0), (0, 1), (-1, 0), (0, -1)];
    let mut seen = vec![false; nodes.len()];
    let mut found = Vec::new();
    for start in 0..nodes.len() {
        if seen[start] {
            continue;
        }
        seen[start] = true;
        let mut component =
            Component { places: BTreeMap::new(), turns: HashMap::from([(start, 0)]), bridges: Vec::new() };
        component.places.insert((0, 0), start);
        let mut queue = VecDeque::from([(start, (0, 0))]);
        while let Some((i, place)) = queue.pop_front() {
            let turn = component.turns[&i];
            for own in 0..4 {
                let Some((j, step_turn)) = links[i][own] else { continue };
                if seen[j] {
                    continue;
                }
                let (du, dv) = STEP[(own + 4 - turn) % 4];
                let next = (place.0 + du, place.1 + dv);
                if component.places.contains_key(&next) {
                    continue;
                }
                seen[j] = true;
                component.places.insert(next, j);
                component.turns.insert(j, (turn + step_turn) % 4);
                queue.push_back((j, next));
            }
        }
        found.push(component);
    }
    found
}

/// Two linked modules: by how much more than usual they stand apart, in parts of the shorter side.
#[derive(Clone, Copy)]
struct Crossing {
    nodes: (usize, usize),
    by_pitch: f64,
    by_sides: f64,
}

/// How much wider than the narrowest gap must be what keeps two parts of one lattice apart.
const SURE_GAP: f64 = 1.2;
/// From so many pairs on, the sides of their boxes tell how far apart they stand: the sides of one box err more than its centre.
const MANY_CROSSINGS: usize = 4;

/// Removes the links over bench gaps. The distance of neighbours is compared with a smooth model of the pitch in this
/// component; all rows that cross between the same two columns decide together.
fn cut_gaps(
    component: &Component,
    nodes: &[Node],
    links: &mut [[Link; 4]],
    detections: &ImageDetections,
    grey: Option<&GrayImage>,
    options: &LayoutOptions,
) {
    let sides = component.sides(nodes);
    let scale = sides[0].norm().min(sides[1].norm());
    // For each axis: (transition, position across it) -> the two nodes and by how much they stand too far apart, by the
    // pitch of the component and by their own sides.
    let crossings = [0, 1].map(|axis| {
        let mut found: BTreeMap<(i32, i32), Crossing> = BTreeMap::new();
        for (&(col, row), &i) in &component.places {
            let next = if axis == 0 { (col + 1, row) } else { (col, row + 1) };
            if let Some(&j) = component.places.get(&next) {
                let own = (axis + component.turns[&i]) % 4;
                if matches!(links[i][own], Some((k, _)) if k == j) {
                    let theirs = (axis + component.turns[&j]) % 4;
                    let apart = (nodes[j].center - nodes[i].center).norm();
                    let half = (nodes[i].direction(own).norm() + nodes[j].direction(theirs).norm()) / 2.0;
                    let crossing = Crossing { nodes: (i, j), by_pitch: 0.0, by_sides: (apart - half) / scale };
                    found.insert(if axis == 0 { (col, row) } else { (row, col) }, crossing);
                }
            }
        }
        let lengths: Vec<(Vector2<f64>, f64)> = found
            .values()
            .map(|crossing| crossing.nodes)
            .map(|(i, j)| ((nodes[i].center + nodes[j].center) / 2.0, (nodes[j].center - nodes[i].center).norm()))
            .collect();
        if !lengths.is_empty() {
            let expected = pitch_model(&lengths, sides[axis].norm());
            let seam = median(&mut found.values().map(|crossing| crossing.by_sides).collect::<Vec<_>>());
            for ((crossing, (_, length)), pitch) in found.values_mut().zip(&lengths).zip(expected) {
                crossing.by_pitch = (length - pitch) / scale;
                crossing.by_sides -= seam;
            }
        }
        found
    });
    for axis in 0..2 {
        let keys: Vec<(i32, i32)> = crossings[axis].keys().copied().collect();
        let links_here: Vec<Crossing> = crossings[axis].values().copied().collect();
        // Two crossings belong together if their modules are neighbours without an aisle between them.
        let together = |first: usize, second: usize| {
            let (from, to) = (keys[first], keys[second]);
            let tight =
                |at: i32| crossings[1 - axis].get(&(from.1, at)).is_some_and(|c| c.by_pitch <= options.gap_threshold);
            to.0 == from.0 && to.1 == from.1 + 1 && (tight(from.0) || tight(from.0 + 1))
        };
        let mut start = 0;
        while start < keys.len() {
            let mut end = start + 1;
            while end < keys.len() && together(end - 1, end) {
                end += 1;
            }
            let group = &links_here[start..end];
            let wide = median(&mut group.iter().map(|link| link.by_pitch).collect::<Vec<_>>());
            let mut gap = wide > options.gap_threshold;
            if group.len() >= MANY_CROSSINGS {
                // Where tables lean away from each other no pitch is common to both; their modules' own sides tell.
                gap |= median(&mut group.iter().map(|link| link.by_sides).collect::<Vec<_>>()) > options.gap_threshold;
            }
            if let Some(grey) = grey.filter(|_| !gap && wide > 0.5 * options.gap_threshold) {
                // Between a seam and a gap by its width: the ground decides (histograms of the transitions, Fig. 8).
                let quads = |link: &Crossing| {
                    (detections.detections[link.nodes.0].quad, detections.detections[link.nodes.1].quad)
                };
                let usual: Vec<(Quad, Quad)> =
                    links_here.iter().filter(|link| link.by_pitch.abs() < 0.03).take(40).map(quads).collect();
                let here: Vec<(Quad, Quad)> = group.iter().map(quads).collect();
                gap = transition::is_gap(grey, &here, &usual);
            }
            if gap {
                for (i, j) in group.iter().map(|link| link.nodes) {
                    for (from, to) in [(i, j), (j, i)] {
                        for link in &mut links[from] {
                            if matches!(link, Some((k, _)) if *k == to) {
                                *link = None;
                            }
                        }
                    }
                }
            }
            start = end;
        }
    }
}

/// The expected distance at each link: the logarithm of the length is fitted as an affine function of the position, gaps
/// left out as outliers. Few links give their lower median, but never less than the module's own side.
fn pitch_model(lengths: &[(Vector2<f64>, f64)], side_px: f64) -> Vec<f64> {
    let mut sorted: Vec<f64> = lengths.iter().map(|(_, length)| *length).collect();
    sorted.sort_by(f64::total_cmp);
    let lower = sorted[(sorted.len() - 1) * 2 / 5].min(side_px * 1.12).max(side_px * 0.95);
    if lengths.len() < 8 {
        return vec![lower; lengths.len()];
    }
    let origin = lengths.iter().map(|(at, _)| at).sum::<Vector2<f64>>() / lengths.len() as f64;
    let spread = lengths.iter().map(|(at, _)| (at - origin).norm()).fold(1.0, f64::max);
    let mut model = nalgebra::Vector3::new(lower.ln(), 0.0, 0.0);
    let value = |model: &nalgebra::Vector3<f64>, at: &Vector2<f64>| {
        let p = (at - origin) / spread;
        model.x + model.y * p.x + model.z * p.y
    };
    let mut cut = 0.08;
    for _ in 0..6 {
        let mut normal = nalgebra::Matrix3::from_diagonal_element(1e-6);
        normal += nalgebra::Matrix3::from_diagonal(&nalgebra::Vector3::new(0.0, 0.05, 0.05));
        let mut right = nalgebra::Vector3::zeros();
        for (at, length) in lengths {
            let t = (length.ln() - value(&model, at)) / cut;
            if t.abs() >= 1.0 {
                continue;
            }
            let weight = (1.0 - t * t).powi(2);
            let p = (at - origin) / spread;
            let row = nalgebra::Vector3::new(1.0, p.x, p.y);
            normal += weight * row * row.transpose();
            right += weight * length.ln() * row;
        }
        match normal.cholesky() {
            Some(cholesky) => model = cholesky.solve(&right),
            None => break,
        }
        cut = 0.06;
    }
    lengths.iter().map(|(at, _)| value(&model, at).exp()).collect()
}

/// Takes out modules that stand off the lattice of their component.
fn drop_outliers(component: &mut Component, nodes: &[Node]) {
    if component.places.len() < 6 {
        return;
    }
    let map = component.map(nodes);
    let out: Vec<(i32, i32)> = component
        .places
        .iter()
        .filter(|((col, row), node)| {
            let [u, v] = map.pitch(f64::from(*col), f64::from(*row));
            (map.pixel(f64::from(*col), f64::from(*row)) - nodes[**node].center).norm()
                > INLIER * u.norm().min(v.norm())
        })
        .map(|(place, _)| *place)
        .collect();
    for place in out {
        component.places.remove(&place);
    }
}

/// Joins components that stand in one lattice: what a broken link or missing modules (equation 3) tore apart.
fn join(
    grown: &mut Vec<Component>,
    nodes: &[Node],
    detections: &ImageDetections,
    grey: Option<&GrayImage>,
    options: &LayoutOptions,
) {
    grown.sort_by_key(|component| std::cmp::Reverse(component.places.len()));
    let mut sides: Vec<[Vector2<f64>; 2]> = grown.iter().map(|component| component.sides(nodes)).collect();
    let mut index = 0;
    while index < grown.len() {
        if grown[index].places.len() < 2 {
            break;
        }
        let mut map = grown[index].map(nodes);
        let mut other = index + 1;
        while other < grown.len() {
            let (base, part) = ((&grown[index], sides[index]), (&grown[other], sides[other]));
            let joined = attachment(base, &map, part, nodes, options).filter(|join| {
                join.missing == 0 || bridge_is_sound(join, &grown[index], &map, grey, detections, nodes)
            });
            let Some(attach) = joined else {
                other += 1;
                continue;
            };
            let part = grown.remove(other);
            sides.remove(other);
            let base = &mut grown[index];
            for ((col, row), node) in &part.places {
                let (u, v) = turned(*col, *row, attach.turn);
                base.places.insert((u + attach.shift.0, v + attach.shift.1), *node);
                base.turns.insert(*node, (part.turns[node] + attach.turn) % 4);
            }
            if attach.missing > 0 {
                base.bridges.push(attach.bridge);
            }
            map = base.map(nodes);
            sides[index] = base.sides(nodes);
            // What failed before may fit the longer lattice.
            other = index + 1;
        }
        index += 1;
    }
}

/// Lattice coordinates in a frame turned by quarter turns.
fn turned(col: i32, row: i32, turn: usize) -> (i32, i32) {
    // A node's direction d is the component's direction d - turn, so a part turned by `turn` steps its own +u along
    // direction `4 - turn` of the base.
    match (4 - turn) % 4 {
        0 => (col, row),
        1 => (-row, col),
        2 => (-col, -row),
        _ => (row, -col),
    }
}

struct Attachment {
    shift: (i32, i32),
    turn: usize,
    /// Columns without any detection between the two.
    missing: i32,
    /// Column of the base after which they are missing.
    bridge: i32,
}

/// How `part` stands in the lattice of `base`, if it does; each with its module's sides.
fn attachment(
    (base, base_sides): (&Component, [Vector2<f64>; 2]),
    map: &LatticeMap,
    (part, part_sides): (&Component, [Vector2<f64>; 2]),
    nodes: &[Node],
    options: &LayoutOptions,
) -> Option<Attachment> {
    let directions = [part_sides[0], part_sides[1], -part_sides[0], -part_sides[1]];
    let turn = (0..4).max_by(|&s, &t| {
        let cosine = |k: usize| base_sides[0].dot(&directions[k]) / directions[k].norm();
        cosine(s).total_cmp(&cosine(t))
    })?;
    for (mine, theirs) in [(base_sides[0], directions[turn]), (base_sides[1], directions[(turn + 1) % 4])] {
        if !(0.8..1.25).contains(&(theirs.norm() / mine.norm()))
            || mine.dot(&theirs) < 0.95 * mine.norm() * theirs.norm()
        {
            return None;
        }
    }
    let (col_low, col_high) = base.col_range();
    let (row_low, row_high) = base.row_range();
    let reach = f64::from(options.max_missing + 2);
    // Gaps are as wide as the shorter side tells, however long the modules are along the row.
    let narrow = (base_sides[0].norm().min(base_sides[1].norm()) / base_sides[0].norm()).min(1.0);
    let mut shift = None;
    for ((col, row), node) in &part.places {
        let at = map.coordinate(nodes[*node].center)?;
        let outside = (f64::from(col_low) - at.x).max(at.x - f64::from(col_high)).max(0.0);
        // The lattice is known where it was fitted; beyond it, less and less.
        let tolerance = 0.15 + 0.02 * outside.min(10.0);
        let (u, v) = turned(*col, *row, turn);
        let near = (at.x.round() as i32 - u, at.y.round() as i32 - v);
        if shift.is_none() && outside > reach {
            return None;
        }
        let shift = *shift.get_or_insert(near);
        let place = (u + shift.0, v + shift.1);
        if base.places.contains_key(&place) {
            return None;
        }
        let (off_col, off_row) = (at.x - f64::from(place.0), at.y - f64::from(place.1));
        if outside < reach && (off_col.abs() > tolerance * narrow || off_row.abs() > 0.25) {
            return None;
        }
    }
    let shift = shift?;
    let places: Vec<(i32, i32)> = part
        .places
        .keys()
        .map(|(col, row)| turned(*col, *row, turn))
        .map(|(u, v)| (u + shift.0, v + shift.1))
        .collect();
    let (part_low, part_high) = range(places.iter().map(|place| place.0));
    let (part_row_low, part_row_high) = range(places.iter().map(|place| place.1));
    // A whole row further out than the next one is another bench.
    if part_row_low > row_high + 1 || part_row_high < row_low - 1 {
        return None;
    }
    let rows_shared = part_row_low <= row_high && part_row_high >= row_low;
    let (missing, bridge) = if part_low > col_high {
        (part_low - col_high - 1, col_high)
    } else if part_high < col_low {
        (col_low - part_high - 1, part_high)
    } else {
        (0, 0)
    };
    if missing > options.max_missing || (missing > 0 && !rows_shared) {
        return None;
    }
    // Beside each other and not linked: only the same columns say that they are rows of one bench.
    if !rows_shared && (part_low < col_low - 1 || part_high > col_high + 1) {
        return None;
    }
    // What stands a gap apart is another bench, whatever the lattice as a whole allows.
    let placed: BTreeMap<(i32, i32), usize> = places.into_iter().zip(part.places.values().copied()).collect();
    let shorter = base_sides[0].norm().min(base_sides[1].norm());
    for (axis, ends) in [
        (0, facing_ends((col_low, col_high), (part_low, part_high))),
        (1, facing_ends((row_low, row_high), (part_row_low, part_row_high))),
    ] {
        // The pitch in between is neither of both where tables lean away from each other.
        let leaning = (1.0 + directions[(turn + axis) % 4].norm() / base_sides[axis].norm()) / 2.0;
        let excess = ends.and_then(|ends| excess(base, &placed, map, nodes, (axis, leaning), ends));
        if excess
            .is_some_and(|excess| excess.abs() > SURE_GAP * options.gap_threshold * shorter / base_sides[axis].norm())
        {
            return None;
        }
    }
    Some(Attachment { shift, turn, missing, bridge })
}

/// The ends at which two ranges face each other, that of the first one first; `None` where they overlap.
fn facing_ends(base: (i32, i32), part: (i32, i32)) -> Option<(i32, i32)> {
    if part.0 > base.1 {
        Some((base.1, part.0))
    } else if part.1 < base.0 {
        Some((base.0, part.1))
    } else {
        None
    }
}

/// By how much more than whole columns (axis 0) or rows (axis 1) the modules at facing ends stand apart, in pitches there:
/// the median over the last two of both sides. The pitch in between is that of the base times `leaning`. `None` where few
/// pairs face each other, for one alone errs by as much as a narrow gap.
fn excess(
    base: &Component,
    placed: &BTreeMap<(i32, i32), usize>,
    map: &LatticeMap,
    nodes: &[Node],
    (axis, leaning): (usize, f64),
    (end, start): (i32, i32),
) -> Option<f64> {
    let outwards = (start - end).signum();
    let mut found: Vec<f64> = Vec::new();
    let mut facing = BTreeSet::new();
    for (place, node) in placed {
        let (at, aside) = if axis == 0 { *place } else { (place.1, place.0) };
        if (at - start) * outwards > 1 {
            continue;
        }
        for inwards in 0..2 {
            let own = end - outwards * inwards;
            let key = if axis == 0 { (own, aside) } else { (aside, own) };
            let Some(other) = base.places.get(&key) else { continue };
            let pitch = map.pitch(f64::from(key.0), f64::from(key.1))[axis] * leaning;
            let apart = (nodes[*node].center - nodes[*other].center).dot(&pitch) / pitch.norm_squared();
            found.push((apart - f64::from(at - own)) * f64::from(outwards));
            facing.insert(aside);
        }
    }
    // Rows are few, and those of one bench in line; columns are many.
    let least = if axis == 0 { 2 } else { MANY_CROSSINGS };
    (facing.len() >= least).then(|| median(&mut found))
}

/// Whether missing columns are missed modules rather than a gap that happens to be a whole number of modules wide. With
/// an image, the place must look like a module or be washed out by glare; without one, a single row may miss one or two.
fn bridge_is_sound(
    attach: &Attachment,
    base: &Component,
    map: &LatticeMap,
    grey: Option<&GrayImage>,
    detections: &ImageDetections,
    nodes: &[Node],
) -> bool {
    let (row_low, row_high) = base.row_range();
    let Some(grey) = grey else {
        return row_low == row_high && attach.missing <= 2;
    };
    let [u, v] = base.sides(nodes);
    let examples: Vec<Quad> = base.places.values().take(40).map(|node| detections.detections[*node].quad).collect();
    let places: Vec<Quad> = (1..=attach.missing)
        .flat_map(|k| (row_low..=row_high).map(move |row| (attach.bridge + k, row)))
        .map(|(col, row)| Quad::from_center(map.pixel(f64::from(col), f64::from(row)), u / 2.0, v / 2.0))
        .collect();
    transition::looks_like_modules(grey, &places, &examples)
}

/// Turns every component so that its columns run along the row: a long one by its own shape, a short one as the long ones
/// about it and its shape say together. Columns then count to the right, rows downwards on the screen.
fn orient(grown: &mut [Component], nodes: &[Node]) {
    let extent = |component: &Component| {
        let (cols, rows) = (component.col_range(), component.row_range());
        (cols.1 - cols.0 + 1, rows.1 - rows.0 + 1)
    };
    let center = |component: &Component| {
        component.places.values().map(|node| nodes[*node].center).sum::<Vector2<f64>>() / component.places.len() as f64
    };
    // (centre, unit vector along the row, weight) of those whose shape tells.
    let long: Vec<(Vector2<f64>, Vector2<f64>, f64)> = grown
        .iter()
        .filter_map(|component| {
            let (cols, rows) = extent(component);
            let [u, v] = component.sides(nodes);
            let weight = component.places.len() as f64;
            if f64::from(cols) >= 2.0 * f64::from(rows) && cols >= 4 {
                Some((center(component), u.normalize(), weight))
            } else if f64::from(rows) >= 2.0 * f64::from(cols) && rows >= 4 {
                Some((center(component), v.normalize(), weight))
            } else {
                None
            }
        })
        .collect();
    for component in grown.iter_mut() {
        let (cols, rows) = extent(component);
        let [u, v] = component.sides(nodes);
        let here = center(component);
        let clear = cols.max(rows) >= 2 * cols.min(rows) && cols.max(rows) >= 4;
        let along_u = if clear && cols.max(rows) >= LONG {
            cols >= rows
        } else {
            let size = u.norm().max(v.norm());
            // The frame may cut a bench down to its last columns: then its neighbours know better than its own shape,
            // which is among them and halved here.
            let own = match (clear, cols >= rows) {
                (false, _) => 0.0,
                (true, true) => 1.0,
                (true, false) => -1.0,
            };
            let own = -0.5 * own * component.places.len() as f64 / 25.0;
            let vote: f64 = long
                .iter()
                .map(|(at, along, weight)| {
                    let distance = (at - here).norm() / size;
                    let agreement = u.normalize().dot(along).abs() - v.normalize().dot(along).abs();
                    agreement * weight / (25.0 + distance * distance)
                })
                .sum::<f64>()
                + own;
            if vote.abs() > 1e-6 { vote > 0.0 } else { cols >= rows }
        };
        let along = if along_u { u } else { v };
        let forward = if along.x.abs() > 0.2 * along.y.abs() { along.x > 0.0 } else { along.y > 0.0 };
        let turn = match (along_u, forward) {
            (true, true) => 0,
            (true, false) => 2,
            (false, true) => 1,
            (false, false) => 3,
        };
        if turn != 0 {
            let places = std::mem::take(&mut component.places);
            component.places = places
                .into_iter()
                .map(|((col, row), node)| {
                    let place = match turn {
                        1 => (row, -col),
                        2 => (-col, -row),
                        _ => (-row, col),
                    };
                    (place, node)
                })
                .collect();
            for node_turn in component.turns.values_mut() {
                *node_turn = (*node_turn + turn) % 4;
            }
            component.bridges.clear();
        }
        // Columns without any detection are bridges, whatever joined them.
        let (low, high) = component.col_range();
        component.bridges = (low..high)
            .filter(|col| {
                component.places.keys().any(|place| place.0 == *col)
                    && !component.places.keys().any(|place| place.0 == *col + 1)
            })
            .collect();
    }
}

/// The finished piece: coordinates from 0, hypotheses in the holes, and what bounds it.
fn piece(component: &Component, nodes: &[Node], detections: &ImageDetections) -> Piece {
    let (col_low, col_high) = component.col_range();
    let (row_low, row_high) = component.row_range();
    let (cols, rows) = (col_high - col_low + 1, row_high - row_low + 1);
    let mut normalised = Component { places: BTreeMap::new(), turns: component.turns.clone(), bridges: Vec::new() };
    for ((col, row), node) in &component.places {
        normalised.places.insert((col - col_low, row - row_low), *node);
    }
    let map = normalised.map(nodes);
    let [u, v] = normalised.sides(nodes);
    let middle = map.pitch(f64::from(cols - 1) / 2.0, f64::from(rows - 1) / 2.0);
    let (fill_u, fill_v) = ((u.norm() / middle[0].norm()).min(1.0), (v.norm() / middle[1].norm()).min(1.0));
    let quad_at = |col: i32, row: i32| {
        let (c, r) = (f64::from(col), f64::from(row));
        let [du, dv] = map.pitch(c, r);
        Quad::from_center(map.pixel(c, r), du * fill_u / 2.0, dv * fill_v / 2.0)
    };
    let margin = (0.15 * u.norm().min(v.norm())).max(4.0);
    let (width, height) = (f64::from(detections.width_px), f64::from(detections.height_px));
    let inside = |quad: &Quad| {
        quad.corners
            .iter()
            .all(|c| c.x > margin && c.y > margin && c.x < width - 1.0 - margin && c.y < height - 1.0 - margin)
    };
    let mut cells = Vec::new();
    for row in 0..rows {
        for col in 0..cols {
            if let Some(node) = normalised.places.get(&(col, row)) {
                cells.push(Cell { row, col, quad: detections.detections[*node].quad, detection: Some(*node) });
            } else {
                let quad = quad_at(col, row);
                if inside(&quad) {
                    cells.push(Cell { row, col, quad, detection: None });
                }
            }
        }
    }
    // A side is closed if, past most of the modules that stand there, one more would be seen.
    let side = |modules: Vec<(i32, i32)>, step: (i32, i32)| {
        let seen = modules.iter().filter(|(col, row)| inside(&quad_at(col + step.0, row + step.1))).count();
        if 2 * seen > modules.len() { End::Closed } else { End::Cut }
    };
    let west = side((0..rows).map(|row| (0, row)).collect(), (-1, 0));
    let east = side((0..rows).map(|row| (cols - 1, row)).collect(), (1, 0));
    let north = side((0..cols).map(|col| (col, 0)).collect(), (0, -1));
    let south = side((0..cols).map(|col| (col, rows - 1)).collect(), (0, 1));
    let bridges = component.bridges.iter().map(|col| col - col_low).collect();
    Piece { rows, cols, cells, map, west, east, north, south, bridges }
}
