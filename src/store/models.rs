//! Models of plants, their layers and features.

use super::digest::Digest;
use super::error::StoreError;
use super::ids::{JobId, SurveyId};
use super::listing::Page;
use heliomap_model::{Layer, ModuleId, PlantId, Warning};
use jiff::Timestamp;

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
    /// Durations of the stages, JSON, where the mapping ran without interruption.
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

/// Properties of a stored layer.
#[derive(Debug, Clone)]
pub struct LayerInfo {
    pub model_seq: i64,
    pub layer: Layer,
    /// Number of features.
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

/// A box of longitudes and latitudes, degrees. One across the line of 180 degrees goes on beyond it: its east is more than 180.
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

    /// The smallest box around boxes that are near each other; it goes on beyond the line of 180 degrees where they lie on
    /// both sides of it.
    pub fn around_all(boxes: impl Iterator<Item = Self> + Clone) -> Option<Self> {
        let plain = boxes.clone().reduce(Self::union)?;
        if plain.width_deg() <= 180.0 {
            return Some(plain);
        }
        let east = |one: Self| match one.min_lon < 0.0 {
            true => Self { min_lon: one.min_lon + 360.0, max_lon: one.max_lon + 360.0, ..one },
            false => one,
        };
        boxes.map(east).reduce(Self::union).filter(|beyond| beyond.width_deg() < plain.width_deg()).or(Some(plain))
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

    /// This box where features may be that begin from -180 to 180 and are at most so wide: the box, and what of it lies a turn
    /// about the globe to the west or to the east.
    pub fn turns(self, widest_deg: f64) -> impl Iterator<Item = Self> {
        let turned = move |by: f64| Self { min_lon: self.min_lon + by, max_lon: self.max_lon + by, ..self };
        let reached = move |turned: &Self| turned.min_lon <= 180.0 + widest_deg && turned.max_lon >= -180.0;
        [0.0, -360.0, 360.0].into_iter().map(turned).filter(reached)
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

/// Models.
#[async_trait::async_trait]
pub trait ModelStore: Send + Sync + 'static {
    /// A plant's models, newest first.
    async fn models(&self, plant: PlantId, page: Page) -> Result<Vec<Model>, StoreError>;
    /// One model of a plant; the newest without a version.
    async fn model(&self, plant: PlantId, version: Option<u32>) -> Result<Option<Model>, StoreError>;
    /// Properties of a stored layer.
    async fn layer(&self, model: &Model, layer: Layer) -> Result<Option<LayerInfo>, StoreError>;
    /// Features of a layer in the order of the model.
    async fn features(&self, layer: &LayerInfo, query: FeatureQuery) -> Result<Vec<Feature>, StoreError>;
    /// One module of a model.
    async fn module(&self, model: &Model, id: ModuleId) -> Result<Option<String>, StoreError>;
    /// The newest version of a plant's model that contains a module.
    async fn module_last_seen(&self, plant: PlantId, id: ModuleId) -> Result<Option<u32>, StoreError>;
}
