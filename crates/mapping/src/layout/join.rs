//! Parts that stand in one lattice become one: what a broken link or missing modules (paper, equation 3) tore apart.

use super::grow::{Component, Node, median, range};
use super::lattice::LatticeMap;
use super::{LayoutOptions, LayoutParams, transition};
use crate::detection::ImageDetections;
use crate::geometry::Quad;
use image::GrayImage;
use nalgebra::Vector2;
use std::collections::{BTreeMap, BTreeSet};

/// Joins components that stand in one lattice: what a broken link or missing modules (equation 3) tore apart.
pub(super) fn join(
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
                join.missing == 0
                    || bridge_is_sound(join, (&grown[index], &map), grey, detections, nodes, &options.params)
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

/// Quarter turns between two lattices, given the sides of the modules of the one and the four directions of the other's; `None`
/// where their modules differ.
fn turn_between(base_sides: [Vector2<f64>; 2], directions: [Vector2<f64>; 4], params: &LayoutParams) -> Option<usize> {
    let turn = (0..4).max_by(|&s, &t| {
        let cosine = |k: usize| base_sides[0].dot(&directions[k]) / directions[k].norm();
        cosine(s).total_cmp(&cosine(t))
    })?;
    for (mine, theirs) in [(base_sides[0], directions[turn]), (base_sides[1], directions[(turn + 1) % 4])] {
        let [low, high] = params.part_ratio;
        if !(low..high).contains(&(theirs.norm() / mine.norm()))
            || mine.dot(&theirs) < params.part_cosine * mine.norm() * theirs.norm()
        {
            return None;
        }
    }
    Some(turn)
}

/// How `part` stands in the lattice of `base`, if it does; each with its module's sides.
fn attachment(
    (base, base_sides): (&Component, [Vector2<f64>; 2]),
    map: &LatticeMap,
    (part, part_sides): (&Component, [Vector2<f64>; 2]),
    nodes: &[Node],
    options: &LayoutOptions,
) -> Option<Attachment> {
    let params = &options.params;
    let directions = [part_sides[0], part_sides[1], -part_sides[0], -part_sides[1]];
    let turn = turn_between(base_sides, directions, params)?;
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
        let tolerance = params.part_off + params.part_off_per_column * outside.min(10.0);
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
        if outside < reach && (off_col.abs() > tolerance * narrow || off_row.abs() > params.part_off_row) {
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
    let placed: BTreeMap<(i32, i32), usize> = places.into_iter().zip(part.places.values().copied()).collect();
    let ends = [
        facing_ends((col_low, col_high), (part_low, part_high)),
        facing_ends((row_low, row_high), (part_row_low, part_row_high)),
    ];
    let part_sides = [0, 1].map(|axis| directions[(turn + axis) % 4].norm());
    if stands_apart((base, base_sides, map), (&placed, part_sides), nodes, ends, options) {
        return None;
    }
    Some(Attachment { shift, turn, missing, bridge })
}

/// Whether a part stands a gap apart: then it is another bench, whatever the lattice as a whole allows.
fn stands_apart(
    (base, base_sides, map): (&Component, [Vector2<f64>; 2], &LatticeMap),
    (placed, part_sides): (&BTreeMap<(i32, i32), usize>, [f64; 2]),
    nodes: &[Node],
    ends: [Option<(i32, i32)>; 2],
    options: &LayoutOptions,
) -> bool {
    let shorter = base_sides[0].norm().min(base_sides[1].norm());
    ends.into_iter().enumerate().any(|(axis, ends)| {
        // The pitch in between is neither of both where tables lean away from each other.
        let leaning = (1.0 + part_sides[axis] / base_sides[axis].norm()) / 2.0;
        let many = options.params.many_crossings;
        let excess = ends.and_then(|ends| excess(base, placed, map, nodes, (axis, leaning), ends, many));
        let least = options.params.sure_gap * options.gap_threshold * shorter / base_sides[axis].norm();
        excess.is_some_and(|excess| excess.abs() > least)
    })
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
    many_crossings: usize,
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
    let least = if axis == 0 { 2 } else { many_crossings };
    (facing.len() >= least).then(|| median(&mut found))
}

/// Whether missing columns are missed modules rather than a gap that happens to be a whole number of modules wide. With
/// an image, the place must look like a module or be washed out by glare; without one, a single row may miss one or two.
fn bridge_is_sound(
    attach: &Attachment,
    (base, map): (&Component, &LatticeMap),
    grey: Option<&GrayImage>,
    detections: &ImageDetections,
    nodes: &[Node],
    params: &LayoutParams,
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
    transition::looks_like_modules(grey, &places, &examples, params)
}
