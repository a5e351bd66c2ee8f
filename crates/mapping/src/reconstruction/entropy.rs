//! Whether the picture data of a JPEG is damaged within: a file that was copied from a bad card is whole by its markers, and
//! decoders show something for whatever bytes they find.
//!
//! Every Huffman code of every scan is read without making a picture of it (ITU-T T.81, annexes F and G). Damage shows as
//! a code that does not exist, a block of more than 64 coefficients, a mean that no picture has, restart markers out of
//! order, or as data that ends before or after the last block. What is refined in later scans of a progressive JPEG needs
//! the picture to be read, and is passed over; so are arithmetic coding and lossless processes, which no camera uses.

use std::io::{BufRead, ErrorKind, Read};

/// Most bytes between the last block of a scan and the next marker: some encoders fill up.
const MAX_FILL_BYTES: u32 = 16;
/// Largest mean of a block times 8, grey levels: twice that of a picture of 8 bits, for encoders that round up.
const MAX_DC: i64 = 2048;

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
enum Stop {
    Damaged(Damage),
    /// The file is no JPEG that this reads, which others judge.
    NotRead,
}

impl From<std::io::Error> for Stop {
    fn from(error: std::io::Error) -> Self {
        if error.kind() == ErrorKind::UnexpectedEof { Self::Damaged(Damage::EndsEarly) } else { Self::NotRead }
    }
}

/// What is damaged in the data of a JPEG whose structure is whole; `None` where all of it reads as it should.
pub fn damage(jpeg: impl BufRead) -> Option<Damage> {
    match Reader::new(jpeg).read() {
        Err(Stop::Damaged(damage)) => Some(damage),
        Ok(()) | Err(Stop::NotRead) => None,
    }
}

/// A Huffman table: the symbol and length of each code, by its first bits.
#[derive(Clone)]
struct Table {
    /// By the next [`Table::FAST`] bits: symbol and length; length 0 for longer codes.
    fast: Vec<(u8, u8)>,
    /// For each length, one more than the last code of it, moved to 16 bits; 0 where it has none.
    ends: [u32; 17],
    /// For each length, the index of its first symbol less its first code.
    offsets: [i64; 17],
    symbols: Vec<u8>,
}

impl Table {
    const FAST: u32 = 9;

    /// From the number of codes of each length, and their symbols in order (T.81, C.2).
    fn new(counts: &[u8; 16], symbols: Vec<u8>) -> Option<Self> {
        let mut table = Self { fast: vec![(0, 0); 1 << Self::FAST], ends: [0; 17], offsets: [0; 17], symbols };
        let (mut code, mut index) = (0_u32, 0_usize);
        for length in 1..=16_u32 {
            let count = u32::from(counts[length as usize - 1]);
            if code + count > 1 << length {
                return None;
            }
            table.offsets[length as usize] = index as i64 - i64::from(code);
            for _ in 0..count {
                if length <= Self::FAST {
                    let from = (code << (Self::FAST - length)) as usize;
                    let entry = (*table.symbols.get(index)?, length as u8);
                    table.fast[from..from + (1 << (Self::FAST - length))].fill(entry);
                }
                code += 1;
                index += 1;
            }
            table.ends[length as usize] = if count > 0 { code << (16 - length) } else { 0 };
            code <<= 1;
        }
        Some(table)
    }

    /// The symbol and length of the code that begins 16 bits.
    fn look_up(&self, bits: u32) -> Option<(u8, u32)> {
        let (symbol, length) = self.fast[(bits >> (16 - Self::FAST)) as usize];
        if length > 0 {
            return Some((symbol, u32::from(length)));
        }
        let length = (1..=16).find(|length| bits < self.ends[*length])?;
        let index = i64::from(bits >> (16 - length)) + self.offsets[length];
        Some((*self.symbols.get(usize::try_from(index).ok()?)?, length as u32))
    }
}

/// A component of the picture.
#[derive(Clone, Copy)]
struct Component {
    id: u8,
    /// Blocks per unit of an interleaved scan, across and down.
    sampling: [u32; 2],
    /// Which quantisation table it uses.
    quantisation: usize,
}

/// The frame header.
struct Frame {
    size_px: [u32; 2],
    progressive: bool,
    components: Vec<Component>,
}

impl Frame {
    fn largest(&self) -> [u32; 2] {
        [0, 1].map(|axis| self.components.iter().map(|component| component.sampling[axis]).max().unwrap_or(1))
    }

    /// How many units a scan of these components has.
    fn units(&self, components: &[Selected]) -> u64 {
        let largest = self.largest();
        let [across, down] = [0, 1].map(|axis| match components {
            // A scan of one component holds the blocks that the picture reaches, and no more.
            [only] => {
                let size_px = (self.size_px[axis] * only.component.sampling[axis]).div_ceil(largest[axis]);
                u64::from(size_px.div_ceil(8))
            }
            _ => u64::from(self.size_px[axis].div_ceil(8 * largest[axis])),
        });
        across * down
    }
}

/// A component of a scan with its tables.
struct Selected {
    component: Component,
    dc: usize,
    ac: usize,
}

/// The coefficients that a scan brings, and of which precision.
#[derive(Clone, Copy)]
struct Band {
    from: u8,
    to: u8,
    refines: bool,
    shift: u8,
}

struct Reader<R> {
    bits: Bits<R>,
    frame: Option<Frame>,
    /// Tables of means and of other coefficients.
    tables: [[Option<Table>; 4]; 2],
    /// The first value of each quantisation table.
    steps: [i64; 4],
    /// Units between two restart markers; 0 for none.
    restart_interval: u64,
}

impl<R: BufRead> Reader<R> {
    fn new(file: R) -> Self {
        let bits = Bits { file, held: 0, count: 0, marker: None };
        Self { bits, frame: None, tables: Default::default(), steps: [1; 4], restart_interval: 0 }
    }

    fn read(&mut self) -> Result<(), Stop> {
        self.bits.array::<2>()?;
        loop {
            let marker = self.bits.next_marker()?;
            match marker {
                0xd9 => return Ok(()),
                0x01 | 0xd0..=0xd8 => continue,
                0xc4 => self.huffman_tables()?,
                0xdb => self.quantisation_tables()?,
                0xdd => {
                    let segment = self.bits.segment()?;
                    self.restart_interval = u64::from(number(&segment, 0)?);
                }
                0xc0..=0xc2 => self.frame = Some(frame(&self.bits.segment()?, marker == 0xc2)?),
                0xc3..=0xcf => return Err(Stop::NotRead),
                0xda => self.scan()?,
                _ => drop(self.bits.segment()?),
            }
        }
    }

    fn huffman_tables(&mut self) -> Result<(), Stop> {
        let segment = self.bits.segment()?;
        let mut rest = segment.as_slice();
        while let Some((kind, after)) = rest.split_first() {
            let (counts, after) = after.split_first_chunk::<16>().ok_or(Stop::NotRead)?;
            let total: usize = counts.iter().map(|count| usize::from(*count)).sum();
            let symbols = after.get(..total).ok_or(Stop::NotRead)?.to_vec();
            let place =
                self.tables.get_mut(usize::from(kind >> 4)).and_then(|kind_of| kind_of.get_mut(usize::from(kind & 15)));
            *place.ok_or(Stop::NotRead)? = Some(Table::new(counts, symbols).ok_or(Stop::NotRead)?);
            rest = &after[total..];
        }
        Ok(())
    }

    fn quantisation_tables(&mut self) -> Result<(), Stop> {
        let segment = self.bits.segment()?;
        let mut rest = segment.as_slice();
        while let Some((kind, after)) = rest.split_first() {
            let (bytes, step) = match kind >> 4 {
                0 => (64, i64::from(*after.first().ok_or(Stop::NotRead)?)),
                _ => (128, i64::from(number(after, 0)?)),
            };
            *self.steps.get_mut(usize::from(kind & 15)).ok_or(Stop::NotRead)? = step;
            rest = after.get(bytes..).ok_or(Stop::NotRead)?;
        }
        Ok(())
    }

    fn scan(&mut self) -> Result<(), Stop> {
        let header = self.bits.segment()?;
        let frame = self.frame.as_ref().ok_or(Stop::NotRead)?;
        let (components, band) = scan_header(&header, frame)?;
        let units = frame.units(&components);
        let scan = Scan { components, band, progressive: frame.progressive, tables: &self.tables, steps: self.steps };
        if band.refines && band.from > 0 {
            return Ok(());
        }
        self.bits.start();
        let (mut done, mut restarts) = (0, 0);
        while done < units {
            let now = if self.restart_interval == 0 { units } else { self.restart_interval.min(units - done) };
            scan.read(&mut self.bits, now)?;
            done += now;
            self.bits.end(done == units)?;
            if done < units {
                match self.bits.marker.take() {
                    Some(marker) if marker == 0xd0 + restarts => restarts = (restarts + 1) % 8,
                    _ => return Err(Stop::Damaged(Damage::Restart)),
                }
                self.bits.start();
            }
        }
        Ok(())
    }
}

fn number(bytes: &[u8], at: usize) -> Result<u16, Stop> {
    let pair = bytes.get(at..at + 2).ok_or(Stop::NotRead)?;
    Ok(u16::from_be_bytes([pair[0], pair[1]]))
}

fn frame(segment: &[u8], progressive: bool) -> Result<Frame, Stop> {
    let (height, width) = (u32::from(number(segment, 1)?), u32::from(number(segment, 3)?));
    let components = segment.get(6..).ok_or(Stop::NotRead)?.chunks_exact(3).map(|entry| Component {
        id: entry[0],
        sampling: [u32::from(entry[1] >> 4), u32::from(entry[1] & 15)],
        quantisation: usize::from(entry[2]),
    });
    let frame = Frame { size_px: [width, height], progressive, components: components.collect() };
    let sane = |component: &Component| {
        component.sampling.iter().all(|blocks| (1..=4).contains(blocks)) && component.quantisation < 4
    };
    // Other precisions are not for photos.
    let is_read = segment[0] == 8 && !frame.components.is_empty() && frame.components.iter().all(sane);
    if is_read { Ok(frame) } else { Err(Stop::NotRead) }
}

fn scan_header(header: &[u8], frame: &Frame) -> Result<(Vec<Selected>, Band), Stop> {
    let count = usize::from(*header.first().ok_or(Stop::NotRead)?);
    let entries = header.get(1..1 + 2 * count).ok_or(Stop::NotRead)?;
    let select = |entry: &[u8]| {
        let component = *frame.components.iter().find(|component| component.id == entry[0]).ok_or(Stop::NotRead)?;
        Ok(Selected { component, dc: usize::from(entry[1] >> 4), ac: usize::from(entry[1] & 15) })
    };
    let components = entries.chunks_exact(2).map(select).collect::<Result<Vec<_>, Stop>>()?;
    let [from, to, precision] = header.get(1 + 2 * count..).and_then(|rest| rest.first_chunk()).ok_or(Stop::NotRead)?;
    let band = match frame.progressive {
        true => Band { from: *from, to: *to, refines: precision >> 4 > 0, shift: precision & 15 },
        false => Band { from: 0, to: 63, refines: false, shift: 0 },
    };
    let is_read = !components.is_empty() && band.from <= band.to && band.to < 64 && band.shift < 14;
    if is_read { Ok((components, band)) } else { Err(Stop::NotRead) }
}

/// A scan whose codes are read.
struct Scan<'a> {
    components: Vec<Selected>,
    band: Band,
    progressive: bool,
    tables: &'a [[Option<Table>; 4]; 2],
    steps: [i64; 4],
}

impl Scan<'_> {
    fn table(&self, kind: usize, index: usize) -> Result<&Table, Stop> {
        self.tables[kind].get(index).and_then(Option::as_ref).ok_or(Stop::NotRead)
    }

    /// Reads so many units, the last of which ends at a marker.
    fn read<R: BufRead>(&self, bits: &mut Bits<R>, units: u64) -> Result<(), Stop> {
        let mut means = vec![0_i64; self.components.len()];
        // Blocks that hold nothing more in this band (T.81, G.1.2.2).
        let mut empty = 0_u32;
        for _ in 0..units {
            for (selected, mean) in self.components.iter().zip(&mut means) {
                let blocks = match self.components.len() {
                    1 => 1,
                    _ => selected.component.sampling[0] * selected.component.sampling[1],
                };
                for _ in 0..blocks {
                    self.block(bits, selected, mean, &mut empty)?;
                }
            }
        }
        if empty > 0 { Err(Stop::Damaged(Damage::TooManyCoefficients)) } else { Ok(()) }
    }

    fn block<R: BufRead>(
        &self,
        bits: &mut Bits<R>,
        selected: &Selected,
        mean: &mut i64,
        empty: &mut u32,
    ) -> Result<(), Stop> {
        if self.band.from == 0 {
            if self.band.refines {
                bits.take(1)?;
                return Ok(());
            }
            let category = u32::from(bits.symbol(self.table(0, selected.dc)?)?);
            if category > 11 {
                return Err(Stop::Damaged(Damage::Mean));
            }
            let value = i64::from(bits.take(category)?);
            *mean += if category > 0 && value >> (category - 1) == 0 { value + 1 - (1 << category) } else { value };
            let dc = (*mean << self.band.shift) * self.steps[selected.component.quantisation];
            if dc.abs() > MAX_DC + self.steps[selected.component.quantisation] {
                return Err(Stop::Damaged(Damage::Mean));
            }
            if self.progressive {
                return Ok(());
            }
        }
        if *empty > 0 {
            *empty -= 1;
            return Ok(());
        }
        let table = self.table(1, selected.ac)?;
        let (mut at, end) = (u32::from(self.band.from.max(1)), u32::from(self.band.to));
        while at <= end {
            let symbol = bits.symbol(table)?;
            let (run, size) = (u32::from(symbol >> 4), u32::from(symbol & 15));
            match (run, size) {
                (15, 0) => at += 16,
                (run, 0) => {
                    if self.progressive {
                        *empty = (1 << run) - 1 + bits.take(run)?;
                    }
                    return Ok(());
                }
                _ => {
                    at += run;
                    if at > end {
                        return Err(Stop::Damaged(Damage::TooManyCoefficients));
                    }
                    bits.take(size)?;
                    at += 1;
                }
            }
        }
        if at > end + 1 { Err(Stop::Damaged(Damage::TooManyCoefficients)) } else { Ok(()) }
    }
}

/// The bits of a file, within a scan those of its data up to the next marker.
struct Bits<R> {
    file: R,
    held: u64,
    count: u32,
    /// The marker that ended the data.
    marker: Option<u8>,
}

impl<R: BufRead> Bits<R> {
    fn array<const N: usize>(&mut self) -> Result<[u8; N], Stop> {
        let mut bytes = [0; N];
        self.file.read_exact(&mut bytes)?;
        Ok(bytes)
    }

    /// The content of a segment.
    fn segment(&mut self) -> Result<Vec<u8>, Stop> {
        let length = u64::from(u16::from_be_bytes(self.array()?)).checked_sub(2).ok_or(Stop::NotRead)?;
        let mut content = Vec::new();
        Read::take(&mut self.file, length).read_to_end(&mut content)?;
        Ok(content)
    }

    /// The marker that ended a scan, or the next; what stands before it is passed over.
    fn next_marker(&mut self) -> Result<u8, Stop> {
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

    fn start(&mut self) {
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

    fn take(&mut self, count: u32) -> Result<u32, Stop> {
        if count == 0 {
            return Ok(0);
        }
        if self.count < count {
            self.fill()?;
        }
        self.count = self.count.checked_sub(count).ok_or(Stop::Damaged(Damage::EndsEarly))?;
        Ok((self.held >> self.count) as u32 & ((1 << count) - 1))
    }

    fn symbol(&mut self, table: &Table) -> Result<u8, Stop> {
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
    fn end(&mut self, is_last: bool) -> Result<(), Stop> {
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

#[cfg(test)]
mod tests {
    use super::*;
    use image::codecs::jpeg::JpegEncoder;

    fn jpeg(quality: u8) -> Vec<u8> {
        let picture = image::RgbImage::from_fn(200, 152, |x, y| {
            let weed = x.wrapping_mul(2_654_435_761) ^ y.wrapping_mul(40_503);
            image::Rgb([(x ^ y) as u8, (weed.wrapping_mul(2_246_822_519) >> 26) as u8, (x * y / 64) as u8])
        });
        let mut bytes = Vec::new();
        JpegEncoder::new_with_quality(&mut bytes, quality).encode_image(&picture).unwrap();
        bytes
    }

    fn data(jpeg: &[u8]) -> usize {
        jpeg.windows(2).position(|pair| pair == [0xff, 0xda]).unwrap() + 14
    }

    #[test]
    fn what_an_encoder_wrote_is_not_damaged() {
        for quality in [10, 75, 95, 100] {
            assert_eq!(damage(jpeg(quality).as_slice()), None, "{quality}");
        }
    }

    #[test]
    fn half_a_picture_with_an_end_marker_ends_early() {
        let whole = jpeg(90);
        for cut in (data(&whole) + 10..whole.len() - 200).step_by(97) {
            let half = [&whole[..cut], &[0xff, 0xd9]].concat();
            assert_eq!(damage(half.as_slice()), Some(Damage::EndsEarly), "cut at {cut}");
        }
    }

    #[test]
    fn a_run_of_zeros_is_found_at_most_places() {
        let whole = jpeg(90);
        let places: Vec<usize> = (data(&whole)..whole.len() - 300).step_by(83).collect();
        let found = |at: &&usize| {
            let spoilt = [&whole[..**at], &[0; 250], &whole[**at + 250..]].concat();
            damage(spoilt.as_slice()).is_some()
        };
        let count = places.iter().filter(found).count();
        assert!(count * 10 >= places.len() * 9, "{count} of {}", places.len());
    }

    #[test]
    fn bytes_left_out_or_doubled_are_found() {
        let whole = jpeg(90);
        let middle = whole.len() / 2;
        for spoilt in
            [[&whole[..middle], &whole[middle + 512..]].concat(), [&whole[..middle], &whole[middle - 512..]].concat()]
        {
            assert!(damage(spoilt.as_slice()).is_some());
        }
    }

    #[test]
    fn other_files_are_left_to_others() {
        for bytes in [b"".as_slice(), b"\xff\xd8", b"no picture at all", &jpeg(90)[..40]] {
            let _ = damage(bytes);
        }
    }
}
