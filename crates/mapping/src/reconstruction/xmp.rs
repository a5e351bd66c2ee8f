//! Numbers that drones write into the XMP of a photo, as attributes or as elements.

use std::fs::File;
use std::io::Read;
use std::path::Path;

/// XMP is looked for in so much of the file's beginning.
const SEARCHED_BYTES: u64 = 256 << 10;
/// Longest number that is read, in characters.
const MAX_NUMBER: usize = 24;

/// The number in `key="+41.30"`, or in the element of that name, such as `drone-dji:RelativeAltitude`; `None` where the
/// file has none.
pub fn number(path: &Path, key: &str) -> Option<f64> {
    let mut start = Vec::new();
    File::open(path).ok()?.take(SEARCHED_BYTES).read_to_end(&mut start).ok()?;
    number_in(&start, key)
}

fn number_in(bytes: &[u8], key: &str) -> Option<f64> {
    let at = bytes.windows(key.len()).position(|window| window == key.as_bytes())? + key.len();
    let text: String = bytes[at..]
        .iter()
        .map(|byte| char::from(*byte))
        .skip_while(|c| matches!(c, '=' | '"' | '\'' | '>' | ' '))
        .take_while(|c| c.is_ascii_digit() || matches!(c, '+' | '-' | '.'))
        .take(MAX_NUMBER)
        .collect();
    text.parse().ok().filter(|value: &f64| value.is_finite())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_of_attributes_and_elements() {
        let height = |xmp: &str| number_in(xmp.as_bytes(), "drone-dji:RelativeAltitude");
        assert_eq!(height("xmp drone-dji:RelativeAltitude=\"+41.30\" more"), Some(41.3));
        assert_eq!(height("<drone-dji:RelativeAltitude>-2.5</drone-dji:RelativeAltitude>"), Some(-2.5));
        assert_eq!(height("drone-dji:RelativeAltitude=\"high\""), None);
        assert_eq!(height("drone-dji:RelativeAltitude"), None);
        assert_eq!(height("nothing"), None);
        assert_eq!(number(Path::new("missing.jpg"), "drone-dji:RelativeAltitude"), None);
    }
}
