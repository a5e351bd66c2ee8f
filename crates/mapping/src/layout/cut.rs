//! Cuts between neighbouring modules where a gap between benches lies (paper, 3.3, equation 2).

use super::grow::{Component, Link, Node, median};
use super::{LayoutOptions, transition};
use crate::detection::ImageDetections;
use crate::geometry::Quad;
use image::GrayImage;
use nalgebra::Vector2;
use std::collections::BTreeMap;

/// Two linked modules: by how much more than usual they stand apart, in parts of the shorter side.
#[derive(Clone, Copy)]
struct Crossing {
    nodes: (usize, usize),
    by_pitch: f64,
    by_sides: f64,
}

/// Removes the links over bench gaps. The distance of neighbours is compared with a smooth model of the pitch in this
/// component; all rows that cross between the same two columns decide together.
pub(super) fn cut_gaps(
    component: &Component,
    nodes: &[Node],
    links: &mut [[Link; 4]],
    detections: &ImageDetections,
    grey: Option<&GrayImage>,
    options: &LayoutOptions,
) {
    let crossings = [0, 1].map(|axis| crossings(component, nodes, links, axis));
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
            if group.len() >= options.params.many_crossings {
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
                gap = transition::is_gap(grey, &here, &usual, &options.params);
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

/// All links along an axis, by transition and position across it: the two modules, and by how much they stand too far apart by the
/// pitch of the component and by their own sides.
fn crossings(
    component: &Component,
    nodes: &[Node],
    links: &[[Link; 4]],
    axis: usize,
) -> BTreeMap<(i32, i32), Crossing> {
    let sides = component.sides(nodes);
    let scale = sides[0].norm().min(sides[1].norm());
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
