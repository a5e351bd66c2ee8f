//! Columns of a row as values.

use super::super::Row;
use crate::store::error::StoreError;
use jiff::Timestamp;
use serde::de::DeserializeOwned;
use sqlx::Row as _;
use std::str::FromStr;
use uuid::Uuid;

/// A number that is smaller than its column could hold.
pub fn small<T: TryFrom<i64>>(what: &'static str, value: i64) -> Result<T, StoreError> {
    T::try_from(value).map_err(|_| StoreError::Corrupt { what, value: value.to_string() })
}

pub fn optional_small(row: &Row, column: &'static str) -> Result<Option<u32>, StoreError> {
    let value: Option<i64> = row.try_get(column)?;
    value.map(|value| small(column, value)).transpose()
}

pub fn parsed<T: FromStr>(row: &Row, column: &'static str) -> Result<T, StoreError> {
    let value: String = row.try_get(column)?;
    value.parse().map_err(|_| StoreError::Corrupt { what: column, value })
}

pub fn uuid(row: &Row, column: &'static str) -> Result<Uuid, StoreError> {
    parsed(row, column)
}

/// A JSON document.
pub fn document<T: DeserializeOwned>(row: &Row, column: &'static str) -> Result<T, StoreError> {
    let value: String = row.try_get(column)?;
    serde_json::from_str(&value).map_err(|_| StoreError::Corrupt { what: column, value })
}

/// A JSON document, where there is one.
pub fn optional_document<T: DeserializeOwned>(row: &Row, column: &'static str) -> Result<Option<T>, StoreError> {
    let value: Option<&str> = row.try_get(column)?;
    value.is_some().then(|| document(row, column)).transpose()
}

pub fn time(row: &Row, column: &'static str) -> Result<Timestamp, StoreError> {
    let value: i64 = row.try_get(column)?;
    Timestamp::from_millisecond(value).map_err(|_| StoreError::Corrupt { what: column, value: value.to_string() })
}

pub fn optional_time(row: &Row, column: &'static str) -> Result<Option<Timestamp>, StoreError> {
    let value: Option<i64> = row.try_get(column)?;
    value.is_some().then(|| time(row, column)).transpose()
}
