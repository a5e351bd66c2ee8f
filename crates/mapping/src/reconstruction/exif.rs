//! What a camera wrote into a photo's file: itself, when and where.

use exif::{Exif, In, Reader, Tag, Value};
use serde::{Deserialize, Serialize};
use std::fs::File;
use std::io::BufReader;
use std::path::Path;

/// Longest name of a camera that is kept, in characters.
const MAX_CAMERA: usize = 80;
/// Heights that a drone may tell, metres.
const HEIGHTS_M: std::ops::Range<f64> = -1_000.0..20_000.0;

/// What a camera wrote into a photo's file.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Exposure {
    /// Make and model.
    pub camera: Option<String>,
    /// When the photo was taken, ISO 8601, by the camera's clock; with an offset from UTC only where the file tells one.
    pub taken: Option<String>,
    pub position: Option<Position>,
}

/// Where the drone's receiver put the camera, WGS 84.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Position {
    /// North positive.
    pub latitude_deg: f64,
    /// East positive.
    pub longitude_deg: f64,
    /// As the drone wrote it, whatever it is above.
    pub height_m: Option<f64>,
}

/// Reads a photo's EXIF; a photo without any, or with what cannot be read, tells nothing.
pub fn read(path: &Path) -> Exposure {
    let Ok(file) = File::open(path) else { return Exposure::default() };
    // Cameras and programs that copy files write directories that are not to the letter: what can be read of them counts.
    let exif = Reader::new()
        .continue_on_error(true)
        .read_from_container(&mut BufReader::new(file))
        .or_else(|error| error.distill_partial_result(|_| {}));
    let Ok(exif) = exif else { return Exposure::default() };
    Exposure { camera: camera(&exif), taken: taken(&exif), position: position(&exif) }
}

/// The text of a field, one line of what can be shown.
fn text(exif: &Exif, tag: Tag) -> Option<String> {
    let Value::Ascii(lines) = &exif.get_field(tag, In::PRIMARY)?.value else { return None };
    let shown: String = String::from_utf8_lossy(lines.first()?).chars().filter(|c| !c.is_control()).collect();
    let shown = shown.trim();
    (!shown.is_empty()).then(|| shown.chars().take(MAX_CAMERA).collect())
}

fn camera(exif: &Exif) -> Option<String> {
    match (text(exif, Tag::Make), text(exif, Tag::Model)) {
        // Some makers say their name in the model again.
        (Some(make), Some(model)) if !model.starts_with(&make) => Some(format!("{make} {model}")),
        (make, model) => model.or(make),
    }
}

fn taken(exif: &Exif) -> Option<String> {
    let written = text(exif, Tag::DateTimeOriginal).or_else(|| text(exif, Tag::DateTime))?;
    // "2026:06:21 10:11:12"
    let time = jiff::civil::DateTime::strptime("%Y:%m:%d %H:%M:%S", &written).ok()?;
    let offset = text(exif, Tag::OffsetTimeOriginal).filter(|offset| {
        let bytes = offset.as_bytes();
        bytes.len() == 6
            && matches!(bytes[0], b'+' | b'-')
            && bytes[3] == b':'
            && [1, 2, 4, 5].iter().all(|at| bytes[*at].is_ascii_digit())
    });
    Some(format!("{time}{}", offset.unwrap_or_default()))
}

fn position(exif: &Exif) -> Option<Position> {
    let latitude_deg = angle(exif, Tag::GPSLatitude, Tag::GPSLatitudeRef, 'S').filter(|deg| deg.abs() <= 90.0)?;
    let longitude_deg = angle(exif, Tag::GPSLongitude, Tag::GPSLongitudeRef, 'W').filter(|deg| deg.abs() <= 180.0)?;
    // What receivers write before they know where they are.
    if latitude_deg == 0.0 && longitude_deg == 0.0 {
        return None;
    }
    let below = exif.get_field(Tag::GPSAltitudeRef, In::PRIMARY).and_then(|field| field.value.get_uint(0)) == Some(1);
    let height_m = numbers(exif, Tag::GPSAltitude).and_then(|numbers| numbers.first().copied());
    let height_m = height_m.map(|height| if below { -height } else { height }).filter(|h| HEIGHTS_M.contains(h));
    Some(Position { latitude_deg, longitude_deg, height_m })
}

/// Degrees, minutes and seconds with their sign, in degrees.
fn angle(exif: &Exif, tag: Tag, reference: Tag, negative: char) -> Option<f64> {
    let parts = numbers(exif, tag)?;
    let degrees: f64 = parts.iter().take(3).zip([1.0, 60.0, 3600.0]).map(|(part, unit)| part / unit).sum();
    let sign = if text(exif, reference)?.starts_with(negative) { -1.0 } else { 1.0 };
    degrees.is_finite().then_some(sign * degrees)
}

fn numbers(exif: &Exif, tag: Tag) -> Option<Vec<f64>> {
    let Value::Rational(parts) = &exif.get_field(tag, In::PRIMARY)?.value else { return None };
    let numbers: Vec<f64> = parts.iter().map(|part| part.to_f64()).collect();
    (!numbers.is_empty() && numbers.iter().all(|number| number.is_finite())).then_some(numbers)
}

#[cfg(test)]
mod tests {
    use super::*;
    use exif::experimental::Writer;
    use exif::{Field, Rational};

    /// A TIFF file with nothing in it but these fields.
    fn file(fields: &[Field]) -> tempfile::NamedTempFile {
        let mut writer = Writer::new();
        fields.iter().for_each(|field| writer.push_field(field));
        let mut bytes = std::io::Cursor::new(Vec::new());
        writer.write(&mut bytes, false).unwrap();
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), bytes.into_inner()).unwrap();
        file
    }

    fn field(tag: Tag, value: Value) -> Field {
        Field { tag, ifd_num: In::PRIMARY, value }
    }

    fn ascii(text: &str) -> Value {
        Value::Ascii(vec![text.as_bytes().to_vec()])
    }

    fn rationals(parts: &[(u32, u32)]) -> Value {
        Value::Rational(parts.iter().map(|(num, denom)| Rational { num: *num, denom: *denom }).collect())
    }

    #[test]
    fn camera_time_and_position() {
        let place = |latitude: &[(u32, u32)], south: &str| {
            [
                field(Tag::GPSLatitude, rationals(latitude)),
                field(Tag::GPSLatitudeRef, ascii(south)),
                field(Tag::GPSLongitude, rationals(&[(8, 1), (15, 1), (0, 1)])),
                field(Tag::GPSLongitudeRef, ascii("W")),
                field(Tag::GPSAltitude, rationals(&[(1234, 10)])),
                field(Tag::GPSAltitudeRef, Value::Byte(vec![1])),
            ]
        };
        let mut fields = place(&[(50, 1), (30, 1), (36, 1)], "S").to_vec();
        fields.extend([
            field(Tag::Make, ascii("DJI")),
            field(Tag::Model, ascii("FC6310\u{7}")),
            field(Tag::DateTimeOriginal, ascii("2026:06:21 10:11:12")),
            field(Tag::OffsetTimeOriginal, ascii("+02:00")),
        ]);
        let told = read(file(&fields).path());
        assert_eq!(told.camera.as_deref(), Some("DJI FC6310"));
        assert_eq!(told.taken.as_deref(), Some("2026-06-21T10:11:12+02:00"));
        let position = told.position.unwrap();
        assert!((position.latitude_deg + 50.51).abs() < 1e-12 && (position.longitude_deg + 8.25).abs() < 1e-12);
        assert_eq!(position.height_m, Some(-123.4));

        let nowhere = |latitude: &[(u32, u32)]| read(file(&place(latitude, "N")).path()).position;
        assert_eq!(nowhere(&[(91, 1)]), None);
        assert_eq!(nowhere(&[(1, 0)]), None);
        let impossible = field(Tag::DateTimeOriginal, ascii("2026:13:40 99:00:00"));
        assert_eq!(read(file(&[impossible]).path()).taken, None);
        assert_eq!(read(Path::new("/dev/null")), Exposure::default());
    }
}
