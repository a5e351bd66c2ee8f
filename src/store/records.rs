//! What the store takes and gives.

use super::access::OrganisationId;
use super::blobs::Digest;
use super::survey_path::SurveyPath;
use heliomap_mapping::reconstruction::PhotoFacts;
use heliomap_model::{Layer, PlantId, Warning};
use jiff::Timestamp;
use std::fmt;
use std::str::FromStr;
use std::time::Duration;
use uuid::Uuid;

macro_rules! row_id {
    ($(#[$doc:meta])* $name:ident) => {
        $(#[$doc])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, serde::Serialize, serde::Deserialize)]
        #[serde(transparent)]
        pub struct $name(pub Uuid);

        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                self.0.fmt(f)
            }
        }
    };
}

pub(super) use row_id;

row_id!(
    /// Identifies a survey: one flight over a plant.
    SurveyId
);
row_id!(
    /// Identifies a job: one mapping of a survey.
    JobId
);

/// A part of a list: at most `limit` rows after the one with the sequence number `after`.
#[derive(Debug, Clone, Copy)]
pub struct Page {
    pub after: Option<i64>,
    pub limit: u32,
}

/// A span of time: from its beginning on, until before its end; open where there is none.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct TimeSpan {
    pub since: Option<Timestamp>,
    pub until: Option<Timestamp>,
}

/// Something created, or found because it was there already.
#[derive(Debug, Clone)]
pub enum Created<T> {
    New(T),
    Existing(T),
}

/// A photovoltaic plant.
#[derive(Debug, Clone)]
pub struct Plant {
    pub seq: i64,
    pub id: PlantId,
    pub organisation: OrganisationId,
    pub name: String,
    pub created: Timestamp,
}

/// One flight over a plant: photos and what structure from motion made of them.
#[derive(Debug, Clone)]
pub struct Survey {
    pub seq: i64,
    pub id: SurveyId,
    pub plant: PlantId,
    pub name: String,
    pub created: Timestamp,
}

/// A file of a survey.
#[derive(Debug, Clone)]
pub struct FileRecord {
    pub path: SurveyPath,
    /// Bytes.
    pub size: u64,
    pub sha256: Digest,
    /// Width and height in pixels, where it is an image.
    pub size_px: Option<[u32; 2]>,
    /// What was found in it, where it is a photo.
    pub photo: Option<PhotoFacts>,
    /// The images that it names, sorted, where it is a reconstruction that could be read.
    pub shots: Option<Vec<String>>,
    pub stored: Timestamp,
}

/// A blob that rows name.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BlobRecord {
    pub plant: PlantId,
    pub sha256: Digest,
    /// Bytes.
    pub size: u64,
}

/// What must be at a file's place for another to be put there.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Wanted {
    /// Some file.
    Anything,
    /// Nothing.
    Nothing,
    /// A file with one of these digests.
    OneOf(Vec<Digest>),
    /// Nothing, or a file with none of these digests.
    NoneOf(Vec<Digest>),
}

impl Wanted {
    /// Whether a file with this digest, or nothing, is as wanted.
    pub fn holds(&self, there: Option<Digest>) -> bool {
        match (self, there) {
            (Self::Anything, Some(_)) | (Self::Nothing, None) => true,
            (Self::OneOf(digests), Some(there)) => digests.contains(&there),
            (Self::NoneOf(digests), there) => there.is_none_or(|there| !digests.contains(&there)),
            _ => false,
        }
    }
}

/// What became of a file that was put.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FileWritten {
    Created,
    Replaced,
    /// The same bytes were there.
    Unchanged,
}

/// Where a job stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum JobState {
    Queued,
    Running,
    Succeeded,
    Failed,
    Cancelled,
}

impl JobState {
    /// All states.
    pub const ALL: [Self; 5] = [Self::Queued, Self::Running, Self::Succeeded, Self::Failed, Self::Cancelled];

    /// The word in rows and answers.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Queued => "queued",
            Self::Running => "running",
            Self::Succeeded => "succeeded",
            Self::Failed => "failed",
            Self::Cancelled => "cancelled",
        }
    }

    /// Whether nothing will change any more.
    pub fn is_final(self) -> bool {
        matches!(self, Self::Succeeded | Self::Failed | Self::Cancelled)
    }
}

impl FromStr for JobState {
    type Err = ();

    fn from_str(text: &str) -> Result<Self, ()> {
        Self::ALL.into_iter().find(|state| state.as_str() == text).ok_or(())
    }
}

/// How far a job has come: `done` of `total` units of a stage.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Progress {
    pub stage: String,
    pub done: u64,
    pub total: u64,
    /// Milliseconds until the job ends, where that can be told.
    pub remaining_ms: Option<u64>,
}

/// Something that a job has found so far.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Checkpoint {
    /// What it is of.
    pub name: String,
    pub document: Vec<u8>,
}

/// One mapping of a survey.
#[derive(Debug, Clone)]
pub struct Job {
    pub seq: i64,
    pub id: JobId,
    pub plant: PlantId,
    pub survey: SurveyId,
    pub state: JobState,
    /// The mapping's options, JSON.
    pub options: String,
    /// The higher, the sooner.
    pub priority: i32,
    pub progress: Option<Progress>,
    pub warnings: Vec<Warning>,
    /// Code and message of the last failure.
    pub error: Option<(String, String)>,
    /// How often it was started.
    pub attempt: u32,
    pub max_attempts: u32,
    pub cancel_requested: bool,
    /// The version of the model that it made.
    pub model_version: Option<u32>,
    pub created: Timestamp,
    pub started: Option<Timestamp>,
    pub finished: Option<Timestamp>,
}

/// How the queue stands, whoever's jobs they are.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Queue {
    /// How many jobs are in each state, all states.
    pub jobs: Vec<(JobState, u64)>,
    /// How many wait for a worker and may be taken now.
    pub waiting: u64,
    /// How long the oldest of these has been waiting.
    pub oldest: Option<Duration>,
    /// How many images of running jobs wait for a worker to help.
    pub images: u64,
}

/// Connections to the database.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Pool {
    pub name: &'static str,
    pub open: u64,
    /// Of those that are open.
    pub idle: u64,
}

/// A mapping asked for.
#[derive(Debug, Clone)]
pub struct JobRequest {
    pub plant: PlantId,
    pub survey: SurveyId,
    /// The mapping's options, JSON.
    pub options: String,
    /// The higher, the sooner.
    pub priority: i32,
    /// How often it is started without getting anywhere before it fails.
    pub max_attempts: u32,
}

/// What became of a mapping asked for.
#[derive(Debug, Clone)]
pub enum Enqueued {
    New(Job),
    /// The survey's unfinished job.
    Existing(Job),
}

/// What became of a cancellation asked for.
#[derive(Debug, Clone)]
pub enum Cancelled {
    /// It is cancelled, or its worker was asked to stop.
    Accepted(Job),
    /// It had ended before.
    TooLate(Job),
}

/// A job in the hands of a worker. The fence tells this claim from every later one.
#[derive(Debug, Clone)]
pub struct Claim {
    pub job: Job,
    pub fence: i64,
}

/// What a worker hears when it reports.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Heartbeat {
    Continue,
    /// Someone cancelled the job.
    Cancel,
    /// The job is gone or in the hands of another worker.
    Lost,
}

/// The longest time between two attempts at a job.
pub const LONGEST_BACKOFF: Duration = Duration::from_secs(600);

/// How a claimed job ends without a model.
#[derive(Debug, Clone)]
pub enum Ending {
    /// For good.
    Failed { code: String, message: String },
    /// To be tried again, unless that was the last attempt of those that got nowhere: `backoff` after the first of these,
    /// four times as long after each further one, at most [`LONGEST_BACKOFF`].
    Retry { code: String, message: String, backoff: Duration },
    /// To be tried after `pause` as if it had not been claimed, by a worker that can.
    Declined { code: String, message: String, pause: Duration },
    /// Because someone asked for it.
    Cancelled,
    /// Back to the queue as if it had not been claimed, because the worker stops.
    Released,
}

/// What became of a model offered.
#[derive(Debug, Clone)]
pub enum Completed {
    Done(Box<Model>),
    /// The claim was lost; nothing was written.
    Fenced,
    /// The plant has that version already; nothing was written.
    Outdated,
}

/// A model of a plant.
#[derive(Debug, Clone)]
pub struct Model {
    pub seq: i64,
    pub plant: PlantId,
    pub version: u32,
    pub survey: SurveyId,
    pub job: JobId,
    /// The whole model as a blob.
    pub sha256: Digest,
    /// Bytes of the blob.
    pub size: u64,
    pub warnings: Vec<Warning>,
    pub created: Timestamp,
}

/// A model to be stored.
#[derive(Debug, Clone)]
pub struct NewModel {
    pub version: u32,
    pub sha256: Digest,
    pub size: u64,
    pub warnings: Vec<Warning>,
    /// What each stage took, JSON, where the mapping ran in one go.
    pub stage_ms: Option<String>,
    pub layers: Vec<NewLayer>,
}

/// A layer of a model to be stored.
#[derive(Debug, Clone)]
pub struct NewLayer {
    pub layer: Layer,
    /// The collection's own members, a JSON object.
    pub properties: String,
    pub features: Vec<NewFeature>,
}

/// A feature to be stored.
#[derive(Debug, Clone)]
pub struct NewFeature {
    pub id: String,
    pub label: String,
    /// The GeoJSON feature.
    pub json: String,
    pub extent: Option<GeoBox>,
}

/// What a layer of a model holds.
#[derive(Debug, Clone)]
pub struct LayerInfo {
    pub model_seq: i64,
    pub layer: Layer,
    /// How many features.
    pub features: u64,
    /// The collection's own members, a JSON object.
    pub properties: String,
    pub extent: Option<GeoBox>,
    /// The largest extent of one feature from south to north, degrees.
    pub tallest_deg: f64,
    /// The largest extent of one feature from west to east, degrees.
    pub widest_deg: f64,
}

/// A part of a layer: at most `limit` features after the one with the sequence number `after` that touch a box.
#[derive(Debug, Clone, Copy)]
pub struct FeatureQuery {
    pub after: Option<i64>,
    pub limit: u32,
    pub within: Option<GeoBox>,
}

/// A stored feature.
#[derive(Debug, Clone)]
pub struct Feature {
    pub seq: i64,
    /// The GeoJSON feature.
    pub json: String,
}

/// A box of longitudes and latitudes, degrees.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GeoBox {
    pub min_lon: f64,
    pub min_lat: f64,
    pub max_lon: f64,
    pub max_lat: f64,
}

impl GeoBox {
    /// The smallest box around positions; `None` without any.
    pub fn around(positions: impl IntoIterator<Item = [f64; 2]>) -> Option<Self> {
        positions.into_iter().fold(None, |extent: Option<Self>, [lon, lat]| {
            Some(extent.map_or(Self { min_lon: lon, min_lat: lat, max_lon: lon, max_lat: lat }, |extent| Self {
                min_lon: extent.min_lon.min(lon),
                min_lat: extent.min_lat.min(lat),
                max_lon: extent.max_lon.max(lon),
                max_lat: extent.max_lat.max(lat),
            }))
        })
    }

    /// The smallest box around both.
    pub fn union(self, other: Self) -> Self {
        Self {
            min_lon: self.min_lon.min(other.min_lon),
            min_lat: self.min_lat.min(other.min_lat),
            max_lon: self.max_lon.max(other.max_lon),
            max_lat: self.max_lat.max(other.max_lat),
        }
    }

    /// Degrees from west to east.
    pub fn width_deg(self) -> f64 {
        self.max_lon - self.min_lon
    }

    /// Degrees from south to north.
    pub fn height_deg(self) -> f64 {
        self.max_lat - self.min_lat
    }
}
