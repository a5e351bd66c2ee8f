//! Names of organisations, plants, surveys and keys.

use unicode_normalization::UnicodeNormalization;

/// Maximum number of characters of a name.
const MAX_CHARACTERS: usize = 200;

/// The text is not a valid name.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
#[error("a name has 1 to {MAX_CHARACTERS} characters, no line breaks and none that steer how text is shown")]
pub struct InvalidName;

/// Validates a name, trims spaces around it, and composes it (Unicode's NFC): what looks the same is the same name.
pub fn checked(name: &str) -> Result<String, InvalidName> {
    let name: String = name.trim().nfc().collect();
    let length = name.chars().count();
    if (1..=MAX_CHARACTERS).contains(&length) && !name.chars().any(steers) { Ok(name) } else { Err(InvalidName) }
}

/// Whether a character is not shown itself but steers how others are: control characters, breaks of lines, and those that
/// turn the direction of text (Unicode's property `Bidi_Control`), by which one name can look like another.
pub fn steers(c: char) -> bool {
    c.is_control()
        || matches!(c, '\u{61c}' | '\u{200e}' | '\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}')
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_one_visible_line() {
        for name in ["Sunfield North", "太陽光発電所", "محطة الطاقة", "👩\u{200d}🔧", &"x".repeat(200)]
        {
            assert_eq!(checked(name).as_deref(), Ok(name));
        }
        assert_eq!(checked("  a \n").as_deref(), Ok("a"));
        assert_eq!(checked("Ho\u{308}he"), checked("H\u{f6}he"));
        for name in ["", " ", "a\nb", "a\0", "gpj.\u{202e}a", "a\u{2066}b\u{2069}", "a\u{2028}b", &"x".repeat(201)] {
            assert_eq!(checked(name), Err(InvalidName), "{name:?}");
        }
    }
}
