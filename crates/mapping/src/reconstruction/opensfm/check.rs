//! Whether a file of a project is one that can be read, looked at by itself when it comes. Memory is bounded, whatever it
//! holds; what fits together with other files is checked when all are there.

use super::cameras::{camera, is_known};
use super::json::{CameraEntry, MAX_RECONSTRUCTION_BYTES, NEAR_BYTES, PointEntry, ReferenceEntry, ShotEntry};
use super::json::{malformed, read_small};
use super::place_on_earth;
use crate::reconstruction::ReconstructionError;
use serde::de::{DeserializeOwned, DeserializeSeed, Error, IgnoredAny, MapAccess, SeqAccess, Visitor};
use serde::{Deserialize, Deserializer};
use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::fs::File;
use std::io::{self, BufRead, BufReader, Read, Seek, SeekFrom};
use std::marker::PhantomData;
use std::path::Path;

/// More shots than any survey has.
pub const MAX_SHOTS: usize = 100_000;
/// Longest name of a shot or camera, bytes.
const MAX_NAME_BYTES: usize = 200;

/// Reads a reconstruction through: the names of its shots.
///
/// # Errors
/// What the reader of projects would refuse in it: what is no reconstruction, cameras that no shot can be read with, and
/// fewer than `min_shots`.
pub fn reconstruction(path: &Path, min_shots: usize) -> Result<BTreeSet<String>, ReconstructionError> {
    let mut seen = Seen::default();
    read(path, Components(&mut seen))?;
    let malformed = |what: String| ReconstructionError::Malformed { path: path.to_owned(), what };
    if seen.shots.len() > MAX_SHOTS {
        return Err(malformed(format!("it names more than {MAX_SHOTS} images")));
    }
    if seen.shots.len() < min_shots {
        return Err(ReconstructionError::TooFewShots { path: path.to_owned(), found: seen.shots.len() });
    }
    let (mut readable, mut unknown) = (0, None);
    let mut sound: BTreeSet<&str> = BTreeSet::new();
    for (shot, name) in &seen.shots {
        let missing = || malformed(format!("shot {shot} names camera `{name}`, which is not there"));
        let entry = seen.cameras.get(name).ok_or_else(missing)?;
        if !is_known(entry) {
            unknown = Some((name, entry));
            continue;
        }
        if sound.insert(name) {
            camera(path, name, entry)?;
        }
        readable += 1;
    }
    if let Some((name, entry)) = unknown.filter(|_| readable < min_shots) {
        // Refused by the name of the model.
        camera(path, name, entry)?;
    }
    Ok(seen.shots.into_keys().collect())
}

/// Reads a reference, the origin of a reconstruction on the earth.
///
/// # Errors
/// What is none.
pub fn reference(path: &Path) -> Result<(), ReconstructionError> {
    place_on_earth(read_small::<ReferenceEntry>(path)?, path.to_owned()).map(drop)
}

/// Reads the names of undistorted images by shot.
///
/// # Errors
/// What is no such list.
pub fn undistorted_names(path: &Path) -> Result<(), ReconstructionError> {
    read_small::<BTreeMap<String, Vec<String>>>(path).map(drop)
}

/// Reads a document to its end.
fn read<'a>(path: &Path, seed: Components<'a>) -> Result<(), ReconstructionError> {
    let unreadable = |source| ReconstructionError::Unreadable { path: path.to_owned(), source };
    let file = File::open(path).map_err(unreadable)?;
    let bytes = file.metadata().map_err(unreadable)?.len();
    if bytes > MAX_RECONSTRUCTION_BYTES {
        let limit = MAX_RECONSTRUCTION_BYTES;
        return Err(ReconstructionError::TooLarge { path: path.to_owned(), bytes, limit });
    }
    let mut reader = BufReader::with_capacity(1 << 16, file);
    // The byte order mark that some editors add.
    if reader.fill_buf().map_err(unreadable)?.starts_with(b"\xef\xbb\xbf") {
        reader.consume(3);
    }
    let mut document = serde_json::Deserializer::from_reader(reader);
    let outcome = seed.deserialize(&mut document).and_then(|()| document.end());
    outcome.map_err(|error| match error.io_error_kind() {
        Some(kind) => unreadable(kind.into()),
        None => malformed(path, &error, &around(path, &error).unwrap_or_default()),
    })
}

/// What stands about the place of an error.
fn around(path: &Path, error: &serde_json::Error) -> io::Result<Vec<u8>> {
    let mut reader = BufReader::new(File::open(path)?);
    for _ in 1..error.line() {
        reader.skip_until(b'\n')?;
    }
    reader.seek(SeekFrom::Current(error.column().saturating_sub(NEAR_BYTES) as i64))?;
    let mut text = Vec::new();
    reader.take(2 * NEAR_BYTES as u64).read_to_end(&mut text)?;
    Ok(text)
}

/// What is kept of a reconstruction.
#[derive(Default)]
struct Seen {
    cameras: BTreeMap<String, CameraEntry>,
    /// The camera of each shot.
    shots: BTreeMap<String, String>,
}

/// The components of a reconstruction: a list, or a single one as some programs write it.
struct Components<'a>(&'a mut Seen);

impl<'de> DeserializeSeed<'de> for Components<'_> {
    type Value = ();

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<(), D::Error> {
        deserializer.deserialize_any(self)
    }
}

impl<'de> Visitor<'de> for Components<'_> {
    type Value = ();

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a list of components with cameras and shots")
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut components: A) -> Result<(), A::Error> {
        while components.next_element_seed(Component(self.0))?.is_some() {}
        Ok(())
    }

    fn visit_map<A: MapAccess<'de>>(self, members: A) -> Result<(), A::Error> {
        Component(self.0).visit_map(members)
    }
}

struct Component<'a>(&'a mut Seen);

impl<'de> DeserializeSeed<'de> for Component<'_> {
    type Value = ();

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<(), D::Error> {
        deserializer.deserialize_map(self)
    }
}

impl<'de> Visitor<'de> for Component<'_> {
    type Value = ();

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a component with cameras and shots")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut members: A) -> Result<(), A::Error> {
        let Seen { cameras, shots } = self.0;
        let (mut has_cameras, mut has_shots) = (false, false);
        while let Some(member) = members.next_key::<String>()? {
            match member.as_str() {
                "cameras" => {
                    has_cameras = true;
                    members.next_value_seed(entries(|name: String, entry: CameraEntry| {
                        cameras.insert(name, entry);
                        cameras.len() <= MAX_SHOTS
                    }))?;
                }
                "shots" => {
                    has_shots = true;
                    members.next_value_seed(entries(|name: String, entry: ShotEntry| {
                        shots.insert(name, entry.camera);
                        shots.len() <= MAX_SHOTS
                    }))?;
                }
                "points" => members.next_value_seed(entries(|_, _: PointEntry| true))?,
                "reference_lla" => drop(members.next_value::<Option<ReferenceEntry>>()?),
                _ => drop(members.next_value::<IgnoredAny>()?),
            }
        }
        match (has_cameras, has_shots) {
            (true, true) => Ok(()),
            (false, _) => Err(A::Error::missing_field("cameras")),
            (_, false) => Err(A::Error::missing_field("shots")),
        }
    }
}

/// The entries of an object, each given to `take`, which says whether more may come.
struct Entries<T, F> {
    take: F,
    kind: PhantomData<T>,
}

fn entries<T: DeserializeOwned, F: FnMut(String, T) -> bool>(take: F) -> Entries<T, F> {
    Entries { take, kind: PhantomData }
}

impl<'de, T: Deserialize<'de>, F: FnMut(String, T) -> bool> DeserializeSeed<'de> for Entries<T, F> {
    type Value = ();

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<(), D::Error> {
        deserializer.deserialize_map(self)
    }
}

impl<'de, T: Deserialize<'de>, F: FnMut(String, T) -> bool> Visitor<'de> for Entries<T, F> {
    type Value = ();

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("entries by their names")
    }

    fn visit_map<A: MapAccess<'de>>(mut self, mut members: A) -> Result<(), A::Error> {
        while let Some((name, entry)) = members.next_entry::<String, T>()? {
            if name.len() > MAX_NAME_BYTES {
                return Err(A::Error::custom("a name is longer than any image has"));
            }
            if !(self.take)(name, entry) {
                return Err(A::Error::custom(format!("it names more than {MAX_SHOTS} images")));
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write;

    const CAMERA: &str = r#""c":{"projection_type":"perspective","width":100,"height":80,"focal":0.8}"#;

    fn shots(range: std::ops::Range<usize>) -> String {
        let shot = |index| format!(r#""{index}.jpg":{{"rotation":[0,0,0],"translation":[0,0,1],"camera":"c"}}"#);
        range.map(shot).collect::<Vec<_>>().join(",")
    }

    fn component(range: std::ops::Range<usize>) -> String {
        format!(r#"{{"cameras":{{{CAMERA}}},"shots":{{{}}},"points":{{"1":{{"coordinates":[1,2,3]}}}}}}"#, shots(range))
    }

    fn checked(text: &str) -> Result<BTreeSet<String>, ReconstructionError> {
        let mut file = tempfile::NamedTempFile::new().unwrap();
        file.write_all(text.as_bytes()).unwrap();
        reconstruction(file.path(), 2)
    }

    #[test]
    fn names_of_all_components() {
        let names = checked(&format!("[{},{}]", component(0..2), component(1..3))).unwrap();
        assert_eq!(names.into_iter().collect::<Vec<_>>(), ["0.jpg", "1.jpg", "2.jpg"]);
        assert_eq!(checked(&format!("\u{feff} {}", component(0..2))).unwrap().len(), 2);
    }

    #[test]
    fn what_the_reader_refuses_is_refused() {
        for (text, code) in [
            ("", "reconstruction_malformed"),
            ("{}", "reconstruction_malformed"),
            ("[]", "too_few_images"),
            ("[7]", "reconstruction_malformed"),
            ("[{", "reconstruction_malformed"),
            (r#"[{"shots":{}}]"#, "reconstruction_malformed"),
            (r#"[{"cameras":{},"shots":[]}]"#, "reconstruction_malformed"),
            ("[NaN]", "reconstruction_not_finite"),
            (&format!("[{}]", component(0..1)), "too_few_images"),
            (&format!("[{}] x", component(0..2)), "reconstruction_malformed"),
            (&format!("[{}]", component(0..2).replace("0.8", "1e9")), "reconstruction_malformed"),
            (&format!("[{}]", component(0..2).replace("perspective", "equirectangular")), "camera_model_unknown"),
            (
                &format!("[{}]", component(0..2).replace(r#""camera":"c""#, r#""camera":"d""#)),
                "reconstruction_malformed",
            ),
            (&format!("[{}]", component(0..2).replace("[1,2,3]", "[1,2,Infinity]")), "reconstruction_not_finite"),
        ] {
            assert_eq!(checked(text).unwrap_err().code(), code, "{text}");
        }
    }

    #[test]
    fn names_are_bounded_over_all_components() {
        let half = MAX_SHOTS / 2;
        let document = |last| format!("[{},{}]", component(0..half), component(half..last));
        assert_eq!(checked(&document(MAX_SHOTS)).unwrap().len(), MAX_SHOTS);
        let error = checked(&document(MAX_SHOTS + 1)).unwrap_err();
        assert!(error.to_string().contains("more than 100000 images"), "{error}");
        let long = format!("[{}]", component(0..2).replace("0.jpg", &"x".repeat(MAX_NAME_BYTES + 1)));
        assert!(checked(&long).is_err());
    }
}
