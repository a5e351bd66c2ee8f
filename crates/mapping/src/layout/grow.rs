//! Benches grow from module to module: links between neighbours, cuts where a gap lies between them, lattice
//! coordinates along the links, and hypotheses where a module is missing.

use super::cut::cut_gaps;
use super::join::join;
use super::lattice::{LatticeMap, Sample};
use super::{Cell, End, LayoutOptions, LayoutParams, Piece};
use crate::detection::ImageDetections;
use crate::geometry::Quad;
use image::GrayImage;
use nalgebra::Vector2;
use std::collections::{BTreeMap, HashMap, VecDeque};

/// A detection as the growth sees it: its centre, and the side vectors of its box, `b` a quarter turn clockwise from `a`.
#[derive(Clone, Copy)]
pub(super) struct Node {
    pub(super) center: Vector2<f64>,
    pub(super) sides: [Vector2<f64>; 2],
}

impl Node {
    /// Side vector of one of the four directions: a, b, -a, -b.
    pub(super) fn direction(&self, d: usize) -> Vector2<f64> {
        if d % 4 < 2 { self.sides[d % 2] } else { -self.sides[d % 2] }
    }
}

/// A link to a neighbour: which, and by how many quarter turns its own frame is turned against ours.
pub(super) type Link = Option<(usize, usize)>;

/// A connected set of modules with lattice coordinates.
pub(super) struct Component {
    /// (column, row) of each node.
    pub(super) places: BTreeMap<(i32, i32), usize>,
    /// Quarter turns of each node's frame against the component's.
    pub(super) turns: HashMap<usize, usize>,
    pub(super) bridges: Vec<i32>,
}

impl Component {
    pub(super) fn sides(&self, nodes: &[Node]) -> [Vector2<f64>; 2] {
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

    pub(super) fn map(&self, nodes: &[Node]) -> LatticeMap {
        let samples: Vec<Sample> = self
            .places
            .iter()
            .map(|((col, row), node)| Sample { col: f64::from(*col), row: f64::from(*row), pixel: nodes[*node].center })
            .collect();
        let [u, v] = self.sides(nodes);
        LatticeMap::fit(&samples, u * 1.02, v * 1.02)
    }

    /// Turns the lattice by quarter turns.
    fn turn(&mut self, turn: usize) {
        if turn == 0 {
            return;
        }
        let places = std::mem::take(&mut self.places);
        self.places = places
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
        for node_turn in self.turns.values_mut() {
            *node_turn = (*node_turn + turn) % 4;
        }
        self.bridges.clear();
    }

    pub(super) fn col_range(&self) -> (i32, i32) {
        range(self.places.keys().map(|place| place.0))
    }

    pub(super) fn row_range(&self) -> (i32, i32) {
        range(self.places.keys().map(|place| place.1))
    }
}

pub(super) fn range(values: impl Iterator<Item = i32>) -> (i32, i32) {
    values.fold((i32::MAX, i32::MIN), |(low, high), v| (low.min(v), high.max(v)))
}

pub(super) fn median(values: &mut [f64]) -> f64 {
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
    let mut links = find_links(&nodes, &options.params);
    let loose_components = components(&nodes, &links);
    for component in &loose_components {
        cut_gaps(component, &nodes, &mut links, detections, grey, options);
    }
    let mut grown: Vec<Component> = components(&nodes, &links);
    for component in &mut grown {
        drop_outliers(component, &nodes, &options.params);
    }
    // What is joined is judged along the row, so the row must be known first; what was joined may tell more of it.
    orient(&mut grown, &nodes, options.params.long_columns);
    join(&mut grown, &nodes, detections, grey, options);
    grown.retain(|component| component.places.len() >= 2);
    orient(&mut grown, &nodes, options.params.long_columns);
    let mut used = vec![false; nodes.len()];
    let mut pieces: Vec<Piece> = grown
        .iter()
        .map(|component| {
            for node in component.places.values() {
                used[*node] = true;
            }
            piece(component, &nodes, detections, &options.params)
        })
        .collect();
    open_torn_ends(&mut pieces, &options.params);
    let loose = (0..nodes.len()).filter(|node| !used[*node]).collect();
    (pieces, loose)
}

/// Where another piece stands on the lattice of this one, a few whole columns further on, neither is sure to end: modules
/// may be missed between them as well as a gap may happen to be as wide.
fn open_torn_ends(pieces: &mut [Piece], params: &LayoutParams) {
    let near = params.torn_reach;
    let mut open: Vec<(usize, bool)> = Vec::new();
    for (i, base) in pieces.iter().enumerate() {
        let [u, v] = base.map.pitch(f64::from(base.cols - 1) / 2.0, f64::from(base.rows - 1) / 2.0);
        let reach_px = u.norm() * (f64::from(base.cols) / 2.0 + near) + v.norm() * f64::from(base.rows);
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
                    let allowed = (params.torn_off + params.torn_off_per_column * beyond) * u.norm().min(v.norm());
                    (0.5..near).contains(&beyond)
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
fn find_links(nodes: &[Node], params: &LayoutParams) -> Vec<[Link; 4]> {
    let mut longest: Vec<f64> = nodes.iter().map(|node| node.sides[0].norm().max(node.sides[1].norm())).collect();
    if longest.is_empty() {
        return Vec::new();
    }
    let cell_px = (median(&mut longest) * params.neighbour_sides[1]).max(1.0);
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
                        let Some((d, turn, distance)) = neighbour(node, &nodes[j], params) else { continue };
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
fn neighbour(node: &Node, other: &Node, params: &LayoutParams) -> Option<(usize, usize, f64)> {
    let ([low, high], [nearest, furthest]) = (params.neighbour_ratio, params.neighbour_sides);
    let turn = (0..4).max_by(|&s, &t| {
        let cosine = |k: usize| node.sides[0].dot(&other.direction(k)) / other.direction(k).norm();
        cosine(s).total_cmp(&cosine(t))
    })?;
    let (a, b) = ((node.sides[0] + other.direction(turn)) / 2.0, (node.sides[1] + other.direction(turn + 1)) / 2.0);
    for (mine, theirs) in [(node.sides[0], other.direction(turn)), (node.sides[1], other.direction(turn + 1))] {
        let ratio = theirs.norm() / mine.norm();
        if !(low..high).contains(&ratio) || mine.dot(&theirs) < params.neighbour_cosine * mine.norm() * theirs.norm() {
            return None;
        }
    }
    let offset = other.center - node.center;
    let determinant = a.perp(&b);
    if determinant.abs() < 1e-9 {
        return None;
    }
    let (along_a, along_b) = (offset.perp(&b) / determinant, a.perp(&offset) / determinant);
    let near = |main: f64, side: f64| (nearest..furthest).contains(&main.abs()) && side.abs() < params.neighbour_aside;
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

/// Takes out modules that stand off the lattice of their component.
fn drop_outliers(component: &mut Component, nodes: &[Node], params: &LayoutParams) {
    if component.places.len() < params.inlier_least {
        return;
    }
    let map = component.map(nodes);
    let out: Vec<(i32, i32)> = component
        .places
        .iter()
        .filter(|((col, row), node)| {
            let [u, v] = map.pitch(f64::from(*col), f64::from(*row));
            (map.pixel(f64::from(*col), f64::from(*row)) - nodes[**node].center).norm()
                > params.inlier * u.norm().min(v.norm())
        })
        .map(|(place, _)| *place)
        .collect();
    for place in out {
        component.places.remove(&place);
    }
}

/// Turns every component so that its columns run along the row: a long one by its own shape, a short one as the long ones
/// about it and its shape say together. Columns then count to the right, rows downwards on the screen.
fn orient(grown: &mut [Component], nodes: &[Node], long_columns: i32) {
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
        let along_u = if clear && cols.max(rows) >= long_columns {
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
        component.turn(match (along_u, forward) {
            (true, true) => 0,
            (true, false) => 2,
            (false, true) => 1,
            (false, false) => 3,
        });
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
fn piece(component: &Component, nodes: &[Node], detections: &ImageDetections, params: &LayoutParams) -> Piece {
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
    let margin = (params.frame_margin * u.norm().min(v.norm())).max(params.frame_margin_px);
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
