//! Models, their layers and features.

use super::super::{Db, Row, Rows, Tx};
use super::columns::{document, parsed, small, time, uuid};
use crate::store::error::StoreError;
use crate::store::ids::{JobId, SurveyId};
use crate::store::jobs::Claim;
use crate::store::listing::Page;
use crate::store::models::{
    Feature, FeatureQuery, GeoBox, LayerInfo, Model, ModelStore, NewFeature, NewLayer, NewModel,
};
use async_trait::async_trait;
use heliomap_model::{Layer, ModuleId, PlantId};
use jiff::Timestamp;
use sqlx::{QueryBuilder, Row as _};
use std::collections::BTreeMap;

macro_rules! model_columns {
    () => {
        "seq, plant_id, version, survey_id, job_id, sha256, size, warnings, created_ms"
    };
}

/// A box that covers less of its layer than this share is looked up by the index of positions.
const SMALL_BOX_SHARE: f64 = 0.05;

/// Features that one statement inserts. A row has eleven parameters, and SQLite takes 32,766 of them in one statement, Postgres
/// 65,535.
const FEATURES_AT_ONCE: usize = 500;

/// Features that one transaction inserts: some 30 ms, in which nobody else writes to an SQLite file.
const FEATURES_OF_PART: usize = 2000;

#[async_trait]
impl ModelStore for Rows {
    async fn models(&self, plant: PlantId, page: Page) -> Result<Vec<Model>, StoreError> {
        const MODELS: &str = concat!(
            "SELECT ",
            model_columns!(),
            " FROM models WHERE plant_id = $1 AND seq < $2 AND version > 0 ORDER BY seq DESC LIMIT $3"
        );
        let query = sqlx::query(MODELS)
            .bind(plant.to_string())
            .bind(page.after.unwrap_or(i64::MAX))
            .bind(i64::from(page.limit));
        query.fetch_all(&self.read).await?.iter().map(model).collect()
    }

    async fn model(&self, plant: PlantId, version: Option<u32>) -> Result<Option<Model>, StoreError> {
        const MODEL: &str = concat!("SELECT ", model_columns!(), " FROM models WHERE plant_id = $1 AND version = $2");
        const NEWEST_MODEL: &str = concat!(
            "SELECT ",
            model_columns!(),
            " FROM models WHERE plant_id = $1 AND version > 0 ORDER BY version DESC LIMIT 1"
        );
        let query = match version {
            Some(version) => sqlx::query(MODEL).bind(plant.to_string()).bind(i64::from(version)),
            None => sqlx::query(NEWEST_MODEL).bind(plant.to_string()),
        };
        query.fetch_optional(&self.read).await?.as_ref().map(model).transpose()
    }

    async fn layer(&self, model: &Model, layer: Layer) -> Result<Option<LayerInfo>, StoreError> {
        const LAYER: &str = "\
            SELECT features, properties, min_lon, min_lat, max_lon, max_lat, tallest_deg, widest_deg FROM layers \
            WHERE model_seq = $1 AND layer = $2";
        let query = sqlx::query(LAYER).bind(model.seq).bind(layer.as_str());
        let Some(row) = query.fetch_optional(&self.read).await? else { return Ok(None) };
        let min_lon: Option<f64> = row.try_get("min_lon")?;
        let extent = match min_lon {
            Some(min_lon) => Some(GeoBox {
                min_lon,
                min_lat: row.try_get("min_lat")?,
                max_lon: row.try_get("max_lon")?,
                max_lat: row.try_get("max_lat")?,
            }),
            None => None,
        };
        Ok(Some(LayerInfo {
            model_seq: model.seq,
            layer,
            features: row.try_get::<i64, _>("features")? as u64,
            properties: row.try_get("properties")?,
            extent,
            tallest_deg: row.try_get("tallest_deg")?,
            widest_deg: row.try_get("widest_deg")?,
        }))
    }

    async fn features(&self, layer: &LayerInfo, page: FeatureQuery) -> Result<Vec<Feature>, StoreError> {
        let Some(within) = page.within else { return self.features_at(layer, page).await };
        let mut found: BTreeMap<i64, Feature> = BTreeMap::new();
        for turned in within.turns(layer.widest_deg) {
            let part = self.features_at(layer, FeatureQuery { within: Some(turned), ..page }).await?;
            found.extend(part.into_iter().map(|feature| (feature.seq, feature)));
        }
        Ok(found.into_values().take(page.limit as usize).collect())
    }

    async fn module(&self, model: &Model, id: ModuleId) -> Result<Option<String>, StoreError> {
        const MODULE: &str = "SELECT feature FROM features WHERE id = $1 AND model_seq = $2 AND layer = 'modules'";
        let query = sqlx::query_scalar(MODULE).bind(id.to_string()).bind(model.seq);
        Ok(query.fetch_optional(&self.read).await?)
    }

    async fn module_last_seen(&self, plant: PlantId, id: ModuleId) -> Result<Option<u32>, StoreError> {
        const MODULE_LAST_SEEN: &str = "\
            SELECT models.version FROM features JOIN models ON models.seq = features.model_seq \
            WHERE features.id = $1 AND features.layer = 'modules' AND models.plant_id = $2 AND models.version > 0 ORDER BY models.version DESC LIMIT 1";
        let query = sqlx::query_scalar(MODULE_LAST_SEEN).bind(id.to_string()).bind(plant.to_string());
        let version: Option<i64> = query.fetch_optional(&self.read).await?;
        version.map(|version| small("version", version)).transpose()
    }
}

impl Rows {
    /// Features of a layer, of those with longitudes as they are stored.
    async fn features_at(&self, layer: &LayerInfo, page: FeatureQuery) -> Result<Vec<Feature>, StoreError> {
        const FEATURES: &str = "\
            SELECT seq, feature FROM features WHERE model_seq = $1 AND layer = $2 AND seq > $3 ORDER BY seq LIMIT $4";
        /// A box that covers little of the layer: in each strip from `$10` to `$11` take the latitudes from the index by place (which
        /// holds all that the condition asks for), and put what is in the box in order. `$9` is the southernmost latitude at which
        /// a feature that reaches into the box may begin. Cross joins and unary pluses hold the planner to that way.
        const FEATURES_IN_SMALL_BOX: &str = "\
            WITH RECURSIVE strips (strip) AS (SELECT CAST($10 AS BIGINT) UNION ALL SELECT strip + 1 FROM strips WHERE strip < $11), \
            near AS MATERIALIZED (SELECT place.seq AS seq FROM strips CROSS JOIN features AS place \
            WHERE place.model_seq = $1 AND place.layer = $2 AND place.strip = strips.strip AND place.min_lat BETWEEN $9 AND $8 \
            AND place.max_lat >= $6 AND place.min_lon <= $7 AND place.max_lon >= $5 AND +place.seq > $3 \
            ORDER BY +place.seq LIMIT $4) \
            SELECT features.seq, features.feature FROM near CROSS JOIN features \
            WHERE features.model_seq = $1 AND features.layer = $2 AND features.seq = near.seq ORDER BY near.seq";
        /// A box that covers much of the layer: walk the layer in order and leave out what lies elsewhere. The unary plus
        /// keeps the planner from the index by place.
        const FEATURES_IN_LARGE_BOX: &str = "\
            SELECT seq, feature FROM features WHERE model_seq = $1 AND layer = $2 AND seq > $3 \
            AND +min_lon <= $7 AND +max_lon >= $5 AND +min_lat <= $8 AND +max_lat >= $6 ORDER BY seq LIMIT $4";
        let share = |covered: f64, whole: f64| if whole > 0.0 { (covered / whole).clamp(0.0, 1.0) } else { 1.0 };
        let is_small = |within: GeoBox, extent: GeoBox| {
            share(within.width_deg(), extent.width_deg()) * share(within.height_deg(), extent.height_deg())
                < SMALL_BOX_SHARE
        };
        let statement = match (page.within, layer.extent) {
            (None, _) => FEATURES,
            (Some(within), Some(extent)) if is_small(within, extent) => FEATURES_IN_SMALL_BOX,
            (Some(_), _) => FEATURES_IN_LARGE_BOX,
        };
        let mut query = sqlx::query(statement)
            .bind(layer.model_seq)
            .bind(layer.layer.as_str())
            .bind(page.after.unwrap_or(0))
            .bind(i64::from(page.limit));
        if let Some(within) = page.within {
            query = query.bind(within.min_lon).bind(within.min_lat).bind(within.max_lon).bind(within.max_lat);
            if let Some(extent) = layer.extent.filter(|extent| is_small(within, *extent)) {
                // Features east of the line of 180 degrees begin at -180 again.
                let [west, east] =
                    if extent.max_lon > 180.0 { [-180.0, 180.0] } else { [extent.min_lon, extent.max_lon] };
                query = query
                    .bind(within.min_lat - layer.tallest_deg)
                    .bind(strip((within.min_lon - layer.widest_deg).max(west)))
                    .bind(strip(within.max_lon.min(east)));
            }
        }
        let rows = query.fetch_all(&self.read).await?;
        rows.iter().map(|row| Ok(Feature { seq: row.try_get("seq")?, json: row.try_get("feature")? })).collect()
    }
}

impl Rows {
    /// Stores the model of a claimed job part by part where nobody sees it yet, so that others write in between; `None` where
    /// the claim is lost. Its version is below zero until [`publish_model`]; what a job left that ended otherwise is deleted
    /// with the next.
    pub(super) async fn stage_model(
        &self,
        claim: &Claim,
        new: &NewModel,
        now: Timestamp,
    ) -> Result<Option<i64>, StoreError> {
        const FORGET_STAGED: &str = "\
            DELETE FROM models WHERE version < 0 \
            AND (job_id = $1 OR NOT EXISTS (SELECT 1 FROM jobs WHERE jobs.id = models.job_id AND jobs.state = 'running'))";
        const STAGE_MODEL: &str = "\
            INSERT INTO models (plant_id, version, survey_id, job_id, sha256, size, warnings, created_ms) \
            VALUES ($1, $2, $3, $4, $5, $6, $7, $8) RETURNING seq";
        let mut tx = self.begin().await?;
        if !is_claimed(&mut tx, claim).await? {
            tx.rollback().await?;
            return Ok(None);
        }
        sqlx::query(FORGET_STAGED).bind(claim.job.id.to_string()).execute(&mut *tx).await?;
        let seq: i64 = sqlx::query_scalar(STAGE_MODEL)
            .bind(claim.job.plant.to_string())
            .bind(-claim.job.seq)
            .bind(claim.job.survey.to_string())
            .bind(claim.job.id.to_string())
            .bind(new.sha256.to_string())
            .bind(new.size as i64)
            .bind(serde_json::json!(new.warnings).to_string())
            .bind(now.as_millisecond())
            .fetch_one(&mut *tx)
            .await?;
        for layer in &new.layers {
            insert_layer(&mut tx, seq, layer).await?;
        }
        tx.commit().await?;
        for layer in &new.layers {
            let mut first = 1;
            for part in layer.features.chunks(FEATURES_OF_PART) {
                let mut tx = self.begin().await?;
                if !is_claimed(&mut tx, claim).await? {
                    tx.rollback().await?;
                    return Ok(None);
                }
                for features in part.chunks(FEATURES_AT_ONCE) {
                    insert_features(&mut tx, seq, layer.layer, first, features).await?;
                    first += features.len() as i64;
                }
                tx.commit().await?;
            }
        }
        Ok(Some(seq))
    }
}

/// Whether a worker has its job still.
pub async fn is_claimed(tx: &mut Tx, claim: &Claim) -> Result<bool, StoreError> {
    const IS_CLAIMED: &str = "SELECT 1 FROM jobs WHERE id = $1 AND fence = $2 AND state = 'running'";
    let query = sqlx::query(IS_CLAIMED).bind(claim.job.id.to_string()).bind(claim.fence);
    Ok(query.fetch_optional(&mut **tx).await?.is_some())
}

/// Gives a staged model its version, by which it is seen; `None` where the plant has that version already.
pub async fn publish_model(tx: &mut Tx, seq: i64, new: &NewModel) -> Result<Option<Model>, StoreError> {
    const PUBLISH_MODEL: &str = concat!(
        "UPDATE models SET version = $2 WHERE seq = $1 AND NOT EXISTS (SELECT 1 FROM models AS other \
         WHERE other.plant_id = models.plant_id AND other.version = $2) RETURNING ",
        model_columns!()
    );
    let query = sqlx::query(PUBLISH_MODEL).bind(seq).bind(i64::from(new.version));
    match query.fetch_optional(&mut **tx).await {
        // Another worker gives its model this version at the same moment.
        Err(sqlx::Error::Database(error)) if error.is_unique_violation() => Ok(None),
        row => row?.as_ref().map(model).transpose(),
    }
}

async fn insert_layer(tx: &mut Tx, model_seq: i64, layer: &NewLayer) -> Result<(), StoreError> {
    const INSERT_LAYER: &str = "\
        INSERT INTO layers (model_seq, layer, features, properties, min_lon, min_lat, max_lon, max_lat, tallest_deg, \
        widest_deg) VALUES ($1, $2, $3, $4, $5, $6, $7, $8, $9, $10)";
    let extents = || layer.features.iter().filter_map(|feature| feature.extent);
    let extent = GeoBox::around_all(extents());
    sqlx::query(INSERT_LAYER)
        .bind(model_seq)
        .bind(layer.layer.as_str())
        .bind(layer.features.len() as i64)
        .bind(&layer.properties)
        .bind(extent.map(|b| b.min_lon))
        .bind(extent.map(|b| b.min_lat))
        .bind(extent.map(|b| b.max_lon))
        .bind(extent.map(|b| b.max_lat))
        .bind(extents().map(GeoBox::height_deg).fold(0.0, f64::max))
        .bind(extents().map(GeoBox::width_deg).fold(0.0, f64::max))
        .execute(&mut **tx)
        .await?;
    Ok(())
}

/// Inserts features that follow each other in a layer, the first with the sequence number `first`, by one statement.
async fn insert_features(
    tx: &mut Tx,
    model_seq: i64,
    layer: Layer,
    first: i64,
    features: &[NewFeature],
) -> Result<(), StoreError> {
    /// Rows follow, as many as one statement may have.
    const INSERT_FEATURES: &str =
        "INSERT INTO features (model_seq, layer, seq, id, label, feature, min_lon, min_lat, max_lon, max_lat, strip) ";
    let mut insert = QueryBuilder::<Db>::new(INSERT_FEATURES);
    insert.push_values((first..).zip(features), |mut row, (seq, feature)| {
        row.push_bind(model_seq)
            .push_bind(layer.as_str())
            .push_bind(seq)
            .push_bind(&feature.id)
            .push_bind(&feature.label)
            .push_bind(&feature.json)
            .push_bind(feature.extent.map(|b| b.min_lon))
            .push_bind(feature.extent.map(|b| b.min_lat))
            .push_bind(feature.extent.map(|b| b.max_lon))
            .push_bind(feature.extent.map(|b| b.max_lat))
            .push_bind(feature.extent.map(|b| strip(b.min_lon)));
    });
    // The number of the last rows differs from layer to layer: their statement is not cached.
    insert.build().persistent(features.len() == FEATURES_AT_ONCE).execute(&mut **tx).await?;
    Ok(())
}

/// The strip from pole to pole in which a longitude lies, by which features are found; migrations compute the same.
fn strip(lon: f64) -> i64 {
    /// Some 30 to 55 m where people live.
    const WIDTH_DEG: f64 = 0.0005;
    ((lon + 180.0) / WIDTH_DEG).floor() as i64
}

fn model(row: &Row) -> Result<Model, StoreError> {
    Ok(Model {
        seq: row.try_get("seq")?,
        plant: PlantId(uuid(row, "plant_id")?),
        version: small("version", row.try_get("version")?)?,
        survey: SurveyId(uuid(row, "survey_id")?),
        job: JobId(uuid(row, "job_id")?),
        sha256: parsed(row, "sha256")?,
        size: row.try_get::<i64, _>("size")? as u64,
        warnings: document(row, "warnings")?,
        created: time(row, "created_ms")?,
    })
}
