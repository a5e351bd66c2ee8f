//! Point clouds in PLY, ASCII or binary, as any producer writes them: positions, read as a stream and thinned as they come
//! where there are very many. The size that a header promises is checked against the file before anything is allocated.

mod header;

use super::error::ReconstructionError;
use crate::geometry::PointCloud;
use crate::geometry::point_cloud::ThinningCloud;
use header::{Element, Encoding, Header, Property, read_header};
use std::fs::File;
use std::io::{self, BufRead, BufReader, Read};
use std::path::Path;

/// Most points that a file may promise.
const MAX_POINTS: u64 = 2_000_000_000;
/// Most points that are kept, a bound on memory (12 bytes each, and 16 while they are thinned).
const MAX_KEPT: usize = 16_000_000;
/// Most items of one list of one record: a vertex is seen by fewer views.
const MAX_LIST_ITEMS: f64 = 1e6;
/// Longest word of an ASCII file, bytes.
const MAX_WORD_BYTES: usize = 400;

/// Reads the vertices of a PLY file: positions in metres in the file's own frame. Points with a coordinate that is not
/// finite are left out; of more than 16 million points one in each cube of a regular grid is kept.
///
/// # Errors
/// An empty cloud, fewer points than promised, more than can be held, or a header that is not PLY.
pub fn read(path: &Path) -> Result<PointCloud, ReconstructionError> {
    let mut open = Open::new(path)?;
    let mut thinning = ThinningCloud::new(MAX_KEPT, open.header.vertex.count as usize);
    open.each(&mut |position| thinning.push(position))?;
    let (cloud, _) = thinning.finish();
    if cloud.positions_m.is_empty() {
        return Err(ReconstructionError::EmptyCloud { path: path.to_owned() });
    }
    Ok(cloud)
}

/// Reads a PLY file through as [`read`] does, and keeps nothing.
///
/// # Errors
/// Those of [`read`].
pub fn check(path: &Path) -> Result<(), ReconstructionError> {
    let mut points = 0_u64;
    Open::new(path)?.each(&mut |_| points += 1)?;
    if points == 0 { Err(ReconstructionError::EmptyCloud { path: path.to_owned() }) } else { Ok(()) }
}

/// A file whose header is read.
struct Open<'a> {
    path: &'a Path,
    reader: BufReader<File>,
    header: Header,
}

impl<'a> Open<'a> {
    fn new(path: &'a Path) -> Result<Self, ReconstructionError> {
        let unreadable = |source| ReconstructionError::Unreadable { path: path.to_owned(), source };
        let file = File::open(path).map_err(unreadable)?;
        let file_bytes = file.metadata().map_err(unreadable)?.len();
        let mut reader = BufReader::with_capacity(1 << 20, file);
        let header = read_header(path, &mut reader)?;
        check_size(path, &header, file_bytes)?;
        Ok(Self { path, reader, header })
    }

    /// Gives every vertex whose coordinates are finite.
    fn each(&mut self, take: &mut dyn FnMut([f32; 3])) -> Result<(), ReconstructionError> {
        let Self { path, reader, header } = self;
        let mut push = |position: [f32; 3]| {
            if position.iter().all(|value| value.is_finite()) {
                take(position);
            }
        };
        if header.encoding == Encoding::Ascii {
            return read_records(path, &mut Words { reader }, header, &mut push);
        }
        let big_endian = header.encoding == Encoding::BigEndian;
        let mut fields = Fields { reader, big_endian };
        if header.vertex.record_bytes().is_some() && header.before.is_empty() {
            fields.read_fixed(path, header, &mut push)
        } else {
            read_records(path, &mut fields, header, &mut push)
        }
    }
}

/// Refuses a header that promises nothing, more than is read, or more than the file holds.
fn check_size(path: &Path, header: &Header, file_bytes: u64) -> Result<(), ReconstructionError> {
    let promised = header.vertex.count;
    if promised == 0 {
        return Err(ReconstructionError::EmptyCloud { path: path.to_owned() });
    }
    if promised > MAX_POINTS {
        return Err(ReconstructionError::CloudTooLarge { path: path.to_owned(), promised, limit: MAX_POINTS });
    }
    // The last separator of an ASCII file may be missing.
    let available = file_bytes - header.bytes + 1;
    let min_bytes = |element: &Element| element.min_record_bytes(header.encoding).max(1);
    let before = header
        .before
        .iter()
        .fold(0_u64, |sum, element| sum.saturating_add(element.count.saturating_mul(min_bytes(element))));
    let held = available.saturating_sub(before) / min_bytes(&header.vertex);
    if held < promised {
        return Err(ReconstructionError::TruncatedCloud { path: path.to_owned(), promised, held });
    }
    Ok(())
}

/// A source of the values of records, one after the other.
trait Values {
    /// The next value, as a property of this type has it.
    fn next(&mut self, scalar: header::Scalar) -> io::Result<f64>;
}

/// The numbers of an ASCII file, whatever the line they stand on.
struct Words<R> {
    reader: R,
}

impl<R: BufRead> Values for Words<R> {
    fn next(&mut self, _: header::Scalar) -> io::Result<f64> {
        let mut word = [0_u8; MAX_WORD_BYTES];
        let mut length = 0;
        loop {
            let buffer = self.reader.fill_buf()?;
            if buffer.is_empty() {
                break;
            }
            let (mut used, mut ended) = (0, false);
            for byte in buffer {
                used += 1;
                if !byte.is_ascii_whitespace() {
                    *word.get_mut(length).ok_or_else(|| io::Error::from(io::ErrorKind::InvalidData))? = *byte;
                    length += 1;
                } else if length > 0 {
                    ended = true;
                    break;
                }
            }
            self.reader.consume(used);
            if ended {
                break;
            }
        }
        if length == 0 {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        let text = std::str::from_utf8(&word[..length]).ok();
        text.and_then(|text| text.parse().ok()).ok_or_else(|| io::ErrorKind::InvalidData.into())
    }
}

/// The fields of a binary file.
struct Fields<R> {
    reader: R,
    big_endian: bool,
}

impl<R: Read> Values for Fields<R> {
    fn next(&mut self, scalar: header::Scalar) -> io::Result<f64> {
        let mut bytes = [0_u8; 8];
        let size = scalar.size();
        self.reader.read_exact(&mut bytes[..size])?;
        Ok(scalar.read(&bytes, self.big_endian))
    }
}

impl<R: Read> Fields<R> {
    /// Reads vertices without lists: whole records at once.
    fn read_fixed(
        &mut self,
        path: &Path,
        header: &Header,
        push: &mut impl FnMut([f32; 3]),
    ) -> Result<(), ReconstructionError> {
        let mut offsets = Vec::with_capacity(header.vertex.properties.len());
        let mut size = 0;
        for property in &header.vertex.properties {
            if let Property::Scalar(scalar) = property {
                offsets.push((size, *scalar));
                size += scalar.size();
            }
        }
        let fields = header.fields.map(|index| offsets[index]);
        let mut record = vec![0_u8; size];
        for done in 0..header.vertex.count {
            self.reader.read_exact(&mut record).map_err(|error| broken(path, header, done, error))?;
            push(fields.map(|(at, scalar)| scalar.read(&record[at..], self.big_endian) as f32));
        }
        Ok(())
    }
}

/// Reads records value by value: those of the elements before the vertices are passed over.
fn read_records(
    path: &Path,
    values: &mut impl Values,
    header: &Header,
    push: &mut impl FnMut([f32; 3]),
) -> Result<(), ReconstructionError> {
    for element in &header.before {
        for _ in 0..element.count {
            read_record(values, element, |_, _| {}).map_err(|error| broken(path, header, 0, error))?;
        }
    }
    for done in 0..header.vertex.count {
        let mut position = [0.0_f32; 3];
        read_record(values, &header.vertex, |index, value| {
            if let Some(slot) = header.fields.iter().position(|field| *field == index) {
                position[slot] = value as f32;
            }
        })
        .map_err(|error| broken(path, header, done, error))?;
        push(position);
    }
    Ok(())
}

/// Reads one record; `scalar` takes the index and value of each property that is no list.
fn read_record(values: &mut impl Values, element: &Element, mut scalar: impl FnMut(usize, f64)) -> io::Result<()> {
    for (index, property) in element.properties.iter().enumerate() {
        match property {
            Property::Scalar(kind) => scalar(index, values.next(*kind)?),
            Property::List { count, item } => {
                let items = values.next(*count)?;
                if !(0.0..=MAX_LIST_ITEMS).contains(&items) {
                    return Err(io::ErrorKind::InvalidData.into());
                }
                for _ in 0..items as u64 {
                    values.next(*item)?;
                }
            }
        }
    }
    Ok(())
}

/// Why a record could not be read, after `done` vertices.
fn broken(path: &Path, header: &Header, done: u64, error: io::Error) -> ReconstructionError {
    let path = path.to_owned();
    match error.kind() {
        io::ErrorKind::UnexpectedEof => {
            ReconstructionError::TruncatedCloud { path, promised: header.vertex.count, held: done }
        }
        io::ErrorKind::InvalidData => {
            ReconstructionError::Malformed { path, what: format!("point {} is not as its header describes", done + 1) }
        }
        _ => ReconstructionError::Unreadable { path, source: error },
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write;

    fn file(bytes: &[u8]) -> tempfile::NamedTempFile {
        let mut file = tempfile::NamedTempFile::new().unwrap();
        file.write_all(bytes).unwrap();
        file
    }

    fn ascii(promised: usize, lines: &str) -> Vec<u8> {
        format!("ply\nformat ascii 1.0\nelement vertex {promised}\nproperty float x\nproperty float y\nproperty float z\nproperty float nx\nproperty float ny\nproperty float nz\nproperty uchar red\nend_header\n{lines}").into_bytes()
    }

    #[test]
    fn ascii_and_both_binary_forms_agree() {
        let expected = [[1.5_f32, -2.0, 400.25], [3.0, 4.0, 401.0]];
        let text = read(file(&ascii(2, "1.5 -2 400.25 0 0 1 7\n3 4 401 0 1 0 9\n")).path()).unwrap();
        assert_eq!(text.positions_m, expected);
        for big in [false, true] {
            let name = if big { "binary_big_endian" } else { "binary_little_endian" };
            let mut bytes = format!(
                "ply\nformat {name} 1.0\nelement vertex 2\nproperty float x\nproperty double y\nproperty float z\nproperty uchar red\nend_header\n"
            )
            .into_bytes();
            for p in expected {
                let y = f64::from(p[1]);
                if big {
                    bytes.extend(p[0].to_be_bytes());
                    bytes.extend(y.to_be_bytes());
                    bytes.extend(p[2].to_be_bytes());
                } else {
                    bytes.extend(p[0].to_le_bytes());
                    bytes.extend(y.to_le_bytes());
                    bytes.extend(p[2].to_le_bytes());
                }
                bytes.push(3);
            }
            let binary = read(file(&bytes).path()).unwrap();
            assert_eq!(binary.positions_m, expected);
            bytes.truncate(bytes.len() - 5);
            assert!(matches!(
                read(file(&bytes).path()),
                Err(ReconstructionError::TruncatedCloud { promised: 2, held: 1, .. })
            ));
        }
    }

    #[test]
    fn broken_clouds_are_refused_by_name() {
        assert!(matches!(read(file(&ascii(0, "")).path()), Err(ReconstructionError::EmptyCloud { .. })));
        assert!(matches!(
            read(file(&ascii(3, "1 2 3 0 0 1 7\n")).path()),
            Err(ReconstructionError::TruncatedCloud { .. })
        ));
        // A promise of terabytes is refused before anything is allocated.
        assert!(matches!(
            read(file(&ascii(100_000_000_000, "1 2 3 0 0 1 7\n")).path()),
            Err(ReconstructionError::CloudTooLarge { .. })
        ));
        assert!(matches!(read(file(b"solid cube\n").path()), Err(ReconstructionError::Malformed { .. })));
        assert!(matches!(read(file(b"ply").path()), Err(ReconstructionError::Malformed { .. })));
        assert!(matches!(
            read(file(&ascii(1, "1 two 3 0 0 1 7\n")).path()),
            Err(ReconstructionError::Malformed { .. })
        ));
    }

    #[test]
    fn lists_other_elements_and_wrapped_lines_are_read() {
        let expected = [[1.5_f32, -2.0, 400.25], [3.0, 4.0, 401.0]];
        let mut bytes = b"ply\nformat binary_little_endian 1.0\nelement camera 1\nproperty float view_px\nproperty list uchar int hull\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nproperty list uchar uint views\nproperty list uchar float weights\nend_header\n".to_vec();
        bytes.extend(1.0_f32.to_le_bytes());
        bytes.extend([1, 7, 0, 0, 0]);
        for (point, views) in expected.iter().zip([2_u8, 0]) {
            point.iter().for_each(|value| bytes.extend(value.to_le_bytes()));
            bytes.push(views);
            bytes.extend(vec![0; 4 * usize::from(views)]);
            bytes.push(1);
            bytes.extend(0.5_f32.to_le_bytes());
        }
        assert_eq!(read(file(&bytes).path()).unwrap().positions_m, expected);
        bytes.truncate(bytes.len() - 3);
        assert!(matches!(
            read(file(&bytes).path()),
            Err(ReconstructionError::TruncatedCloud { promised: 2, held: 1, .. })
        ));
        let wrapped = "\n1.5 -2\n 400.25 0 0 1 7 3 4 401 0 1\n\n0 9";
        assert_eq!(read(file(&ascii(2, wrapped)).path()).unwrap().positions_m, expected);
    }
}
