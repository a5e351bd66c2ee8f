//! Why a mapping could not be made.

use crate::detection::DetectionError;
use crate::detection::external::BoxError;
use crate::reconstruction::ReadError;
use crate::refinement::ControlError;

/// Why a mapping could not be made.
#[derive(Debug, thiserror::Error)]
pub enum MapError {
    #[error("the mapping was cancelled")]
    Cancelled,
    /// Bad input: the sentence names the file and says what to do. Trying again does not help.
    #[error("{message}")]
    Input { code: &'static str, message: String },
    /// Something outside the input failed (a full disk, a missing runtime); trying again may help.
    #[error("{message}")]
    Environment { message: String },
}

impl From<ReadError> for MapError {
    fn from(error: ReadError) -> Self {
        match error {
            ReadError::NotFetched { .. } => Self::Environment { message: error.to_string() },
            _ => Self::Input { code: error.code(), message: error.to_string() },
        }
    }
}

impl From<ControlError> for MapError {
    fn from(error: ControlError) -> Self {
        Self::Input { code: "control_invalid", message: error.to_string() }
    }
}

impl From<BoxError> for MapError {
    fn from(error: BoxError) -> Self {
        Self::Input { code: "boxes_invalid", message: error.to_string() }
    }
}

impl From<DetectionError> for MapError {
    fn from(error: DetectionError) -> Self {
        Self::Environment { message: error.to_string() }
    }
}
