//! A point cloud with normals, and the index that finds the points near a ray.

use nalgebra::Vector3;
use std::collections::HashSet;
use std::hash::{BuildHasherDefault, Hasher};

/// Points and their normals in the local frame, metres. `normals` is empty or as long as `positions_m`.
#[derive(Debug, Clone, Default)]
pub struct PointCloud {
    pub positions_m: Vec<[f32; 3]>,
    pub normals: Vec<[f32; 3]>,
}

/// Gathers points one by one and thins them as they come, so that memory stays bounded whatever their number: once there
/// are more than `most`, only the first point of each cube of a regular grid is kept, the cubes as small as the bound
/// allows. The same points in the same order give the same cloud.
#[derive(Debug)]
pub struct ThinningCloud {
    most: usize,
    /// Edge of the cubes; `None` while every point is kept.
    cube_m: Option<f64>,
    taken: HashSet<u64, BuildHasherDefault<CubeHasher>>,
    positions_m: Vec<[f32; 3]>,
}

impl ThinningCloud {
    /// Smallest cubes, metres: finer than any dense cloud.
    const FIRST_CUBE_M: f64 = 0.02;

    /// An empty cloud that will hold `most` points at most (at least one), with room for `expected` of them.
    pub fn new(most: usize, expected: usize) -> Self {
        let most = most.max(1);
        Self { most, cube_m: None, taken: HashSet::default(), positions_m: Vec::with_capacity(expected.min(most)) }
    }

    /// Takes a point in, metres.
    pub fn push(&mut self, position_m: [f32; 3]) {
        if self.cube_m.is_some_and(|cube_m| !self.taken.insert(cube(position_m, cube_m))) {
            return;
        }
        while self.positions_m.len() >= self.most {
            let cube_m = self.cube_m.map_or(Self::FIRST_CUBE_M, |cube_m| cube_m * 1.25);
            self.cube_m = Some(cube_m);
            let taken = &mut self.taken;
            taken.clear();
            self.positions_m.retain(|kept| taken.insert(cube(*kept, cube_m)));
            if !self.taken.insert(cube(position_m, cube_m)) {
                return;
            }
        }
        self.positions_m.push(position_m);
    }

    /// The cloud, and the edge of the cubes that it was thinned to, metres, if it was.
    pub fn finish(self) -> (PointCloud, Option<f64>) {
        (PointCloud { positions_m: self.positions_m, normals: Vec::new() }, self.cube_m)
    }
}

/// Number of the cube that a point lies in: 21 bits a coordinate, so that cubes of 2 cm repeat after 42 km.
fn cube(position_m: [f32; 3], cube_m: f64) -> u64 {
    position_m.iter().fold(0, |key, coordinate| {
        let index = (f64::from(*coordinate) / cube_m).floor() as i64;
        key << 21 | (index as u64 & 0x1F_FFFF)
    })
}

/// Cube numbers are spread by a multiplication: a keyed hash would cost more than all the rest.
#[derive(Debug, Default, Clone, Copy)]
struct CubeHasher(u64);

impl Hasher for CubeHasher {
    fn finish(&self) -> u64 {
        self.0
    }

    fn write(&mut self, bytes: &[u8]) {
        for byte in bytes {
            self.write_u64(u64::from(*byte));
        }
    }

    fn write_u64(&mut self, value: u64) {
        let mixed = (self.0 ^ value).wrapping_mul(0x9E37_79B9_7F4A_7C15);
        self.0 = mixed ^ (mixed >> 29);
    }
}

/// A point near a ray.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct NearRay {
    /// Index into the cloud.
    pub point: u32,
    /// Distance to the ray, metres.
    pub distance_m: f64,
    /// Distance along the ray, metres.
    pub depth_m: f64,
}

/// A grid over the horizontal plane: the points of each cell lie next to each other, and each cell knows its lowest and
/// highest point. Built once in linear time; a ray visits only the cells that it passes at a height where they have
/// points.
#[derive(Debug)]
pub struct CloudIndex<'a> {
    cloud: &'a PointCloud,
    cell_m: f64,
    origin: [f64; 2],
    columns: usize,
    rows: usize,
    /// Start of each cell in `order`; one more entry than cells.
    starts: Vec<u32>,
    order: Vec<u32>,
    /// Lowest and highest point of each cell, metres.
    heights_m: Vec<[f32; 2]>,
    /// Lowest and highest point of all, metres.
    height_range_m: [f64; 2],
}

impl<'a> CloudIndex<'a> {
    /// Indexes a cloud with about `points_per_cell` points in each cell that has any.
    pub fn new(cloud: &'a PointCloud, points_per_cell: f64) -> Self {
        let mut low = [f64::INFINITY; 2];
        let mut high = [f64::NEG_INFINITY; 2];
        for p in &cloud.positions_m {
            for axis in 0..2 {
                low[axis] = low[axis].min(f64::from(p[axis]));
                high[axis] = high[axis].max(f64::from(p[axis]));
            }
        }
        if cloud.positions_m.is_empty() {
            (low, high) = ([0.0; 2], [0.0; 2]);
        }
        let area = ((high[0] - low[0]) * (high[1] - low[1])).max(1e-6);
        let count = cloud.positions_m.len().max(1) as f64;
        // Never more cells than four times the points: a far outlier must not blow the grid up.
        let cell_m = (area * points_per_cell / count).sqrt().max((area / (4.0 * count)).sqrt()).max(0.05);
        let columns = ((high[0] - low[0]) / cell_m) as usize + 1;
        let rows = ((high[1] - low[1]) / cell_m) as usize + 1;
        let cell_of = |p: &[f32; 3]| {
            let column = (((f64::from(p[0]) - low[0]) / cell_m) as usize).min(columns - 1);
            let row = (((f64::from(p[1]) - low[1]) / cell_m) as usize).min(rows - 1);
            row * columns + column
        };
        let mut starts = vec![0_u32; columns * rows + 1];
        let mut heights_m = vec![[f32::INFINITY, f32::NEG_INFINITY]; columns * rows];
        for p in &cloud.positions_m {
            let cell = cell_of(p);
            starts[cell + 1] += 1;
            heights_m[cell] = [heights_m[cell][0].min(p[2]), heights_m[cell][1].max(p[2])];
        }
        for cell in 1..starts.len() {
            starts[cell] += starts[cell - 1];
        }
        let mut next = starts.clone();
        let mut order = vec![0_u32; cloud.positions_m.len()];
        for (index, p) in cloud.positions_m.iter().enumerate() {
            let cell = cell_of(p);
            order[next[cell] as usize] = index as u32;
            next[cell] += 1;
        }
        let height_range_m = cloud.positions_m.iter().fold([f64::INFINITY, f64::NEG_INFINITY], |range, p| {
            [range[0].min(f64::from(p[2])), range[1].max(f64::from(p[2]))]
        });
        Self { cloud, cell_m, origin: low, columns, rows, starts, order, heights_m, height_range_m }
    }

    /// The position of a point, metres.
    pub fn position_m(&self, point: u32) -> Vector3<f64> {
        let p = self.cloud.positions_m[point as usize];
        Vector3::new(f64::from(p[0]), f64::from(p[1]), f64::from(p[2]))
    }

    /// The normal of a point, where the cloud has normals.
    pub fn normal(&self, point: u32) -> Option<Vector3<f64>> {
        self.cloud.normals.get(point as usize).map(|n| Vector3::new(f64::from(n[0]), f64::from(n[1]), f64::from(n[2])))
    }

    /// All points within `radius_m` of the ray from `origin` along the unit vector `direction`, which must point
    /// downwards; in the order of distance. Empty where the ray does not go down.
    pub fn near_ray(&self, origin: &Vector3<f64>, direction: &Vector3<f64>, radius_m: f64) -> Vec<NearRay> {
        let mut found = Vec::new();
        if direction.z > -0.05 || self.order.is_empty() {
            return found;
        }
        let [lowest_m, highest_m] = self.height_range_m;
        self.near_segment(origin, direction, radius_m, lowest_m, highest_m, &mut found);
        found.sort_by(|a, b| a.distance_m.total_cmp(&b.distance_m).then(a.point.cmp(&b.point)));
        found
    }

    fn near_segment(
        &self,
        origin: &Vector3<f64>,
        direction: &Vector3<f64>,
        radius_m: f64,
        lowest_m: f64,
        highest_m: f64,
        found: &mut Vec<NearRay>,
    ) {
        let depth_of = |height: f64| ((height - origin.z) / direction.z).max(0.0);
        let (from, to) = (depth_of(highest_m + radius_m), depth_of(lowest_m - radius_m));
        let at = |depth: f64| origin + direction * depth;
        let (start, end) = (at(from), at(to));
        let cell = |value: f64, axis: usize, limit: usize| {
            (((value - self.origin[axis]) / self.cell_m).floor().max(0.0) as usize).min(limit - 1)
        };
        let (x_low, x_high) = (start.x.min(end.x) - radius_m, start.x.max(end.x) + radius_m);
        let (y_low, y_high) = (start.y.min(end.y) - radius_m, start.y.max(end.y) + radius_m);
        let extent = [self.columns as f64 * self.cell_m, self.rows as f64 * self.cell_m];
        if x_high < self.origin[0] || y_high < self.origin[1] {
            return;
        }
        if x_low > self.origin[0] + extent[0] || y_low > self.origin[1] + extent[1] {
            return;
        }
        let reach = self.cell_m * std::f64::consts::FRAC_1_SQRT_2 + radius_m;
        let horizontal = direction.x.hypot(direction.y);
        for row in cell(y_low, 1, self.rows)..=cell(y_high, 1, self.rows) {
            for column in cell(x_low, 0, self.columns)..=cell(x_high, 0, self.columns) {
                let index = row * self.columns + column;
                let (first, last) = (self.starts[index] as usize, self.starts[index + 1] as usize);
                if first == last {
                    continue;
                }
                // The stretch of the ray over this cell, and its heights there.
                let middle = [
                    self.origin[0] + (column as f64 + 0.5) * self.cell_m - origin.x,
                    self.origin[1] + (row as f64 + 0.5) * self.cell_m - origin.y,
                ];
                if horizontal > 1e-9 {
                    let across = (middle[0] * direction.y - middle[1] * direction.x) / horizontal;
                    if across.abs() > reach {
                        continue;
                    }
                    let along = (middle[0] * direction.x + middle[1] * direction.y) / (horizontal * horizontal);
                    let span = reach / horizontal;
                    let high = origin.z + direction.z * (along - span).max(from) + radius_m;
                    let low = origin.z + direction.z * (along + span).min(to) - radius_m;
                    let [cell_low, cell_high] = self.heights_m[index];
                    if high < f64::from(cell_low) || low > f64::from(cell_high) {
                        continue;
                    }
                }
                for &point in &self.order[first..last] {
                    let offset = self.position_m(point) - origin;
                    let depth_m = offset.dot(direction);
                    let squared = offset.norm_squared() - depth_m * depth_m;
                    if squared <= radius_m * radius_m && depth_m > 0.0 {
                        found.push(NearRay { point, distance_m: squared.max(0.0).sqrt(), depth_m });
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn a_cloud_is_thinned_evenly_and_never_holds_more_than_it_may() {
        let mut thinning = ThinningCloud::new(5_000, 40_000);
        // 20 m by 20 m in steps of 10 cm, in an order that jumps about.
        for k in 0..40_000_u32 {
            let index = (k * 7_919) % 40_000;
            thinning.push([(index % 200) as f32 * 0.1, (index / 200) as f32 * 0.1, 400.0]);
            assert!(thinning.positions_m.len() <= 5_000);
        }
        let (cloud, cube_m) = thinning.finish();
        let cube_m = cube_m.unwrap();
        assert!((0.2..0.5).contains(&cube_m), "{cube_m}");
        assert!(cloud.positions_m.len() > 1_500, "{}", cloud.positions_m.len());
        let mut per_metre = [0; 400];
        for p in &cloud.positions_m {
            per_metre[p[1] as usize * 20 + p[0] as usize] += 1;
        }
        assert!(per_metre.iter().all(|count| (4..=25).contains(count)), "{per_metre:?}");
    }

    #[test]
    fn few_points_are_kept_as_they_are() {
        let mut thinning = ThinningCloud::new(10, 3);
        let points = [[1.0, 2.0, 3.0], [1.0, 2.0, 3.0], [4.0, 5.0, 6.0]];
        points.iter().for_each(|p| thinning.push(*p));
        let (cloud, cube_m) = thinning.finish();
        assert_eq!((cloud.positions_m.as_slice(), cube_m), (points.as_slice(), None));
    }

    proptest! {
        #[test]
        fn the_index_finds_what_a_scan_finds(
            points in prop::collection::vec([-20.0..20.0_f32, -20.0..20.0_f32, 0.0..6.0_f32], 1..400),
            aim in [-15.0..15.0_f64, -15.0..15.0_f64], from in [-30.0..30.0_f64, -30.0..30.0_f64], radius in 0.1..3.0_f64,
        ) {
            let cloud = PointCloud { positions_m: points, normals: vec![] };
            let index = CloudIndex::new(&cloud, 5.0);
            let origin = Vector3::new(from[0], from[1], 50.0);
            let direction = (Vector3::new(aim[0], aim[1], 0.0) - origin).normalize();
            let mut found: Vec<u32> = index.near_ray(&origin, &direction, radius).iter().map(|near| near.point).collect();
            found.sort_unstable();
            let expected: Vec<u32> = (0..cloud.positions_m.len() as u32)
                .filter(|&k| {
                    let offset = index.position_m(k) - origin;
                    (offset - direction * offset.dot(&direction)).norm() <= radius
                })
                .collect();
            prop_assert_eq!(found, expected);
        }
    }
}
