//! Why photos cannot be reconstructed: each sentence says what to do.

use heliomap_mapping::reconstruction::PhotoError;
use std::path::PathBuf;

/// Why photos cannot be reconstructed.
#[derive(Debug, thiserror::Error)]
pub enum ReconstructError {
    #[error("{} holds {found} photos: put at least {needed} overlapping ones there", folder.display())]
    TooFewPhotos { folder: PathBuf, found: usize, needed: usize },
    #[error("{} and {} have the same name, by which a photo is known: rename one of them", first.display(), second.display())]
    SameName { first: PathBuf, second: PathBuf },
    #[error(transparent)]
    Photo(#[from] PhotoError),
    #[error(
        "{found} of {photos} photos have a GNSS position with a height, {needed} are needed: give the photos as the camera \
         wrote them (with EXIF)"
    )]
    TooFewPositions { found: usize, photos: usize, needed: usize },
    #[error(
        "all photos were taken within {spread_m:.1} m of each other: a plant cannot be seen in depth from one place; fly on \
         between photos"
    )]
    OnePlace { spread_m: f64 },
    #[error(
        "{photo} states no focal length: give it with --focal, in pixels over the longer side of the photo (the focal length \
         in millimetres over the sensor's longer side)"
    )]
    NoFocalLength { photo: String },
    #[error(
        "the photos fit together, but not with their GNSS positions: are these of one flight, and not in one straight line?"
    )]
    NotAligned,
    #[error("{message}")]
    Refused { code: String, message: String },
    #[error(
        "{} cannot be started as a Python with pycolmap: {source}; run `make setup`, or name one with --reconstruct-python",
        python.display()
    )]
    NotStarted { python: PathBuf, source: std::io::Error },
    #[error("the reconstruction ended without a result ({status}): {last_words}")]
    Crashed { status: String, last_words: String },
    #[error("the reconstruction was cancelled")]
    Cancelled,
    #[error("{} cannot be written: {source}", path.display())]
    NotWritable { path: PathBuf, source: std::io::Error },
}

impl ReconstructError {
    /// A stable word for programs.
    pub fn code(&self) -> &str {
        match self {
            Self::TooFewPhotos { .. } => "too_few_images",
            Self::SameName { .. } => "image_name_twice",
            Self::Photo(error) => error.code(),
            Self::TooFewPositions { .. } => "too_few_positions",
            Self::OnePlace { .. } => "images_of_one_place",
            Self::NoFocalLength { .. } => "focal_length_unknown",
            Self::NotAligned => "reconstruction_not_aligned",
            Self::Refused { code, .. } => code,
            Self::NotStarted { .. } => "engine_missing",
            Self::Crashed { .. } => "engine_failed",
            Self::Cancelled => "cancelled",
            Self::NotWritable { .. } => "not_writable",
        }
    }
}
