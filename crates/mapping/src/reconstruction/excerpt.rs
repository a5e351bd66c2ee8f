//! A photo's file without what is no part of its picture: metadata, which may be as large as an upload and means nothing to
//! a decoder.

use std::io::{self, Read, Seek, SeekFrom};
use std::ops::Range;

/// Most parts of a file; a camera's has a few.
const MAX_PARTS: usize = 4096;

/// A file is in more parts than any camera makes.
#[derive(Debug)]
pub struct TooManyParts;

/// Parts of a file, in order.
#[derive(Debug, Default)]
pub struct Parts(Vec<Range<u64>>);

impl Parts {
    /// Adds bytes behind the last.
    pub fn add(&mut self, bytes: Range<u64>) -> Result<(), TooManyParts> {
        let count = self.0.len();
        match self.0.last_mut() {
            Some(last) if last.end == bytes.start => last.end = bytes.end,
            _ if count < MAX_PARTS => self.0.push(bytes),
            _ => return Err(TooManyParts),
        }
        Ok(())
    }

    fn bytes(&self) -> u64 {
        self.0.iter().map(|part| part.end - part.start).sum()
    }

    /// How many bytes follow in the file from a place among the parts on, and where in the file they are.
    fn find(&self, mut at: u64) -> Option<(u64, u64)> {
        for part in &self.0 {
            let length = part.end - part.start;
            if at < length {
                return Some((length - at, part.start + at));
            }
            at -= length;
        }
        None
    }
}

/// Reads parts of a file as if nothing were between them.
#[derive(Debug)]
pub struct Excerpt<R> {
    file: R,
    parts: Parts,
    at: u64,
}

impl<R> Excerpt<R> {
    pub fn new(file: R, parts: Parts) -> Self {
        Self { file, parts, at: 0 }
    }
}

impl<R: Read + Seek> Read for Excerpt<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let Some((left, place)) = self.parts.find(self.at) else { return Ok(0) };
        self.file.seek(SeekFrom::Start(place))?;
        let most = buffer.len().min(usize::try_from(left).unwrap_or(usize::MAX));
        let count = self.file.read(&mut buffer[..most])?;
        self.at += count as u64;
        Ok(count)
    }
}

impl<R: Read + Seek> Seek for Excerpt<R> {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        let at = match to {
            SeekFrom::Start(at) => Some(at),
            SeekFrom::Current(by) => self.at.checked_add_signed(by),
            SeekFrom::End(by) => self.parts.bytes().checked_add_signed(by),
        };
        self.at = at.ok_or(io::ErrorKind::InvalidInput)?;
        Ok(self.at)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Cursor;

    #[test]
    fn parts_read_as_one() {
        let mut parts = Parts::default();
        for part in [1..3, 3..4, 6..8] {
            parts.add(part).unwrap();
        }
        let mut excerpt = Excerpt::new(Cursor::new(b"0123456789"), parts);
        let mut text = String::new();
        excerpt.read_to_string(&mut text).unwrap();
        assert_eq!(text, "12367");
        assert_eq!(excerpt.seek(SeekFrom::End(-3)).unwrap(), 2);
        let mut rest = String::new();
        excerpt.read_to_string(&mut rest).unwrap();
        assert_eq!(rest, "367");
    }

    #[test]
    fn their_number_is_bounded() {
        let mut parts = Parts::default();
        for index in 0..MAX_PARTS as u64 {
            parts.add(2 * index..2 * index + 1).unwrap();
        }
        assert!(parts.add(1_000_000..1_000_001).is_err());
    }
}
