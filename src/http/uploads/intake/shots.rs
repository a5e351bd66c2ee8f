//! Which images a reconstruction was made from, read from its file without keeping anything else of it.

use serde::Deserializer;
use serde::de::{DeserializeSeed, Error, IgnoredAny, MapAccess, SeqAccess, Visitor};
use std::collections::BTreeSet;
use std::fmt;
use std::io::Read;

/// More names than any survey has images.
pub const MAX_SHOTS: usize = 100_000;
/// Longest name of an image, bytes.
const MAX_NAME: usize = 200;

/// What a document that should be a reconstruction turned out to be.
#[derive(Debug, PartialEq)]
pub enum Shots {
    /// The images that it names, of all its components.
    Named(BTreeSet<String>),
    /// It names more than any survey has.
    TooMany,
    /// It is none, or no JSON.
    Unknown,
}

/// Reads the names of the shots in a document as OpenSfM writes it.
pub fn read(document: impl Read) -> Shots {
    let mut names = BTreeSet::new();
    let mut deserializer = serde_json::Deserializer::from_reader(document);
    let read = Components(&mut names).deserialize(&mut deserializer).and_then(|()| deserializer.end());
    match read {
        _ if names.len() > MAX_SHOTS => Shots::TooMany,
        Ok(()) => Shots::Named(names),
        Err(_) => Shots::Unknown,
    }
}

/// The components of a reconstruction, the names of whose shots are collected.
struct Components<'a>(&'a mut BTreeSet<String>);

impl<'de> DeserializeSeed<'de> for Components<'_> {
    type Value = ();

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<(), D::Error> {
        deserializer.deserialize_seq(self)
    }
}

impl<'de> Visitor<'de> for Components<'_> {
    type Value = ();

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("components")
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut components: A) -> Result<(), A::Error> {
        while components.next_element_seed(Component(self.0))?.is_some() {}
        Ok(())
    }
}

struct Component<'a>(&'a mut BTreeSet<String>);

impl<'de> DeserializeSeed<'de> for Component<'_> {
    type Value = ();

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<(), D::Error> {
        deserializer.deserialize_map(self)
    }
}

impl<'de> Visitor<'de> for Component<'_> {
    type Value = ();

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a component")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut members: A) -> Result<(), A::Error> {
        while let Some(member) = members.next_key::<String>()? {
            match member.as_str() {
                "shots" => members.next_value_seed(Names(self.0))?,
                _ => drop(members.next_value::<IgnoredAny>()?),
            }
        }
        Ok(())
    }
}

/// The keys of an object, its values left aside.
struct Names<'a>(&'a mut BTreeSet<String>);

impl<'de> DeserializeSeed<'de> for Names<'_> {
    type Value = ();

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<(), D::Error> {
        deserializer.deserialize_map(self)
    }
}

impl<'de> Visitor<'de> for Names<'_> {
    type Value = ();

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("shots by their names")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut shots: A) -> Result<(), A::Error> {
        while let Some((name, IgnoredAny)) = shots.next_entry::<String, IgnoredAny>()? {
            if name.len() > MAX_NAME {
                return Err(A::Error::custom("a name longer than any image has"));
            }
            self.0.insert(name);
            if self.0.len() > MAX_SHOTS {
                return Err(A::Error::custom("more names than a survey has"));
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn component(shots: std::ops::Range<usize>) -> String {
        let shots: Vec<String> = shots.map(|shot| format!("\"{shot}.jpg\":{{\"camera\":[1]}}")).collect();
        format!("{{\"cameras\":{{}},\"shots\":{{{}}},\"points\":{{\"1\":{{}}}}}}", shots.join(","))
    }

    #[test]
    fn names_of_all_components() {
        let names = |names: &[&str]| Shots::Named(names.iter().map(|name| (*name).to_owned()).collect());
        let document = format!("[{},{},{{}}]", component(0..2), component(1..3));
        assert_eq!(read(document.as_bytes()), names(&["0.jpg", "1.jpg", "2.jpg"]));
        assert_eq!(read(&b"[]"[..]), names(&[]));
        for other in ["[{\"shots\": 1}]", "[3]", "{}", "[{}", "[] x", "[{\"shots\": {\"a.jpg\": NaN}}]"] {
            assert_eq!(read(other.as_bytes()), Shots::Unknown, "{other}");
        }
    }

    #[test]
    fn names_are_bounded_over_all_components() {
        let half = MAX_SHOTS / 2;
        let document = |last| format!("[{},{}]", component(0..half), component(half..last));
        assert!(matches!(read(document(MAX_SHOTS).as_bytes()), Shots::Named(names) if names.len() == MAX_SHOTS));
        assert_eq!(read(document(MAX_SHOTS + 1).as_bytes()), Shots::TooMany);
        let long = format!("[{{\"shots\":{{\"{}\":0}}}}]", "x".repeat(MAX_NAME + 1));
        assert_eq!(read(long.as_bytes()), Shots::Unknown);
    }
}
