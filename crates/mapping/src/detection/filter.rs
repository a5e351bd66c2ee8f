//! What no module can be is dropped (paper, 3.2): boxes cut by the frame, boxes over better ones, boxes of a size unlike
//! the others', and weak boxes that stand alone.

use super::mask_to_boxes::{ModuleBox, middle};
use super::neighbours::Grid;
use super::probability::ProbabilityMap;
use nalgebra::{Matrix2, Matrix3, Vector2, Vector3};

/// Least mean `module` inside a box.
const MODULE: f64 = 0.5;
/// Range of areas, in parts of the representative box's.
pub(super) const SIZE: (f64, f64) = (0.45, 2.0);
/// The largest share of the smaller of two boxes that may overlap (paper: 20 %).
pub(super) const OVERLAP: f64 = 0.2;
/// Score from which a box needs no neighbour.
const ALONE: f32 = 0.9;
/// The most boxes of a group that may be dropped, and by how much its median score falls short of the image's.
const SMALL: usize = 8;
const WEAKER: f64 = 0.2;
/// Tolerance of a neighbour's place, in modules.
const LATTICE: f64 = 0.2;
/// Difference of the logarithm of a box's area to the usual there, from which it is odd.
const ODD: f64 = 0.25;
/// Difference of the logarithms of areas, up to which boxes are alike.
const ALIKE: f64 = 0.25;
/// Odd boxes in a group of more than this many are modules of another size.
const FEW: usize = 4;
/// Pitch of neighbours, in modules.
const PITCH: f64 = 1.02;

/// The boxes that may be modules, the best first. `module` is the probability of a module's face, on the raster in whose
/// pixels the boxes are.
pub fn plausible(boxes: Vec<ModuleBox>, module: &ProbabilityMap) -> Vec<ModuleBox> {
    let representative = middle(boxes.iter().map(ModuleBox::area_px2));
    let sized = boxes
        .into_iter()
        .filter(|b| (SIZE.0 * representative..SIZE.1 * representative).contains(&b.area_px2()))
        .filter(|b| inside_mean(module, b) > MODULE)
        .collect();
    without_overlaps(mend_odd_ones(sized))
}

/// Without the weak boxes that stand alone, for a good one needs no neighbour, and without small groups far weaker than what
/// the image shows elsewhere: light through the seams of shadows, planks, bushes in a row.
pub fn supported(boxes: Vec<ModuleBox>) -> Vec<ModuleBox> {
    let neighbours = lattice_neighbours(&boxes);
    let usual = middle(boxes.iter().map(|b| f64::from(b.score)));
    let mut is_kept: Vec<bool> =
        boxes.iter().zip(&neighbours).map(|(b, near)| !near.is_empty() || b.score > ALONE).collect();
    for group in groups(&neighbours) {
        let score = middle(group.iter().map(|&index| f64::from(boxes[index].score)));
        if group.len() <= SMALL && score < usual - WEAKER {
            group.into_iter().for_each(|index| is_kept[index] = false);
        }
    }
    boxes.into_iter().zip(is_kept).filter(|(_, kept)| *kept).map(|(b, _)| b).collect()
}

/// Boxes that reach each other from neighbour to neighbour.
fn groups(neighbours: &[Vec<usize>]) -> Vec<Vec<usize>> {
    let mut linked: Vec<Vec<usize>> = neighbours.to_vec();
    for (index, near) in neighbours.iter().enumerate() {
        near.iter().for_each(|&other| linked[other].push(index));
    }
    let mut is_seen = vec![false; neighbours.len()];
    let mut found = Vec::new();
    for start in 0..neighbours.len() {
        if std::mem::replace(&mut is_seen[start], true) {
            continue;
        }
        let mut group = vec![start];
        let mut next = 0;
        while next < group.len() {
            for &other in &linked[group[next]] {
                if !std::mem::replace(&mut is_seen[other], true) {
                    group.push(other);
                }
            }
            next += 1;
        }
        found.push(group);
    }
    found
}

/// An odd box that stands in the lattice of others takes their shape; one that does not is dropped.
fn mend_odd_ones(mut boxes: Vec<ModuleBox>) -> Vec<ModuleBox> {
    let neighbours = lattice_neighbours(&boxes);
    let odd = odd_ones(&boxes, &neighbours);
    let mut shapes: Vec<Vec<ModuleBox>> = vec![Vec::new(); boxes.len()];
    for (index, near) in neighbours.iter().enumerate().filter(|(index, _)| !odd[*index]) {
        for &other in near.iter().filter(|other| odd[**other]) {
            shapes[other].push(boxes[index]);
        }
    }
    for (b, shapes) in boxes.iter_mut().zip(&shapes) {
        let Some(first) = shapes.first() else { continue };
        // Opposite edge vectors mean the same.
        let along = |a: Vector2<f64>, b: Vector2<f64>| if a.dot(&b) < 0.0 { -a } else { a };
        b.u = shapes.iter().map(|shape| along(shape.u, first.u)).sum::<Vector2<f64>>() / shapes.len() as f64;
        b.v = shapes.iter().map(|shape| along(shape.v, first.v)).sum::<Vector2<f64>>() / shapes.len() as f64;
    }
    boxes
        .into_iter()
        .zip(odd)
        .zip(shapes)
        .filter(|((_, odd), shapes)| !odd || !shapes.is_empty())
        .map(|((b, _), _)| b)
        .collect()
}

/// Which boxes are unlike the size that modules have there, and in no group of their like. The size may change over the
/// image, as it does in perspective, and a plant may have modules of several sizes: these stand in benches.
fn odd_ones(boxes: &[ModuleBox], neighbours: &[Vec<usize>]) -> Vec<bool> {
    let sizes: Vec<f64> = boxes.iter().map(|b| b.area_px2().ln()).collect();
    let expected = plane_through(&boxes.iter().map(|b| b.center).collect::<Vec<_>>(), &sizes);
    let alike = |a: usize, b: usize| (sizes[a] - sizes[b]).abs() < ALIKE;
    (0..boxes.len())
        .map(|index| {
            if (sizes[index] - expected[index]).abs() < ODD {
                return false;
            }
            // The group of those alike, as far as it takes to know that it is large.
            let mut group = vec![index];
            let mut next = 0;
            while next < group.len() && group.len() <= FEW {
                let member = group[next];
                for &other in &neighbours[member] {
                    if alike(member, other) && neighbours[other].contains(&member) && !group.contains(&other) {
                        group.push(other);
                    }
                }
                next += 1;
            }
            group.len() <= FEW
        })
        .collect()
}

/// The values at the points of the plane that most of `values` lie close to (least squares, with weights that fall beyond
/// a tenth).
fn plane_through(points: &[Vector2<f64>], values: &[f64]) -> Vec<f64> {
    let mean = points.iter().sum::<Vector2<f64>>() / points.len().max(1) as f64;
    let spread = points.iter().map(|p| (p - mean).norm()).fold(1.0, f64::max);
    let rows: Vec<Vector3<f64>> = points
        .iter()
        .map(|p| {
            let at = (p - mean) / spread;
            Vector3::new(1.0, at.x, at.y)
        })
        .collect();
    let mut sorted = values.to_vec();
    sorted.sort_unstable_by(f64::total_cmp);
    let mut plane = Vector3::new(sorted.get(sorted.len() / 2).copied().unwrap_or(0.0), 0.0, 0.0);
    // Few points tell no slope.
    for _ in 0..if points.len() < 12 { 0 } else { 15 } {
        // Held down a little, lest it tilts towards a stray box far away.
        let held = 0.05 * points.len() as f64;
        let mut matrix = Matrix3::from_diagonal(&Vector3::new(1e-6, held, held));
        let mut right = Vector3::zeros();
        for (row, value) in rows.iter().zip(values) {
            let weight = 1.0 / (1.0 + ((value - row.dot(&plane)) / 0.1).powi(2));
            matrix += row * row.transpose() * weight;
            right += row * (weight * value);
        }
        let Some(solution) = matrix.cholesky().map(|factors| factors.solve(&right)) else { break };
        plane = solution;
    }
    rows.iter().map(|row| row.dot(&plane)).collect()
}

/// Mean probability on a grid of 5 x 5 points over the inner 70 % of the box; nought where all lie outside.
pub(super) fn inside_mean(module: &ProbabilityMap, b: &ModuleBox) -> f64 {
    let (mut sum, mut count) = (0.0, 0);
    for i in -2..=2 {
        for j in -2..=2 {
            let at = b.center + (b.u * f64::from(i) + b.v * f64::from(j)) * 0.175;
            let (x, y) = (at.x.round(), at.y.round());
            if x >= 0.0 && y >= 0.0 && x < module.width() as f64 && y < module.height() as f64 {
                sum += f64::from(module.get(x as usize, y as usize));
                count += 1;
            }
        }
    }
    if count > 0 { sum / f64::from(count) } else { 0.0 }
}

/// The best box of each place: one that overlaps a better one by more than [`OVERLAP`] of the smaller of both is dropped.
pub fn without_overlaps(mut boxes: Vec<ModuleBox>) -> Vec<ModuleBox> {
    boxes.sort_by(|a, b| b.score.total_cmp(&a.score));
    let longest = boxes.iter().map(|b| b.u.norm()).fold(0.0, f64::max);
    let grid = Grid::new(boxes.iter().map(|b| b.center).collect(), longest);
    let mut kept = vec![false; boxes.len()];
    for (index, b) in boxes.iter().enumerate() {
        let quad = b.quad();
        kept[index] = grid.within(b.center, longest).filter(|&(other, _)| kept[other]).all(|(other, distance2)| {
            let better = &boxes[other];
            distance2.sqrt() >= (b.u.norm() + better.u.norm()) / 2.0
                || quad.overlap_px2(&better.quad()) < OVERLAP * b.area_px2().min(better.area_px2())
        });
    }
    boxes.into_iter().zip(kept).filter(|(_, kept)| *kept).map(|(b, _)| b).collect()
}

/// The boxes that stand where the lattice of modules has the four neighbours of each box.
pub(super) fn lattice_neighbours(boxes: &[ModuleBox]) -> Vec<Vec<usize>> {
    let longest = boxes.iter().map(|b| b.u.norm()).fold(0.0, f64::max);
    let grid = Grid::new(boxes.iter().map(|b| b.center).collect(), longest);
    boxes
        .iter()
        .map(|b| {
            let Some(modules_from_px) = Matrix2::from_columns(&[b.u, b.v]).try_inverse() else { return Vec::new() };
            [b.u, -b.u, b.v, -b.v]
                .into_iter()
                .flat_map(|step| {
                    let place = b.center + step * PITCH;
                    grid.within(place, LATTICE * (b.u.norm() + b.v.norm()))
                        .map(|(other, _)| other)
                        .filter(move |&other| (modules_from_px * (boxes[other].center - place)).amax() < LATTICE)
                })
                .collect()
        })
        .collect()
}

/// Whether every corner lies inside a frame of `width` x `height` pixels: a module that the frame cuts is incomplete.
pub fn is_inside_frame(corners: &[Vector2<f64>; 4], width: u32, height: u32) -> bool {
    corners
        .iter()
        .all(|c| (-0.5..=f64::from(width) - 0.5).contains(&c.x) && (-0.5..=f64::from(height) - 0.5).contains(&c.y))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::detection::Source;

    fn upright(x: f64, y: f64, score: f32) -> ModuleBox {
        ModuleBox {
            center: Vector2::new(x, y),
            u: Vector2::new(20.0, 0.0),
            v: Vector2::new(0.0, 10.0),
            score,
            source: Source::Unet,
        }
    }

    #[test]
    fn of_two_boxes_that_overlap_the_better_stays() {
        let kept = without_overlaps(vec![upright(0.0, 0.0, 0.8), upright(10.0, 0.0, 0.9), upright(27.0, 0.0, 0.7)]);
        let places: Vec<f64> = kept.iter().map(|b| b.center.x).collect();
        assert_eq!(places, [10.0, 27.0]);
    }

    #[test]
    fn a_weak_box_needs_a_neighbour_in_the_lattice() {
        let module = ProbabilityMap::from_fn(200, 100, |_, _| 1.0);
        let boxes = vec![
            upright(20.0, 20.0, 0.6),
            upright(40.4, 20.0, 0.6),
            // Beside the lattice.
            upright(48.0, 50.0, 0.6),
            upright(120.0, 50.0, 0.95),
        ];
        let mut places: Vec<f64> = supported(plausible(boxes, &module)).iter().map(|b| b.center.x).collect();
        places.sort_by(f64::total_cmp);
        assert_eq!(places, [20.0, 40.4, 120.0]);
    }

    /// A bench of 6 x 3 boxes with edges of `width` and `height` pixels.
    fn bench(x: f64, y: f64, width: f64, height: f64) -> Vec<ModuleBox> {
        (0..18)
            .map(|i| ModuleBox {
                center: Vector2::new(x + 1.02 * width * f64::from(i % 6), y + 1.02 * height * f64::from(i / 6)),
                u: Vector2::new(width, 0.0),
                v: Vector2::new(0.0, height),
                score: 0.95,
                source: Source::Unet,
            })
            .collect()
    }

    fn full() -> ProbabilityMap {
        ProbabilityMap::from_fn(600, 400, |_, _| 1.0)
    }

    #[test]
    fn modules_of_two_sizes_in_perspective_all_stay() {
        let mut boxes = bench(30.0, 30.0, 20.0, 12.0);
        boxes.extend(bench(30.0, 330.0, 27.0, 17.0));
        boxes.extend(bench(300.0, 200.0, 12.0, 30.0));
        let count = boxes.len();
        assert_eq!(plausible(boxes, &full()).len(), count);
    }

    #[test]
    fn an_odd_box_takes_the_shape_of_its_neighbours_or_goes() {
        let mut boxes = bench(30.0, 30.0, 20.0, 12.0);
        let place = boxes[7].center;
        boxes[7].u *= 0.75;
        boxes[7].u.y = 3.0;
        boxes.push(ModuleBox { center: Vector2::new(400.0, 300.0), u: Vector2::new(30.0, 0.0), ..boxes[0] });
        let kept = plausible(boxes, &full());
        assert_eq!(kept.len(), 18);
        let mended = kept.iter().find(|b| b.center == place).unwrap();
        assert!((mended.u - Vector2::new(20.0, 0.0)).norm() < 1e-9);
    }

    #[test]
    fn the_frame_cuts_what_reaches_out_of_it() {
        let inside = |x: f64, y: f64| is_inside_frame(&upright(x, y, 1.0).quad().corners, 100, 50);
        assert!(inside(9.5, 4.5));
        assert!(!inside(9.4, 4.5));
        assert!(inside(89.5, 44.5));
        assert!(!inside(89.5, 44.6));
    }

    #[test]
    fn a_small_group_far_weaker_than_the_rest_is_dropped() {
        let at = |x: f64, y: f64, score: f32| ModuleBox {
            center: Vector2::new(x, y),
            u: Vector2::new(0.0, 32.0),
            v: Vector2::new(20.0, 0.0),
            score,
            source: Source::Unet,
        };
        let bench: Vec<ModuleBox> = (0..12).map(|k| at(50.0 + 20.6 * f64::from(k), 50.0, 0.98)).collect();
        let group = |score: f32| (0..4).map(move |k| at(60.0 + 20.6 * f64::from(k), 400.0, score));
        let count = |score: f32| supported(bench.iter().copied().chain(group(score)).collect()).len();
        assert_eq!(count(0.65), 12);
        assert_eq!(count(0.9), 16);
        // In a photo that is hard throughout, weak boxes are all there is.
        assert_eq!(supported(group(0.65).collect()).len(), 4);
    }
}
