//! Lists in parts: a limit and a cursor, and a link to the next part.

use crate::http::error::{ApiError, Code};
use crate::store::Page;
use axum::Json;
use axum::http::{HeaderValue, header};
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};
use unicode_normalization::UnicodeNormalization;

const DEFAULT_LIMIT: u32 = 100;
const MAX_LIMIT: u32 = 1000;

/// Query parameters of a list that can be filtered: which part, and which items.
macro_rules! filtered_list {
    ($(#[$doc:meta])* $name:ident { $($(#[$about:meta])* $field:ident: $type:ty,)* }) => {
        $(#[$doc])*
        #[derive(Debug, serde::Deserialize, utoipa::IntoParams)]
        #[serde(deny_unknown_fields)]
        #[into_params(parameter_in = Query)]
        pub struct $name {
            /// Most items in the answer.
            #[param(minimum = 1, maximum = 1000, default = 100)]
            pub limit: Option<u32>,
            /// Where to go on: taken from the link to the next part.
            #[param(pattern = "^[0-9]{1,18}$")]
            pub cursor: Option<String>,
            $($(#[$about])* pub $field: Option<$type>,)*
        }

        impl $name {
            /// Which part.
            pub fn part(&self) -> $crate::http::paging::PageQuery {
                $crate::http::paging::PageQuery { limit: self.limit, cursor: self.cursor.clone() }
            }

            /// The list's path with these filters.
            pub fn path(&self, list: &str) -> String {
                let filters: &[(&str, Option<String>)] =
                    &[$((stringify!($field), self.$field.as_ref().map(ToString::to_string)),)*];
                $crate::http::paging::with_filters(list, filters)
            }
        }
    };
}

pub(super) use filtered_list;

/// A list's path with what it is filtered by.
pub fn with_filters(list: &str, filters: &[(&str, Option<String>)]) -> String {
    let told = filters.iter().filter_map(|(name, value)| Some(format!("{name}={}", encoded(value.as_deref()?))));
    let told: Vec<String> = told.collect();
    if told.is_empty() { list.to_owned() } else { format!("{list}?{}", told.join("&")) }
}

/// The next part of a list at a path with its filters.
pub fn next_part(path: &str, limit: u32, cursor: impl std::fmt::Display) -> String {
    let mark = if path.contains('?') { '&' } else { '?' };
    format!("{path}{mark}limit={limit}&cursor={cursor}")
}

/// A value as a URL's query may hold it (RFC 3986).
fn encoded(value: &str) -> String {
    let byte = |byte: u8| match byte {
        b'A'..=b'Z' | b'a'..=b'z' | b'0'..=b'9' | b'-' | b'.' | b'_' | b'~' => char::from(byte).to_string(),
        byte => format!("%{byte:02X}"),
    };
    value.bytes().map(byte).collect()
}

/// How a name must begin. What no name holds finds none, in every database.
pub fn prefix_filter(asked: Option<&str>) -> Result<String, ApiError> {
    let asked = asked.unwrap_or_default();
    if asked.chars().count() > 200 {
        return Err(ApiError::new(Code::InvalidQuery, "name is longer than 200 characters, as no name is"));
    }
    Ok(asked.nfc().collect::<String>().replace('\0', "\u{1}"))
}

/// Reads a word that a list is filtered by, one of those of a state.
pub fn state_filter<T: std::str::FromStr>(word: Option<&str>, words: &str) -> Result<Option<T>, ApiError> {
    let wrong = |_| ApiError::new(Code::InvalidQuery, format!("state must be one of {words}"));
    word.map(str::parse).transpose().map_err(wrong)
}

/// Which part of a list.
#[derive(Debug, Deserialize, utoipa::IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct PageQuery {
    /// Most items in the answer.
    #[param(minimum = 1, maximum = 1000, default = 100)]
    pub limit: Option<u32>,
    /// Where to go on: taken from the link to the next part.
    #[param(pattern = "^[0-9]{1,18}$")]
    pub cursor: Option<String>,
}

impl PageQuery {
    /// The rows to ask for: one more than is shown tells whether there is a next part.
    pub fn page(&self) -> Result<Page, ApiError> {
        Ok(Page { after: self.cursor.as_deref().map(parse_cursor).transpose()?, limit: self.limit()? + 1 })
    }

    fn limit(&self) -> Result<u32, ApiError> {
        list_limit(self.limit)
    }

    /// The part of a list from the rows asked for; `seq` is a row's sequence number, `path` where the list is, with what it
    /// was filtered by.
    pub fn items<R, T>(
        &self,
        path: &str,
        rows: Vec<R>,
        seq: impl Fn(&R) -> i64,
        view: impl Fn(R) -> T,
    ) -> Result<List<T>, ApiError> {
        let limit = self.limit()?;
        let more = rows.len() > limit as usize;
        let mut last = None;
        let items = rows.into_iter().take(limit as usize).inspect(|row| last = Some(seq(row))).map(view).collect();
        let next = last.filter(|_| more).map(|last| next_part(path, limit, last));
        Ok(List { items, next })
    }
}

/// How many items a part has at most, by what was asked for.
pub fn list_limit(asked: Option<u32>) -> Result<u32, ApiError> {
    match asked.unwrap_or(DEFAULT_LIMIT) {
        limit @ 1..=MAX_LIMIT => Ok(limit),
        limit => Err(ApiError::new(Code::InvalidQuery, format!("limit is {limit}; it must be 1 to {MAX_LIMIT}"))),
    }
}

/// Reads a cursor that this service gave.
pub fn parse_cursor(cursor: &str) -> Result<i64, ApiError> {
    cursor.parse().ok().filter(|seq| *seq >= 0).ok_or_else(|| {
        ApiError::new(
            Code::InvalidQuery,
            "the cursor is none of this service's: take it from the link to the next part",
        )
    })
}

/// A `Link` header to the next part.
pub fn next_link(url: &str) -> Option<(header::HeaderName, HeaderValue)> {
    Some((header::LINK, HeaderValue::from_str(&format!("<{url}>; rel=\"next\"")).ok()?))
}

/// A part of a list.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub struct List<T> {
    pub items: Vec<T>,
    /// The next part, where there is one; also in the header `link`.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(example = "/api/v1/plants?limit=100&cursor=100")]
    pub next: Option<String>,
}

impl<T: Serialize> IntoResponse for List<T> {
    fn into_response(self) -> Response {
        let link = self.next.as_deref().and_then(next_link);
        let mut response = Json(self).into_response();
        response.headers_mut().extend(link);
        response
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn filters_stay_in_the_link_to_the_next_part() {
        let path = with_filters("/list", &[("name", Some("A&b \u{e9}".to_owned())), ("state", None)]);
        assert_eq!(path, "/list?name=A%26b%20%C3%A9");
        let query = PageQuery { limit: Some(1), cursor: None };
        let list = query.items(&path, vec![1, 2], |row| *row, |row| row).unwrap();
        assert_eq!(list.next.as_deref(), Some("/list?name=A%26b%20%C3%A9&limit=1&cursor=1"));
        let list = query.items("/list", vec![1, 2], |row| *row, |row| row).unwrap();
        assert_eq!(list.next.as_deref(), Some("/list?limit=1&cursor=1"));
    }
}
