//! Path, query and body, with problem documents where they are wrong.

use crate::http::error::{ApiError, Code};
use axum::Json;
use axum::extract::path::ErrorKind;
use axum::extract::rejection::{JsonRejection, PathRejection, QueryRejection};
use axum::extract::{FromRequest, FromRequestParts, Request};
use serde::de::value::MapAccessDeserializer;
use serde::de::{DeserializeOwned, MapAccess, Visitor};
use serde::{Deserialize, Deserializer};
use std::fmt;
use std::marker::PhantomData;

/// Path parameters; a path that cannot name anything is 404.
#[derive(FromRequestParts)]
#[from_request(via(axum::extract::Path), rejection(ApiError))]
pub struct ApiPath<T>(pub T);

/// Query parameters.
#[derive(FromRequestParts)]
#[from_request(via(axum::extract::Query), rejection(ApiError))]
pub struct ApiQuery<T>(pub T);

/// A JSON body, which is an object.
pub struct ApiJson<T>(pub T);

impl<S: Send + Sync, T: DeserializeOwned> FromRequest<S> for ApiJson<T> {
    type Rejection = ApiError;

    async fn from_request(request: Request, state: &S) -> Result<Self, ApiError> {
        let Json(Object(value)) = Json::<Object<T>>::from_request(request, state).await?;
        Ok(Self(value))
    }
}

/// A JSON object. What derives `Deserialize` takes an array of its members as well, which nobody means.
pub struct Object<T>(pub T);

impl<'de, T: Deserialize<'de>> Deserialize<'de> for Object<T> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Members<T>(PhantomData<T>);

        impl<'de, T: Deserialize<'de>> Visitor<'de> for Members<T> {
            type Value = T;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("an object")
            }

            fn visit_map<A: MapAccess<'de>>(self, members: A) -> Result<T, A::Error> {
                T::deserialize(MapAccessDeserializer::new(members))
            }
        }

        deserializer.deserialize_map(Members(PhantomData)).map(Self)
    }
}

impl From<PathRejection> for ApiError {
    fn from(rejection: PathRejection) -> Self {
        let PathRejection::FailedToDeserializePathParams(error) = rejection else {
            return Self::new(Code::NotFound, "the path names nothing; identifiers are UUIDs");
        };
        let value = match error.into_kind() {
            ErrorKind::ParseErrorAtKey { value, .. }
            | ErrorKind::ParseErrorAtIndex { value, .. }
            | ErrorKind::ParseError { value, .. }
            | ErrorKind::DeserializeError { value, .. } => format!("`{}`", value.chars().take(80).collect::<String>()),
            _ => "a part of it".to_owned(),
        };
        Self::new(Code::NotFound, format!("the path names nothing: {value} is no identifier; identifiers are UUIDs"))
    }
}

impl From<QueryRejection> for ApiError {
    fn from(rejection: QueryRejection) -> Self {
        Self::new(Code::InvalidQuery, query_in_words(&cause(&rejection)))
    }
}

impl From<JsonRejection> for ApiError {
    fn from(rejection: JsonRejection) -> Self {
        match &rejection {
            JsonRejection::JsonDataError(_) => Self::new(
                Code::InvalidFields,
                format!("the document does not fit: {}", members_in_words(&cause(&rejection))),
            ),
            JsonRejection::MissingJsonContentType(_) => {
                Self::new(Code::UnsupportedMediaType, "send JSON with the header `content-type: application/json`")
            }
            JsonRejection::BytesRejection(error) if error.status() == axum::http::StatusCode::PAYLOAD_TOO_LARGE => {
                Self::new(Code::TooLarge, "JSON documents are at most 1 MiB: send less at once")
            }
            JsonRejection::BytesRejection(_) => {
                Self::new(Code::UploadInterrupted, "the document came in part only; send it again")
            }
            _ => Self::new(Code::InvalidJson, format!("this is no JSON: {}", cause(&rejection))),
        }
    }
}

/// What is wrong, without what the framework says that it was doing.
fn cause(rejection: &dyn std::error::Error) -> String {
    rejection.source().map_or_else(|| rejection.to_string(), ToString::to_string)
}

/// What is wrong with a query, from `PARAMETER: WHAT` in the words of the deserializer.
fn query_in_words(text: &str) -> String {
    if let Some((_, unknown)) = text.split_once("unknown field ") {
        let (name, known) = unknown.split_once(", expected ").unwrap_or((unknown, "none"));
        return format!("there is no query parameter {name} here; expected: {}", known.trim_start_matches("one of "));
    }
    if let Some((_, name)) = text.split_once("duplicate field ") {
        return format!("the query parameter {name} is given twice");
    }
    let Some((name, what)) = text.split_once(": ") else { return format!("the query cannot be read: {text}") };
    let expected = match what {
        _ if matches!(name, "since" | "until") => "a time such as 2026-01-31T12:00:00Z",
        "provided string was not `true` or `false`" => "true or false",
        what if what.contains("digit") || what.contains("integer") || what.starts_with("number too") => {
            "a whole number"
        }
        what if what.contains("UUID") => "a UUID",
        what => return format!("the query parameter `{name}`: {what}"),
    };
    format!("the query parameter `{name}` does not fit: {expected} is expected")
}

/// What is wrong with members of a document, in words of JSON and not of this program.
fn members_in_words(text: &str) -> String {
    let text = text.split(" at line ").next().unwrap_or_default();
    let Some((before, kind)) = text.rsplit_once("expected ") else { return text.to_owned() };
    let kind = match kind {
        "u8" | "u16" | "u32" | "u64" | "usize" | "i32" | "i64" => "a whole number within range",
        "f32" | "f64" => "a number",
        "a sequence" => "an array",
        kind if kind.starts_with("struct ") => "an object",
        kind => kind,
    };
    format!("{before}expected {kind}")
}

#[cfg(test)]
mod tests {
    use super::*;
    use axum::extract::{FromRequest, Query};

    #[derive(Debug, Deserialize)]
    #[serde(deny_unknown_fields)]
    #[expect(dead_code, reason = "only what does not fit is looked at")]
    struct Asked {
        limit: Option<u32>,
        since: Option<jiff::Timestamp>,
        exact: Option<bool>,
        id: Option<uuid::Uuid>,
    }

    #[test]
    fn queries_are_refused_in_words() {
        for (query, words) in [
            ("limit=x", "the query parameter `limit` does not fit: a whole number is expected"),
            ("limit=", "the query parameter `limit` does not fit: a whole number is expected"),
            ("limit=99999999999", "the query parameter `limit` does not fit: a whole number is expected"),
            ("exact=1", "the query parameter `exact` does not fit: true or false is expected"),
            ("since=now", "the query parameter `since` does not fit: a time such as 2026-01-31T12:00:00Z is expected"),
            ("id=7", "the query parameter `id` does not fit: a UUID is expected"),
            ("lmit=1", "there is no query parameter `lmit` here; expected: `limit`, `since`, `exact`, `id`"),
            ("limit=1&limit=2", "the query parameter `limit` is given twice"),
        ] {
            let uri = format!("/list?{query}").parse().unwrap();
            let problem = ApiError::from(Query::<Asked>::try_from_uri(&uri).unwrap_err());
            assert_eq!((problem.code, &*problem.detail), (Code::InvalidQuery, words));
        }
    }

    #[tokio::test]
    async fn documents_are_refused_in_words() {
        for (body, words) in [
            (
                r#"{"limit": "x"}"#,
                "the document does not fit: limit: invalid type: string \"x\", expected a whole number within range",
            ),
            (
                r#"{"limit": -1}"#,
                "the document does not fit: limit: invalid value: integer `-1`, expected a whole number within range",
            ),
            ("{", "this is no JSON: EOF while parsing an object at line 1 column 1"),
        ] {
            let request = Request::post("/").header("content-type", "application/json").body(body.into()).unwrap();
            let problem = ApiJson::<Asked>::from_request(request, &()).await.err().unwrap();
            assert_eq!(problem.detail, words);
        }
    }
}
