//! Huffman tables of a JPEG (ITU-T T.81, annex C).

/// A Huffman table: the symbol and length of each code, by its first bits.
#[derive(Clone)]
pub(super) struct Table {
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
    pub(super) fn new(counts: &[u8; 16], symbols: Vec<u8>) -> Option<Self> {
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
    pub(super) fn look_up(&self, bits: u32) -> Option<(u8, u32)> {
        let (symbol, length) = self.fast[(bits >> (16 - Self::FAST)) as usize];
        if length > 0 {
            return Some((symbol, u32::from(length)));
        }
        let length = (1..=16).find(|length| bits < self.ends[*length])?;
        let index = i64::from(bits >> (16 - length)) + self.offsets[length];
        Some((*self.symbols.get(usize::try_from(index).ok()?)?, length as u32))
    }
}
