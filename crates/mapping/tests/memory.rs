//! Photos that claim far more metadata than they hold take next to no memory: every allocation of this process is counted.

#![allow(unsafe_code, reason = "a global allocator is unsafe by its trait")]

use heliomap_mapping::reconstruction::{exif, photo};
use std::alloc::{GlobalAlloc, Layout, System};
use std::path::PathBuf;
use std::sync::atomic::{AtomicUsize, Ordering};

static LIVE: AtomicUsize = AtomicUsize::new(0);
static PEAK: AtomicUsize = AtomicUsize::new(0);

struct Counting;

// SAFETY: every call goes to the system's allocator as it came; growing in place is left to the default, a copy.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        let live = LIVE.fetch_add(layout.size(), Ordering::Relaxed) + layout.size();
        PEAK.fetch_max(live, Ordering::Relaxed);
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, place: *mut u8, layout: Layout) {
        LIVE.fetch_sub(layout.size(), Ordering::Relaxed);
        unsafe { System.dealloc(place, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// What some work gives, and the most bytes that it held at once.
fn measured<T>(work: impl FnOnce() -> T) -> (T, usize) {
    let before = LIVE.load(Ordering::Relaxed);
    PEAK.store(before, Ordering::Relaxed);
    let done = work();
    (done, PEAK.load(Ordering::Relaxed) - before)
}

/// Width and height of the pictures.
const SIDE: u32 = 64;
const PIXELS: usize = (SIDE * SIDE) as usize;
/// Bytes of metadata.
const BOMB: u32 = 10_000_000;
/// What a look at such a file may take at once: buffers and the small picture.
const MOST: usize = 2 << 20;

const ASCII: u16 = 2;
const SHORT: u16 = 3;
const LONG: u16 = 4;

/// An entry of a directory: tag, kind, count, value or place.
type Entry = (u16, u16, u32, u32);

fn directory(entries: &[Entry]) -> Vec<u8> {
    let mut bytes = (entries.len() as u16).to_le_bytes().to_vec();
    for (tag, kind, count, value) in entries {
        bytes.extend([tag.to_le_bytes(), kind.to_le_bytes()].concat());
        bytes.extend([count.to_le_bytes(), value.to_le_bytes()].concat());
    }
    bytes.extend([0; 4]);
    bytes
}

/// A grey TIFF, its pixels at 8, zeros behind them, and more entries in its directory.
fn tiff(more: &[Entry]) -> Vec<u8> {
    let first = 8 + PIXELS as u32 + BOMB;
    let mut entries = vec![
        (256, SHORT, 1, SIDE),
        (257, SHORT, 1, SIDE),
        (258, SHORT, 1, 8),
        (259, SHORT, 1, 1),
        (262, SHORT, 1, 1),
        (273, LONG, 1, 8),
        (277, SHORT, 1, 1),
        (278, LONG, 1, SIDE),
        (279, LONG, 1, PIXELS as u32),
    ];
    entries.retain(|entry| more.iter().all(|other| other.0 != entry.0));
    entries.extend(more);
    entries.sort_unstable();
    let mut bytes = [b"II*\0".as_slice(), &first.to_le_bytes()].concat();
    bytes.resize(first as usize, 0);
    bytes.extend(directory(&entries));
    bytes
}

/// Texts that all lie on the same zeros.
fn texts() -> Vec<u8> {
    tiff(&[0x10f, 0x110, 0x132].map(|tag| (tag, ASCII, BOMB, 8 + PIXELS as u32)))
}

fn chunk(name: &[u8; 4], content: &[u8]) -> Vec<u8> {
    let mut crc = flate2::Crc::new();
    crc.update(name);
    crc.update(content);
    [&(content.len() as u32).to_be_bytes()[..], name, content, &crc.sum().to_be_bytes()].concat()
}

fn deflated(bytes: &[u8]) -> Vec<u8> {
    let mut encoder = flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::best());
    std::io::Write::write_all(&mut encoder, bytes).unwrap();
    encoder.finish().unwrap()
}

/// A grey PNG with more chunks behind its header.
fn png(more: &[Vec<u8>]) -> Vec<u8> {
    let header = [&SIDE.to_be_bytes()[..], &SIDE.to_be_bytes(), &[8, 0, 0, 0, 0]].concat();
    let row = [0; 1 + SIDE as usize];
    let pixels = chunk(b"IDAT", &deflated(&row.repeat(SIDE as usize)));
    let mut bytes = b"\x89PNG\r\n\x1a\n".to_vec();
    bytes.extend(chunk(b"IHDR", &header));
    bytes.extend(more.concat());
    bytes.extend([pixels, chunk(b"IEND", b"")].concat());
    bytes
}

/// A JPEG with segments of `content` behind its start, and `behind` behind its end.
fn jpeg(marker: u8, content: &[u8], behind: &[u8]) -> Vec<u8> {
    let mut whole = std::io::Cursor::new(Vec::new());
    image::GrayImage::new(SIDE, SIDE).write_to(&mut whole, image::ImageFormat::Jpeg).unwrap();
    let whole = whole.into_inner();
    let length = (content.len() as u16 + 2).to_be_bytes();
    let segment = [&[0xff, marker][..], &length, content].concat();
    let mut bytes = whole[..2].to_vec();
    while bytes.len() < BOMB as usize {
        bytes.extend(&segment);
    }
    bytes.extend(&whole[2..]);
    bytes.extend(behind);
    bytes
}

#[test]
fn metadata_takes_no_memory_however_much_it_claims() {
    let folder = tempfile::tempdir().unwrap();
    let compressed = [b"k\0\0".as_slice(), &deflated(&vec![0; 20 * BOMB as usize])].concat();
    let icc = [b"ICC_PROFILE\0\x01\xff".as_slice(), &[0; 65_000]].concat();
    let files: Vec<(&str, Vec<u8>, bool)> = vec![
        ("texts.tif", texts(), true),
        ("texts.png", png(&[chunk(b"eXIf", &texts())]), true),
        ("icc.png", png(&[chunk(b"iCCP", &compressed)]), true),
        ("text.png", png(&[chunk(b"zTXt", &compressed)]), true),
        ("exif.jpg", jpeg(0xe1, &[b"Exif\0\0".as_slice(), &[0; 65_000]].concat(), b""), true),
        ("icc.jpg", jpeg(0xe2, &icc, b""), true),
        ("xmp.jpg", jpeg(0xe1, &[b"http://ns.adobe.com/xap/1.0/\0".as_slice(), &[b' '; 65_000]].concat(), b""), true),
        ("film.jpg", jpeg(0xfe, b"comment", &vec![0; BOMB as usize]), true),
        // The decoder would keep a value of 32 bytes for every two of the file.
        ("bits.tif", tiff(&[(258, SHORT, BOMB / 2, 8 + PIXELS as u32)]), false),
        ("strips.tif", tiff(&[273, 279].map(|tag| (tag, LONG, BOMB / 4, 8 + PIXELS as u32))), false),
    ];
    for (name, bytes, is_picture) in files {
        let path: PathBuf = folder.path().join(name);
        std::fs::write(&path, &bytes).unwrap();
        drop(bytes);
        let (_, took) = measured(|| exif::read(&path));
        assert!(took < 64 << 10, "the EXIF of {name} took {took} bytes");
        let (looked, took) = measured(|| {
            let header = photo::inspect(&path, name, photo::DEFAULT_MAX_PIXELS)?;
            photo::examine(&path, name, header)
        });
        assert!(took < MOST, "{name} took {took} bytes: {looked:?}");
        assert_eq!(looked.is_ok(), is_picture, "{name}: {looked:?}");
    }
}
