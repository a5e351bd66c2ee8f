//! What structure from motion gives us, as one type, with one reader per producer.

mod entropy;
pub mod error;
mod excerpt;
pub mod exif;
mod folder;
mod jpeg;
pub mod opensfm;
pub mod photo;
mod plausible;
pub mod ply;
pub mod quality;
pub mod xmp;

use crate::geometry::{Camera, PointCloud, Pose};
pub use error::ReconstructionError;
pub use folder::ProjectFolder;
use heliomap_model::GeodeticReference;
use nalgebra::Vector3;
pub use photo::{Photo, PhotoError, PhotoFacts};

/// One photo: its camera and its pose. Pixels are those of the undistorted image.
#[derive(Debug, Clone)]
pub struct Shot {
    /// File name of the original image, the key of everything.
    pub name: String,
    /// Free of distortion, at the size of the image on disk.
    pub camera: Camera,
    pub pose: Pose,
    /// Where the GNSS receiver put the camera, local frame, metres.
    pub gnss_enu_m: Option<Vector3<f64>>,
}

/// A reconstructed scene in a local east-north-up frame.
#[derive(Debug, Clone)]
pub struct Reconstruction {
    pub reference: GeodeticReference,
    /// Whether place and scale come from GNSS or control; otherwise both are arbitrary.
    pub georeferenced: bool,
    /// Sorted by name.
    pub shots: Vec<Shot>,
    /// Sparse points (tie points), metres.
    pub sparse_points_m: Vec<Vector3<f64>>,
    /// The dense cloud, where there is one.
    pub dense: Option<PointCloud>,
}

/// Something about the input that a person should know.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Note {
    /// A stable word.
    pub code: &'static str,
    /// One sentence.
    pub message: String,
}

/// A project as read from disk: the scene, and the photo of each shot.
#[derive(Debug)]
pub struct Project {
    pub reconstruction: Reconstruction,
    /// One per shot, in the same order.
    pub photos: Vec<Photo>,
    pub notes: Vec<Note>,
}

/// Why a project cannot be mapped as it is.
#[derive(Debug, thiserror::Error)]
pub enum ReadError {
    #[error(transparent)]
    Reconstruction(#[from] ReconstructionError),
    #[error(transparent)]
    Photo(PhotoError),
    #[error(
        "{reconstruction} is of other images: it names {shot} and others, of which none is in images/ (there: {image}); \
         add the images that were reconstructed, or the reconstruction of these"
    )]
    OtherImages { reconstruction: String, shot: String, image: String },
    #[error(
        "{count} shots of {reconstruction} have no image in images/ or undistorted/images/ ({shots}): add them, or remove \
         these shots from the reconstruction"
    )]
    ShotWithoutImage { reconstruction: String, shots: String, count: usize },
    /// Where the photo is kept did not give it; trying again may help.
    #[error("{name} cannot be fetched: {reason}")]
    NotFetched { name: String, reason: String },
}

impl ReadError {
    /// A stable word for programs.
    pub fn code(&self) -> &'static str {
        match self {
            Self::Reconstruction(error) => error.code(),
            Self::Photo(error) => error.code(),
            Self::OtherImages { .. } => "reconstruction_of_other_images",
            Self::ShotWithoutImage { .. } => "shot_without_image",
            Self::NotFetched { .. } => "image_not_fetched",
        }
    }
}
