//! What cannot stand where it was put: benches through each other, and rows on the ground between benches.
//!
//! Light that falls through the seams of a table draws a row of modules on the ground beside it, and from all photos alike, so
//! that it triangulates well. But it lies on the ground, metres below where the benches about it say that one would stand.

use super::{Refined, RefinementParams};
use crate::fusion::{Doubt, Fused, FusedBench, View};
use nalgebra::{Matrix3, Vector2, Vector3};
use rayon::prelude::*;
use rstar::RTree;
use rstar::primitives::GeomWithData;
use std::collections::{BTreeMap, BTreeSet};

/// Why a bench is left out.
enum Reason {
    /// It lies through another one.
    Through(usize),
    /// It lies so much lower than a bench there would stand, metres.
    Low(f64),
}

/// Leaves out benches that cannot be, with a doubt each.
pub(super) fn exclude(views: &[View<'_>], fused: &mut Fused, refined: &mut Refined, params: &RefinementParams) {
    let reasons: BTreeMap<usize, Reason> = {
        let places = Places::new(fused, refined);
        let of = |bench: usize| places.through(bench, params).or_else(|| places.low(bench, params));
        (0..fused.benches.len()).into_par_iter().filter_map(|bench| Some((bench, of(bench)?))).collect()
    };
    if reasons.is_empty() || reasons.len() == fused.benches.len() {
        return;
    }
    let doubts: Vec<Doubt> =
        reasons.iter().map(|(bench, reason)| doubt(views, &fused.benches, *bench, reason)).collect();
    let kept: Vec<bool> = (0..fused.benches.len()).map(|bench| !reasons.contains_key(&bench)).collect();
    fused.doubts.extend(doubts);
    fused.keep_benches(&kept);
    let mut keep = kept.iter();
    refined.benches.retain(|_| keep.next().copied().unwrap_or(false));
}

fn doubt(views: &[View<'_>], benches: &[FusedBench], bench: usize, reason: &Reason) -> Doubt {
    let FusedBench { modules, middle_m, .. } = &benches[bench];
    let names: BTreeSet<&str> = benches[bench].sightings().map(|(view, _)| views[view].shot.name.as_str()).collect();
    let (code, message) = match reason {
        Reason::Through(other) => {
            let at = benches[*other].middle_m;
            let message = format!(
                "{} modules seen at {:.1} m east, {:.1} m north lie over the bench at {:.1} m east, {:.1} m north, but do not \
                 fit its lattice; they are left out: check these images",
                modules.len(),
                middle_m.x,
                middle_m.y,
                at.x,
                at.y
            );
            ("bench_seen_apart", message)
        }
        Reason::Low(by_m) => {
            let message = format!(
                "{} modules seen at {:.1} m east, {:.1} m north lie {by_m:.1} m lower than a bench between its neighbours \
                 would: on the ground, as shadows do; they are left out: check these images",
                modules.len(),
                middle_m.x,
                middle_m.y
            );
            ("bench_on_ground", message)
        }
    };
    Doubt {
        code: code.into(),
        message,
        images: names.into_iter().map(str::to_owned).collect(),
        benches: match reason {
            Reason::Through(other) => vec![bench.min(*other), bench.max(*other)],
            Reason::Low(_) => vec![bench],
        },
        places_m: vec![middle_m.xy()],
        sightings: benches[bench].sightings().collect(),
    }
}

type Module = GeomWithData<[f64; 2], (usize, usize)>;

/// Where all modules stand.
struct Places<'a> {
    fused: &'a Fused,
    refined: &'a Refined,
    tree: RTree<Module>,
    /// How many boxes each bench was seen by.
    sightings: Vec<usize>,
}

impl<'a> Places<'a> {
    fn new(fused: &'a Fused, refined: &'a Refined) -> Self {
        let modules = refined.benches.iter().enumerate().flat_map(|(bench, lattice)| {
            let places = lattice.modules.iter().enumerate();
            places.map(move |(module, place)| GeomWithData::new(place.center_m.xy().into(), (bench, module)))
        });
        let tree = RTree::bulk_load(modules.collect());
        let sightings = fused.benches.iter().map(|bench| bench.sightings().count()).collect();
        Self { fused, refined, tree, sightings }
    }

    /// The bench with more boxes that this one shares more ground with than two can.
    fn through(&self, bench: usize, params: &RefinementParams) -> Option<Reason> {
        let lattice = &self.refined.benches[bench];
        let reach_m = lattice.module_size_m[0].min(lattice.module_size_m[1]) * params.most_shared;
        let mut covered: BTreeMap<usize, usize> = BTreeMap::new();
        for place in &lattice.modules {
            let near = self.tree.locate_within_distance(place.center_m.xy().into(), reach_m * reach_m);
            let others: BTreeSet<usize> = near
                .map(|other| other.data.0)
                .filter(|other| (self.sightings[*other], bench) > (self.sightings[bench], *other))
                .collect();
            for other in others {
                *covered.entry(other).or_default() += 1;
            }
        }
        let (other, count) = covered.into_iter().max_by_key(|(_, count)| *count)?;
        (3 * count > lattice.modules.len()).then_some(Reason::Through(other))
    }

    /// Whether a bench of fewer rows than those about it lies on the ground.
    fn low(&self, bench: usize, params: &RefinementParams) -> Option<Reason> {
        let modules = &self.refined.benches[bench].modules;
        let middle = modules.iter().map(|module| module.center_m).sum::<Vector3<f64>>() / modules.len() as f64;
        let rows = self.fused.benches[bench].rows;
        // The nearest module of each bench about it, the nearest first.
        let mut about: BTreeMap<usize, (f64, usize)> = BTreeMap::new();
        let reach_m = params.neighbour_reach_m;
        for (near, distance) in self.tree.nearest_neighbor_iter_with_distance_2(middle.xy().into()) {
            if distance > reach_m * reach_m || about.len() > params.most_neighbours {
                break;
            }
            let (other, module) = near.data;
            if other != bench && self.fused.benches[other].rows > rows {
                about.entry(other).or_insert((distance, module));
            }
        }
        if about.len() < params.least_neighbours {
            return None;
        }
        let columns: Vec<Vector3<f64>> =
            about.iter().map(|(&other, &(_, module))| self.column(other, module)).collect();
        let (expected_m, rest_m) = height_between(&columns, middle.xy(), params)?;
        let by_m = expected_m - middle.z;
        (by_m > params.least_low_m.max(3.0 * rest_m)).then_some(Reason::Low(by_m))
    }

    /// The middle of the column of a bench that a module stands in.
    fn column(&self, bench: usize, module: usize) -> Vector3<f64> {
        let fused = &self.fused.benches[bench];
        let col = fused.modules[module].col;
        let places = fused.modules.iter().zip(&self.refined.benches[bench].modules);
        let own = places.filter(|(module, _)| module.col == col).map(|(_, place)| place.center_m);
        let (sum, count) = own.fold((Vector3::zeros(), 0.0), |(sum, count), place| (sum + place, count + 1.0));
        sum / count
    }
}

/// The height at a place of the plane through some points, and the median of what it leaves at these, metres. Slopes are held
/// small where the points do not show them.
fn height_between(points: &[Vector3<f64>], at: Vector2<f64>, params: &RefinementParams) -> Option<(f64, f64)> {
    let flat = (params.height_scatter_m / params.slope_sigma).powi(2);
    let mut normal = Matrix3::from_diagonal(&Vector3::new(0.0, flat, flat));
    let mut rhs = Vector3::zeros();
    for point in points {
        let row = Vector3::new(1.0, point.x - at.x, point.y - at.y);
        normal += row * row.transpose();
        rhs += row * point.z;
    }
    let plane = normal.cholesky()?.solve(&rhs);
    let rest = |point: &Vector3<f64>| (point.z - plane.dot(&Vector3::new(1.0, point.x - at.x, point.y - at.y))).abs();
    Some((plane.x, super::lattice::median(points.iter().map(rest).collect())?))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_slope_is_no_step() {
        let params = RefinementParams::default();
        let point = |east: f64, north: f64| Vector3::new(east, north, 0.2 * north + 100.0);
        let points: Vec<_> =
            [(-10.0, 7.0), (5.0, 7.0), (-8.0, 14.0), (9.0, 14.0), (2.0, 21.0)].map(|(e, n)| point(e, n)).into();
        let (height_m, rest_m) = height_between(&points, Vector2::zeros(), &params).unwrap();
        assert!((height_m - 100.0).abs() < 0.5 && rest_m < 0.1, "{height_m} {rest_m}");
    }
}
