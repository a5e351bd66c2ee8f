//! Parts of lists, and the result of creating an entry.

use jiff::Timestamp;

/// A part of a list: at most `limit` rows after the one with the sequence number `after`.
#[derive(Debug, Clone, Copy)]
pub struct Page {
    pub after: Option<i64>,
    pub limit: u32,
}

/// A time span, from `since` (inclusive) to `until` (exclusive); unbounded where there is none.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct TimeSpan {
    pub since: Option<Timestamp>,
    pub until: Option<Timestamp>,
}

/// Something created, or the existing one of the same name.
#[derive(Debug, Clone)]
pub enum Created<T> {
    New(T),
    Existing(T),
}
