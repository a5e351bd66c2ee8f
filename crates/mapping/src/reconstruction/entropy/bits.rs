//! The bits of a JPEG's data, and why reading them ends.

use super::huffman::Table;
use std::io::{BufRead, ErrorKind, Read};

/// Most bytes between the last block of a scan and the next marker: some encoders fill up.
const MAX_FILL_BYTES: u32 = 16;
/// Why data is damaged.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Damage {
    /// A code that the tables do not have.
    NoSuchCode,
    /// More coefficients than a block has.
    TooManyCoefficients,
    /// A block brighter or darker than any.
    Mean,
    /// A restart marker is missing or out of order.
    Restart,
    /// Data ends before the last block.
    EndsEarly,
    /// Data goes on after the last block.
    GoesOn,
}

/// What reading on gives up with.
pub(super) enum Stop {
    Damaged(Damage),
    /// The file is no JPEG that this reads, which others judge.
    NotRead,
}

impl From<std::io::Error> for Stop {
    fn from(error: std::io::Error) -> Self {
        if error.kind() == ErrorKind::UnexpectedEof { Self::Damaged(Damage::EndsEarly) } else { Self::NotRead }
    }
}

/// The bits of a file, within a scan those of its data up to the next marker.
pub(super) struct Bits<R> {
    file: R,
    held: u64,
    count: u32,
    /// The marker that ended the data.
    pub(super) marker: Option<u8>,
}

impl<R: BufRead> Bits<R> {
    pub(super) fn new(file: R) -> Self {
        Self { file, held: 0, count: 0, marker: None }
    }

    pub(super) fn array<const N: usize>(&mut self) -> Result<[u8; N], Stop> {
        let mut bytes = [0; N];
        self.file.read_exact(&mut bytes)?;
        Ok(bytes)
    }

    /// The content of a segment.
    pub(super) fn segment(&mut self) -> Result<Vec<u8>, Stop> {
        let length = u64::from(u16::from_be_bytes(self.array()?)).checked_sub(2).ok_or(Stop::NotRead)?;
        let mut content = Vec::new();
        Read::take(&mut self.file, length).read_to_end(&mut content)?;
        Ok(content)
    }

    /// The marker that ended a scan, or the next; what stands before it is passed over.
    pub(super) fn next_marker(&mut self) -> Result<u8, Stop> {
        if let Some(marker) = self.marker.take() {
            return Ok(marker);
        }
        loop {
            let [mut byte] = self.array()?;
            while byte != 0xff {
                [byte] = self.array()?;
            }
            while byte == 0xff {
                [byte] = self.array()?;
            }
            if byte != 0 {
                return Ok(byte);
            }
        }
    }

    pub(super) fn start(&mut self) {
        (self.held, self.count, self.marker) = (0, 0, None);
    }

    /// The next byte of the data; `None` from its end on.
    fn byte(&mut self) -> Result<Option<u8>, Stop> {
        if self.marker.is_some() {
            return Ok(None);
        }
        let [byte] = self.array()?;
        if byte != 0xff {
            return Ok(Some(byte));
        }
        let [mut next] = self.array()?;
        while next == 0xff {
            [next] = self.array()?;
        }
        if next == 0 {
            return Ok(Some(0xff));
        }
        self.marker = Some(next);
        Ok(None)
    }

    /// Holds 16 bits at least where there are so many.
    fn fill(&mut self) -> Result<(), Stop> {
        while self.count <= 48 {
            let Some(byte) = self.byte()? else { break };
            self.held = self.held << 8 | u64::from(byte);
            self.count += 8;
        }
        Ok(())
    }

    pub(super) fn take(&mut self, count: u32) -> Result<u32, Stop> {
        if count == 0 {
            return Ok(0);
        }
        if self.count < count {
            self.fill()?;
        }
        self.count = self.count.checked_sub(count).ok_or(Stop::Damaged(Damage::EndsEarly))?;
        Ok((self.held >> self.count) as u32 & ((1 << count) - 1))
    }

    pub(super) fn symbol(&mut self, table: &Table) -> Result<u8, Stop> {
        if self.count < 16 {
            self.fill()?;
        }
        // Past the end there are ones, as fill bits are.
        let bits = match self.count {
            16.. => (self.held >> (self.count - 16)) as u32 & 0xffff,
            few => {
                let missing = 16 - few;
                ((self.held << missing) as u32 | ((1 << missing) - 1)) & 0xffff
            }
        };
        match table.look_up(bits) {
            Some((_, length)) if length > self.count => Err(Stop::Damaged(Damage::EndsEarly)),
            Some((symbol, length)) => {
                self.count -= length;
                Ok(symbol)
            }
            None if self.count < 16 && self.marker.is_some() => Err(Stop::Damaged(Damage::EndsEarly)),
            None => Err(Stop::Damaged(Damage::NoSuchCode)),
        }
    }

    /// Reads on to the marker that ends the data. After the last unit it may be filled up.
    pub(super) fn end(&mut self, is_last: bool) -> Result<(), Stop> {
        let mut extra = self.count / 8;
        while self.byte()?.is_some() {
            extra += 1;
            if extra > MAX_FILL_BYTES {
                break;
            }
        }
        // A restart marker where the last unit was: none was due.
        let restarts = is_last && self.marker.is_some_and(|marker| (0xd0..=0xd7).contains(&marker));
        match extra {
            0..=MAX_FILL_BYTES if !restarts => Ok(()),
            _ => Err(Stop::Damaged(Damage::GoesOn)),
        }
    }
}
