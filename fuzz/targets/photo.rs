//! A photo as it is uploaded and mapped: its header, what it tells of itself, its pixels.

#![no_main]

use heliomap_mapping::reconstruction::{exif, photo};
use libfuzzer_sys::fuzz_target;

/// Most pixels of an image: enough for every format's parts, few enough to be quick.
const MAX_PIXELS: u64 = 250_000;

fuzz_target!(|bytes: &[u8]| {
    let name = match bytes {
        [0x89, b'P', ..] => "photo.png",
        [b'I', b'I', ..] | [b'M', b'M', ..] => "photo.tif",
        _ => "photo.jpg",
    };
    let file = heliomap_fuzz::file(name);
    std::fs::write(&file, bytes).unwrap();
    let told = exif::read(&file);
    if let Some(position) = &told.position {
        assert!(position.latitude_deg.abs() <= 90.0 && position.longitude_deg.abs() <= 180.0, "{position:?}");
    }
    if let Ok(header) = photo::inspect(&file, name, MAX_PIXELS) {
        assert!(u64::from(header.width_px) * u64::from(header.height_px) <= MAX_PIXELS);
        let _ = photo::inspect_whole(&file, name, MAX_PIXELS);
        let _ = photo::examine(&file, name, header);
    }
});
