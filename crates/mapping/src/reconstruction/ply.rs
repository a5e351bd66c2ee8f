//! Point clouds in PLY, ASCII or binary: positions, read as a stream and thinned as they come where there are very many.
//! The size that a header promises is checked against the file before anything is allocated.

use super::error::ReconstructionError;
use crate::geometry::PointCloud;
use crate::geometry::point_cloud::ThinningCloud;
use std::fs::File;
use std::io::{BufRead, BufReader, Read};
use std::path::Path;

/// Most points that a file may promise.
const MAX_POINTS: u64 = 2_000_000_000;
/// Most points that are kept, a bound on memory (12 bytes each, and 16 while they are thinned).
const MOST_KEPT: usize = 16_000_000;
const MAX_HEADER_BYTES: usize = 64 * 1024;

#[derive(Debug, Clone, Copy, PartialEq)]
enum Encoding {
    Ascii,
    LittleEndian,
    BigEndian,
}

#[derive(Debug, Clone, Copy)]
enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Scalar {
    fn parse(word: &str) -> Option<Self> {
        Some(match word {
            "char" | "int8" => Self::I8,
            "uchar" | "uint8" => Self::U8,
            "short" | "int16" => Self::I16,
            "ushort" | "uint16" => Self::U16,
            "int" | "int32" => Self::I32,
            "uint" | "uint32" => Self::U32,
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return None,
        })
    }

    fn size(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }

    /// The value of a field of a binary record (`bytes` has at least `size` bytes).
    fn read(self, bytes: &[u8], big_endian: bool) -> f32 {
        let mut field = [0_u8; 8];
        let size = self.size();
        field[..size].copy_from_slice(&bytes[..size]);
        if big_endian {
            field[..size].reverse();
        }
        match self {
            Self::I8 => f32::from(field[0] as i8),
            Self::U8 => f32::from(field[0]),
            Self::I16 => f32::from(i16::from_le_bytes([field[0], field[1]])),
            Self::U16 => f32::from(u16::from_le_bytes([field[0], field[1]])),
            Self::I32 => i32::from_le_bytes([field[0], field[1], field[2], field[3]]) as f32,
            Self::U32 => u32::from_le_bytes([field[0], field[1], field[2], field[3]]) as f32,
            Self::F32 => f32::from_le_bytes([field[0], field[1], field[2], field[3]]),
            Self::F64 => f64::from_le_bytes(field) as f32,
        }
    }
}

/// The vertex element as the header describes it.
struct Header {
    encoding: Encoding,
    vertices: u64,
    properties: Vec<(String, Scalar)>,
    /// Where each of x, y, z stands among the properties.
    fields: [usize; 3],
}

/// Reads the vertices of a PLY file: positions in metres in the file's own frame. Points with a coordinate that is not
/// finite are left out; of more than 16 million points one in each cube of a regular grid is kept.
///
/// # Errors
/// An empty cloud, fewer points than promised, more than can be held, or a header that is not PLY.
pub fn read(path: &Path) -> Result<PointCloud, ReconstructionError> {
    let unreadable = |source| ReconstructionError::Unreadable { path: path.to_owned(), source };
    let file = File::open(path).map_err(unreadable)?;
    let file_bytes = file.metadata().map_err(unreadable)?.len();
    let mut reader = BufReader::with_capacity(1 << 20, file);
    let (header, header_bytes) = read_header(path, &mut reader)?;
    if header.vertices == 0 {
        return Err(ReconstructionError::EmptyCloud { path: path.to_owned() });
    }
    if header.vertices > MAX_POINTS {
        return Err(ReconstructionError::CloudTooLarge {
            path: path.to_owned(),
            promised: header.vertices,
            limit: MAX_POINTS,
        });
    }
    let record_bytes: usize = header.properties.iter().map(|(_, scalar)| scalar.size()).sum();
    // The least that a record takes: in ASCII one digit and one separator a property.
    let least_bytes = match header.encoding {
        Encoding::Ascii => 2 * header.properties.len() as u64,
        _ => record_bytes as u64,
    };
    let held = (file_bytes - header_bytes + 1) / least_bytes;
    if held < header.vertices {
        return Err(ReconstructionError::TruncatedCloud { path: path.to_owned(), promised: header.vertices, held });
    }
    let mut thinning = ThinningCloud::new(MOST_KEPT, header.vertices as usize);
    let mut push = |position: [f32; 3]| {
        if position.iter().all(|value| value.is_finite()) {
            thinning.push(position);
        }
    };
    match header.encoding {
        Encoding::Ascii => read_ascii(path, &mut reader, &header, &mut push)?,
        encoding => {
            let mut offsets = Vec::with_capacity(header.properties.len());
            let mut offset = 0;
            for (_, scalar) in &header.properties {
                offsets.push((offset, *scalar));
                offset += scalar.size();
            }
            let fields = header.fields.map(|index| offsets[index]);
            let mut record = vec![0_u8; record_bytes];
            for done in 0..header.vertices {
                reader.read_exact(&mut record).map_err(|error| match error.kind() {
                    std::io::ErrorKind::UnexpectedEof => ReconstructionError::TruncatedCloud {
                        path: path.to_owned(),
                        promised: header.vertices,
                        held: done,
                    },
                    _ => unreadable(error),
                })?;
                push(fields.map(|(at, scalar)| scalar.read(&record[at..], encoding == Encoding::BigEndian)));
            }
        }
    }
    let (cloud, _) = thinning.finish();
    if cloud.positions_m.is_empty() {
        return Err(ReconstructionError::EmptyCloud { path: path.to_owned() });
    }
    Ok(cloud)
}

fn read_ascii(
    path: &Path,
    reader: &mut impl BufRead,
    header: &Header,
    push: &mut impl FnMut([f32; 3]),
) -> Result<(), ReconstructionError> {
    let mut line = Vec::new();
    for done in 0..header.vertices {
        line.clear();
        let read = reader
            .by_ref()
            .take(MAX_HEADER_BYTES as u64)
            .read_until(b'\n', &mut line)
            .map_err(|source| ReconstructionError::Unreadable { path: path.to_owned(), source })?;
        if read == 0 {
            return Err(ReconstructionError::TruncatedCloud {
                path: path.to_owned(),
                promised: header.vertices,
                held: done,
            });
        }
        let malformed = || ReconstructionError::Malformed {
            path: path.to_owned(),
            what: format!("point {} does not hold {} numbers", done + 1, header.properties.len()),
        };
        let text = std::str::from_utf8(&line).map_err(|_| malformed())?;
        let mut values = [0.0_f32; 3];
        let mut words = 0;
        for (index, word) in text.split_ascii_whitespace().enumerate() {
            if let Some(slot) = header.fields.iter().position(|field| *field == index) {
                values[slot] = word.parse().map_err(|_| malformed())?;
            }
            words = index + 1;
        }
        if words < header.properties.len() {
            return Err(malformed());
        }
        push(values);
    }
    Ok(())
}

/// The header, and how many bytes it took.
fn read_header(path: &Path, reader: &mut impl BufRead) -> Result<(Header, u64), ReconstructionError> {
    let malformed = |what: String| ReconstructionError::Malformed { path: path.to_owned(), what };
    let mut encoding = None;
    let mut vertices = None;
    let mut properties: Vec<(String, Scalar)> = Vec::new();
    let mut elements = 0;
    let mut consumed = 0;
    let mut first = true;
    loop {
        let mut line = Vec::new();
        reader
            .by_ref()
            .take((MAX_HEADER_BYTES - consumed.min(MAX_HEADER_BYTES)) as u64)
            .read_until(b'\n', &mut line)
            .map_err(|source| ReconstructionError::Unreadable { path: path.to_owned(), source })?;
        consumed += line.len();
        if line.last() != Some(&b'\n') {
            return Err(malformed("the PLY header does not end".to_owned()));
        }
        let text = String::from_utf8_lossy(&line);
        let words: Vec<&str> = text.split_ascii_whitespace().collect();
        if first && words != ["ply"] {
            return Err(malformed("it does not begin with `ply`".to_owned()));
        }
        first = false;
        match words.as_slice() {
            ["format", name, _] => {
                encoding = Some(match *name {
                    "ascii" => Encoding::Ascii,
                    "binary_little_endian" => Encoding::LittleEndian,
                    "binary_big_endian" => Encoding::BigEndian,
                    other => return Err(malformed(format!("`{other}` is no PLY format"))),
                });
            }
            ["element", name, count] => {
                elements += 1;
                if elements == 1 {
                    if *name != "vertex" {
                        return Err(malformed(format!("its first element is `{name}`, not `vertex`")));
                    }
                    vertices = Some(count.parse::<u64>().map_err(|_| malformed(format!("`{count}` is no count")))?);
                }
            }
            ["property", "list", ..] if elements == 1 => {
                return Err(malformed("its vertices hold lists".to_owned()));
            }
            ["property", kind, name] if elements == 1 => {
                let scalar = Scalar::parse(kind).ok_or_else(|| malformed(format!("`{kind}` is no PLY type")))?;
                properties.push(((*name).to_owned(), scalar));
            }
            ["end_header"] => break,
            _ => {}
        }
    }
    let place = |name: &str| properties.iter().position(|(property, _)| property == name);
    let (Some(x), Some(y), Some(z)) = (place("x"), place("y"), place("z")) else {
        return Err(malformed("its vertices have no x, y and z".to_owned()));
    };
    let header = Header {
        encoding: encoding.ok_or_else(|| malformed("it names no format".to_owned()))?,
        vertices: vertices.ok_or_else(|| malformed("it has no vertices".to_owned()))?,
        fields: [x, y, z],
        properties,
    };
    Ok((header, consumed as u64))
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
}
