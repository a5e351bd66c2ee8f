//! OpenSfM's `reconstruction.json` and the small files beside it, as they are written.

use crate::reconstruction::ReconstructionError;
use serde::Deserialize;
use serde::de::DeserializeOwned;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::Read;
use std::path::Path;

/// Most bytes that are read of a reconstruction, and of the small files beside it.
pub(super) const MAX_RECONSTRUCTION_BYTES: u64 = 4 << 30;
const MAX_SMALL_BYTES: u64 = 16 << 20;

/// One component: what hangs together by common points.
#[derive(Deserialize)]
pub(super) struct Component {
    pub(super) cameras: BTreeMap<String, CameraEntry>,
    pub(super) shots: BTreeMap<String, ShotEntry>,
    #[serde(default)]
    pub(super) points: BTreeMap<String, PointEntry>,
    #[serde(default)]
    pub(super) reference_lla: Option<ReferenceEntry>,
}

#[derive(Deserialize)]
pub(super) struct CameraEntry {
    pub(super) projection_type: String,
    /// Pixels; some programs write a whole number as `1368.0`.
    pub(super) width: f64,
    pub(super) height: f64,
    pub(super) focal: Option<f64>,
    pub(super) focal_x: Option<f64>,
    pub(super) focal_y: Option<f64>,
    pub(super) c_x: Option<f64>,
    pub(super) c_y: Option<f64>,
    pub(super) k1: Option<f64>,
    pub(super) k2: Option<f64>,
    pub(super) k3: Option<f64>,
    pub(super) k4: Option<f64>,
    pub(super) p1: Option<f64>,
    pub(super) p2: Option<f64>,
}

#[derive(Deserialize)]
pub(super) struct ShotEntry {
    pub(super) rotation: [f64; 3],
    pub(super) translation: [f64; 3],
    pub(super) camera: String,
    #[serde(default)]
    pub(super) gps_position: Option<[f64; 3]>,
    #[serde(default)]
    pub(super) gps_dop: Option<f64>,
}

#[derive(Deserialize)]
pub(super) struct PointEntry {
    pub(super) coordinates: [f64; 3],
}

#[derive(Deserialize, Clone, Copy)]
pub(super) struct ReferenceEntry {
    pub(super) latitude: f64,
    pub(super) longitude: f64,
    pub(super) altitude: f64,
}

/// The components of a reconstruction: a list, or a single one as some programs write it.
pub(super) fn read_components(path: &Path) -> Result<Vec<Component>, ReconstructionError> {
    let text = read_text(path, MAX_RECONSTRUCTION_BYTES)?;
    match text.iter().find(|byte| !byte.is_ascii_whitespace()) {
        Some(b'{') => Ok(vec![parse(path, &text)?]),
        _ => parse(path, &text),
    }
}

/// A small JSON file.
pub(super) fn read_small<T: DeserializeOwned>(path: &Path) -> Result<T, ReconstructionError> {
    parse(path, &read_text(path, MAX_SMALL_BYTES)?)
}

/// A file whole, its size bounded, without the byte order mark that some editors add.
fn read_text(path: &Path, limit: u64) -> Result<Vec<u8>, ReconstructionError> {
    let unreadable = |source| ReconstructionError::Unreadable { path: path.to_owned(), source };
    let file = File::open(path).map_err(unreadable)?;
    let bytes = file.metadata().map_err(unreadable)?.len();
    if bytes > limit {
        return Err(ReconstructionError::TooLarge { path: path.to_owned(), bytes, limit });
    }
    let mut text = Vec::with_capacity(bytes as usize);
    file.take(limit).read_to_end(&mut text).map_err(unreadable)?;
    if text.starts_with(b"\xef\xbb\xbf") {
        text.drain(..3);
    }
    Ok(text)
}

fn parse<T: DeserializeOwned>(path: &Path, text: &[u8]) -> Result<T, ReconstructionError> {
    serde_json::from_slice(text).map_err(|error| {
        let line = text.split(|byte| *byte == b'\n').nth(error.line().saturating_sub(1)).unwrap_or(&[]);
        let from = error.column().saturating_sub(NEAR_BYTES).min(line.len());
        malformed(path, &error, &line[from..(error.column() + NEAR_BYTES).min(line.len())])
    })
}

/// How much of a text about an error is looked at, bytes to each side.
pub(super) const NEAR_BYTES: usize = 12;

/// What a text is that cannot be read, by what stands `around` the place of the error.
pub(super) fn malformed(path: &Path, error: &serde_json::Error, around: &[u8]) -> ReconstructionError {
    // Python writes NaN and Infinity, which JSON does not know.
    for word in ["NaN", "Infinity"] {
        if error.is_syntax() && around.windows(word.len()).any(|window| window == word.as_bytes()) {
            return ReconstructionError::NotFinite {
                path: path.to_owned(),
                value: word.to_owned(),
                place: format!("line {}, column {}", error.line(), error.column()),
            };
        }
    }
    let what = if error.is_eof() { format!("it is cut short ({error})") } else { error.to_string() };
    ReconstructionError::Malformed { path: path.to_owned(), what }
}
