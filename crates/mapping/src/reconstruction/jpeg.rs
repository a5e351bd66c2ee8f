//! The structure of a JPEG file, read without decoding it: its size in pixels, whether it is whole, and which of its bytes
//! make the picture.

use super::excerpt::Parts;
use std::io::{self, BufRead, ErrorKind, Read};

/// What is wrong with a JPEG file.
#[derive(Debug, thiserror::Error)]
pub enum JpegError {
    /// It ends before its end-of-image marker.
    #[error("it ends before its end-of-image marker")]
    CutShort,
    /// A marker or segment where none can be.
    #[error("{0}")]
    Malformed(&'static str),
    /// Metadata between its segments so often as in no picture.
    #[error("its picture is in too many pieces")]
    TooManyParts,
    #[error(transparent)]
    Io(io::Error),
}

impl From<io::Error> for JpegError {
    fn from(error: io::Error) -> Self {
        if error.kind() == ErrorKind::UnexpectedEof { Self::CutShort } else { Self::Io(error) }
    }
}

/// Most scans of a picture: each is decoded over all of it. Programs that write progressive pictures make 6 to 14.
const MAX_SCANS: u32 = 32;

const START_OF_IMAGE: u8 = 0xd8;
const END_OF_IMAGE: u8 = 0xd9;
const START_OF_SCAN: u8 = 0xda;

/// What [`walk`] finds.
#[derive(Debug)]
pub struct Structure {
    /// Width and height.
    pub size_px: [u32; 2],
    /// The bytes that make the picture: all but metadata (application segments, comments) and what follows its end.
    pub picture: Parts,
}

/// Application segments that say how colours are to be read: JFIF and Adobe (ITU-T T.872, 6.5).
const COLOUR_SEGMENTS: [u8; 2] = [0xe0, 0xee];

fn is_metadata(marker: u8) -> bool {
    matches!(marker, 0xe0..=0xef | 0xfe) && !COLOUR_SEGMENTS.contains(&marker)
}

/// Walks through a JPEG that is whole: every segment and scan up to the first end-of-image marker. What follows (previews
/// that cameras append) is not looked at. `limit` may end the walk as soon as the size is known.
pub fn walk(file: impl BufRead, limit: impl Fn([u32; 2]) -> bool) -> Result<Structure, JpegError> {
    let mut file = Counted { inner: file, at: 0 };
    let mut start = [0; 2];
    file.read_exact(&mut start)?;
    if start != [0xff, START_OF_IMAGE] {
        return Err(JpegError::Malformed("it does not begin as a JPEG"));
    }
    let mut size_px = None;
    let mut scans = 0_u32;
    let mut picture = Parts::default();
    let mut keep = |from: u64, to: u64| picture.add(from..to).map_err(|_| JpegError::TooManyParts);
    keep(0, 2)?;
    let mut marker = next_marker(&mut file, false)?;
    loop {
        let from = file.at - 2;
        match marker {
            END_OF_IMAGE => {
                keep(from, file.at)?;
                break;
            }
            0x01 | 0xd0..=START_OF_IMAGE => {}
            _ => {
                if let Some(size) = segment(&mut file, marker)? {
                    if !limit(size) {
                        return Ok(Structure { size_px: size, picture });
                    }
                    size_px = Some(size);
                }
            }
        }
        let in_scan = marker == START_OF_SCAN;
        scans += u32::from(in_scan);
        if scans > MAX_SCANS {
            return Err(JpegError::Malformed("it is in more than 32 scans, which no camera writes"));
        }
        let next = next_marker(&mut file, in_scan)?;
        if !is_metadata(marker) {
            keep(from, file.at - 2)?;
        }
        marker = next;
    }
    match size_px {
        Some(size_px) if scans > 0 => Ok(Structure { size_px, picture }),
        _ => Err(JpegError::Malformed("it holds no picture")),
    }
}

/// Reads a segment to its end; width and height where it is a frame header, whatever the process.
fn segment(file: &mut impl BufRead, marker: u8) -> Result<Option<[u32; 2]>, JpegError> {
    let length = read_u16(file)?;
    let mut rest = u64::from(length.checked_sub(2).ok_or(JpegError::Malformed("a segment has no length"))?);
    let mut size_px = None;
    // Start of frame; not the tables and extensions among them.
    if matches!(marker, 0xc0..=0xcf) && !matches!(marker, 0xc4 | 0xc8 | 0xcc) {
        if rest < 5 {
            return Err(JpegError::Malformed("its frame header is too short"));
        }
        let mut precision = [0];
        file.read_exact(&mut precision)?;
        let height = u32::from(read_u16(file)?);
        let width = u32::from(read_u16(file)?);
        if width == 0 || height == 0 {
            return Err(JpegError::Malformed("it has no pixels"));
        }
        rest -= 5;
        size_px = Some([width, height]);
    }
    if io::copy(&mut Read::take(file, rest), &mut io::sink())? < rest {
        return Err(JpegError::CutShort);
    }
    Ok(size_px)
}

/// A reader that knows how far it came.
struct Counted<R> {
    inner: R,
    at: u64,
}

impl<R: BufRead> Read for Counted<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let count = self.inner.read(buffer)?;
        self.at += count as u64;
        Ok(count)
    }
}

impl<R: BufRead> BufRead for Counted<R> {
    fn fill_buf(&mut self) -> io::Result<&[u8]> {
        self.inner.fill_buf()
    }

    fn consume(&mut self, count: usize) {
        self.at += count as u64;
        self.inner.consume(count);
    }
}

/// The next marker; within a scan, entropy-coded bytes and restart markers are passed over.
fn next_marker(file: &mut impl BufRead, in_scan: bool) -> Result<u8, JpegError> {
    loop {
        let mut byte = [0];
        if in_scan {
            skip_to_ff(file)?;
        }
        file.read_exact(&mut byte)?;
        if byte[0] != 0xff {
            return Err(JpegError::Malformed("a marker is missing between its segments"));
        }
        while byte[0] == 0xff {
            file.read_exact(&mut byte)?;
        }
        match byte[0] {
            0x00 | 0xd0..=0xd7 if in_scan => {}
            0x00 => return Err(JpegError::Malformed("a marker is missing between its segments")),
            marker => return Ok(marker),
        }
    }
}

fn skip_to_ff(file: &mut impl BufRead) -> Result<(), JpegError> {
    loop {
        let buffer = file.fill_buf()?;
        if buffer.is_empty() {
            return Err(JpegError::CutShort);
        }
        match buffer.iter().position(|byte| *byte == 0xff) {
            Some(at) => {
                file.consume(at);
                return Ok(());
            }
            None => {
                let all = buffer.len();
                file.consume(all);
            }
        }
    }
}

fn read_u16(file: &mut impl BufRead) -> Result<u16, JpegError> {
    let mut bytes = [0; 2];
    file.read_exact(&mut bytes)?;
    Ok(u16::from_be_bytes(bytes))
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::codecs::jpeg::JpegEncoder;

    fn jpeg() -> Vec<u8> {
        let image = image::RgbImage::from_fn(64, 48, |x, y| image::Rgb([(x * 7) as u8, (y * 5) as u8, (x * y) as u8]));
        let mut bytes = Vec::new();
        JpegEncoder::new_with_quality(&mut bytes, 95).encode_image(&image).unwrap();
        bytes
    }

    #[test]
    fn a_whole_image_has_its_size_even_with_bytes_behind_it() {
        let mut bytes = jpeg();
        assert_eq!(walk(&bytes[..], |_| true).unwrap().size_px, [64, 48]);
        bytes.extend_from_slice(b"preview");
        assert_eq!(walk(&bytes[..], |_| true).unwrap().size_px, [64, 48]);
    }

    #[test]
    fn every_way_to_cut_it_is_seen() {
        let bytes = jpeg();
        for end in 0..bytes.len() {
            assert!(walk(&bytes[..end], |_| true).is_err(), "cut at {end} of {}", bytes.len());
        }
    }

    #[test]
    fn pictures_of_very_many_scans_are_refused() {
        let bytes = jpeg();
        let scan = bytes.windows(2).position(|pair| pair == [0xff, START_OF_SCAN]).unwrap();
        let (head, data) = bytes[..bytes.len() - 2].split_at(scan);
        let of = |scans: usize| [head, &data.repeat(scans), &[0xff, END_OF_IMAGE]].concat();
        assert!(walk(&of(MAX_SCANS as usize)[..], |_| true).is_ok());
        assert!(matches!(walk(&of(MAX_SCANS as usize + 1)[..], |_| true), Err(JpegError::Malformed(_))));
    }

    #[test]
    fn the_limit_is_asked_before_the_scan() {
        let bytes = jpeg();
        assert_eq!(walk(&bytes[..bytes.len() / 2], |_| false).unwrap().size_px, [64, 48]);
    }
}
