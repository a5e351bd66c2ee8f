//! Whether the picture data of a JPEG is damaged within: a file that was copied from a bad card is whole by its markers, and
//! decoders show something for whatever bytes they find.
//!
//! Every Huffman code of every scan is read without making a picture of it (ITU-T T.81, annexes F and G). Damage shows as
//! a code that does not exist, a block of more than 64 coefficients, a mean that no picture has, restart markers out of
//! order, or as data that ends before or after the last block. Arithmetic coding and lossless processes, which no camera
//! uses, are passed over.

mod bits;
mod huffman;

pub use bits::Damage;
use bits::{Bits, Stop};
use huffman::Table;
use std::collections::BTreeMap;
use std::io::BufRead;

/// Largest mean of a block times 8, grey levels: twice that of a picture of 8 bits, for encoders that round up.
const MAX_DC: i64 = 2048;

/// What is damaged in the data of a JPEG whose structure is whole; `None` where all of it reads as it should.
pub fn damage(jpeg: impl BufRead) -> Option<Damage> {
    match Reader::new(jpeg).read() {
        Err(Stop::Damaged(damage)) => Some(damage),
        Ok(()) | Err(Stop::NotRead) => None,
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
    /// Of each component of a progressive picture and each of its blocks: which coefficients are not zero so far, a bit each.
    known: BTreeMap<u8, Vec<u64>>,
    /// The first value of each quantisation table.
    steps: [i64; 4],
    /// Units between two restart markers; 0 for none.
    restart_interval: u64,
}

impl<R: BufRead> Reader<R> {
    fn new(file: R) -> Self {
        let (tables, known) = (Default::default(), BTreeMap::new());
        Self { bits: Bits::new(file), frame: None, tables, known, steps: [1; 4], restart_interval: 0 }
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
        let mut known = match components.as_slice() {
            [only] if frame.progressive && band.from > 0 => self.known.remove(&only.component.id).unwrap_or_default(),
            _ => Vec::new(),
        };
        if frame.progressive && band.from > 0 {
            known.resize(usize::try_from(units).map_err(|_| Stop::NotRead)?, 0);
        }
        let first = components.first().map(|selected| selected.component.id);
        let scan = Scan { components, band, progressive: frame.progressive, tables: &self.tables, steps: self.steps };
        self.bits.start();
        let (mut done, mut restarts) = (0, 0);
        while done < units {
            let now = if self.restart_interval == 0 { units } else { self.restart_interval.min(units - done) };
            let blocks = known.get_mut(done as usize..(done + now) as usize).unwrap_or_default();
            scan.read(&mut self.bits, now, blocks)?;
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
        if let Some(id) = first.filter(|_| !known.is_empty()) {
            self.known.insert(id, known);
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

    /// Reads so many units, the last of which ends at a marker. `known` is of each block of a band without means.
    fn read<R: BufRead>(&self, bits: &mut Bits<R>, units: u64, known: &mut [u64]) -> Result<(), Stop> {
        let mut means = vec![0_i64; self.components.len()];
        // Blocks that hold nothing more in this band (T.81, G.1.2.2).
        let mut empty = 0_u32;
        for unit in 0..units {
            if self.band.from > 0 && self.progressive {
                let (Some(selected), Some(known)) = (self.components.first(), known.get_mut(unit as usize)) else {
                    return Err(Stop::NotRead);
                };
                match self.band.refines {
                    true => self.refined(bits, selected, known, &mut empty)?,
                    false => self.coefficients(bits, selected, known, &mut empty)?,
                }
                continue;
            }
            for (selected, mean) in self.components.iter().zip(&mut means) {
                let blocks = match self.components.len() {
                    1 => 1,
                    _ => selected.component.sampling[0] * selected.component.sampling[1],
                };
                for _ in 0..blocks {
                    self.block(bits, selected, mean)?;
                }
            }
        }
        if empty > 0 { Err(Stop::Damaged(Damage::TooManyCoefficients)) } else { Ok(()) }
    }

    /// A block with its mean and, in a sequential picture, all else.
    fn block<R: BufRead>(&self, bits: &mut Bits<R>, selected: &Selected, mean: &mut i64) -> Result<(), Stop> {
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
        let step = self.steps[selected.component.quantisation];
        if ((*mean << self.band.shift) * step).abs() > MAX_DC + step {
            return Err(Stop::Damaged(Damage::Mean));
        }
        match self.progressive {
            true => Ok(()),
            false => self.coefficients(bits, selected, &mut 0, &mut 0),
        }
    }

    /// The coefficients of a block besides its mean, as they first come.
    fn coefficients<R: BufRead>(
        &self,
        bits: &mut Bits<R>,
        selected: &Selected,
        known: &mut u64,
        empty: &mut u32,
    ) -> Result<(), Stop> {
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
                    *known |= 1 << at;
                    at += 1;
                }
            }
        }
        if at > end + 1 { Err(Stop::Damaged(Damage::TooManyCoefficients)) } else { Ok(()) }
    }

    /// A further bit of the coefficients of a block, and those that are no longer zero with it (T.81, G.1.2.3).
    fn refined<R: BufRead>(
        &self,
        bits: &mut Bits<R>,
        selected: &Selected,
        known: &mut u64,
        empty: &mut u32,
    ) -> Result<(), Stop> {
        let table = self.table(1, selected.ac)?;
        let (mut at, end) = (u32::from(self.band.from), u32::from(self.band.to));
        while *empty == 0 && at <= end {
            let symbol = bits.symbol(table)?;
            let (mut zeros, size) = (u32::from(symbol >> 4), u32::from(symbol & 15));
            match (zeros, size) {
                (_, 1) => drop(bits.take(1)?),
                (15, 0) => {}
                // This block, and so many after it, have no new ones.
                (run, 0) => {
                    *empty = (1 << run) + bits.take(run)?;
                    break;
                }
                _ => return Err(Stop::Damaged(Damage::NoSuchCode)),
            }
            while at <= end {
                if *known >> at & 1 == 1 {
                    bits.take(1)?;
                } else if zeros == 0 {
                    break;
                } else {
                    zeros -= 1;
                }
                at += 1;
            }
            if size == 1 {
                if at > end {
                    return Err(Stop::Damaged(Damage::TooManyCoefficients));
                }
                *known |= 1 << at;
            }
            at += 1;
        }
        if *empty > 0 {
            for at in at..=end {
                if *known >> at & 1 == 1 {
                    bits.take(1)?;
                }
            }
            *empty -= 1;
        }
        Ok(())
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
    fn progressive_pictures_are_read_through_all_their_scans() {
        let whole = include_bytes!("../../tests/fixtures/progressive.jpg");
        assert_eq!(damage(whole.as_slice()), None);
        let places: Vec<usize> = (data(whole)..whole.len() - 160).step_by(37).collect();
        let found = |at: &&usize| {
            let spoilt = [&whole[..**at], &[0; 150], &whole[**at + 150..]].concat();
            damage(spoilt.as_slice()).is_some()
        };
        let count = places.iter().filter(found).count();
        assert!(count * 10 >= places.len() * 8, "{count} of {}", places.len());
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
