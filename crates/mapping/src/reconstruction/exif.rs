//! What a camera wrote into a photo's file: itself, when and where.
//!
//! Counts and offsets in such a file are anybody's: a few kilobytes may claim gigabytes of text. So the directories are
//! read entry by entry, of an entry that is wanted no more than its first bytes, and memory is the same for every file.

use serde::{Deserialize, Serialize};
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;

/// Longest name of a camera that is kept, in characters.
const MAX_CAMERA: usize = 80;
/// Heights that a drone may tell, metres.
const HEIGHTS_M: std::ops::Range<f64> = -1_000.0..20_000.0;

/// Diagonal of the film whose view EXIF's equivalent focal length means (EXIF 2.32, FocalLengthIn35mmFilm), millimetres.
const FILM_DIAGONAL_MM: f64 = 43.27;

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

/// Reads a photo's EXIF; a photo without any, or with what cannot be read, has nothing to say. Cameras and programs that copy
/// files write directories that are not to the letter: what can be read of them counts.
pub fn read(path: &Path) -> Exposure {
    let fields = Fields::of_file(path).unwrap_or_default();
    Exposure { camera: fields.camera(), taken: fields.taken(), position: fields.position() }
}

/// The focal length by that of a camera with 35 mm film and the same view, which is written in whole millimetres, pixels of a
/// photo of `width` x `height`.
pub fn film_focal_px(path: &Path, width: u32, height: u32) -> Option<f64> {
    let focal_mm = Fields::of_file(path)?.film_focal_mm.map(f64::from)?;
    let focal_px = focal_mm / FILM_DIAGONAL_MM * f64::from(width).hypot(f64::from(height));
    (focal_px > 1.0).then_some(focal_px)
}

/// The focal length of the lens, millimetres.
pub fn focal_mm(path: &Path) -> Option<f64> {
    Fields::of_file(path)?.focal_mm.filter(|focal_mm| *focal_mm > 0.0)
}

/// The most values that an entry of a TIFF's first directory claims, of those that a decoder reads: the baseline tags, less
/// texts (TIFF 6.0, part 1 and section 21). `None` where it has no directory that can be read.
pub fn most_tiff_values<R: Read + Seek>(file: &mut R) -> Option<u32> {
    const BASELINE_TAGS: std::ops::RangeInclusive<u16> = 254..=532;
    let length = file.seek(SeekFrom::End(0)).ok()?;
    let mut tiff = Tiff::open(file, 0, length)?;
    let directory = tiff.first_directory()?;
    let mut most = 0;
    tiff.each(directory, u16::MAX, |_, entry| {
        if BASELINE_TAGS.contains(&entry.tag) && entry.kind != kind::ASCII {
            most = most.max(entry.count);
        }
    });
    Some(most)
}

/// The fields that are read, as they are in the file.
#[derive(Debug, Default)]
struct Fields {
    make: Option<String>,
    model: Option<String>,
    modified: Option<String>,
    taken: Option<String>,
    utc_offset: Option<String>,
    focal_mm: Option<f64>,
    film_focal_mm: Option<u32>,
    latitude: Angle,
    longitude: Angle,
    is_below: bool,
    height_m: Option<f64>,
}

/// Degrees, minutes and seconds, and the half of the globe.
#[derive(Debug, Default)]
struct Angle {
    parts: Option<[f64; 3]>,
    half: Option<String>,
}

impl Angle {
    /// Degrees with their sign.
    fn degrees(&self, negative: char) -> Option<f64> {
        let degrees: f64 = self.parts?.iter().zip([1.0, 60.0, 3600.0]).map(|(part, unit)| part / unit).sum();
        let sign = if self.half.as_ref()?.starts_with(negative) { -1.0 } else { 1.0 };
        degrees.is_finite().then_some(sign * degrees)
    }
}

/// Tags of the directories (EXIF 2.32, tables 3 to 12; TIFF 6.0).
mod tag {
    pub const MAKE: u16 = 0x010f;
    pub const MODEL: u16 = 0x0110;
    pub const DATE_TIME: u16 = 0x0132;
    pub const EXIF_DIRECTORY: u16 = 0x8769;
    pub const GPS_DIRECTORY: u16 = 0x8825;
    pub const DATE_TIME_ORIGINAL: u16 = 0x9003;
    pub const OFFSET_TIME_ORIGINAL: u16 = 0x9011;
    pub const FOCAL_LENGTH: u16 = 0x920a;
    pub const FILM_FOCAL_LENGTH: u16 = 0xa405;
    pub const LATITUDE_HALF: u16 = 1;
    pub const LATITUDE: u16 = 2;
    pub const LONGITUDE_HALF: u16 = 3;
    pub const LONGITUDE: u16 = 4;
    pub const HEIGHT_SIDE: u16 = 5;
    pub const HEIGHT: u16 = 6;
}

impl Fields {
    fn of_file(path: &Path) -> Option<Self> {
        let mut file = File::open(path).ok()?;
        let (start, length) = find(&mut file)?;
        let mut tiff = Tiff::open(file, start, length)?;
        let mut fields = Self::default();
        let (mut exif, mut gps) = (None, None);
        let first = tiff.first_directory()?;
        tiff.each(first, MAX_ENTRIES, |tiff, entry| match entry.tag {
            tag::MAKE => fields.make = tiff.text(entry),
            tag::MODEL => fields.model = tiff.text(entry),
            tag::DATE_TIME => fields.modified = tiff.text(entry),
            tag::EXIF_DIRECTORY => exif = tiff.number(entry),
            tag::GPS_DIRECTORY => gps = tiff.number(entry),
            _ => {}
        });
        if let Some(exif) = exif {
            tiff.each(exif, MAX_ENTRIES, |tiff, entry| match entry.tag {
                tag::DATE_TIME_ORIGINAL => fields.taken = tiff.text(entry),
                tag::OFFSET_TIME_ORIGINAL => fields.utc_offset = tiff.text(entry),
                tag::FOCAL_LENGTH => fields.focal_mm = tiff.rationals(entry).map(|[focal_mm, ..]| focal_mm),
                tag::FILM_FOCAL_LENGTH => fields.film_focal_mm = tiff.number(entry),
                _ => {}
            });
        }
        if let Some(gps) = gps {
            tiff.each(gps, MAX_ENTRIES, |tiff, entry| match entry.tag {
                tag::LATITUDE_HALF => fields.latitude.half = tiff.text(entry),
                tag::LATITUDE => fields.latitude.parts = tiff.rationals(entry),
                tag::LONGITUDE_HALF => fields.longitude.half = tiff.text(entry),
                tag::LONGITUDE => fields.longitude.parts = tiff.rationals(entry),
                tag::HEIGHT_SIDE => fields.is_below = tiff.number(entry) == Some(1),
                tag::HEIGHT => fields.height_m = tiff.rationals(entry).map(|[height_m, ..]| height_m),
                _ => {}
            });
        }
        Some(fields)
    }

    fn camera(&self) -> Option<String> {
        let name = |text: &Option<String>| Some(text.as_ref()?.chars().take(MAX_CAMERA).collect::<String>());
        match (name(&self.make), name(&self.model)) {
            // Some makers say their name in the model again.
            (Some(make), Some(model)) if !model.starts_with(&make) => Some(format!("{make} {model}")),
            (make, model) => model.or(make),
        }
    }

    fn taken(&self) -> Option<String> {
        let written = self.taken.as_ref().or(self.modified.as_ref())?;
        // "2026:06:21 10:11:12"
        let time = jiff::civil::DateTime::strptime("%Y:%m:%d %H:%M:%S", written).ok()?;
        let offset = self.utc_offset.as_deref().filter(|offset| {
            let bytes = offset.as_bytes();
            bytes.len() == 6
                && matches!(bytes[0], b'+' | b'-')
                && bytes[3] == b':'
                && [1, 2, 4, 5].iter().all(|at| bytes[*at].is_ascii_digit())
        });
        Some(format!("{time}{}", offset.unwrap_or_default()))
    }

    fn position(&self) -> Option<Position> {
        let latitude_deg = self.latitude.degrees('S').filter(|deg| deg.abs() <= 90.0)?;
        let longitude_deg = self.longitude.degrees('W').filter(|deg| deg.abs() <= 180.0)?;
        // What receivers write before they know where they are.
        if latitude_deg == 0.0 && longitude_deg == 0.0 {
            return None;
        }
        let height_m = self.height_m.map(|height_m| if self.is_below { -height_m } else { height_m });
        Some(Position {
            latitude_deg,
            longitude_deg,
            height_m: height_m.filter(|height_m| HEIGHTS_M.contains(height_m)),
        })
    }
}

/// A JPEG's EXIF is looked for in so many bytes of its beginning: it stands in one of the first segments.
const JPEG_HEADER_BYTES: u64 = 1 << 20;
/// Chunks of a PNG among which its EXIF is looked for; 100 megapixels in chunks of 8 KiB are fewer.
const MAX_PNG_CHUNKS: usize = 100_000;
const JPEG_START: [u8; 2] = [0xff, 0xd8];
const PNG_START: [u8; 8] = *b"\x89PNG\r\n\x1a\n";
/// How a JPEG's segment of EXIF begins.
const JPEG_EXIF: [u8; 6] = *b"Exif\0\0";

/// Where in a photo the TIFF structure is that holds its EXIF: first byte and length.
fn find<R: Read + Seek>(file: &mut R) -> Option<(u64, u64)> {
    let length = file.seek(SeekFrom::End(0)).ok()?;
    file.rewind().ok()?;
    let mut start = [0; 8];
    file.read_exact(&mut start).ok()?;
    match start {
        [a, b, ..] if [a, b] == JPEG_START => find_in_jpeg(file),
        PNG_START => find_in_png(file),
        [b'I', b'I', ..] | [b'M', b'M', ..] => Some((0, length)),
        _ => None,
    }
}

fn find_in_jpeg<R: Read + Seek>(file: &mut R) -> Option<(u64, u64)> {
    let mut at = file.seek(SeekFrom::Start(2)).ok()?;
    while at < JPEG_HEADER_BYTES {
        let mut head = [0; 4];
        file.seek(SeekFrom::Start(at)).ok()?;
        file.read_exact(&mut head).ok()?;
        let [0xff, marker, high, low] = head else { return None };
        let length = u64::from(u16::from_be_bytes([high, low]));
        match marker {
            // A fill byte.
            0xff => {
                at += 1;
                continue;
            }
            // The picture, or its end.
            0xda | 0xd9 => return None,
            0xe1 if length >= 2 + JPEG_EXIF.len() as u64 => {
                let mut name = [0; JPEG_EXIF.len()];
                file.read_exact(&mut name).ok()?;
                if name == JPEG_EXIF {
                    return Some((at + 10, length - 8));
                }
            }
            _ => {}
        }
        at += 2 + length.max(2);
    }
    None
}

fn find_in_png<R: Read + Seek>(file: &mut R) -> Option<(u64, u64)> {
    let mut at = PNG_START.len() as u64;
    for _ in 0..MAX_PNG_CHUNKS {
        let mut head = [0; 8];
        file.seek(SeekFrom::Start(at)).ok()?;
        file.read_exact(&mut head).ok()?;
        let length = u64::from(u32::from_be_bytes([head[0], head[1], head[2], head[3]]));
        match &head[4..] {
            b"eXIf" => return Some((at + 8, length)),
            b"IEND" => return None,
            _ => at += 8 + length + 4,
        }
    }
    None
}

/// Most entries of a directory that are looked at; cameras write fewer than a hundred.
const MAX_ENTRIES: u16 = 1000;
/// Most bytes of a text that are read.
const MAX_TEXT_BYTES: usize = 256;

/// An entry of a directory.
#[derive(Debug, Clone, Copy)]
struct Entry {
    tag: u16,
    kind: u16,
    count: u32,
    /// The value itself where it fits, else its place.
    value: [u8; 4],
}

/// Kinds of values (TIFF 6.0, section 2; `UTF8`: EXIF 3.0).
mod kind {
    pub const BYTE: u16 = 1;
    pub const ASCII: u16 = 2;
    pub const SHORT: u16 = 3;
    pub const LONG: u16 = 4;
    pub const RATIONAL: u16 = 5;
    pub const UTF8: u16 = 129;
}

/// A TIFF structure within a file.
struct Tiff<R> {
    file: R,
    start: u64,
    length: u64,
    is_little_endian: bool,
}

impl<R: Read + Seek> Tiff<R> {
    fn open(file: R, start: u64, length: u64) -> Option<Self> {
        let mut tiff = Self { file, start, length, is_little_endian: true };
        let mut head = [0; 4];
        tiff.read_at(0, &mut head)?;
        tiff.is_little_endian = match head {
            [b'I', b'I', 42, 0] => true,
            [b'M', b'M', 0, 42] => false,
            _ => return None,
        };
        Some(tiff)
    }

    fn read_at(&mut self, offset: u64, bytes: &mut [u8]) -> Option<()> {
        let end = offset.checked_add(bytes.len() as u64)?;
        if end > self.length {
            return None;
        }
        self.file.seek(SeekFrom::Start(self.start.checked_add(offset)?)).ok()?;
        self.file.read_exact(bytes).ok()
    }

    fn u16(&self, bytes: [u8; 2]) -> u16 {
        if self.is_little_endian { u16::from_le_bytes(bytes) } else { u16::from_be_bytes(bytes) }
    }

    fn u32(&self, bytes: [u8; 4]) -> u32 {
        if self.is_little_endian { u32::from_le_bytes(bytes) } else { u32::from_be_bytes(bytes) }
    }

    fn first_directory(&mut self) -> Option<u32> {
        let mut offset = [0; 4];
        self.read_at(4, &mut offset)?;
        Some(self.u32(offset))
    }

    /// Visits the first entries of the directory at an offset, as far as they can be read.
    fn each(&mut self, directory: u32, most: u16, mut visit: impl FnMut(&mut Self, &Entry)) {
        let mut count = [0; 2];
        if self.read_at(directory.into(), &mut count).is_none() {
            return;
        }
        for index in 0..self.u16(count).min(most) {
            let mut entry = [0; 12];
            if self.read_at(u64::from(directory) + 2 + 12 * u64::from(index), &mut entry).is_none() {
                return;
            }
            let [a, b, c, d, e, f, g, h, value @ ..] = entry;
            let entry = Entry { tag: self.u16([a, b]), kind: self.u16([c, d]), count: self.u32([e, f, g, h]), value };
            visit(self, &entry);
        }
    }

    /// Reads the beginning of a value whose items have so many bytes; how much of it there is.
    fn value(&mut self, entry: &Entry, item_bytes: u64, bytes: &mut [u8]) -> Option<usize> {
        let all = u64::from(entry.count) * item_bytes;
        let count = bytes.len().min(usize::try_from(all).unwrap_or(usize::MAX));
        if all <= 4 {
            bytes[..count].copy_from_slice(&entry.value[..count]);
        } else {
            let offset = u64::from(self.u32(entry.value));
            self.read_at(offset, &mut bytes[..count])?;
        }
        Some(count)
    }

    /// The first line of a text, without what cannot be shown.
    fn text(&mut self, entry: &Entry) -> Option<String> {
        if !matches!(entry.kind, kind::ASCII | kind::UTF8) {
            return None;
        }
        let mut bytes = [0; MAX_TEXT_BYTES];
        let count = self.value(entry, 1, &mut bytes)?;
        let line = bytes[..count].split(|byte| *byte == 0).next()?;
        let shown: String = String::from_utf8_lossy(line).chars().filter(|c| !c.is_control()).collect();
        let shown = shown.trim();
        (!shown.is_empty()).then(|| shown.to_owned())
    }

    fn number(&mut self, entry: &Entry) -> Option<u32> {
        if entry.count == 0 {
            return None;
        }
        let [a, b, ..] = entry.value;
        match entry.kind {
            kind::BYTE if entry.count <= 4 => Some(a.into()),
            kind::SHORT if entry.count <= 2 => Some(self.u16([a, b]).into()),
            kind::LONG if entry.count == 1 => Some(self.u32(entry.value)),
            _ => None,
        }
    }

    /// The first three of some fractions, zero where there are fewer.
    fn rationals(&mut self, entry: &Entry) -> Option<[f64; 3]> {
        if entry.kind != kind::RATIONAL || entry.count == 0 {
            return None;
        }
        let mut bytes = [0; 24];
        let count = self.value(entry, 8, &mut bytes)?;
        let mut numbers = [0.0; 3];
        for (number, parts) in numbers.iter_mut().zip(bytes[..count].as_chunks::<8>().0) {
            let [a, b, c, d, e, f, g, h] = *parts;
            *number = f64::from(self.u32([a, b, c, d])) / f64::from(self.u32([e, f, g, h]));
        }
        numbers.iter().all(|number| number.is_finite()).then_some(numbers)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use exif::experimental::Writer;
    use exif::{Field, In, Rational, Tag, Value};

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
