//! Rows as values.

use super::super::Row;
use crate::store::requests::KeptAnswer;
use crate::store::{
    ApiKey, AuditEntry, BlobRecord, Delivery, DeliveryId, Digest, FileRecord, Job, JobId, KeyId, Model, Organisation,
    OrganisationId, Plant, Progress, Quotas, StoreError, Survey, SurveyId, SurveyPath, Upload, UploadId, Usage,
    Webhook, WebhookId,
};
use heliomap_model::{PlantId, Warning};
use jiff::Timestamp;
use serde::de::DeserializeOwned;
use sqlx::Row as _;
use std::str::FromStr;
use uuid::Uuid;

pub fn plant(row: &Row) -> Result<Plant, StoreError> {
    Ok(Plant {
        seq: row.try_get("seq")?,
        id: PlantId(uuid(row, "id")?),
        organisation: OrganisationId(uuid(row, "organisation_id")?),
        name: row.try_get("name")?,
        created: time(row, "created_ms")?,
    })
}

pub fn organisation(row: &Row) -> Result<Organisation, StoreError> {
    Ok(Organisation {
        id: OrganisationId(uuid(row, "id")?),
        name: row.try_get("name")?,
        created: time(row, "created_ms")?,
    })
}

pub fn usage(row: &Row) -> Result<Usage, StoreError> {
    let count = |column: &str| Ok::<_, StoreError>(row.try_get::<i64, _>(column)? as u64);
    let quota = |column: &str| Ok::<_, StoreError>(row.try_get::<Option<i64>, _>(column)?.map(|quota| quota as u64));
    Ok(Usage {
        bytes: count("bytes")?,
        announced_bytes: count("announced_bytes")?,
        plants: count("plants")?,
        own: Quotas { bytes: quota("max_bytes")?, plants: quota("max_plants")? },
    })
}

pub fn key(row: &Row) -> Result<ApiKey, StoreError> {
    let plants: Option<String> = row.try_get("plants")?;
    Ok(ApiKey {
        seq: row.try_get("seq")?,
        id: KeyId(uuid(row, "id")?),
        organisation: OrganisationId(uuid(row, "organisation_id")?),
        name: row.try_get("name")?,
        prefix: row.try_get("prefix")?,
        scopes: words("scopes", row.try_get("scopes")?)?,
        plants: plants.map(|plants| words("plants", plants)).transpose()?,
        created: time(row, "created_ms")?,
        expires: optional_time(row, "expires_ms")?,
        revoked: optional_time(row, "revoked_ms")?,
        last_used: optional_time(row, "last_used_ms")?,
    })
}

pub fn audit_entry(row: &Row) -> Result<AuditEntry, StoreError> {
    let key_id: Option<String> = row.try_get("key_id")?;
    let key_name: Option<String> = row.try_get("key_name")?;
    Ok(AuditEntry {
        organisation: OrganisationId(uuid(row, "organisation_id")?),
        at: time(row, "at_ms")?,
        key: match key_id.zip(key_name) {
            Some((_, name)) => Some((KeyId(uuid(row, "key_id")?), name)),
            None => None,
        },
        subject: row.try_get("subject")?,
        method: row.try_get("method")?,
        path: row.try_get("path")?,
        status: small("status", row.try_get("status")?)?,
        request_id: row.try_get("request_id")?,
    })
}

pub fn survey(row: &Row) -> Result<Survey, StoreError> {
    Ok(Survey {
        seq: row.try_get("seq")?,
        id: SurveyId(uuid(row, "id")?),
        plant: PlantId(uuid(row, "plant_id")?),
        name: row.try_get("name")?,
        created: time(row, "created_ms")?,
    })
}

pub fn path(row: &Row) -> Result<SurveyPath, StoreError> {
    let path: String = row.try_get("path")?;
    SurveyPath::parse(&path).map_err(|_| StoreError::Corrupt { what: "path of a file", value: path })
}

pub fn digest_and_path(row: &Row) -> Result<(Digest, SurveyPath), StoreError> {
    Ok((parsed(row, "sha256")?, path(row)?))
}

pub fn blob(row: &Row) -> Result<BlobRecord, StoreError> {
    let size: i64 = row.try_get("size")?;
    Ok(BlobRecord { plant: PlantId(uuid(row, "plant_id")?), sha256: parsed(row, "sha256")?, size: size as u64 })
}

pub fn file(row: &Row) -> Result<FileRecord, StoreError> {
    let width_px = optional_small(row, "width_px")?;
    let height_px = optional_small(row, "height_px")?;
    Ok(FileRecord {
        path: path(row)?,
        size: row.try_get::<i64, _>("size")? as u64,
        sha256: parsed(row, "sha256")?,
        size_px: width_px.zip(height_px).map(|(width, height)| [width, height]),
        photo: optional_document(row, "photo")?,
        shots: optional_document(row, "shots")?,
        stored: time(row, "stored_ms")?,
    })
}

pub fn upload(row: &Row) -> Result<Upload, StoreError> {
    Ok(Upload {
        id: UploadId(uuid(row, "id")?),
        survey: SurveyId(uuid(row, "survey_id")?),
        length: row.try_get::<i64, _>("length")? as u64,
        received: row.try_get::<i64, _>("received")? as u64,
        partial: row.try_get("partial")?,
        parts: row.try_get("parts")?,
        metadata: row.try_get("metadata")?,
        expires: time(row, "expires_ms")?,
        outcome: row.try_get("outcome")?,
        home: row.try_get::<Option<&str>, _>("home")?.map(|_| uuid(row, "home")).transpose()?,
    })
}

/// The answer to a request, where it was answered.
pub fn kept_answer(row: &Row) -> Result<Option<KeptAnswer>, StoreError> {
    let status: Option<i64> = row.try_get("status")?;
    let Some(status) = status else { return Ok(None) };
    Ok(Some(KeptAnswer {
        fingerprint: parsed(row, "fingerprint")?,
        status: small("status", status)?,
        headers: row.try_get("headers")?,
        body: row.try_get("body")?,
    }))
}

pub fn webhook(row: &Row) -> Result<Webhook, StoreError> {
    let plant: Option<String> = row.try_get("plant_id")?;
    Ok(Webhook {
        seq: row.try_get("seq")?,
        id: WebhookId(uuid(row, "id")?),
        organisation: OrganisationId(uuid(row, "organisation_id")?),
        plant: plant.map(|_| uuid(row, "plant_id").map(PlantId)).transpose()?,
        url: row.try_get("url")?,
        created: time(row, "created_ms")?,
    })
}

pub fn delivery(row: &Row) -> Result<Delivery, StoreError> {
    Ok(Delivery {
        seq: row.try_get("seq")?,
        id: DeliveryId(uuid(row, "id")?),
        webhook: WebhookId(uuid(row, "webhook_id")?),
        job: JobId(uuid(row, "job_id")?),
        state: parsed(row, "state")?,
        attempts: small("attempts", row.try_get("attempts")?)?,
        attempts_left: small("attempts_left", row.try_get("attempts_left")?)?,
        run_after: time(row, "run_after_ms")?,
        error: row.try_get("error")?,
        created: time(row, "created_ms")?,
        finished: optional_time(row, "finished_ms")?,
    })
}

pub fn job(row: &Row) -> Result<Job, StoreError> {
    let stage: Option<String> = row.try_get("stage")?;
    let error_code: Option<String> = row.try_get("error_code")?;
    let error_message: Option<String> = row.try_get("error_message")?;
    let progress = match stage {
        Some(stage) => Some(Progress {
            stage,
            done: row.try_get::<i64, _>("done")? as u64,
            total: row.try_get::<i64, _>("total")? as u64,
            remaining_ms: row.try_get::<Option<i64>, _>("remaining_ms")?.map(|ms| ms as u64),
        }),
        None => None,
    };
    Ok(Job {
        seq: row.try_get("seq")?,
        id: JobId(uuid(row, "id")?),
        plant: PlantId(uuid(row, "plant_id")?),
        survey: SurveyId(uuid(row, "survey_id")?),
        state: parsed(row, "state")?,
        options: row.try_get("options")?,
        priority: small("priority", row.try_get("priority")?)?,
        progress,
        warnings: warnings(row)?,
        error: error_code.zip(error_message),
        attempt: small("attempt", row.try_get("attempt")?)?,
        max_attempts: small("max_attempts", row.try_get("max_attempts")?)?,
        cancel_requested: row.try_get("cancel_requested")?,
        model_version: optional_small(row, "model_version")?,
        created: time(row, "created_ms")?,
        started: optional_time(row, "started_ms")?,
        finished: optional_time(row, "finished_ms")?,
    })
}

pub fn model(row: &Row) -> Result<Model, StoreError> {
    Ok(Model {
        seq: row.try_get("seq")?,
        plant: PlantId(uuid(row, "plant_id")?),
        version: small("version", row.try_get("version")?)?,
        survey: SurveyId(uuid(row, "survey_id")?),
        job: JobId(uuid(row, "job_id")?),
        sha256: parsed(row, "sha256")?,
        size: row.try_get::<i64, _>("size")? as u64,
        warnings: warnings(row)?,
        created: time(row, "created_ms")?,
    })
}

/// A number that is smaller than its column could hold.
pub fn small<T: TryFrom<i64>>(what: &'static str, value: i64) -> Result<T, StoreError> {
    T::try_from(value).map_err(|_| StoreError::Corrupt { what, value: value.to_string() })
}

fn optional_small(row: &Row, column: &'static str) -> Result<Option<u32>, StoreError> {
    let value: Option<i64> = row.try_get(column)?;
    value.map(|value| small(column, value)).transpose()
}

/// Words with blanks between them.
fn words<T: FromStr, C: FromIterator<T>>(what: &'static str, value: String) -> Result<C, StoreError> {
    value.split(' ').map(str::parse).collect::<Result<C, _>>().map_err(|_| StoreError::Corrupt { what, value })
}

fn parsed<T: FromStr>(row: &Row, column: &'static str) -> Result<T, StoreError> {
    let value: String = row.try_get(column)?;
    value.parse().map_err(|_| StoreError::Corrupt { what: column, value })
}

pub fn uuid(row: &Row, column: &'static str) -> Result<Uuid, StoreError> {
    parsed(row, column)
}

/// A JSON document.
fn optional_document<T: DeserializeOwned>(row: &Row, column: &'static str) -> Result<Option<T>, StoreError> {
    let value: Option<String> = row.try_get(column)?;
    let read = |value: String| {
        serde_json::from_str(&value).map_err(|_| StoreError::Corrupt { what: column, value: value.clone() })
    };
    value.map(read).transpose()
}

fn warnings(row: &Row) -> Result<Vec<Warning>, StoreError> {
    let value: String = row.try_get("warnings")?;
    serde_json::from_str(&value).map_err(|_| StoreError::Corrupt { what: "warnings", value })
}

fn time(row: &Row, column: &'static str) -> Result<Timestamp, StoreError> {
    let value: i64 = row.try_get(column)?;
    Timestamp::from_millisecond(value).map_err(|_| StoreError::Corrupt { what: column, value: value.to_string() })
}

fn optional_time(row: &Row, column: &'static str) -> Result<Option<Timestamp>, StoreError> {
    let value: Option<i64> = row.try_get(column)?;
    value.map(|_| time(row, column)).transpose()
}
