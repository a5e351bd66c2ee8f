//! All benches and all views as one robust least-squares estimate.
//!
//! A bench is a plane lattice (with a bend where it is long), seen by the cameras: what is minimised is the distance, in
//! pixels, between where each module was seen and where the lattice puts it. Poses are never exact: each view may move and
//! turn a little, the modules being the tie points, and may displace each bench by a little more. How much of either there
//! is, and how well boxes are centred, is estimated from the plant itself along with the rest, so that cameras that agree
//! are believed and others are mended. Benches of one type share their spacing. The point cloud only steers what the views
//! leave open, such as the depth of a bench that one view alone shows.

use super::lattice::{BenchMatrix, BenchVector, Lattice, PARAMS, centered, median};
use super::normal::{Group, Normal, Sight, Spreads, Step};
use super::spacing::{self, Spacing};
use super::uncertainty::{self, Measured, Uncertainty};
use super::views::AdjustedView;
use super::{Refined, RefinedBench, RefinedModule, RefinementParams};
use crate::fusion::{Fused, FusedBench, View};
use nalgebra::{Vector2, Vector3};
use rayon::prelude::*;
use std::cmp::Ordering;
use std::collections::BTreeMap;

/// Refines all benches.
pub(super) fn refine(views: &[View<'_>], fused: &Fused, params: &RefinementParams) -> Refined {
    let benches = &fused.benches;
    let mut problem = Problem::new(views, benches, &fused.camera_sigma_m, *params);
    problem.solve();
    let scatter = uncertainty::scatter(
        (&problem.lattices, &problem.groups),
        &problem.views,
        &problem.spreads,
        params,
        |bench, normal, right| problem.prior(bench, normal, right),
    );
    let known = (problem.lattices.as_slice(), problem.views.as_slice());
    let measured = Measured { scatter, common_m: problem.common_m() };
    let uncertainties = uncertainty::of_benches(&problem.linearised(), known, &problem.spreads, &measured, params);
    let benches = benches
        .par_iter()
        .zip(problem.lattices.par_iter().zip(&uncertainties))
        .map(|(bench, (lattice, uncertainty))| refined(views, &problem.views, bench, lattice, uncertainty))
        .collect();
    let poses = problem.views.iter().map(AdjustedView::pose).collect();
    Refined { benches, poses, alignment: None, scaled: None }
}

/// What is estimated, and from what.
struct Problem {
    lattices: Vec<Lattice>,
    groups: Vec<Vec<Group>>,
    views: Vec<AdjustedView>,
    spreads: Spreads,
    anchors: Vec<Anchor>,
    /// How well the cloud knows the place of a bench, one standard deviation, metres.
    cloud_m: f64,
    spacings: Vec<Spacing>,
    /// The typical camera's measured quality: what it displaces on the ground, metres.
    camera_m: Option<f64>,
    params: RefinementParams,
}

/// Where the cloud has a bench: the lattice that fits its points.
struct Anchor {
    lattice: Lattice,
    /// Mean squares of the column and row numbers of its modules.
    spread: [f64; 2],
}

impl Problem {
    fn new(views: &[View<'_>], benches: &[FusedBench], camera_sigma_m: &[f64], params: RefinementParams) -> Self {
        let camera_m = median(camera_sigma_m.to_vec());
        let lattices: Vec<Lattice> = benches.par_iter().map(|bench| Lattice::start(views, bench)).collect();
        let mut groups: Vec<Vec<Group>> = benches
            .par_iter()
            .zip(&lattices)
            .map(|(bench, lattice)| groups_of(views, bench, lattice, &params))
            .collect();
        let mut groups_of_view: Vec<Vec<(usize, usize)>> = vec![Vec::new(); views.len()];
        for (bench, groups) in groups.iter().enumerate() {
            for (place, group) in groups.iter().enumerate() {
                groups_of_view[group.view].push((bench, place));
            }
        }
        let adjusted: Vec<AdjustedView> = views
            .par_iter()
            .zip(&groups_of_view)
            .enumerate()
            .map(|(index, (view, members))| {
                let shown = members.iter().flat_map(|&(bench, place)| {
                    let lattice = &lattices[bench];
                    groups[bench][place].sights.iter().map(|sight| {
                        let [c, r] = sight.place.map(f64::from);
                        lattice.position(c, r)
                    })
                });
                let quality = camera_m.map_or(1.0, |typical_m| camera_sigma_m[index] / typical_m);
                AdjustedView::new(view, shown, quality)
            })
            .collect();
        // Where a view displaces a bench, all its modules are displaced alike.
        groups.par_iter_mut().zip(&lattices).for_each(|(groups, lattice)| {
            for group in groups {
                let rest = residuals_px(lattice, group, &adjusted);
                let middle = |axis: usize| median(rest.iter().map(|(rest, _)| rest[axis]).collect()).unwrap_or(0.0);
                group.offset_px = Vector2::new(middle(0), middle(1));
            }
        });
        let offsets: Vec<f64> = groups.iter().flatten().map(|group| group.offset_px.norm()).collect();
        let anchors = benches
            .iter()
            .zip(&lattices)
            .map(|(bench, lattice)| {
                let count = bench.modules.len() as f64;
                let mean_square = |f: fn((f64, f64)) -> f64| {
                    bench.modules.iter().map(|m| f(centered(bench, m.row, m.col)).powi(2)).sum::<f64>() / count
                };
                Anchor { lattice: lattice.clone(), spread: [mean_square(|p| p.0), mean_square(|p| p.1)] }
            })
            .collect();
        let spacings = spacing::types(benches, &lattices, &params);
        let mut problem = Self {
            lattices,
            groups,
            views: adjusted,
            spreads: Spreads {
                center_px: 1.0,
                group_px: (median(offsets).unwrap_or(1.0) / 1.18).clamp(1.0, 60.0),
                shared_px: if camera_m.is_some() { params.shared_px } else { 0.0 },
                pose_m: if camera_m.is_some() { params.fixed_pose_m } else { params.first_pose_m },
            },
            anchors,
            cloud_m: params.first_cloud_m,
            spacings,
            camera_m,
            params,
        };
        problem.spreads.center_px = problem.center_spread_px();
        problem
    }

    /// The problem about the present estimate.
    fn linearised(&self) -> Normal {
        Normal::new(&self.lattices, &self.groups, &self.views, &self.spreads, |bench, normal, right| {
            self.prior(bench, normal, right);
        })
    }

    /// Gauss-Newton steps, after each of which the spreads are estimated anew.
    fn solve(&mut self) {
        // Far from the solution a step need not be exact; where there are few views it costs nothing.
        let (tolerance, most) = if self.views.len() <= 500 { (1e-8, 1000) } else { (1e-3, 100) };
        for round in 0..self.params.most_rounds {
            let normal = self.linearised();
            let step = normal.solve(tolerance, most);
            let moved_m = self.take(&step);
            let before = self.spreads;
            self.spreads = Spreads {
                center_px: self.center_spread_px(),
                group_px: self.group_spread_px(&normal, before.group_px),
                shared_px: before.shared_px,
                pose_m: self.next_pose_m(round, &normal, before.pose_m),
            };
            self.cloud_m = self.cloud_spread_m();
            spacing::update(&mut self.spacings, &self.lattices, &self.params);
            let settled = |new: f64, old: f64| (new / old - 1.0).abs() < self.params.settled;
            if round >= self.params.fixed_rounds.max(3) + usize::from(self.camera_m.is_some())
                && moved_m < self.params.settled_m
                && settled(self.spreads.center_px, before.center_px)
                && settled(self.spreads.group_px, before.group_px)
                && settled(self.spreads.pose_m, before.pose_m)
            {
                break;
            }
        }
    }

    /// Takes a step and tells how far it moved anything, metres.
    fn take(&mut self, step: &Step) -> f64 {
        let mut moved_m = 0.0_f64;
        for (view, correction) in self.views.iter_mut().zip(&step.views) {
            moved_m = moved_m.max(correction.component_div(&view.correction_scale()).amax());
            view.correct(correction);
        }
        for (lattice, change) in self.lattices.iter_mut().zip(&step.benches) {
            moved_m = moved_m.max(change.fixed_rows::<3>(0).amax());
            lattice.add(change);
        }
        for (groups, offsets) in self.groups.iter_mut().zip(&step.offsets_px) {
            for (group, offset) in groups.iter_mut().zip(offsets) {
                group.offset_px = *offset;
            }
        }
        moved_m
    }

    /// What is known of a bench besides its sights.
    fn prior(&self, bench: usize, normal: &mut BenchMatrix, right: &mut BenchVector) {
        let lattice = &self.lattices[bench];
        let anchor = &self.anchors[bench];
        let known = 1.0 / (self.cloud_m * self.cloud_m);
        for (term, share) in [(0, 1.0), (1, anchor.spread[0].max(0.25)), (2, anchor.spread[1].max(0.25))] {
            let off = anchor.lattice.terms[term] - lattice.terms[term];
            for axis in 0..3 {
                normal[(3 * term + axis, 3 * term + axis)] += known * share;
                right[3 * term + axis] += known * share * off[axis];
            }
        }
        // A bench too short to show a bend has none.
        let bend_sigma_m = if lattice.bends { self.params.bend_sigma_m } else { 1e-6 };
        let stiff = 1.0 / (bend_sigma_m * bend_sigma_m);
        for axis in 0..3 {
            normal[(9 + axis, 9 + axis)] += stiff;
            right[9 + axis] -= stiff * lattice.terms[3][axis];
        }
        square_prior(lattice, self.params.square_sigma, normal, right);
        self.spacings[bench].prior(lattice, self.params.type_sigma, normal, right);
    }

    /// Standard deviation of a box's centre by the residuals, pixels.
    fn center_spread_px(&self) -> f64 {
        let count: usize = self.groups.iter().flatten().map(|group| group.sights.len()).sum();
        let stride = count.div_ceil(self.params.most_sampled).max(1);
        let rest: Vec<f64> = self
            .groups
            .par_iter()
            .zip(&self.lattices)
            .enumerate()
            .filter(|(index, _)| index % stride == 0)
            .flat_map_iter(|(_, (groups, lattice))| {
                // Few modules hide in the offset of their group.
                groups.iter().filter(|group| group.sights.len() >= 6).flat_map(move |group| {
                    residuals_px(lattice, group, &self.views)
                        .into_iter()
                        .map(|(rest, spread)| (rest - group.offset_px).norm() / spread)
                })
            })
            .collect();
        // Half of the lengths of a normal deviation in the plane are below 1.18 sigma.
        median(rest).map_or(0.5, |median| median / 1.1774).clamp(0.02, 10.0)
    }

    /// How far the boxes of one module are off alike in all views, one standard deviation on the ground, metres: what the means
    /// of its residuals scatter more than boxes that err by themselves would.
    fn common_m(&self) -> f64 {
        let means: Vec<(f64, f64)> = self
            .groups
            .par_iter()
            .zip(&self.lattices)
            .flat_map_iter(|(groups, lattice)| {
                let mut modules: BTreeMap<(i32, i32), (Vector2<f64>, f64, f64)> = BTreeMap::new();
                for group in groups {
                    let view = &self.views[group.view];
                    let sigma_m = self.spreads.center_px / view.px_per_m();
                    for (sight, (rest, spread)) in group.sights.iter().zip(residuals_px(lattice, group, &self.views)) {
                        if spread <= 1.0 {
                            let place = sight.place.map(|at| (2.0 * at).round() as i32);
                            let entry = modules.entry((place[0], place[1])).or_default();
                            entry.0 += view.on_ground(rest - group.offset_px);
                            entry.1 += sigma_m * sigma_m;
                            entry.2 += 1.0;
                        }
                    }
                }
                let several = modules.into_values().filter(|(_, _, count)| *count >= 3.0);
                several.map(|(sum, squares, count)| ((sum / count).norm_squared(), squares / (count * count)))
            })
            .collect();
        let (squares, expected): (Vec<f64>, Vec<f64>) = means.into_iter().unzip();
        // Half of the squared lengths of a normal deviation in the plane are below 1.386 variances.
        let square = median(squares).unwrap_or(0.0) / 1.386;
        (square - median(expected).unwrap_or(0.0)).max(0.0).sqrt()
    }

    /// Standard deviation of the offsets of groups (MacKay's fixed point: the sum of squares over the number that the
    /// data, and not the prior, determine).
    fn group_spread_px(&self, normal: &Normal, before_px: f64) -> f64 {
        let (mut squares, mut determined, mut spent) = (0.0, 0.0, 0.0);
        for (bench, groups) in self.groups.iter().enumerate() {
            if groups.len() < 2 {
                continue;
            }
            spent += 3.0;
            for (group, variance) in groups.iter().zip(normal.offset_variances(bench)) {
                let trust = group.trust(&self.spreads);
                squares += trust * group.offset_px.norm_squared();
                determined += 2.0 * (1.0 - trust * variance / (before_px * before_px)).max(0.0);
            }
        }
        spent += 6.0 * self.views.len() as f64;
        let left = (determined - spent).max(0.2 * determined);
        if left < 2.0 { before_px } else { (squares / left).sqrt().clamp(0.01, 60.0) }
    }

    /// Standard deviation of the cloud's places of benches: three times what those that several views show are off, for
    /// they are all off the same way.
    fn cloud_spread_m(&self) -> f64 {
        let off = self.anchors.iter().zip(&self.lattices).zip(&self.groups).filter(|(_, groups)| groups.len() > 2);
        let off = off.map(|((anchor, lattice), _)| (anchor.lattice.terms[0] - lattice.terms[0]).norm()).collect();
        let RefinementParams { first_cloud_m, best_cloud_m, .. } = self.params;
        median(off).map_or(first_cloud_m, |off_m| 3.0 * off_m).clamp(best_cloud_m, first_cloud_m)
    }

    /// The same for the next round: where the cameras' quality is known they stand still at first, and never stray beyond it.
    fn next_pose_m(&self, round: usize, normal: &Normal, before_m: f64) -> f64 {
        let Some(camera_m) = self.camera_m else { return self.pose_spread_m(normal, before_m) };
        match (round + 1).cmp(&self.params.fixed_rounds) {
            Ordering::Less => self.params.fixed_pose_m,
            Ordering::Equal => camera_m,
            Ordering::Greater => self.pose_spread_m(normal, before_m).min(self.params.most_pose_factor * camera_m),
        }
    }

    /// Standard deviation of the poses' errors as they move the ground, likewise.
    fn pose_spread_m(&self, normal: &Normal, before_m: f64) -> f64 {
        let variances = uncertainty::pose_variances(normal, self.views.len(), self.params.exact_views);
        let (mut squares, mut determined) = (0.0, 0.0);
        for (view, variance) in self.views.iter().zip(variances) {
            let scale = view.prior_scale();
            for k in 0..6 {
                squares += (view.correction()[k] / scale[k]).powi(2);
                determined += (1.0 - variance[k] / (before_m * scale[k]).powi(2)).clamp(0.0, 1.0);
            }
        }
        if determined < 6.0 { before_m } else { (squares / determined).sqrt().clamp(0.002, 3.0) }
    }
}

/// The sights of a bench, by view.
fn groups_of(views: &[View<'_>], bench: &FusedBench, lattice: &Lattice, params: &RefinementParams) -> Vec<Group> {
    let edge_spread = params.edge_spread as f32;
    let mut groups: Vec<Group> = Vec::new();
    let mut group_of_view = std::collections::BTreeMap::new();
    for module in &bench.modules {
        let (c, r) = centered(bench, module.row, module.col);
        for o in &module.observations {
            let index = *group_of_view.entry(o.view).or_insert_with(|| {
                groups.push(Group { view: o.view, sights: Vec::new(), offset_px: Vector2::zeros() });
                groups.len() - 1
            });
            let quad = &views[o.view].detections.detections[o.detection].quad;
            let middle = quad.center();
            let mut add = |r: f64, seen_px: Vector2<f64>, spread: f32| {
                groups[index].sights.push(Sight { place: [c as f32, r as f32], seen_px, spread });
            };
            add(r, middle, 1.0);
            if bench.rows > 1 {
                continue;
            }
            // The upper and lower edges show the tilt that the centres of one row cannot.
            let shot = views[o.view].shot;
            let below = lattice.position(c, 0.0) + lattice.step_row() * 0.5;
            let at = |point: &Vector3<f64>| shot.camera.project(&shot.pose.to_camera(point));
            if let (Some(here), Some(below)) = (at(&lattice.position(c, 0.0)), at(&below)) {
                let [u, v] = quad.sides();
                let toward = below - here;
                let side = if toward.dot(&u).abs() / u.norm() > toward.dot(&v).abs() / v.norm() { u } else { v };
                let half = if side.dot(&toward) > 0.0 { side / 2.0 } else { -side / 2.0 };
                add(0.5, middle + half, edge_spread);
                add(-0.5, middle - half, edge_spread);
            }
        }
    }
    groups
}

/// Seen less computed pixel of every sight of a group, its offset not counted, and the spread of the sight.
fn residuals_px(lattice: &Lattice, group: &Group, views: &[AdjustedView]) -> Vec<(Vector2<f64>, f64)> {
    let view = &views[group.view];
    group
        .sights
        .iter()
        .filter_map(|sight| {
            let [c, r] = sight.place.map(f64::from);
            Some((sight.seen_px - view.pixel(&lattice.position(c, r))?, f64::from(sight.spread)))
        })
        .collect()
}

/// Tables are square: a weak observation that the two steps are perpendicular.
fn square_prior(lattice: &Lattice, sigma: f64, normal: &mut BenchMatrix, right: &mut BenchVector) {
    let (u, v) = (lattice.step_col(), lattice.step_row());
    let lengths = u.norm() * v.norm();
    if lengths < 1e-9 {
        return;
    }
    let rest = -u.dot(&v) / lengths;
    let weight = 1.0 / (sigma * sigma);
    let mut gradient = [0.0; 6];
    for a in 0..3 {
        gradient[a] = v[a] / lengths;
        gradient[3 + a] = u[a] / lengths;
    }
    for i in 0..6 {
        right[3 + i] += weight * gradient[i] * rest;
        for j in 0..=i {
            normal[(3 + i, 3 + j)] += weight * gradient[i] * gradient[j];
        }
    }
}

fn refined(
    views: &[View<'_>],
    adjusted: &[AdjustedView],
    bench: &FusedBench,
    lattice: &Lattice,
    uncertainty: &Uncertainty,
) -> RefinedBench {
    let modules = bench
        .modules
        .iter()
        .map(|module| {
            let (c, r) = centered(bench, module.row, module.col);
            let factors = lattice.factors(c, r);
            let spread_m = |covariance: &BenchMatrix| {
                Vector3::from_fn(|axis, _| {
                    let mut variance = 0.0;
                    for i in 0..PARAMS / 3 {
                        for j in 0..PARAMS / 3 {
                            variance += factors[i] * factors[j] * covariance[(3 * i + axis, 3 * j + axis)];
                        }
                    }
                    variance.max(0.0).sqrt()
                })
            };
            let by_boxes_m = spread_m(&uncertainty.boxes);
            let shared_m = by_boxes_m * (uncertainty.shared_m / by_boxes_m.xy().amax().max(1e-9));
            let sigma_m = (spread_m(&uncertainty.whole).map(|s| s * s) + shared_m.map(|s| s * s)).map(f64::sqrt);
            let known = sigma_m.iter().all(|sigma| sigma.is_finite() && *sigma > 0.0);
            RefinedModule { center_m: lattice.position(c, r), sigma_m: known.then_some(sigma_m) }
        })
        .collect();
    let (step_col, step_row) = (lattice.step_col(), lattice.step_row());
    let along = step_col.normalize();
    let across = (step_row - along * along.dot(&step_row)).normalize();
    let (fill_col, fill_row) = lattice.fill(views, adjusted, bench);
    let height = if bench.rows == 1 { step_row.norm() } else { step_row.norm() * fill_row };
    RefinedBench { modules, along, across, module_size_m: [step_col.norm() * fill_col, height] }
}
