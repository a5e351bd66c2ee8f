//! Why an attempt at a job failed.

use crate::store::StoreError;
use heliomap_mapping::pipeline::MapError;

/// Why an attempt at a job made no model.
#[derive(Debug, thiserror::Error)]
pub(crate) enum AttemptError {
    #[error(transparent)]
    Map(#[from] MapError),
    #[error(transparent)]
    Store(#[from] StoreError),
    #[error("prepare the folder of the job: {0}")]
    Folder(#[from] std::io::Error),
    #[error("cannot read the job's options: {0}")]
    Options(serde_json::Error),
    #[error("cannot read the plant's model {version}: {source}")]
    PreviousModel { version: u32, source: serde_json::Error },
    #[error("the mapper panicked")]
    Panicked,
}
