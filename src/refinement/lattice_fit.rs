//! The lattice of a bench as one robust least-squares estimate from the pixels of all views.
//!
//! A bench is a plane lattice: an origin, a step along the row, a step across it, and a bend along the row where it is
//! long enough to show one. The views' cameras are the instrument: what is minimised is the distance, in pixels, between
//! where each module was seen and where the lattice puts it. Each view may be displaced by a few pixels against the
//! others (its pose is never exact); how much is estimated from the plant itself. The point cloud only steers what the
//! views leave open, such as the depth of a bench that one view alone shows.

use super::{RefinedBench, RefinedModule};
use crate::fusion::{FusedBench, View};
use nalgebra::{DMatrix, DVector, Matrix2x3, Vector2, Vector3};
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Noise of a module's centre in the image, pixels.
const CENTER_SIGMA_PX: f64 = 0.4;
/// Noise of a corner, pixels.
const CORNER_SIGMA_PX: f64 = 1.2;
/// How well the cloud knows the place of a piece of bench as a whole, metres.
const CLOUD_SIGMA_M: f64 = 0.15;
/// How far from a right angle a table may be, as the cosine.
const SQUARE_SIGMA: f64 = 0.003;
/// How far a bench bends from straight over half its length, metres.
const BEND_SIGMA_M: f64 = 0.1;
/// Benches from this many columns on may bend.
const BEND_COLUMNS: i32 = 10;

/// What a bench's estimate starts from and is told.
#[derive(Clone, Copy)]
struct Settings {
    /// Expected displacement of one view against the others, pixels.
    view_sigma_px: f64,
}

/// The lattice: centre, steps and bend. `position = origin + c step_col + r step_row + (s^2 - 1/3) bend`, with `c`, `r`
/// counted from the middle of the bench and `s` running from -1 to 1 along it.
#[derive(Clone)]
struct Lattice {
    origin: Vector3<f64>,
    step_col: Vector3<f64>,
    step_row: Vector3<f64>,
    bend: Vector3<f64>,
    half_cols: f64,
}

impl Lattice {
    fn position(&self, c: f64, r: f64) -> Vector3<f64> {
        self.origin + self.step_col * c + self.step_row * r + self.bend * self.bend_factor(c)
    }

    fn bend_factor(&self, c: f64) -> f64 {
        let s = c / self.half_cols;
        s * s - 1.0 / 3.0
    }
}

struct Estimate {
    lattice: Lattice,
    /// Covariance of origin, steps and bend (12 x 12 or 9 x 9).
    covariance: Option<DMatrix<f64>>,
    view_offsets_px: Vec<Vector2<f64>>,
}

/// Refines all benches: a first pass tells how far views are displaced, a second uses it.
pub(super) fn refine(views: &[View<'_>], benches: &[FusedBench]) -> Vec<RefinedBench> {
    let pass = |settings: Settings| -> Vec<Estimate> {
        benches.par_iter().map(|bench| estimate(views, bench, settings)).collect()
    };
    let first = pass(Settings { view_sigma_px: 1.0 });
    let mut offsets: Vec<f64> = first.iter().flat_map(|e| &e.view_offsets_px).map(|offset| offset.norm()).collect();
    let estimates = if offsets.is_empty() {
        first
    } else {
        offsets.sort_by(f64::total_cmp);
        let sigma = offsets[offsets.len() / 2] / 1.18;
        pass(Settings { view_sigma_px: sigma.clamp(0.1, 60.0) })
    };
    benches.par_iter().zip(estimates).map(|(bench, estimate)| refined(views, bench, &estimate)).collect()
}

/// Place of a module counted from the middle of its bench.
fn centered(bench: &FusedBench, row: i32, col: i32) -> (f64, f64) {
    (f64::from(col) - f64::from(bench.cols - 1) / 2.0, f64::from(row) - f64::from(bench.rows - 1) / 2.0)
}

/// A start from the positions that the single views give, by robust linear least squares.
fn start(views: &[View<'_>], bench: &FusedBench) -> Lattice {
    let [u, v] = bench.pitch_m;
    let samples: Vec<(f64, f64, Vector3<f64>)> = bench
        .modules
        .iter()
        .map(|m| {
            let (c, r) = centered(bench, m.row, m.col);
            let count = m.observations.len() as f64;
            (c, r, m.observations.iter().map(|o| o.position_m).sum::<Vector3<f64>>() / count)
        })
        .collect();
    let mean = samples.iter().map(|s| s.2).sum::<Vector3<f64>>() / samples.len() as f64;
    let mut lattice = Lattice {
        origin: mean,
        step_col: Vector3::new(u.x, u.y, 0.0),
        step_row: Vector3::new(v.x, v.y, 0.0),
        bend: Vector3::zeros(),
        half_cols: (f64::from(bench.cols) / 2.0).max(0.5),
    };
    let mut cut = 2.0_f64;
    for _ in 0..5 {
        let mut normal = nalgebra::Matrix3::from_diagonal(&Vector3::new(1e-9, 1e-3, 1e-3));
        let mut right = [lattice.origin * 1e-9, lattice.step_col * 1e-3, lattice.step_row * 1e-3];
        for (c, r, p) in &samples {
            let t = (lattice.position(*c, *r) - p).norm() / cut;
            let weight = 1.0 / (1.0 + t * t);
            let row = Vector3::new(1.0, *c, *r);
            normal += weight * row * row.transpose();
            for (slot, basis) in right.iter_mut().zip(row.iter()) {
                *slot += p * (weight * basis);
            }
        }
        let Some(inverse) = normal.try_inverse() else { break };
        let solve = |k: usize| right[0] * inverse[(k, 0)] + right[1] * inverse[(k, 1)] + right[2] * inverse[(k, 2)];
        (lattice.origin, lattice.step_col, lattice.step_row) = (solve(0), solve(1), solve(2));
        cut = 0.3;
    }
    if bench.rows == 1 {
        lattice.step_row = lone_row_step(views, bench, &lattice);
    }
    lattice
}

/// For a single row the step across is the face itself, from its upper to its lower edge: first guess level.
fn lone_row_step(views: &[View<'_>], bench: &FusedBench, lattice: &Lattice) -> Vector3<f64> {
    let along = lattice.step_col.try_normalize(1e-9).unwrap_or(Vector3::x());
    let level = Vector3::new(along.y, -along.x, 0.0).try_normalize(1e-9).unwrap_or(-Vector3::y());
    let ratios: Vec<f64> = bench
        .modules
        .iter()
        .flat_map(|m| &m.observations)
        .map(|o| {
            let [u, v] = views[o.view].detections.detections[o.detection].quad.sides();
            let (a, b) = (u.norm(), v.norm());
            let shot = views[o.view].shot;
            let image_along = shot.pose.camera_from_world * along;
            let image_along = Vector2::new(image_along.x, image_along.y);
            if u.dot(&image_along).abs() / a >= v.dot(&image_along).abs() / b { b / a } else { a / b }
        })
        .collect();
    level * lattice.step_col.norm() * 0.98 * median(ratios).unwrap_or(1.0)
}

fn median(mut values: Vec<f64>) -> Option<f64> {
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// Gauss-Newton with Cauchy weights.
fn estimate(views: &[View<'_>], bench: &FusedBench, settings: Settings) -> Estimate {
    let mut lattice = start(views, bench);
    let bends = bench.cols >= BEND_COLUMNS;
    let shape = if bends { 12 } else { 9 };
    let mut slots: BTreeMap<usize, usize> = BTreeMap::new();
    let mut observed = 0;
    for observation in bench.modules.iter().flat_map(|m| &m.observations) {
        let next = slots.len();
        slots.entry(observation.view).or_insert(next);
        observed += 1;
    }
    let size = shape + 2 * slots.len();
    let mut offsets = vec![Vector2::<f64>::zeros(); slots.len()];
    let cloud_sigma_m = CLOUD_SIGMA_M * f64::from(observed).sqrt();
    let mut covariance = None;
    for round in 0..12 {
        let mut normal = DMatrix::<f64>::zeros(size, size);
        let mut right = DVector::<f64>::zeros(size);
        let (mut squares, mut count) = (0.0, 0.0);
        for module in &bench.modules {
            let (c, r) = centered(bench, module.row, module.col);
            let factors = [1.0, c, r, lattice.bend_factor(c)];
            for o in &module.observations {
                let view = &views[o.view];
                let slot = shape + 2 * slots[&o.view];
                let offset = offsets[slots[&o.view]];
                let quad = &view.detections.detections[o.detection].quad;
                let mut add = |position: Vector3<f64>, factors: [f64; 4], seen: Vector2<f64>, sigma: f64| {
                    let Some((pixel, jacobian)) = project(view, &position) else { return };
                    let rest = seen - pixel - offset;
                    let t2 = rest.norm_squared() / (sigma * sigma);
                    let weight = 1.0 / (1.0 + t2 / 9.0) / (sigma * sigma);
                    squares += weight * rest.norm_squared();
                    count += 2.0;
                    for i in 0..shape / 3 {
                        for j in 0..=i {
                            let block = jacobian.transpose() * jacobian * (weight * factors[i] * factors[j]);
                            for a in 0..3 {
                                for b in 0..3 {
                                    normal[(3 * i + a, 3 * j + b)] += block[(a, b)];
                                }
                            }
                        }
                        let down = jacobian.transpose() * rest * (weight * factors[i]);
                        for a in 0..3 {
                            right[3 * i + a] += down[a];
                            for b in 0..2 {
                                normal[(slot + b, 3 * i + a)] += weight * factors[i] * jacobian[(b, a)];
                            }
                        }
                    }
                    for b in 0..2 {
                        normal[(slot + b, slot + b)] += weight;
                        right[slot + b] += weight * rest[b];
                    }
                };
                add(lattice.position(c, r), factors, quad.center(), CENTER_SIGMA_PX);
                if bench.rows == 1 {
                    // The upper and lower edges show the tilt that the centres of one row cannot.
                    let middle = quad.center();
                    let step = project(view, &(lattice.position(c, r) + lattice.step_row * 0.5));
                    if let Some((below, _)) = step {
                        let [u, v] = quad.sides();
                        let toward = below - middle - offset;
                        let side =
                            if toward.dot(&u).abs() / u.norm() > toward.dot(&v).abs() / v.norm() { u } else { v };
                        let half = if side.dot(&toward) > 0.0 { side / 2.0 } else { -side / 2.0 };
                        for (sign, seen) in [(0.5, middle + half), (-0.5, middle - half)] {
                            let factors = [1.0, c, sign, lattice.bend_factor(c)];
                            add(lattice.position(c, 0.0) + lattice.step_row * sign, factors, seen, CORNER_SIGMA_PX);
                        }
                    }
                }
                // What the cloud says, as one measurement of the whole.
                let rest = o.position_m - lattice.position(c, r);
                let weight = 1.0 / (1.0 + rest.norm_squared()) / (cloud_sigma_m * cloud_sigma_m);
                for i in 0..shape / 3 {
                    for a in 0..3 {
                        right[3 * i + a] += weight * factors[i] * rest[a];
                        for j in 0..=i {
                            normal[(3 * i + a, 3 * j + a)] += weight * factors[i] * factors[j];
                        }
                    }
                }
            }
        }
        square_prior(&lattice, &mut normal, &mut right);
        if bends {
            for a in 0..3 {
                normal[(9 + a, 9 + a)] += 1.0 / (BEND_SIGMA_M * BEND_SIGMA_M);
                right[9 + a] -= lattice.bend[a] / (BEND_SIGMA_M * BEND_SIGMA_M);
            }
        }
        let prior = 1.0 / (settings.view_sigma_px * settings.view_sigma_px);
        for (index, offset) in offsets.iter().enumerate() {
            for b in 0..2 {
                normal[(shape + 2 * index + b, shape + 2 * index + b)] += prior;
                right[shape + 2 * index + b] -= prior * offset[b];
            }
        }
        for i in 0..size {
            normal[(i, i)] += 1e-9;
            for j in 0..i {
                normal[(j, i)] = normal[(i, j)];
            }
        }
        let Some(cholesky) = normal.cholesky() else { break };
        let step = cholesky.solve(&right);
        let take = |at: usize| Vector3::new(step[at], step[at + 1], step[at + 2]);
        lattice.origin += take(0);
        lattice.step_col += take(3);
        lattice.step_row += take(6);
        if bends {
            lattice.bend += take(9);
        }
        for (index, offset) in offsets.iter_mut().enumerate() {
            *offset += Vector2::new(step[shape + 2 * index], step[shape + 2 * index + 1]);
        }
        let moved = step.rows(0, shape).amax();
        if moved < 1e-6 || round == 11 {
            let unit = (squares / f64::max(count - size as f64, 1.0)).max(1.0);
            let inverse = cholesky.inverse();
            covariance = Some(inverse.view((0, 0), (shape, shape)).into_owned() * unit);
            break;
        }
    }
    // The offsets of a bench seen once mean nothing.
    if slots.len() < 2 {
        offsets.clear();
    }
    Estimate { lattice, covariance, view_offsets_px: offsets }
}

/// Tables are square: a weak observation that the two steps are perpendicular.
fn square_prior(lattice: &Lattice, normal: &mut DMatrix<f64>, right: &mut DVector<f64>) {
    let (u, v) = (lattice.step_col, lattice.step_row);
    let lengths = u.norm() * v.norm();
    if lengths < 1e-9 {
        return;
    }
    let rest = -u.dot(&v) / lengths;
    let weight = 1.0 / (SQUARE_SIGMA * SQUARE_SIGMA);
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

/// Pixel of a point, and its derivative by the point (2 x 3, pixels per metre).
fn project(view: &View<'_>, position: &Vector3<f64>) -> Option<(Vector2<f64>, Matrix2x3<f64>)> {
    let camera = &view.shot.camera;
    let p = view.shot.pose.to_camera(position);
    let pixel = camera.project(&p)?;
    let size = f64::from(camera.width_px.max(camera.height_px));
    let (fx, fy) = (camera.focal_x * size, camera.focal_y * size);
    let by_camera = Matrix2x3::new(fx / p.z, 0.0, -fx * p.x / (p.z * p.z), 0.0, fy / p.z, -fy * p.y / (p.z * p.z));
    Some((pixel, by_camera * view.shot.pose.camera_from_world.matrix()))
}

fn refined(views: &[View<'_>], bench: &FusedBench, estimate: &Estimate) -> RefinedBench {
    let lattice = &estimate.lattice;
    let modules = bench
        .modules
        .iter()
        .map(|module| {
            let (c, r) = centered(bench, module.row, module.col);
            let factors = [1.0, c, r, lattice.bend_factor(c)];
            let sigma_m = estimate.covariance.as_ref().map(|covariance| {
                Vector3::from_fn(|a, _| {
                    let mut variance = 0.0;
                    for i in 0..covariance.nrows() / 3 {
                        for j in 0..covariance.nrows() / 3 {
                            variance += factors[i] * factors[j] * covariance[(3 * i + a, 3 * j + a)];
                        }
                    }
                    variance.max(0.0).sqrt()
                })
            });
            RefinedModule { center_m: lattice.position(c, r), sigma_m }
        })
        .collect();
    let along = lattice.step_col.normalize();
    let across = (lattice.step_row - along * along.dot(&lattice.step_row)).normalize();
    let (fill_col, fill_row) = fill(views, bench, lattice);
    let height = if bench.rows == 1 { lattice.step_row.norm() } else { lattice.step_row.norm() * fill_row };
    RefinedBench { modules, along, across, module_size_m: [lattice.step_col.norm() * fill_col, height] }
}

/// Share of the pitch that a module's face takes along and across the row: the median over all boxes.
fn fill(views: &[View<'_>], bench: &FusedBench, lattice: &Lattice) -> (f64, f64) {
    let (mut along, mut across) = (Vec::new(), Vec::new());
    for module in &bench.modules {
        let (c, r) = centered(bench, module.row, module.col);
        for o in &module.observations {
            let view = &views[o.view];
            let at = |dc: f64, dr: f64| project(view, &lattice.position(c + dc, r + dr)).map(|(pixel, _)| pixel);
            let ends = (at(-0.5, 0.0), at(0.5, 0.0), at(0.0, -0.5), at(0.0, 0.5));
            let (Some(west), Some(east), Some(north), Some(south)) = ends else { continue };
            let (step_u, step_v) = (east - west, south - north);
            let [a, b] = view.detections.detections[o.detection].quad.sides();
            let (u, v) =
                if a.dot(&step_u).abs() / a.norm() > b.dot(&step_u).abs() / b.norm() { (a, b) } else { (b, a) };
            along.push(u.norm() / step_u.norm());
            across.push(v.norm() / step_v.norm());
        }
    }
    // A column or row alone has no neighbour to overlap.
    let clamp = |values: Vec<f64>| median(values).unwrap_or(0.98).clamp(0.5, 0.998);
    (clamp(along), clamp(across))
}
