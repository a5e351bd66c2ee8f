//! Which modules of a survey are those of the model before: their identifiers live on.
//!
//! GNSS moves one survey against the next by metres, more than a module, turns it by a degree and scales it by half a
//! percent; locally structure from motion bends both. A plant repeats itself: moved by one column nearly all of it lies on
//! modules again. So every motion is tried that lays an end of a large bench on an end of a bench before, each is carried
//! from bench to neighbouring bench, which may stand a little off the others, and what lays most modules on modules counts.
//! What decides is thus where benches and lines end, and holes. Where that leaves two motions, the smaller one is taken, and
//! it is said.

use nalgebra::{Rotation2, Vector2};
use rstar::RTree;
use rstar::primitives::GeomWithData;
use std::cmp::Ordering;
use std::collections::{BTreeMap, BTreeSet, BinaryHeap};

/// How far one survey may be moved against the next, metres; how far turned, radians.
const MOST_M: f64 = 15.0;
const MOST_TURN_RAD: f64 = 0.1;
/// Benches from which motions are tried, and about each of them the benches by which they are judged.
const SEEDS: usize = 5;
const JUDGED_BY: usize = 30;
/// Neighbours of a bench to which its place is carried.
const NEIGHBOURS: usize = 8;
/// Modules of a bench by which its place is found.
const SAMPLE: usize = 60;
/// Least share of a bench's modules that lie on modules, for it to be found again.
const FOUND: f64 = 0.5;
/// Part of what a motion by one column loses in the judged benches, by which the best motion must lead.
const LEAD: f64 = 0.3;

/// A module of a survey: which bench it is of, its centre east and north, and half its shorter side, all in metres.
#[derive(Debug, Clone, Copy)]
pub(super) struct Place {
    pub bench: usize,
    pub at_m: Vector2<f64>,
    pub reach_m: f64,
}

/// What was found again.
#[derive(Debug, PartialEq)]
pub(super) struct FoundAgain {
    /// Pairs of a module of the survey and one of the survey before, by their index, sorted.
    pub pairs: Vec<(usize, usize)>,
    /// Another motion of the whole that does as well: by how far it differs, metres east and north.
    pub or_moved_by_m: Option<Vector2<f64>>,
}

/// Finds the modules of `old` again in `new`, both in one frame but for what GNSS errs.
pub(super) fn find_again(new: &[Place], old: &[Place]) -> FoundAgain {
    let (new, old) = (Survey::of(new), Survey::of(old));
    let Some((motion, seed, or_moved_by_m)) = best_motion(&new, &old) else {
        return FoundAgain { pairs: Vec::new(), or_moved_by_m: None };
    };
    let placed = new.place(&old, &motion, seed, usize::MAX);
    FoundAgain { pairs: new.pairs(&old, &motion, &placed), or_moved_by_m }
}

/// A turn about a place, which is laid on another.
#[derive(Debug, Clone, Copy)]
struct Motion {
    turn: Rotation2<f64>,
    from_m: Vector2<f64>,
    to_m: Vector2<f64>,
}

impl Motion {
    fn apply(&self, at_m: Vector2<f64>) -> Vector2<f64> {
        self.turn * (at_m - self.from_m) + self.to_m
    }
}

/// A bench as it lies on the ground.
struct Bench {
    modules: Vec<usize>,
    sample: Vec<usize>,
    middle_m: Vector2<f64>,
    /// Along the row, of length 1, and one column in that direction.
    axis: Vector2<f64>,
    pitch_m: f64,
    /// Middles of both ends.
    ends_m: [Vector2<f64>; 2],
}

struct Survey<'a> {
    places: &'a [Place],
    benches: Vec<Bench>,
    /// For each bench those next to it.
    neighbours: Vec<Vec<usize>>,
    tree: RTree<GeomWithData<[f64; 2], usize>>,
}

/// Where benches of a survey were found in the one before.
struct Placed {
    /// What is left to the motion for each bench that was found again, metres.
    rest_m: BTreeMap<usize, Vector2<f64>>,
    /// Modules that lie on modules, and modules that were looked at.
    found: f64,
    sought: f64,
    /// Modules looked at in one column of each bench.
    column: f64,
}

impl Placed {
    fn share(&self) -> f64 {
        self.found / self.sought.max(1.0)
    }
}

/// The motion that lays most modules about some large bench on modules, that bench, and by how far another one differs that
/// does as well.
fn best_motion(new: &Survey, old: &Survey) -> Option<(Motion, usize, Option<Vector2<f64>>)> {
    let mut seeds: Vec<usize> = (0..new.benches.len()).collect();
    seeds.sort_by_key(|bench| (std::cmp::Reverse(new.benches[*bench].modules.len()), *bench));
    struct Tried {
        motion: Motion,
        seed: usize,
        at_m: Vector2<f64>,
        moved_m: f64,
        placed: Placed,
    }
    let mut best: Option<(Tried, Option<Vector2<f64>>)> = None;
    for seed in seeds.into_iter().take(SEEDS) {
        let bench = &new.benches[seed];
        let mut tried: Vec<Tried> = motions(bench, old)
            .into_iter()
            .filter_map(|motion| {
                let placed = new.place(old, &motion, seed, JUDGED_BY);
                let at_m = motion.apply(bench.middle_m) + placed.rest_m.get(&seed)?;
                Some(Tried { motion, seed, at_m, moved_m: (at_m - bench.middle_m).norm(), placed })
            })
            .collect();
        // By so much two motions differ that a column tells apart.
        let column = |tried: &Tried| LEAD * tried.placed.column / tried.placed.sought.max(1.0);
        tried.sort_by(|a, b| b.placed.share().total_cmp(&a.placed.share()).then(a.moved_m.total_cmp(&b.moved_m)));
        let Some(most) = tried.first().map(|first| first.placed.share() - column(first)) else { continue };
        tried.retain(|tried| tried.placed.share() >= most);
        tried.sort_by(|a, b| a.moved_m.total_cmp(&b.moved_m).then(b.placed.share().total_cmp(&a.placed.share())));
        let least = tried.swap_remove(0);
        let apart_m = bench.pitch_m.min(2.0 * new.places[bench.modules[0]].reach_m) / 2.0;
        let other = tried.iter().map(|tried| tried.at_m - least.at_m).find(|apart| apart.norm() > apart_m);
        let better = |(best, unsure): &(Tried, Option<Vector2<f64>>)| {
            (other.is_none(), least.placed.share()).partial_cmp(&(unsure.is_none(), best.placed.share()))
        };
        if best.as_ref().is_none_or(|best| better(best) == Some(Ordering::Greater)) {
            best = Some((least, other));
        }
    }
    best.map(|(tried, other)| (tried.motion, tried.seed, other))
}

/// The motions that lay an end of a bench on an end of one before.
fn motions(bench: &Bench, old: &Survey) -> Vec<Motion> {
    let mut found: Vec<Motion> = Vec::new();
    for other in &old.benches {
        if (other.middle_m - bench.middle_m).norm() > MOST_M + (other.length_m() - bench.length_m()).abs() {
            continue;
        }
        let forwards = bench.axis.dot(&other.axis) >= 0.0;
        let axis = if forwards { other.axis } else { -other.axis };
        let turn = Rotation2::rotation_between(&bench.axis, &axis);
        if turn.angle().abs() > MOST_TURN_RAD {
            continue;
        }
        for end in 0..2 {
            let to_m = other.ends_m[if forwards { end } else { 1 - end }];
            let motion = Motion { turn, from_m: bench.ends_m[end], to_m };
            let at_m = motion.apply(bench.middle_m);
            let is_new = found.iter().all(|known| (known.apply(bench.middle_m) - at_m).norm() > 0.2 * bench.pitch_m);
            if is_new && (at_m - bench.middle_m).norm() <= MOST_M {
                found.push(motion);
            }
        }
    }
    found
}

impl Bench {
    fn of(modules: Vec<usize>, places: &[Place]) -> Self {
        let count = modules.len() as f64;
        let middle_m = modules.iter().map(|m| places[*m].at_m).sum::<Vector2<f64>>() / count;
        let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
        for module in &modules {
            let off = places[*module].at_m - middle_m;
            (xx, xy, yy) = (xx + off.x * off.x, xy + off.x * off.y, yy + off.y * off.y);
        }
        let heading = 0.5 * (2.0 * xy).atan2(xx - yy);
        let axis = Vector2::new(heading.cos(), heading.sin());
        let mut along: Vec<(f64, usize)> =
            modules.iter().map(|m| ((places[*m].at_m - middle_m).dot(&axis), *m)).collect();
        along.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let reach_m = places[modules[0]].reach_m;
        let mut steps: Vec<f64> =
            along.windows(2).map(|pair| pair[1].0 - pair[0].0).filter(|step| *step > reach_m).collect();
        steps.sort_by(f64::total_cmp);
        let pitch_m = steps.get(steps.len() / 2).copied().unwrap_or(2.0 * reach_m);
        let ends_m = [along[0].0, along[along.len() - 1].0].map(|end| middle_m + axis * end);
        // Spread evenly, first and last among them.
        let wanted = along.len().min(SAMPLE);
        let sample = (0..wanted).map(|k| along[k * (along.len() - 1) / (wanted - 1).max(1)].1).collect();
        Self { modules, sample, middle_m, axis, pitch_m, ends_m }
    }

    fn length_m(&self) -> f64 {
        (self.ends_m[1] - self.ends_m[0]).norm()
    }
}

impl<'a> Survey<'a> {
    fn of(places: &'a [Place]) -> Self {
        let mut of_bench: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
        for (module, place) in places.iter().enumerate() {
            of_bench.entry(place.bench).or_default().push(module);
        }
        let benches: Vec<Bench> = of_bench.into_values().map(|modules| Bench::of(modules, places)).collect();
        let middles = RTree::bulk_load(
            benches.iter().enumerate().map(|(k, b)| GeomWithData::new([b.middle_m.x, b.middle_m.y], k)).collect(),
        );
        let neighbours = benches
            .iter()
            .enumerate()
            .map(|(own, bench)| {
                let near = middles.nearest_neighbor_iter([bench.middle_m.x, bench.middle_m.y]).map(|near| near.data);
                near.filter(|other| *other != own).take(NEIGHBOURS).collect()
            })
            .collect();
        let tree =
            places.iter().enumerate().map(|(k, p)| GeomWithData::new([p.at_m.x, p.at_m.y], k)).collect::<Vec<_>>();
        Self { places, benches, neighbours, tree: RTree::bulk_load(tree) }
    }

    /// The module nearest to a place, and how far it is off from there, if that is no more than `reach_m`.
    fn nearest(&self, at_m: Vector2<f64>, reach_m: f64) -> Option<(usize, Vector2<f64>)> {
        let nearest = self.tree.nearest_neighbor([at_m.x, at_m.y])?;
        let off_m = Vector2::from(*nearest.geom()) - at_m;
        (off_m.norm() <= reach_m).then_some((nearest.data, off_m))
    }

    /// Places benches one by one, from the seed to its neighbours and on, at most so many.
    fn place(&self, old: &Survey, motion: &Motion, seed: usize, most: usize) -> Placed {
        let mut placed = Placed { rest_m: BTreeMap::new(), found: 0.0, sought: 0.0, column: 0.0 };
        let mut reached: BTreeSet<usize> = BTreeSet::new();
        // Nearest first.
        let mut queue = BinaryHeap::from([Next { distance_m: 0.0, bench: seed, expected_m: Vector2::zeros() }]);
        while let Some(Next { bench, expected_m, .. }) = queue.pop() {
            if reached.len() >= most || !reached.insert(bench) {
                continue;
            }
            let own = &self.benches[bench];
            let (rest_m, found) = self.settle(old, motion, own, expected_m);
            let share = found as f64 / own.sample.len() as f64;
            placed.found += share * own.modules.len() as f64;
            placed.sought += own.modules.len() as f64;
            placed.column += own.modules.len() as f64 / (own.length_m() / own.pitch_m + 1.0).round();
            let is_found = share >= FOUND;
            if is_found {
                placed.rest_m.insert(bench, rest_m);
            }
            for &next in &self.neighbours[bench] {
                if !reached.contains(&next) {
                    let distance_m = (self.benches[next].middle_m - own.middle_m).norm();
                    let expected_m = if is_found { rest_m } else { expected_m };
                    queue.push(Next { distance_m, bench: next, expected_m });
                }
            }
        }
        placed
    }

    /// Where a bench lies best, near to what is expected or one column beside it, and how many of its sample lie on modules.
    fn settle(&self, old: &Survey, motion: &Motion, bench: &Bench, expected_m: Vector2<f64>) -> (Vector2<f64>, usize) {
        let column_m = motion.turn * bench.axis * bench.pitch_m;
        let mut best = self.fit(old, motion, bench, expected_m);
        for beside_m in [column_m, -column_m] {
            if best.1 == bench.sample.len() {
                break;
            }
            let other = self.fit(old, motion, bench, expected_m + beside_m);
            if other.1 > best.1 {
                best = other;
            }
        }
        best
    }

    /// Moves a bench onto the modules next to it: by how much in all, and how many of its sample then lie on modules.
    fn fit(&self, old: &Survey, motion: &Motion, bench: &Bench, start_m: Vector2<f64>) -> (Vector2<f64>, usize) {
        let offs = |rest_m: Vector2<f64>, share: f64| -> Vec<Vector2<f64>> {
            let sample = bench.sample.iter().map(|module| &self.places[*module]);
            sample
                .filter_map(|place| old.nearest(motion.apply(place.at_m) + rest_m, share * place.reach_m))
                .map(|(_, off_m)| off_m)
                .collect()
        };
        let mut rest_m = start_m;
        for _ in 0..2 {
            let offs = offs(rest_m, 1.0);
            if offs.is_empty() {
                return (start_m, 0);
            }
            let middle = |axis: usize| {
                let mut values: Vec<f64> = offs.iter().map(|off| off[axis]).collect();
                values.sort_by(f64::total_cmp);
                values[values.len() / 2]
            };
            rest_m += Vector2::new(middle(0), middle(1));
        }
        (rest_m, offs(rest_m, 0.7).len())
    }

    /// Pairs of own modules and those of the survey before, each in one pair at most.
    fn pairs(&self, old: &Survey, motion: &Motion, placed: &Placed) -> Vec<(usize, usize)> {
        let found = RTree::bulk_load(
            placed
                .rest_m
                .iter()
                .map(|(bench, rest_m)| {
                    let middle_m = self.benches[*bench].middle_m;
                    GeomWithData::new([middle_m.x, middle_m.y], *rest_m)
                })
                .collect(),
        );
        let mut candidates: Vec<(f64, usize, usize)> = Vec::new();
        for (index, bench) in self.benches.iter().enumerate() {
            // A bench that is not found as a whole, as half of one that is now two, stands like the one next to it.
            let next = || found.nearest_neighbor([bench.middle_m.x, bench.middle_m.y]).map(|next| next.data);
            let Some(rest_m) = placed.rest_m.get(&index).copied().or_else(next) else { continue };
            for &module in &bench.modules {
                let place = &self.places[module];
                if let Some((other, off_m)) = old.nearest(motion.apply(place.at_m) + rest_m, place.reach_m) {
                    candidates.push((off_m.norm(), module, other));
                }
            }
        }
        candidates.sort_by(|a, b| a.0.total_cmp(&b.0).then((a.1, a.2).cmp(&(b.1, b.2))));
        let mut taken = BTreeSet::new();
        let nearest = candidates.into_iter().filter(|(_, _, other)| taken.insert(*other));
        let mut pairs: Vec<(usize, usize)> = nearest.map(|(_, module, other)| (module, other)).collect();
        pairs.sort_unstable();
        pairs
    }
}

/// A bench that is placed next, and where it is expected.
struct Next {
    distance_m: f64,
    bench: usize,
    expected_m: Vector2<f64>,
}

impl Ord for Next {
    /// The nearest comes first out of a heap.
    fn cmp(&self, other: &Self) -> Ordering {
        other.distance_m.total_cmp(&self.distance_m).then(other.bench.cmp(&self.bench))
    }
}

impl PartialOrd for Next {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl PartialEq for Next {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other) == Ordering::Equal
    }
}

impl Eq for Next {}

#[cfg(test)]
mod tests {
    use super::*;

    const PITCH_M: [f64; 2] = [1.02, 1.67];

    /// A module by bench, row and column, and where it stands.
    type Known = ((usize, i32, i32), Place);

    /// Benches of two rows: three to a line and half a metre apart, lines 6 m apart.
    fn plant(benches: usize, columns: i32) -> Vec<Known> {
        let mut modules = Vec::new();
        for bench in 0..benches {
            let corner = Vector2::new((bench % 3) as f64 * (PITCH_M[0] * 18.0 + 2.5), (bench / 3) as f64 * -6.0);
            for (row, column) in (0..2).flat_map(|row| (0..columns).map(move |column| (row, column))) {
                let at_m = corner + Vector2::new(f64::from(column) * PITCH_M[0], -f64::from(row) * PITCH_M[1]);
                modules.push(((bench, row, column), Place { bench, at_m, reach_m: 0.5 }));
            }
        }
        modules
    }

    fn moved(plant: &[Known], change: impl Fn(Vector2<f64>) -> Vector2<f64>) -> Vec<Known> {
        plant.iter().map(|(key, place)| (*key, Place { at_m: change(place.at_m), ..*place })).collect()
    }

    /// How many modules are found as themselves and as others, and whether that is sure.
    fn found(new: &[Known], old: &[Known]) -> (usize, usize, bool) {
        let places = |known: &[Known]| known.iter().map(|(_, place)| *place).collect::<Vec<_>>();
        let again = find_again(&places(new), &places(old));
        let right = again.pairs.iter().filter(|(n, o)| new[*n].0 == old[*o].0).count();
        (right, again.pairs.len() - right, again.or_moved_by_m.is_none())
    }

    #[test]
    fn one_module_gone_from_each_bench_changes_nothing_for_the_others() {
        let old = plant(6, 18);
        for shift in [0.0, 0.7, PITCH_M[0], 2.0 * PITCH_M[0], 8.0] {
            let mut new = moved(&old, |at| at + Vector2::new(shift, 0.4 * shift));
            new.retain(|((bench, row, column), _)| (*row, *column) != (0, 4 + *bench as i32));
            assert_eq!(found(&new, &old), (new.len(), 0, true), "moved by {shift} m");
        }
        // Of one bench alone the ends tell.
        let old = plant(1, 18);
        let mut new = moved(&old, |at| at + Vector2::new(1.0, 0.3));
        new.remove(7);
        assert_eq!(found(&new, &old), (35, 0, true));
    }

    #[test]
    fn a_turned_scaled_and_bent_survey_is_found_again() {
        let old = plant(60, 18);
        let turn = Rotation2::new(0.02);
        let new = moved(&old, |at| {
            // A metre and a half over the length of the plant.
            let bend = Vector2::new(1.5 * (at.y / 114.0).powi(2), 0.8 * (at.y / 114.0).powi(2));
            turn * at * 1.005 + bend + Vector2::new(3.0, -2.0)
        });
        assert_eq!(found(&new, &old), (new.len(), 0, true));
    }

    #[test]
    fn benches_that_are_new_or_gone_take_no_identifiers() {
        let (small, large) = (plant(6, 18), plant(12, 18));
        let shift = |at| at + Vector2::new(PITCH_M[0], 2.0);
        assert_eq!(found(&moved(&large, shift), &small), (small.len(), 0, true));
        assert_eq!(found(&moved(&small, shift), &large).1, 0);
        let without: Vec<Known> = large.iter().filter(|((bench, ..), _)| bench % 5 != 1).copied().collect();
        assert_eq!(found(&moved(&without, shift), &large), (without.len(), 0, true));
    }

    #[test]
    fn a_bench_that_became_two_keeps_its_modules() {
        let old = plant(6, 18);
        let mut new = moved(&old, |at| at + Vector2::new(1.02, 0.5));
        for ((bench, _, column), place) in &mut new {
            if *bench == 2 && *column >= 7 {
                place.bench = 6;
            }
        }
        assert_eq!(found(&new, &old), (new.len(), 0, true));
    }

    #[test]
    fn what_ends_do_not_tell_is_said() {
        // A column more on every bench: on which side of them?
        let (old, new) = (plant(6, 17), plant(6, 18));
        assert_eq!(found(&new, &old), (old.len(), 0, false));
    }

    #[test]
    fn another_plant_is_not_found() {
        let old = plant(6, 18);
        assert_eq!(found(&moved(&old, |at| at + Vector2::new(400.0, 0.0)), &old), (0, 0, true));
        assert_eq!(found(&old, &[]), (0, 0, true));
        assert_eq!(found(&[], &old), (0, 0, true));
    }
}
