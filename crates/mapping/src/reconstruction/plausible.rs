//! Does a reconstruction hang together: its cameras with GNSS, its cloud with its points and cameras.

use super::{Note, Reconstruction, ReconstructionError};
use crate::geometry::PointCloud;
use nalgebra::Vector3;
use rstar::RTree;
use std::path::Path;

/// Cameras further off their GNSS positions than this, in the median, are of another place, metres.
const MAX_FROM_GNSS_M: f64 = 20.0;
/// Points of the cloud, and sparse points, that are compared.
const SAMPLE: usize = 20_000;
/// A sparse point is on the cloud if a point of the cloud is within this share of the height of the cameras above it.
const NEAR_SHARE: f64 = 0.1;
/// Least share of sparse points on the cloud. A sound cloud may cover a part of what the photos show, but not less.
const MIN_NEAR: f64 = 0.05;
/// Fewest sparse points that decide; where there are fewer, the cloud is compared with the cameras.
const MIN_POINTS: usize = 30;
/// The cloud of a survey lies within this many heights of the cameras, measured along the ground.
const MAX_HEIGHTS_AWAY: f64 = 20.0;

/// A note where the camera centres are far from where the GNSS receiver put them.
pub(super) fn far_from_gnss(reconstruction: &Reconstruction) -> Option<Note> {
    let shots = reconstruction.shots.iter();
    let offsets = shots.filter_map(|shot| Some((shot.pose.center() - shot.gnss_enu_m?).norm())).collect();
    let median = median(offsets)?;
    (median > MAX_FROM_GNSS_M).then(|| Note {
        code: "far_from_gnss",
        message: format!(
            "camera centres lie {median:.0} m (median) from their GNSS positions: is reference_lla.json of the same project?"
        ),
    })
}

/// Refuses a dense cloud, read from `path`, that lies elsewhere than the sparse points or the cameras: of another program, in
/// another frame, or of another plant.
///
/// # Errors
/// [`ReconstructionError::CloudElsewhere`].
pub(super) fn check_cloud(path: &Path, reconstruction: &Reconstruction) -> Result<(), ReconstructionError> {
    let Some(cloud) = &reconstruction.dense else { return Ok(()) };
    let dense = sample(cloud);
    let centers: Vec<Vector3<f64>> = reconstruction.shots.iter().map(|shot| shot.pose.center()).collect();
    let sparse = &reconstruction.sparse_points_m;
    let ground = if sparse.len() >= MIN_POINTS { sparse.clone() } else { dense.clone() };
    let height_m =
        match (median(centers.iter().map(|c| c.z).collect()), median(ground.iter().map(|point| point.z).collect())) {
            (Some(cameras), Some(ground)) => (cameras - ground).abs().max(1.0),
            _ => return Ok(()),
        };
    let agrees = if sparse.len() >= MIN_POINTS {
        near_share(&dense, sparse, NEAR_SHARE * height_m) >= MIN_NEAR
    } else {
        let middle = |points: &[Vector3<f64>]| {
            [0, 1].map(|axis| median(points.iter().map(|point| point[axis]).collect()).unwrap_or(f64::NAN))
        };
        let (cloud, cameras) = (middle(&dense), middle(&centers));
        (cloud[0] - cameras[0]).hypot(cloud[1] - cameras[1]) <= MAX_HEIGHTS_AWAY * height_m
    };
    if agrees { Ok(()) } else { Err(ReconstructionError::CloudElsewhere { path: path.to_owned() }) }
}

/// Share of `points` that have one of `cloud` within `radius_m`.
fn near_share(cloud: &[Vector3<f64>], points: &[Vector3<f64>], radius_m: f64) -> f64 {
    let tree = RTree::bulk_load(cloud.iter().map(|point| [point.x, point.y, point.z]).collect());
    let stride = points.len().div_ceil(SAMPLE).max(1);
    let mut compared = 0;
    let near = points.iter().step_by(stride).filter(|point| {
        compared += 1;
        let nearest = tree.nearest_neighbor([point.x, point.y, point.z]);
        nearest.is_some_and(|near| (Vector3::from(*near) - **point).norm() <= radius_m)
    });
    let near = near.count();
    near as f64 / f64::from(compared.max(1))
}

fn sample(cloud: &PointCloud) -> Vec<Vector3<f64>> {
    let stride = cloud.positions_m.len().div_ceil(SAMPLE).max(1);
    cloud.positions_m.iter().step_by(stride).map(|p| Vector3::from(p.map(f64::from))).collect()
}

fn median(mut values: Vec<f64>) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}
