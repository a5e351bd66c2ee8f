//! Both networks' boxes as one (paper, 3.2): the U-Net's are the foundation, because they are the more precise; YOLO's
//! complement them, filtered by the dimensions of the representative box and by their distance to the U-Net's: apart from
//! these, but where their lattice goes on, within a few modules.

use super::filter::{OVERLAP, SIZE, lattice_neighbours};
use super::mask_to_boxes::{ModuleBox, middle};
use super::neighbours::Grid;

/// Least distance of a complement's centre to each box of the foundation, in short sides of that box.
const APART: f64 = 0.6;

/// How many modules beyond the foundation's boxes its lattice may be continued.
const CONTINUED: usize = 3;

/// The boxes of the foundation, and those of the complement that find something else and of which the foundation's network
/// `shows` at least a trace. Complements take the shape of the neighbour whose lattice they continue. Where the foundation
/// has no box, the complement's own representative box sets the size.
pub fn merge(
    foundation: Vec<ModuleBox>,
    complement: Vec<ModuleBox>,
    shows: impl Fn(&ModuleBox) -> bool,
) -> Vec<ModuleBox> {
    let found_alone = foundation.is_empty();
    let measure = if found_alone { &complement } else { &foundation };
    let representative = middle(measure.iter().map(ModuleBox::area_px2));
    let longest = foundation.iter().chain(&complement).map(|b| b.u.norm()).fold(0.0, f64::max);
    let grid = Grid::new(foundation.iter().map(|b| b.center).collect(), longest);
    let is_new = |b: &ModuleBox| {
        let quad = b.quad();
        (SIZE.0 * representative..SIZE.1 * representative).contains(&b.area_px2())
            && grid.within(b.center, longest).all(|(index, distance2)| {
                let other = &foundation[index];
                distance2.sqrt() > APART * other.v.norm()
                    && quad.overlap_px2(&other.quad()) < OVERLAP * b.area_px2().min(other.area_px2())
            })
    };
    let added: Vec<ModuleBox> = complement.into_iter().filter(|b| is_new(b) && shows(b)).collect();
    let count = foundation.len();
    let mut all: Vec<ModuleBox> = foundation.into_iter().chain(added).collect();
    if found_alone {
        return all;
    }
    let neighbours = lattice_neighbours(&all);
    let mut is_kept: Vec<bool> = (0..all.len()).map(|index| index < count).collect();
    for _ in 0..CONTINUED {
        let reached: Vec<(usize, usize)> = (count..all.len())
            .filter(|&index| !is_kept[index])
            .filter_map(|index| Some((index, neighbours[index].iter().copied().find(|&other| is_kept[other])?)))
            .collect();
        for (index, like) in reached {
            is_kept[index] = true;
            all[index] = ModuleBox { u: all[like].u, v: all[like].v, ..all[index] };
        }
    }
    all.into_iter().zip(is_kept).filter(|(_, kept)| *kept).map(|(b, _)| b).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::detection::Source;
    use nalgebra::Vector2;

    fn at(x: f64, scale: f64, source: Source) -> ModuleBox {
        let (u, v) = (Vector2::new(20.0 * scale, 0.0), Vector2::new(0.0, 12.0 * scale));
        ModuleBox { center: Vector2::new(x, 50.0), u, v, score: 0.8, source }
    }

    #[test]
    fn the_complement_fills_gaps_and_nothing_else() {
        let foundation: Vec<ModuleBox> = [20.0, 40.5, 81.5].iter().map(|x| at(*x, 1.0, Source::Unet)).collect();
        let complement = vec![
            at(61.0, 1.0, Source::Yolo),
            // Beside the lattice: on a shadow, say.
            ModuleBox { center: Vector2::new(61.0, 150.0), ..at(61.0, 1.0, Source::Yolo) },
            // The same modules again, shifted as YOLO shifts them.
            at(22.0, 1.0, Source::Yolo),
            at(44.0, 1.1, Source::Yolo),
            // Far too large and far too small.
            at(150.0, 2.0, Source::Yolo),
            at(200.0, 0.5, Source::Yolo),
        ];
        let merged = merge(foundation.clone(), complement.clone(), |_| true);
        let new: Vec<f64> = merged.iter().filter(|b| b.source == Source::Yolo).map(|b| b.center.x).collect();
        assert_eq!((merged.len(), new), (4, vec![61.0]));
        // Of which the foundation's own network shows nothing.
        assert_eq!(merge(foundation, complement, |_| false).len(), 3);
    }

    #[test]
    fn either_alone_stands() {
        let complement = [at(20.0, 1.0, Source::Yolo), at(40.5, 1.0, Source::Yolo)];
        assert_eq!(merge(Vec::new(), complement.to_vec(), |_| true).len(), 2);
        // A network that sees no trace of them speaks against them, whether or not it has boxes of its own.
        assert!(merge(Vec::new(), complement.to_vec(), |_| false).is_empty());
        assert_eq!(merge(complement.to_vec(), Vec::new(), |_| true).len(), 2);
        assert!(merge(Vec::new(), Vec::new(), |_| true).is_empty());
    }
}
