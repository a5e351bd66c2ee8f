//! Where a file belongs.

use super::protocol::wrong;
use crate::http::error::ApiError;
use crate::http::state::AppState;
use crate::store::{Content, ImageName, SurveyId, SurveyPath};
use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use std::collections::HashMap;

/// The place that stands for a whole archive in place of one file.
const ARCHIVE: &str = "reconstruction";

/// Where a file belongs, by what its client told: `path`, its place in the survey's folder (or `reconstruction` for an
/// archive), or else `filename` or `name`, that of a photo.
pub(super) enum Place {
    File(SurveyPath),
    Archive,
}

impl Place {
    pub(super) fn of(metadata: &str) -> Result<Self, ApiError> {
        let mut told: HashMap<&str, String> = HashMap::new();
        for pair in metadata.split(',').map(str::trim).filter(|pair| !pair.is_empty()) {
            let (name, value) = pair.split_once(' ').unwrap_or((pair, ""));
            let value = BASE64_STANDARD.decode(value.trim()).ok().and_then(|bytes| String::from_utf8(bytes).ok());
            told.insert(name, value.ok_or_else(|| wrong(format!("{name} in Upload-Metadata is no base64 of UTF-8")))?);
        }
        match (told.get("path"), told.get("filename").or(told.get("name"))) {
            (Some(path), _) if path == ARCHIVE => Ok(Self::Archive),
            (Some(path), _) => Ok(Self::File(SurveyPath::parse(path)?)),
            (None, Some(name)) => Ok(Self::File(SurveyPath::of_image(&ImageName::parse(name)?))),
            (None, None) => {
                Err(wrong("Upload-Metadata must tell `filename` (of a photo) or `path` (in the survey's folder)"))
            }
        }
    }

    /// Whether so many bytes may be there already.
    pub(super) async fn may_hold(&self, state: &AppState, survey: SurveyId, length: u64) -> Result<bool, ApiError> {
        Ok(match self {
            Self::File(path) => state.store.file(survey, path).await?.is_some_and(|file| file.size == length),
            Self::Archive => !state.store.files(survey).await?.is_empty(),
        })
    }

    /// As a client tells it.
    pub(super) fn told(&self) -> &str {
        match self {
            Self::File(path) => path.as_str(),
            Self::Archive => ARCHIVE,
        }
    }

    pub(super) fn name(&self) -> &str {
        match self {
            Self::File(path) => path.as_str(),
            Self::Archive => "the archive",
        }
    }

    pub(super) fn max_bytes(&self, state: &AppState) -> u64 {
        match self {
            Self::Archive => state.limits.max_archive_size,
            Self::File(path) if path.content() == Content::Image => state.limits.max_image_size,
            Self::File(_) => state.limits.max_file_size,
        }
    }
}
