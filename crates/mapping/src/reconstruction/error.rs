//! What can be wrong with a reconstruction: each sentence names the file and says what to do.

use std::path::PathBuf;

/// Why a reconstruction could not be read.
#[derive(Debug, thiserror::Error)]
pub enum ReconstructionError {
    #[error(
        "{} is missing: reconstruct the images first (OpenSfM leaves it in the project folder) and give that folder",
        path.display()
    )]
    Missing { path: PathBuf },
    #[error("{} cannot be read: {source}", path.display())]
    Unreadable { path: PathBuf, source: std::io::Error },
    #[error("{} has {bytes} bytes, more than the {limit} that are read: it is no file of this kind, or thin it first", path.display())]
    TooLarge { path: PathBuf, bytes: u64, limit: u64 },
    #[error("{} is not what OpenSfM writes: {what}; export it again", path.display())]
    Malformed { path: PathBuf, what: String },
    #[error("{} holds {value} where a finite number is expected ({place}): remove that shot or reconstruct again", path.display())]
    NotFinite { path: PathBuf, value: String, place: String },
    #[error(
        "{}: camera `{camera}` is of the unknown model `{model}`; perspective, brown, simple_radial, radial, fisheye and \
         fisheye_opencv can be read: undistort the images with the program that made them and give that reconstruction",
        path.display()
    )]
    UnknownCameraModel { path: PathBuf, camera: String, model: String },
    #[error("{} holds {found} shots: a plant cannot be mapped from fewer than two images", path.display())]
    TooFewShots { path: PathBuf, found: usize },
    #[error(
        "{} is not in a local frame: its cameras stand about ({east_m:.0}, {north_m:.0}) m, which is in no UTM zone at \
         reference_lla.json; give reconstruction.topocentric.json, which ODM leaves beside it",
        path.display()
    )]
    NotLocal { path: PathBuf, east_m: f64, north_m: f64 },
    #[error(
        "{} lies elsewhere than the sparse points and cameras of the reconstruction: it was made by another program, or is of \
         another frame or plant; give the cloud that OpenSfM made, or remove the file to map from the sparse points",
        path.display()
    )]
    CloudElsewhere { path: PathBuf },
    #[error("{} holds no points: densify again, or remove the file to map from the sparse points", path.display())]
    EmptyCloud { path: PathBuf },
    #[error("{} promises {promised} points but ends after {held}: it was cut short; copy it again", path.display())]
    TruncatedCloud { path: PathBuf, promised: u64, held: u64 },
    #[error("{} holds a cloud of {promised} points, more than the {limit} that are read: thin it first", path.display())]
    CloudTooLarge { path: PathBuf, promised: u64, limit: u64 },
    #[error("{} and {}: neither dense nor sparse points are there to locate modules with; run the reconstruction again", cloud.display(), reconstruction.display())]
    NoPoints { cloud: PathBuf, reconstruction: PathBuf },
}

impl ReconstructionError {
    /// A stable word for programs.
    pub fn code(&self) -> &'static str {
        match self {
            Self::Missing { .. } => "reconstruction_missing",
            Self::Unreadable { .. } => "file_unreadable",
            Self::TooLarge { .. } => "file_too_large",
            Self::Malformed { .. } => "reconstruction_malformed",
            Self::NotFinite { .. } => "reconstruction_not_finite",
            Self::UnknownCameraModel { .. } => "camera_model_unknown",
            Self::TooFewShots { .. } => "too_few_images",
            Self::NotLocal { .. } => "reconstruction_not_local",
            Self::CloudElsewhere { .. } => "point_cloud_elsewhere",
            Self::EmptyCloud { .. } => "point_cloud_empty",
            Self::TruncatedCloud { .. } => "point_cloud_truncated",
            Self::CloudTooLarge { .. } => "point_cloud_too_large",
            Self::NoPoints { .. } => "points_missing",
        }
    }
}
