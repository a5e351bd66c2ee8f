//! Pure maths, without any vocabulary of the project: cameras and poses, geodesy, quadrilaterals in the image,
//! robust fits, and point clouds with a spatial index.

pub mod camera;
pub mod point_cloud;
pub mod pose;
pub mod quad;
pub mod similarity;

pub use camera::Camera;
pub use point_cloud::PointCloud;
pub use pose::Pose;
pub use quad::Quad;
pub use similarity::Similarity;
