//! The schema of a database compared with that of this program, without changing anything.

use super::error::StoreError;
use jiff::Timestamp;

/// A database's schema compared with this program's.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Schema {
    /// There are no tables yet.
    Absent,
    /// Some changes are still to be made.
    Behind {
        missing: usize,
    },
    Current,
    /// A newer version of the program changed it.
    Ahead,
}

impl Schema {
    /// Compares the changes that this program knows with those that were made.
    pub(super) fn of(known: impl IntoIterator<Item = i64>, made: &[i64]) -> Self {
        let known: Vec<i64> = known.into_iter().collect();
        let missing = known.iter().filter(|version| !made.contains(version)).count();
        match missing {
            _ if made.is_empty() => Self::Absent,
            _ if made.iter().any(|version| !known.contains(version)) => Self::Ahead,
            0 => Self::Current,
            missing => Self::Behind { missing },
        }
    }
}

/// Result of examining a database.
#[derive(Debug)]
pub struct Examined {
    pub schema: Schema,
    /// Whether rows can be written, tried where the schema is current.
    pub writable: Result<(), StoreError>,
    /// The time of its own clock, where it has one.
    pub now: Option<Timestamp>,
    /// Whether there is a valid key.
    pub has_keys: bool,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn schemas() {
        assert_eq!(Schema::of([1, 2], &[]), Schema::Absent);
        assert_eq!(Schema::of([1, 2], &[1]), Schema::Behind { missing: 1 });
        assert_eq!(Schema::of([1, 2], &[1, 2]), Schema::Current);
        assert_eq!(Schema::of([1, 2], &[1, 2, 3]), Schema::Ahead);
        assert_eq!(Schema::of([1, 2], &[1, 3]), Schema::Ahead);
    }
}
