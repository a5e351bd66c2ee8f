//! The header of a PLY file: its encoding, and the elements up to the vertices.

use crate::reconstruction::ReconstructionError;
use std::io::{BufRead, Read};
use std::path::Path;

const MAX_HEADER_BYTES: usize = 64 * 1024;

#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Encoding {
    Ascii,
    LittleEndian,
    BigEndian,
}

#[derive(Debug, Clone, Copy)]
pub(super) enum Scalar {
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

    pub(super) fn size(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }

    /// The value of a field of a binary record; `bytes` holds at least `size` bytes.
    pub(super) fn read(self, bytes: &[u8], big_endian: bool) -> f64 {
        let mut field = [0_u8; 8];
        let size = self.size();
        field[..size].copy_from_slice(&bytes[..size]);
        if big_endian {
            field[..size].reverse();
        }
        match self {
            Self::I8 => f64::from(field[0] as i8),
            Self::U8 => f64::from(field[0]),
            Self::I16 => f64::from(i16::from_le_bytes([field[0], field[1]])),
            Self::U16 => f64::from(u16::from_le_bytes([field[0], field[1]])),
            Self::I32 => f64::from(i32::from_le_bytes([field[0], field[1], field[2], field[3]])),
            Self::U32 => f64::from(u32::from_le_bytes([field[0], field[1], field[2], field[3]])),
            Self::F32 => f64::from(f32::from_le_bytes([field[0], field[1], field[2], field[3]])),
            Self::F64 => f64::from_le_bytes(field),
        }
    }
}

/// What a record of an element holds, in order.
#[derive(Debug, Clone)]
pub(super) enum Property {
    Scalar(Scalar),
    /// A count, then that many items (OpenMVS writes the views of each vertex so).
    List {
        count: Scalar,
        item: Scalar,
    },
}

impl Property {
    /// The fewest bytes that it takes in a binary file.
    fn min_bytes(&self) -> u64 {
        match self {
            Self::Scalar(scalar) | Self::List { count: scalar, .. } => scalar.size() as u64,
        }
    }
}

/// One kind of record.
#[derive(Debug)]
pub(super) struct Element {
    pub(super) name: String,
    pub(super) count: u64,
    pub(super) properties: Vec<Property>,
    names: Vec<String>,
}

impl Element {
    /// The fewest bytes that a record takes: in ASCII one digit and one separator a property.
    pub(super) fn min_record_bytes(&self, encoding: Encoding) -> u64 {
        match encoding {
            Encoding::Ascii => 2 * self.properties.len() as u64,
            _ => self.properties.iter().map(Property::min_bytes).sum(),
        }
    }

    /// Bytes of a binary record, `None` where it holds lists.
    pub(super) fn record_bytes(&self) -> Option<usize> {
        let sizes = self.properties.iter().map(|property| match property {
            Property::Scalar(scalar) => Some(scalar.size()),
            Property::List { .. } => None,
        });
        sizes.sum()
    }
}

/// The elements before the vertices, the vertices, and where x, y and z stand among the properties of a vertex.
pub(super) struct Header {
    pub(super) encoding: Encoding,
    pub(super) before: Vec<Element>,
    pub(super) vertex: Element,
    pub(super) fields: [usize; 3],
    /// Bytes of the header itself.
    pub(super) bytes: u64,
}

/// Reads the header; what stands behind the vertices is not looked at.
pub(super) fn read_header(path: &Path, reader: &mut impl BufRead) -> Result<Header, ReconstructionError> {
    let malformed = |what: String| ReconstructionError::Malformed { path: path.to_owned(), what };
    let mut encoding = None;
    let mut elements: Vec<Element> = Vec::new();
    let mut consumed = 0;
    loop {
        let line = read_line(path, reader, consumed)?;
        let first = consumed == 0;
        consumed += line.len();
        let text = String::from_utf8_lossy(&line);
        let words: Vec<&str> = text.split_ascii_whitespace().collect();
        if first && words != ["ply"] {
            return Err(malformed("it does not begin with `ply`".to_owned()));
        }
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
                let count = count.parse::<u64>().map_err(|_| malformed(format!("`{count}` is no count")))?;
                elements.push(Element { name: (*name).to_owned(), count, properties: Vec::new(), names: Vec::new() });
            }
            ["property", kind @ .., name] => {
                let element =
                    elements.last_mut().ok_or_else(|| malformed("a property belongs to no element".to_owned()))?;
                element.properties.push(property(kind).map_err(malformed)?);
                element.names.push((*name).to_owned());
            }
            ["end_header"] => break,
            _ => {}
        }
    }
    let Some(at) = elements.iter().position(|element| element.name == "vertex") else {
        return Err(malformed("it has no vertices".to_owned()));
    };
    let vertex = elements.swap_remove(at);
    elements.truncate(at);
    let place = |name: &str| vertex.names.iter().position(|property| property == name);
    let (Some(x), Some(y), Some(z)) = (place("x"), place("y"), place("z")) else {
        return Err(malformed("its vertices have no x, y and z".to_owned()));
    };
    let fields = [x, y, z];
    if fields.iter().any(|field| matches!(vertex.properties[*field], Property::List { .. })) {
        return Err(malformed("x, y or z of its vertices is a list".to_owned()));
    }
    let encoding = encoding.ok_or_else(|| malformed("it names no format".to_owned()))?;
    Ok(Header { encoding, before: elements, vertex, fields, bytes: consumed as u64 })
}

fn read_line(path: &Path, reader: &mut impl BufRead, consumed: usize) -> Result<Vec<u8>, ReconstructionError> {
    let mut line = Vec::new();
    reader
        .take((MAX_HEADER_BYTES - consumed.min(MAX_HEADER_BYTES)) as u64)
        .read_until(b'\n', &mut line)
        .map_err(|source| ReconstructionError::Unreadable { path: path.to_owned(), source })?;
    if line.last() != Some(&b'\n') {
        let what = "the PLY header does not end".to_owned();
        return Err(ReconstructionError::Malformed { path: path.to_owned(), what });
    }
    Ok(line)
}

/// The type of a property, from the words between `property` and its name.
fn property(kind: &[&str]) -> Result<Property, String> {
    let scalar = |word: &str| Scalar::parse(word).ok_or_else(|| format!("`{word}` is no PLY type"));
    match kind {
        ["list", count, item] => Ok(Property::List { count: scalar(count)?, item: scalar(item)? }),
        [kind] => Ok(Property::Scalar(scalar(kind)?)),
        _ => Err("a property has the wrong number of words".to_owned()),
    }
}
