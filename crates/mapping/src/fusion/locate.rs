//! From pixels to 3D: where the rays of a piece of bench meet the point cloud (paper, 3.4).
//!
//! The paper takes the cloud points nearest to each ray. Here they are only the samples of a surface: over one piece of a
//! bench the inverse depth is a smooth (for a plane: exactly affine) function of the pixel, fitted robustly, so that
//! modules without points under glare, or with points on the ground below, stand where their neighbours say.

use super::View;
use super::piece_lattice::PieceLattice;
use crate::geometry::point_cloud::CloudIndex;
use crate::geometry::{Camera, PointCloud, Pose};
use crate::layout::lattice::Sample;
use crate::layout::{End, LatticeMap, Piece};
use crate::reconstruction::Shot;
use nalgebra::{DMatrix, DVector, Vector2, Vector3};
use rayon::prelude::*;

/// Points averaged for one ray (paper: "a small set of nearest points").
const NEAREST: usize = 8;

/// A module in a piece, with its place in 3D.
#[derive(Debug, Clone)]
pub struct LocatedCell {
    pub row: i32,
    pub col: i32,
    /// Index into the view's detections; `None` for a hypothesis.
    pub detection: Option<usize>,
    /// Centre in the image, pixels.
    pub center_px: Vector2<f64>,
    /// Centre in the local frame by the smoothed surface, metres.
    pub position_m: Vector3<f64>,
    /// What the cloud itself says at this ray (paper, 3.4), metres.
    pub cloud_m: Option<Vector3<f64>>,
}

/// A piece of a bench with its place in 3D, oriented alike in all views: columns run eastwards (or southwards, where rows
/// run north-south), rows a quarter turn clockwise from that as seen from above.
#[derive(Debug, Clone)]
pub struct LocatedPiece {
    pub view: usize,
    /// Sorted by row and column; both start at 0.
    pub cells: Vec<LocatedCell>,
    pub rows: i32,
    pub cols: i32,
    pub west: End,
    pub east: End,
    pub north: End,
    pub south: End,
    pub bridges: Vec<i32>,
    /// Lattice coordinates (column, row) to east and north, metres.
    pub ground: LatticeMap,
    /// How well the cloud tells where the piece stands, one standard deviation in the horizontal plane, metres.
    pub sigma_m: f64,
    /// Where it stands by its boxes, once the pitch of its type is known.
    pub(super) lattice: Option<Box<PieceLattice>>,
}

impl LocatedPiece {
    /// The cell at a place.
    pub fn cell(&self, row: i32, col: i32) -> Option<&LocatedCell> {
        self.cells.binary_search_by_key(&(row, col), |cell| (cell.row, cell.col)).ok().map(|index| &self.cells[index])
    }

    /// Middle of the piece, east and north in metres.
    pub fn middle(&self) -> Vector2<f64> {
        self.ground.pixel(f64::from(self.cols - 1) / 2.0, f64::from(self.rows - 1) / 2.0)
    }

    /// Metres per column and per row in the middle, in the horizontal plane.
    pub fn pitch_m(&self) -> [Vector2<f64>; 2] {
        self.ground.pitch(f64::from(self.cols - 1) / 2.0, f64::from(self.rows - 1) / 2.0)
    }

    /// Fits `ground` to the cells again.
    pub fn refit(&mut self, fallback: [Vector2<f64>; 2]) {
        let samples: Vec<Sample> = self
            .cells
            .iter()
            .filter(|cell| cell.detection.is_some())
            .map(|cell| Sample { col: f64::from(cell.col), row: f64::from(cell.row), pixel: cell.position_m.xy() })
            .collect();
        self.ground = LatticeMap::fit(&samples, fallback[0], fallback[1]);
    }

    /// The piece turned by half a turn: what was west is east, what was north is south.
    fn turned_around(mut self) -> Self {
        let [u, v] = self.pitch_m();
        for cell in &mut self.cells {
            cell.row = self.rows - 1 - cell.row;
            cell.col = self.cols - 1 - cell.col;
        }
        self.cells.sort_by_key(|cell| (cell.row, cell.col));
        std::mem::swap(&mut self.west, &mut self.east);
        std::mem::swap(&mut self.north, &mut self.south);
        let last = self.cols - 1;
        // A bridge after column c has its far end at the next column that holds a detection.
        let far_end = |bridge: i32| {
            (bridge + 1..=last)
                .find(|col| self.cells.iter().any(|cell| cell.col == last - col && cell.detection.is_some()))
                .unwrap_or(last)
        };
        self.bridges = self.bridges.iter().map(|&bridge| last - far_end(bridge)).collect();
        self.bridges.sort_unstable();
        self.refit([-u, -v]);
        self
    }
}

/// All pieces of all views in 3D.
#[derive(Debug, Clone)]
pub struct Located {
    pub pieces: Vec<LocatedPiece>,
}

/// Locates every piece of every view in the cloud.
pub fn locate(views: &[View<'_>], cloud: &PointCloud) -> Located {
    let index = CloudIndex::new(cloud, 12.0);
    let radius_m = typical_spacing_m(cloud).clamp(0.1, 1.5) * 2.5;
    let pieces: Vec<Vec<LocatedPiece>> = views
        .par_iter()
        .enumerate()
        .map(|(view_index, view)| locate_view(view_index, view, &index, radius_m))
        .collect();
    let mut pieces: Vec<LocatedPiece> = pieces.into_iter().flatten().collect();
    let boundary = heading_boundary(&pieces);
    for piece in &mut pieces {
        let [u, _] = piece.pitch_m();
        let heading = u.y.atan2(u.x);
        // Headings within half a turn clockwise from the boundary run forwards.
        if (boundary - heading).rem_euclid(std::f64::consts::TAU) > std::f64::consts::PI {
            let turned = piece.clone().turned_around();
            *piece = turned;
        }
    }
    Located { pieces }
}

/// Mean distance of neighbouring points if the cloud were spread evenly over the ground it covers, metres.
fn typical_spacing_m(cloud: &PointCloud) -> f64 {
    let mut occupied = std::collections::HashSet::new();
    let stride = (cloud.positions_m.len() / 200_000).max(1);
    for p in cloud.positions_m.iter().step_by(stride) {
        occupied.insert((p[0].floor() as i64, p[1].floor() as i64));
    }
    (occupied.len() as f64 / cloud.positions_m.len().max(1) as f64).sqrt()
}

/// The heading, radians, past which "forwards" begins: about north-east, so that rows run eastwards or southwards, but
/// where the fewest rows head, so that parallel rows never run in opposite directions.
fn heading_boundary(pieces: &[LocatedPiece]) -> f64 {
    let headings: Vec<(f64, f64)> = pieces
        .iter()
        .map(|piece| {
            let [u, _] = piece.pitch_m();
            (u.y.atan2(u.x), piece.cells.len() as f64)
        })
        .collect();
    let mut best = (f64::INFINITY, 45.0_f64);
    for offset in [0.0, 4.0, -4.0, 8.0, -8.0, 12.0, -12.0, 16.0, -16.0, 20.0, -20.0] {
        let boundary = (45.0_f64 + offset).to_radians();
        let mass: f64 = headings
            .iter()
            .map(|(heading, weight)| {
                let off = (heading - boundary).rem_euclid(std::f64::consts::PI);
                let off = off.min(std::f64::consts::PI - off);
                weight * (-(off / 0.1).powi(2)).exp()
            })
            .sum();
        if mass < best.0 - 1e-9 {
            best = (mass, 45.0 + offset);
        }
    }
    best.1.to_radians()
}

/// A ray sample: normalised image coordinates, and the inverse depth that the cloud gives there.
struct DepthSample {
    normalised: Vector2<f64>,
    inverse_depth: f64,
    weight: f64,
}

/// What the cloud says at each cell of a piece, metres.
type CloudAtCells = Vec<Option<Vector3<f64>>>;

fn locate_view(view_index: usize, view: &View<'_>, cloud: &CloudIndex<'_>, radius_m: f64) -> Vec<LocatedPiece> {
    let (camera, pose) = (&view.shot.camera, &view.shot.pose);
    let sampled: Vec<(Vec<DepthSample>, CloudAtCells)> = view
        .layout
        .pieces
        .iter()
        .map(|piece| {
            let mut samples = Vec::new();
            let at_cells = piece
                .cells
                .iter()
                .map(|cell| {
                    let center = cell.quad.center();
                    let point = cloud_point(view.shot, center, cloud, radius_m);
                    if let Some(point) = point {
                        samples.push(depth_sample(camera, pose, center, &point));
                    }
                    // One row alone does not show its tilt by its centres.
                    if piece.rows == 1 {
                        for corner in cell.quad.corners {
                            let pixel = center + (corner - center) * 0.6;
                            if let Some(point) = cloud_point(view.shot, pixel, cloud, radius_m) {
                                samples.push(depth_sample(camera, pose, pixel, &point));
                            }
                        }
                    }
                    point
                })
                .collect();
            (samples, at_cells)
        })
        .collect();
    // The whole view as one plane: what pieces without points of their own fall back on.
    let all: Vec<&DepthSample> = sampled.iter().flat_map(|(samples, _)| samples).collect();
    let Some(view_plane) = DepthModel::fit(&all, None, 3) else { return Vec::new() };
    view.layout
        .pieces
        .iter()
        .zip(&sampled)
        .map(|(piece, (samples, at_cells))| {
            let samples: Vec<&DepthSample> = samples.iter().collect();
            let terms = if piece.cols >= 12 && samples.len() >= 24 { 4 } else { 3 };
            let along = {
                let ends = [0.0, f64::from(piece.cols - 1).max(1.0)]
                    .map(|col| camera.normalised_from_pixel(piece.map.pixel(col, 0.0)));
                (ends[1] - ends[0]).try_normalize(1e-12).unwrap_or(Vector2::x())
            };
            let model = DepthModel::fit(&samples, Some((&view_plane, along)), terms).unwrap_or(view_plane);
            located_piece(view_index, view.shot, piece, &model, at_cells)
        })
        .collect()
}

fn depth_sample(camera: &Camera, pose: &Pose, pixel: Vector2<f64>, point: &Vector3<f64>) -> DepthSample {
    DepthSample {
        normalised: camera.normalised_from_pixel(pixel),
        inverse_depth: 1.0 / pose.to_camera(point).z,
        weight: 1.0,
    }
}

/// The mean of the points nearest to the ray of a pixel, pulled onto the ray (paper, 3.4). Of several surfaces along the
/// ray the one nearest to the camera counts.
fn cloud_point(shot: &Shot, pixel: Vector2<f64>, cloud: &CloudIndex<'_>, radius_m: f64) -> Option<Vector3<f64>> {
    let origin = shot.pose.center();
    let direction = shot.pose.direction_to_world(&shot.camera.bearing(pixel));
    let near = cloud.near_ray(&origin, &direction, radius_m);
    if near.len() < 2 {
        return None;
    }
    let mut depths: Vec<f64> = near.iter().take(NEAREST).map(|n| n.depth_m).collect();
    depths.sort_by(f64::total_cmp);
    let median = depths[depths.len() / 2];
    let close: Vec<f64> = depths.into_iter().filter(|depth| (depth - median).abs() < 0.5).collect();
    let depth = close.iter().sum::<f64>() / close.len() as f64;
    Some(origin + direction * depth)
}

/// Inverse depth over the normalised image: `a + b x + c y`, exact for a plane, with one bend along the row.
#[derive(Clone, Copy)]
struct DepthModel {
    origin: Vector2<f64>,
    along: Vector2<f64>,
    scale: f64,
    /// Median of the samples.
    typical: f64,
    terms: [f64; 4],
}

impl DepthModel {
    fn basis(&self, at: Vector2<f64>) -> [f64; 4] {
        let p = (at - self.origin) / self.scale;
        let t = p.dot(&self.along);
        [1.0, p.x, p.y, t * t]
    }

    fn inverse_depth(&self, at: Vector2<f64>) -> f64 {
        self.basis(at).iter().zip(self.terms).map(|(basis, term)| basis * term).sum()
    }

    /// Robust fit. With a prior plane, the slopes lean towards it where the samples leave them open.
    fn fit(samples: &[&DepthSample], prior: Option<(&Self, Vector2<f64>)>, count: usize) -> Option<Self> {
        if samples.is_empty() || (prior.is_none() && samples.len() < 3) {
            return None;
        }
        let mut sorted: Vec<f64> = samples.iter().map(|s| s.inverse_depth).collect();
        sorted.sort_by(f64::total_cmp);
        let median = sorted[sorted.len() / 2];
        let origin = samples.iter().map(|s| s.normalised).sum::<Vector2<f64>>() / samples.len() as f64;
        let scale = samples.iter().map(|s| (s.normalised - origin).norm()).fold(1e-6, f64::max);
        let along = prior.map_or(Vector2::x(), |(_, along)| along);
        let mut model = Self { origin, along, scale, typical: median, terms: [median, 0.0, 0.0, 0.0] };
        // The prior's slopes in this model's units; a slope of one degree is its standard deviation.
        let slopes = prior.map(|(plane, _)| {
            let step = 1e-3;
            let slope = |d: Vector2<f64>| {
                (plane.inverse_depth(origin + d * step) - plane.inverse_depth(origin - d * step)) / (2.0 * step) * scale
            };
            [slope(Vector2::x()), slope(Vector2::y())]
        });
        if let Some([x, y]) = slopes {
            model.terms[1] = x;
            model.terms[2] = y;
        }
        // Depth errors of about 2 % of a metre per 40 m are noise; a metre is the ground below.
        let mut cut = 1.5 * median * median;
        for _ in 0..8 {
            let mut normal = DMatrix::<f64>::zeros(count, count);
            let mut right = DVector::<f64>::zeros(count);
            for sample in samples {
                let basis = model.basis(sample.normalised);
                let t = (sample.inverse_depth - model.inverse_depth(sample.normalised)) / cut;
                if t.abs() >= 1.0 {
                    continue;
                }
                let weight = sample.weight * (1.0 - t * t).powi(2);
                for i in 0..count {
                    for j in 0..count {
                        normal[(i, j)] += weight * basis[i] * basis[j];
                    }
                    right[i] += weight * basis[i] * sample.inverse_depth;
                }
            }
            if let Some(slopes) = slopes {
                let weight = 0.02;
                for (i, slope) in slopes.iter().enumerate() {
                    normal[(i + 1, i + 1)] += weight;
                    right[i + 1] += weight * slope;
                }
            }
            for i in 0..count {
                normal[(i, i)] += 1e-6;
            }
            if count == 4 {
                normal[(3, 3)] += 0.05;
            }
            let solution = normal.cholesky()?.solve(&right);
            for i in 0..count {
                model.terms[i] = solution[i];
            }
            let mut residuals: Vec<f64> =
                samples.iter().map(|s| (s.inverse_depth - model.inverse_depth(s.normalised)).abs()).collect();
            residuals.sort_by(f64::total_cmp);
            cut = (4.0 * 1.4826 * residuals[residuals.len() / 2]).clamp(0.08 * median * median, 1.5 * median * median);
        }
        model.terms.iter().all(|term| term.is_finite()).then_some(model)
    }

    /// The point in the world that a pixel shows.
    fn point(&self, shot: &Shot, pixel: Vector2<f64>) -> Vector3<f64> {
        let normalised = shot.camera.normalised_from_pixel(pixel);
        // Far from its samples a slope must not run through the horizon.
        let depth = 1.0 / self.inverse_depth(normalised).clamp(0.5 * self.typical, 2.0 * self.typical);
        let camera = Vector3::new(normalised.x, normalised.y, 1.0) * depth;
        shot.pose.direction_to_world(&camera) + shot.pose.center()
    }
}

fn located_piece(
    view: usize,
    shot: &Shot,
    piece: &Piece,
    model: &DepthModel,
    at_cells: &[Option<Vector3<f64>>],
) -> LocatedPiece {
    let cells: Vec<LocatedCell> = piece
        .cells
        .iter()
        .zip(at_cells)
        .map(|(cell, cloud_m)| {
            let center_px = cell.quad.center();
            LocatedCell {
                row: cell.row,
                col: cell.col,
                detection: cell.detection,
                center_px,
                position_m: model.point(shot, center_px),
                cloud_m: *cloud_m,
            }
        })
        .collect();
    let (col, row) = (f64::from(piece.cols - 1) / 2.0, f64::from(piece.rows - 1) / 2.0);
    let ground_at = |c: f64, r: f64| model.point(shot, piece.map.pixel(c, r)).xy();
    let fallback =
        [ground_at(col + 0.5, row) - ground_at(col - 0.5, row), ground_at(col, row + 0.5) - ground_at(col, row - 0.5)];
    let mut located = LocatedPiece {
        view,
        rows: piece.rows,
        cols: piece.cols,
        west: piece.west,
        east: piece.east,
        north: piece.north,
        south: piece.south,
        bridges: piece.bridges.clone(),
        ground: piece.map.clone(),
        sigma_m: cloud_sigma_m(&cells),
        lattice: None,
        cells,
    };
    located.refit(fallback);
    located
}

/// Standard deviation of a piece's place in the horizontal plane by the scatter of the cloud about its surface, and by how
/// much of it has points at all, metres. The cloud scatters along the rays, which are steep: of that little is horizontal.
fn cloud_sigma_m(cells: &[LocatedCell]) -> f64 {
    let mut scatter: Vec<f64> =
        cells.iter().filter_map(|cell| Some((cell.cloud_m? - cell.position_m).xy().norm())).collect();
    if scatter.is_empty() {
        return 0.5;
    }
    scatter.sort_by(f64::total_cmp);
    let without = 1.0 - scatter.len() as f64 / cells.len() as f64;
    0.03 + 0.3 * scatter[scatter.len() / 2] + 0.3 * without
}
