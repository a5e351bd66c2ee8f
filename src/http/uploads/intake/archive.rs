//! Zip and tar archives from people one does not know: every entry is looked at before the first is unpacked, and no
//! entry decides where anything is written.

mod places;

use crate::config::Limits;
use crate::store::{Digest, StagedFile, SurveyPath, keep_free};
pub use places::LeftOut;
use places::{Places, places};
use sha2::Digest as _;
use std::cell::Cell;
use std::collections::BTreeSet;
use std::fs::File;
use std::io::{self, BufReader, BufWriter, Read, Seek, SeekFrom, Write};
use std::path::Path;

/// Below this, an archive may unpack to any multiple of its size.
const RATIO_FLOOR: u64 = 64 << 20;
/// How many ignored entries are named.
const MAX_NAMED: usize = 20;
const CHUNK: usize = 128 << 10;
/// Longest name of an entry, bytes.
const MAX_NAME: usize = 1024;
/// Most bytes between the contents of two entries of a tar (headers, and records of long names) and behind the last.
const MAX_BETWEEN: u64 = 1 << 20;
/// Bytes of a block of a tar: contents fill whole blocks, and at least one block of zeros is its end (POSIX pax).
const TAR_BLOCK: u64 = 512;
/// The record that ends a zip, less its comment, and where in it the comment's length is (APPNOTE.TXT 4.3.16).
const ZIP_END: (&[u8], u64, usize) = (b"PK\x05\x06", 22, 20);
/// Most bytes of a zip's directory per entry that it may have, and in any case.
const DIRECTORY_BYTES: (u64, u64) = (256, 1 << 20);
/// How archives begin that people make and that are not read.
const OTHER_KINDS: [(&[u8], &str); 5] = [
    (b"\xfd7zXZ\0", "an xz file"),
    (b"BZh", "a bzip2 file"),
    (b"\x28\xb5\x2f\xfd", "a Zstandard file"),
    (b"7z\xbc\xaf\x27\x1c", "a 7z archive"),
    (b"Rar!", "a RAR archive"),
];
/// How much is unpacked before the disk is looked at again.
const LOOK_EVERY_BYTES: u64 = 16 << 20;

/// Why an archive is refused.
#[derive(Debug, thiserror::Error)]
pub enum ArchiveError {
    #[error("the body begins as neither a zip, a tar nor a gzipped tar")]
    Unknown,
    #[error("the body is {kind}, which is not read; make a zip, a tar or a tar.gz of the same files")]
    OtherKind { kind: &'static str },
    #[error("the archive cannot be read: {0}; make it again")]
    Unreadable(String),
    #[error("the entry `{entry}` {what}; make an archive of plain files with relative paths")]
    Unsafe { entry: String, what: &'static str },
    #[error("the archive {what}; send the files of one reconstruction and nothing else, or ask for a higher limit")]
    TooLarge { what: String },
    #[error("the entry `{entry}` cannot be placed in a survey: {reason}")]
    Name { entry: String, reason: &'static str },
    #[error("the entries `{first}` and `{second}` would both be {path}; leave one of them out")]
    Twice { path: SurveyPath, first: String, second: String },
    #[error("two entries are named `{entry}`; leave one of them out")]
    SameName { entry: String },
    #[error(
        "none of its {entries} entries is a file of a reconstruction; expected are reconstruction.json, \
         reference_lla.json, undistorted/… and images/… as OpenSfM leaves them{hint}"
    )]
    NothingKnown { entries: usize, hint: String },
    /// The service's own disk failed.
    #[error(transparent)]
    Disk(io::Error),
}

/// What an archive held.
#[derive(Debug)]
pub struct Unpacked {
    pub files: Vec<(SurveyPath, StagedFile)>,
    /// Entries that were not taken, the first few by name.
    pub ignored: Vec<String>,
    pub ignored_count: usize,
    /// Those of them that look like a photo or a part of a reconstruction, all, with the reason.
    pub left_out: Vec<LeftOut>,
}

/// Unpacks the files of a survey from an archive into files of their own in `folder`.
pub fn unpack(archive: &Path, folder: &Path, limits: &Limits) -> Result<Unpacked, ArchiveError> {
    let size = std::fs::metadata(archive).map_err(ArchiveError::Disk)?.len();
    let budget = limits.max_unpacked_size.min(size.saturating_mul(limits.max_unpacked_ratio).max(RATIO_FLOOR));
    let reader = Reader { file: archive, budget, max_entries: limits.max_entries };

    let mut names = Vec::new();
    reader.each(&mut |name, _| {
        names.push(name.to_owned());
        Ok(())
    })?;
    let Places { taken, left_out } = places(&names)?;
    if taken.is_empty() {
        let hint = left_out.first().map(|left_out| format!(" ({}: {})", left_out.entry, left_out.reason));
        return Err(ArchiveError::NothingKnown { entries: names.len(), hint: hint.unwrap_or_default() });
    }
    let mut unpacked = Unpacked { files: Vec::new(), ignored: Vec::new(), ignored_count: 0, left_out };
    let mut disk = Disk { folder, reserve: limits.disk_reserve, since: 0 };
    let mut index = 0;
    reader.each(&mut |name, content| {
        match taken.get(&index) {
            Some(place) => unpacked.files.push((place.clone(), disk.stage(content)?)),
            None => {
                // What is ignored is read as well: its checksum shows whether the archive came changed.
                io::copy(content, &mut io::sink()).map_err(read_error)?;
                unpacked.ignored_count += 1;
                if unpacked.ignored.len() < MAX_NAMED {
                    unpacked.ignored.push(name.to_owned());
                }
            }
        }
        index += 1;
        Ok(())
    })?;
    Ok(unpacked)
}

/// What is done with the name and the bytes of each regular file.
type Visit<'a> = &'a mut dyn FnMut(&str, &mut dyn Read) -> Result<(), ArchiveError>;

struct Reader<'a> {
    file: &'a Path,
    /// Bytes that may come out of it.
    budget: u64,
    max_entries: usize,
}

impl Reader<'_> {
    /// Visits every regular file in the order of the archive; refuses links, devices and names that lead elsewhere.
    fn each(&self, visit: Visit<'_>) -> Result<(), ArchiveError> {
        let mut file = File::open(self.file).map_err(ArchiveError::Disk)?;
        let mut head = Vec::new();
        Read::by_ref(&mut file).take(512).read_to_end(&mut head).map_err(ArchiveError::Disk)?;
        file.seek(SeekFrom::Start(0)).map_err(ArchiveError::Disk)?;
        let file = BufReader::with_capacity(CHUNK, file);
        match head.as_slice() {
            [b'P', b'K', 3, 4, ..] | [b'P', b'K', 5, 6, ..] => self.each_of_zip(file, visit),
            [0x1f, 0x8b, ..] => self.each_of_tar(flate2::read::MultiGzDecoder::new(file), visit),
            head if head.get(257..262) == Some(b"ustar".as_slice()) => self.each_of_tar(file, visit),
            head => Err(match OTHER_KINDS.into_iter().find(|(begin, _)| head.starts_with(begin)) {
                Some((_, kind)) => ArchiveError::OtherKind { kind },
                None => ArchiveError::Unknown,
            }),
        }
    }

    fn each_of_zip(&self, file: BufReader<File>, visit: Visit<'_>) -> Result<(), ArchiveError> {
        // The directory is held in memory: how much of it there may be is known before it is read.
        let (per_entry, least) = DIRECTORY_BYTES;
        let meter = Meter::default();
        meter.bound(least + per_entry * self.max_entries as u64);
        let opened = zip::ZipArchive::new(Metered { inner: file, meter: &meter });
        if meter.is_used_up() {
            return Err(self.too_many());
        }
        meter.lift();
        let mut archive = opened.map_err(zip_error)?;
        if archive.offset() != 0 {
            return Err(ArchiveError::Unreadable("bytes that belong to no entry stand before its first".to_owned()));
        }
        require_zip_end(self.file, archive.comment().len())?;
        require_each_once(self.file, archive.central_directory_start(), archive.len())?;
        if archive.len() > self.max_entries {
            return Err(self.too_many());
        }
        let mut left = self.budget;
        for index in 0..archive.len() {
            let mut entry = archive.by_index(index).map_err(zip_error)?;
            let name = entry.name().map_err(zip_error)?.into_owned();
            check_name(&name)?;
            let name = with_slashes(name);
            if entry.is_symlink() {
                return Err(unsafe_entry(&name, "is a link"));
            }
            if entry.is_dir() || name.ends_with('/') {
                continue;
            }
            if entry.encrypted() {
                return Err(unsafe_entry(&name, "is encrypted"));
            }
            // What the entry says of its size is checked here, what really comes out of it below.
            if entry.size() > left {
                return Err(self.too_much());
            }
            let mut bounded = Bounded { inner: &mut entry, left: &mut left, exceeded: false };
            let visited = visit(&name, &mut bounded);
            if bounded.exceeded {
                return Err(self.too_much());
            }
            visited?;
        }
        Ok(())
    }

    fn each_of_tar(&self, file: impl Read, visit: Visit<'_>) -> Result<(), ArchiveError> {
        let mut left = self.budget;
        let mut bounded = Bounded { inner: file, left: &mut left, exceeded: false };
        let between = Meter::default();
        between.bound(MAX_BETWEEN);
        let mut archive = tar::Archive::new(Metered { inner: &mut bounded, meter: &between });
        let outcome = self.each_of_entries(&mut archive, &between, visit);
        let outcome = outcome.and_then(|padding| end_of_tar(archive.into_inner(), padding));
        if bounded.exceeded {
            return Err(self.too_much());
        }
        if between.is_used_up() {
            return Err(ArchiveError::Unreadable("what stands before an entry is too long".to_owned()));
        }
        outcome
    }

    /// Names are held in memory before they are known: `between` bounds what is read of anything but contents. The bytes
    /// that fill the last block of the last content.
    fn each_of_entries<R: Read>(
        &self,
        archive: &mut tar::Archive<R>,
        between: &Meter,
        mut visit: Visit<'_>,
    ) -> Result<u64, ArchiveError> {
        let mut padding = 0;
        for (index, entry) in archive.entries().map_err(read_error)?.enumerate() {
            if index >= self.max_entries {
                return Err(self.too_many());
            }
            let mut entry = entry.map_err(read_error)?;
            between.lift();
            self.look_at(&mut entry, &mut visit)?;
            io::copy(&mut entry, &mut io::sink()).map_err(read_error)?;
            padding = entry.size().next_multiple_of(TAR_BLOCK) - entry.size();
            between.bound(MAX_BETWEEN);
        }
        Ok(padding)
    }

    fn look_at<R: Read>(&self, entry: &mut tar::Entry<'_, R>, visit: &mut Visit<'_>) -> Result<(), ArchiveError> {
        let name = String::from_utf8(entry.path_bytes().into_owned())
            .map_err(|error| unsafe_entry(&String::from_utf8_lossy(error.as_bytes()), "has a name that is no UTF-8"))?;
        let name = name.strip_prefix("./").unwrap_or(&name).to_owned();
        let kind = entry.header().entry_type();
        if kind.is_dir() {
            if !name.is_empty() {
                check_name(&name)?;
            }
            return Ok(());
        }
        if kind.is_pax_global_extensions() {
            return Ok(());
        }
        check_name(&name)?;
        let name = with_slashes(name);
        if kind.is_symlink() || kind.is_hard_link() {
            return Err(unsafe_entry(&name, "is a link"));
        }
        if !kind.is_file() {
            return Err(unsafe_entry(&name, "is no plain file"));
        }
        visit(&name, entry)
    }

    fn too_many(&self) -> ArchiveError {
        ArchiveError::TooLarge { what: format!("has more than {} entries", self.max_entries) }
    }

    fn too_much(&self) -> ArchiveError {
        ArchiveError::TooLarge { what: format!("unpacks to more than {} bytes", self.budget) }
    }
}

/// Refuses names that lead out of the folder that they are unpacked in, on any system.
fn check_name(name: &str) -> Result<(), ArchiveError> {
    if name.is_empty() || name.len() > MAX_NAME || name.contains('\0') {
        return Err(unsafe_entry(name, "has no usable name"));
    }
    let drive = name.as_bytes().get(1) == Some(&b':');
    if name.starts_with('/') || name.starts_with('\\') || drive {
        return Err(unsafe_entry(name, "has an absolute path"));
    }
    if name.split(['/', '\\']).any(|part| part == "..") {
        return Err(unsafe_entry(name, "has `..` in its path"));
    }
    Ok(())
}

/// A name with `/` between its parts, where a program of Windows put `\`.
fn with_slashes(name: String) -> String {
    if name.contains('\\') { name.replace('\\', "/") } else { name }
}

fn unsafe_entry(name: &str, what: &'static str) -> ArchiveError {
    ArchiveError::Unsafe { entry: shown(name), what }
}

/// A name as it may be shown.
fn shown(name: &str) -> String {
    name.chars().take(120).map(|c| if c.is_control() { '\u{fffd}' } else { c }).collect()
}

fn zip_error(error: zip::result::ZipError) -> ArchiveError {
    ArchiveError::Unreadable(error.to_string())
}

fn read_error(error: io::Error) -> ArchiveError {
    match error.kind() {
        io::ErrorKind::UnexpectedEof => ArchiveError::Unreadable("it is cut short".to_owned()),
        _ => ArchiveError::Unreadable(error.to_string()),
    }
}

/// Reads what follows the last entry of a tar to the end of the stream, so that the checksum of what it is packed in is
/// compared: after `padding` bytes, at least one block of zeros and nothing else.
fn end_of_tar<R: Read>(mut archive: Metered<'_, R>, padding: u64) -> Result<(), ArchiveError> {
    io::copy(&mut archive, &mut io::sink()).map_err(read_error)?;
    if !archive.meter.is_blank.get() {
        return Err(ArchiveError::Unreadable("bytes follow its end, as where two archives were joined".to_owned()));
    }
    if archive.meter.count.get() < padding + TAR_BLOCK {
        return Err(ArchiveError::Unreadable("it is cut short".to_owned()));
    }
    Ok(())
}

/// Fails where a zip with a comment of so many bytes does not end with its last record.
fn require_zip_end(file: &Path, comment_bytes: usize) -> Result<(), ArchiveError> {
    let (signature, record_bytes, length_at) = ZIP_END;
    let mut file = File::open(file).map_err(ArchiveError::Disk)?;
    let from_end = record_bytes + comment_bytes as u64;
    let mut record = Vec::new();
    file.seek(SeekFrom::End(-(from_end as i64))).map_err(ArchiveError::Disk)?;
    file.take(record_bytes).read_to_end(&mut record).map_err(ArchiveError::Disk)?;
    let length =
        record.get(length_at..length_at + 2).map(|bytes| usize::from(u16::from_le_bytes([bytes[0], bytes[1]])));
    if !record.starts_with(signature) || length != Some(comment_bytes) {
        return Err(ArchiveError::Unreadable("bytes follow its end, as where two archives were joined".to_owned()));
    }
    Ok(())
}

/// Fails where several entries in the directory of a zip have one name, of which the reader has kept `count` names.
fn require_each_once(file: &Path, start: u64, count: usize) -> Result<(), ArchiveError> {
    /// Signature and length of a record less its texts, and where in it their lengths are (APPNOTE.TXT 4.3.12).
    const RECORD: (&[u8], usize, [usize; 3]) = (b"PK\x01\x02", 46, [28, 30, 32]);
    let (signature, record_bytes, lengths_at) = RECORD;
    let mut file = BufReader::new(File::open(file).map_err(ArchiveError::Disk)?);
    file.seek(SeekFrom::Start(start)).map_err(ArchiveError::Disk)?;
    let mut names: BTreeSet<Vec<u8>> = BTreeSet::new();
    let mut record = vec![0; record_bytes];
    // One name more than are known means that one is there twice.
    while names.len() <= count && file.read_exact(&mut record).is_ok() && record.starts_with(signature) {
        let [name, extra, comment] = lengths_at.map(|at| usize::from(u16::from_le_bytes([record[at], record[at + 1]])));
        let mut text = vec![0; name];
        file.read_exact(&mut text).map_err(read_error)?;
        file.seek_relative((extra + comment) as i64).map_err(ArchiveError::Disk)?;
        if names.contains(&text) {
            return Err(ArchiveError::SameName { entry: shown(&String::from_utf8_lossy(&text)) });
        }
        names.insert(text);
    }
    Ok(())
}

/// Where entries are unpacked.
struct Disk<'a> {
    folder: &'a Path,
    /// Bytes that stay free, so that jobs that run have room for what they write.
    reserve: u64,
    /// Bytes since the disk was looked at.
    since: u64,
}

impl Disk<'_> {
    /// Copies an entry to a file of its own.
    fn stage(&mut self, content: &mut dyn Read) -> Result<StagedFile, ArchiveError> {
        let new = tempfile::Builder::new().prefix("unpacked-").tempfile_in(self.folder);
        let (file, path) = new.map_err(ArchiveError::Disk)?.into_parts();
        let mut writer = BufWriter::with_capacity(CHUNK, file);
        let mut hasher = sha2::Sha256::new();
        let mut buffer = vec![0; CHUNK];
        let mut size = 0;
        loop {
            let count = match content.read(&mut buffer) {
                Ok(0) => break,
                Ok(count) => count,
                Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
                Err(error) => return Err(read_error(error)),
            };
            hasher.update(&buffer[..count]);
            writer.write_all(&buffer[..count]).map_err(ArchiveError::Disk)?;
            size += count as u64;
            self.since += count as u64;
            if self.since >= LOOK_EVERY_BYTES {
                self.since = 0;
                keep_free(self.folder, self.reserve).map_err(ArchiveError::Disk)?;
            }
        }
        let file = writer.into_inner().map_err(|error| ArchiveError::Disk(error.into_error()))?;
        file.sync_all().map_err(ArchiveError::Disk)?;
        Ok(StagedFile { path, size, sha256: Digest(hasher.finalize().into()) })
    }
}

/// What came out of a reader since it was last bounded.
#[derive(Default)]
struct Meter {
    /// How much more may come, where there is a bound.
    room: Cell<Option<u64>>,
    /// Bytes that came.
    count: Cell<u64>,
    /// Whether all of them are zero.
    is_blank: Cell<bool>,
}

impl Meter {
    fn bound(&self, bytes: u64) {
        self.room.set(Some(bytes));
        self.count.set(0);
        self.is_blank.set(true);
    }

    fn lift(&self) {
        self.room.set(None);
    }

    fn is_used_up(&self) -> bool {
        self.room.get() == Some(0)
    }
}

/// A reader that gives no more than its meter has room for.
struct Metered<'a, R> {
    inner: R,
    meter: &'a Meter,
}

impl<R: Read> Read for Metered<'_, R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let meter = self.meter;
        let Some(room) = meter.room.get() else { return self.inner.read(buffer) };
        let most = buffer.len().min(usize::try_from(room).unwrap_or(usize::MAX));
        if most == 0 && !buffer.is_empty() {
            return Err(io::Error::other("more than it may hold"));
        }
        let count = self.inner.read(&mut buffer[..most])?;
        meter.room.set(Some(room - count as u64));
        meter.count.set(meter.count.get() + count as u64);
        meter.is_blank.set(meter.is_blank.get() && buffer[..count].iter().all(|byte| *byte == 0));
        Ok(count)
    }
}

impl<R: Seek> Seek for Metered<'_, R> {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        self.inner.seek(to)
    }
}

/// A reader that gives no more than is left.
struct Bounded<'a, R> {
    inner: R,
    left: &'a mut u64,
    exceeded: bool,
}

impl<R: Read> Read for Bounded<'_, R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let count = self.inner.read(buffer)?;
        match self.left.checked_sub(count as u64) {
            Some(left) => {
                *self.left = left;
                Ok(count)
            }
            None => {
                self.exceeded = true;
                Err(io::Error::other("more than it may hold"))
            }
        }
    }
}
