//! A point cloud with normals.

/// Points and their normals in the local frame, metres. `normals` is empty or as long as `positions`.
#[derive(Debug, Clone, Default)]
pub struct PointCloud {
    pub positions_m: Vec<[f32; 3]>,
    pub normals: Vec<[f32; 3]>,
}
