//! Lists of a survey's files: by what they are filtered, and where the next part begins. That is after a path and not after a
//! number of files, so that whatever is put or replaced meanwhile, and whatever the filter, nothing is left out or told twice.

use crate::http::controllers::images::FileView;
use crate::http::error::{ApiError, Code};

/// Longest cursor: two digits for each byte of a path.
const MAX_CURSOR: usize = 800;
/// Words of all warnings of photos.
const WARNINGS: [&str; 7] =
    ["damaged", "blurred", "underexposed", "overexposed", "no_position", "no_time", "duplicate"];

/// The path after which a part begins: whatever the bytes of a cursor are, only their place in the order counts.
pub fn path_of(cursor: Option<&str>) -> Result<String, ApiError> {
    let Some(cursor) = cursor else { return Ok(String::new()) };
    let byte = |pair: &[u8]| u8::from_str_radix(std::str::from_utf8(pair).ok()?, 16).ok();
    let bytes: Option<Vec<u8>> = cursor.as_bytes().chunks(2).map(byte).collect();
    let digits = cursor.bytes().all(|byte| matches!(byte, b'0'..=b'9' | b'a'..=b'f'));
    let well_formed = digits && (2..=MAX_CURSOR).contains(&cursor.len()) && cursor.len() % 2 == 0;
    let text = bytes.filter(|_| well_formed).map(|bytes| String::from_utf8_lossy(&bytes).replace('\0', ""));
    let wrong = "the cursor is none of this service's: take it from the link to the next part";
    text.ok_or(ApiError::new(Code::InvalidQuery, wrong))
}

/// The cursor of the part that begins after a path.
pub fn cursor_after(path: &str) -> String {
    path.bytes().map(|byte| format!("{byte:02x}")).collect()
}

/// Refuses a word that is no warning's, `any` or `none`.
pub fn check_warning(word: Option<&str>) -> Result<(), ApiError> {
    match word {
        Some(word) if !["any", "none"].contains(&word) && !WARNINGS.contains(&word) => {
            let words = WARNINGS.join(", ");
            Err(ApiError::new(Code::InvalidQuery, format!("warning must be any, none or one of {words}")))
        }
        _ => Ok(()),
    }
}

/// Whether a file has this warning, `any`, or `none`; where nothing is asked for, every file will do.
pub fn has_warning(file: &FileView, word: Option<&str>) -> bool {
    match word {
        None => true,
        Some("any") => !file.warnings.is_empty(),
        Some("none") => file.warnings.is_empty(),
        Some(word) => file.warnings.iter().any(|warning| warning.code == word),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cursor_is_a_place_in_the_order() {
        for path in ["images/a.jpg", "images/\u{e9} (1).jpg", "reconstruction.json"] {
            assert_eq!(path_of(Some(&cursor_after(path))).unwrap(), path);
        }
        assert_eq!(path_of(None).unwrap(), "");
        // Whoever makes one up gets some place, and no fault.
        assert_eq!(path_of(Some("ff61")).unwrap(), "\u{fffd}a");
        for wrong in ["", "6", "616", "xy", "+1", "\u{e9}", &"61".repeat(401)] {
            assert!(path_of(Some(wrong)).is_err(), "{wrong}");
        }
    }
}
