//! Which images a reconstruction was made from, read from its file without keeping anything else of it.

use serde::Deserialize;
use serde::de::{Deserializer, Error, IgnoredAny, MapAccess, Visitor};
use std::collections::BTreeSet;
use std::fmt;

/// More names than any survey has images.
const MAX_SHOTS: usize = 100_000;
/// Longest name of an image, bytes.
const MAX_NAME: usize = 200;

/// One component of a reconstruction as OpenSfM writes it.
#[derive(Deserialize)]
pub struct Component {
    #[serde(default)]
    pub shots: Names,
}

/// The keys of an object, its values left aside.
#[derive(Default)]
pub struct Names(pub BTreeSet<String>);

impl<'de> Deserialize<'de> for Names {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_map(Keys)
    }
}

struct Keys;

impl<'de> Visitor<'de> for Keys {
    type Value = Names;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("shots by their names")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Names, A::Error> {
        let mut names = BTreeSet::new();
        while let Some((name, IgnoredAny)) = map.next_entry::<String, IgnoredAny>()? {
            if name.len() > MAX_NAME || names.len() >= MAX_SHOTS {
                return Err(A::Error::custom("more or longer names than a survey has"));
            }
            names.insert(name);
        }
        Ok(Names(names))
    }
}
