//! A photo as it is uploaded and mapped: its header, what it tells of itself, its pixels; and the memory that each takes.

#![no_main]

use heliomap_fuzz::memory::Allowance;
use heliomap_mapping::reconstruction::{exif, photo};
use libfuzzer_sys::fuzz_target;

/// Most pixels of an image: enough for every format's parts, few enough to be quick.
const MAX_PIXELS: u64 = 250_000;
/// Metadata takes the same for every file.
const METADATA: Allowance = Allowance { bytes: 64 << 10, per_input_byte: 0 };
/// A header: buffers, and the values of a TIFF's directory as its decoder keeps them.
const HEADER: Allowance = Allowance { bytes: 1 << 20, per_input_byte: 128 };
/// The picture: as decoded, by formats of up to 16 bytes per pixel twice over, beside the file itself.
const PICTURE: Allowance = Allowance { bytes: (4 << 20) + 32 * MAX_PIXELS as usize, per_input_byte: 128 };

fuzz_target!(|bytes: &[u8]| {
    let name = match bytes {
        [0x89, b'P', ..] => "photo.png",
        [b'I', b'I', ..] | [b'M', b'M', ..] => "photo.tif",
        _ => "photo.jpg",
    };
    let file = heliomap_fuzz::file(name);
    std::fs::write(&file, bytes).unwrap();
    let told = METADATA.within(bytes.len(), "the EXIF", || exif::read(&file));
    if let Some(position) = &told.position {
        assert!(position.latitude_deg.abs() <= 90.0 && position.longitude_deg.abs() <= 180.0, "{position:?}");
    }
    if let Ok(header) = HEADER.within(bytes.len(), "the header", || photo::inspect(&file, name, MAX_PIXELS)) {
        assert!(u64::from(header.width_px) * u64::from(header.height_px) <= MAX_PIXELS);
        let _ = PICTURE.within(bytes.len(), "a picture", || photo::inspect_whole(&file, name, MAX_PIXELS));
        let _ = PICTURE.within(bytes.len(), "a measured picture", || photo::examine(&file, name, header));
    }
});
