//! What no module can be is dropped (paper, 3.2): boxes cut by the frame, boxes over better ones, boxes of a size unlike
//! the others', and weak boxes that stand alone.

use super::mask_to_boxes::{ModuleBox, middle};
use super::neighbours::Grid;
use super::probability::ProbabilityMap;
use nalgebra::{Matrix2, Vector2};

/// Least mean `module` inside a box.
const MODULE: f64 = 0.5;
/// Range of areas, in parts of the representative box's.
const SIZE: (f64, f64) = (0.45, 2.0);
/// The largest share of the smaller of two boxes that may overlap (paper: 20 %).
const OVERLAP: f64 = 0.2;
/// Score from which a box needs no neighbour.
const ALONE: f32 = 0.9;
/// Tolerance of a neighbour's place, in modules.
const LATTICE: f64 = 0.2;
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
    let apart = without_overlaps(sized);
    let neighbours = lattice_neighbours(&apart);
    apart.into_iter().zip(neighbours).filter(|(b, count)| *count > 0 || b.score > ALONE).map(|(b, _)| b).collect()
}

/// Mean probability on a grid of 5 x 5 points over the inner 70 % of the box; nought where all lie outside.
fn inside_mean(module: &ProbabilityMap, b: &ModuleBox) -> f64 {
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

/// How many of its four neighbours in the lattice of modules each box has.
fn lattice_neighbours(boxes: &[ModuleBox]) -> Vec<usize> {
    let longest = boxes.iter().map(|b| b.u.norm()).fold(0.0, f64::max);
    let grid = Grid::new(boxes.iter().map(|b| b.center).collect(), longest);
    boxes
        .iter()
        .map(|b| {
            let Some(modules_from_px) = Matrix2::from_columns(&[b.u, b.v]).try_inverse() else { return 0 };
            [b.u, -b.u, b.v, -b.v]
                .into_iter()
                .filter(|step| {
                    let place = b.center + step * PITCH;
                    grid.within(place, LATTICE * (b.u.norm() + b.v.norm()))
                        .any(|(other, _)| (modules_from_px * (boxes[other].center - place)).amax() < LATTICE)
                })
                .count()
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

    fn upright(x: f64, y: f64, score: f32) -> ModuleBox {
        ModuleBox { center: Vector2::new(x, y), u: Vector2::new(20.0, 0.0), v: Vector2::new(0.0, 10.0), score }
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
        let mut places: Vec<f64> = plausible(boxes, &module).iter().map(|b| b.center.x).collect();
        places.sort_by(f64::total_cmp);
        assert_eq!(places, [20.0, 40.4, 120.0]);
    }

    #[test]
    fn the_frame_cuts_what_reaches_out_of_it() {
        let inside = |x: f64, y: f64| is_inside_frame(&upright(x, y, 1.0).quad().corners, 100, 50);
        assert!(inside(9.5, 4.5));
        assert!(!inside(9.4, 4.5));
        assert!(inside(89.5, 44.5));
        assert!(!inside(89.5, 44.6));
    }
}
