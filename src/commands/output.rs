//! What commands write: to standard output, and to the files and folders that people name.

use anyhow::{Context, bail, ensure};
use serde::Serialize;
use std::fmt;
use std::io::{BufWriter, ErrorKind, Write};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

/// Prints a text to standard output. A reader who has gone, as `head` does, has seen enough.
///
/// # Errors
/// Where it cannot be written for another reason, a full disk for example.
pub fn print(text: impl fmt::Display) -> anyhow::Result<()> {
    match write_stdout(&text) {
        Err(error) if error.kind() == ErrorKind::BrokenPipe => Ok(()),
        written => written.context("writing to standard output"),
    }
}

/// As [`print`] for what is shown once: a reader who has gone is an error, too.
pub fn print_once(text: impl fmt::Display) -> anyhow::Result<()> {
    write_stdout(&text).context("writing to standard output")
}

fn write_stdout(text: &dyn fmt::Display) -> std::io::Result<()> {
    let mut stdout = std::io::stdout().lock();
    write!(stdout, "{text}")?;
    stdout.flush()
}

/// Writes a message to standard error, beside the output; a closed standard error is ignored.
pub fn notify(text: impl fmt::Display) {
    let _ = writeln!(std::io::stderr(), "{text}");
}

/// Where a document is written.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Output {
    /// `-`, or one of the names that the system has for it.
    Stdout,
    File(PathBuf),
}

impl Output {
    /// The output that a path names, checked before the work begins.
    ///
    /// # Errors
    /// A folder, a file in a folder that is not there, and one that cannot be written.
    pub fn named(path: &Path) -> anyhow::Result<Self> {
        if ["-", "/dev/stdout", "/dev/fd/1", "/proc/self/fd/1"].iter().any(|name| path.as_os_str() == *name) {
            return Ok(Self::Stdout);
        }
        let shown = path.display();
        let there = std::fs::metadata(path);
        ensure!(
            !there.as_ref().is_ok_and(std::fs::Metadata::is_dir),
            "{shown} is a folder: name a file in it to write to"
        );
        if is_replaced(path) {
            let folder = folder_of(path);
            if !folder.is_dir() {
                bail!("there is no folder {} to write {shown} into: make it, or name another file", folder.display());
            }
            tempfile::NamedTempFile::new_in(folder)
                .with_context(|| format!("cannot write into {}", folder.display()))?;
        }
        Ok(Self::File(path.to_owned()))
    }

    /// Writes a document as JSON. A regular file is written whole or not at all; into anything else, such as a pipe or a
    /// device, it is written as it comes.
    pub fn write_json(&self, document: &impl Serialize) -> anyhow::Result<()> {
        match self {
            Self::Stdout => print(format_args!("{}\n", serde_json::to_string(document)?)),
            Self::File(path) => write_json(path, document).with_context(|| format!("writing {}", path.display())),
        }
    }
}

impl fmt::Display for Output {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Stdout => f.write_str("standard output"),
            Self::File(path) => path.display().fmt(f),
        }
    }
}

fn write_json(path: &Path, document: &impl Serialize) -> anyhow::Result<()> {
    if !is_replaced(path) {
        let file = std::fs::OpenOptions::new().write(true).create(true).truncate(true).open(path)?;
        return write_flushed(file, document);
    }
    let mut file = tempfile::NamedTempFile::new_in(folder_of(path))?;
    write_flushed(&mut file, document)?;
    file.as_file().set_permissions(PermissionsExt::from_mode(0o644))?;
    file.persist(path)?;
    Ok(())
}

fn write_flushed(file: impl Write, document: &impl Serialize) -> anyhow::Result<()> {
    let mut writer = BufWriter::new(file);
    serde_json::to_writer(&mut writer, document)?;
    writer.flush()?;
    Ok(())
}

/// Whether a path is a regular file or nothing yet: a link, a pipe and a device stay what they are.
fn is_replaced(path: &Path) -> bool {
    std::fs::symlink_metadata(path).map_or(true, |there| there.is_file())
}

fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// Makes a folder that a person named for pictures, before the work begins; its parent must be there.
///
/// # Errors
/// What is there is no folder; or it cannot be made.
pub fn prepare_folder(folder: &Path) -> anyhow::Result<()> {
    let shown = folder.display();
    match std::fs::metadata(folder) {
        Ok(there) => ensure!(there.is_dir(), "{shown} is no folder: name one for the pictures"),
        Err(_) => {
            let parent = folder_of(folder);
            ensure!(parent.is_dir(), "there is no folder {} to make {shown} in: make it first", parent.display());
            std::fs::create_dir(folder).with_context(|| format!("cannot make the folder {shown}"))?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Read;
    use std::os::unix::fs::FileTypeExt;
    use std::process::Command;

    #[test]
    fn files_are_replaced_atomically_and_devices_are_written_into() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        std::fs::write(at("file"), "a document that is longer than the new one").unwrap();
        std::os::unix::fs::symlink(at("file"), at("link")).unwrap();
        for name in ["file", "link", "new"] {
            Output::named(&at(name)).unwrap().write_json(&[1, 2]).unwrap();
            assert_eq!(std::fs::read_to_string(at(name)).unwrap(), "[1,2]", "{name}");
        }
        assert!(std::fs::symlink_metadata(at("link")).unwrap().is_symlink());
        assert!(Command::new("mkfifo").arg(at("pipe")).status().unwrap().success());
        let pipe = at("pipe");
        let reader = std::thread::spawn(move || {
            let mut text = String::new();
            std::fs::File::open(pipe).unwrap().read_to_string(&mut text).map(|_| text)
        });
        Output::named(&at("pipe")).unwrap().write_json(&[3]).unwrap();
        assert_eq!(reader.join().unwrap().unwrap(), "[3]");
        assert!(std::fs::metadata(at("pipe")).unwrap().file_type().is_fifo());
    }

    #[test]
    fn unwritable_outputs_are_refused_before_the_work() {
        let folder = tempfile::tempdir().unwrap();
        let refused = |path: &Path| Output::named(path).unwrap_err().to_string();
        assert!(refused(folder.path()).contains("is a folder"));
        assert!(refused(&folder.path().join("no/plant.geojson")).contains("make it, or name another file"));
        assert!(!folder.path().join("no").exists());
        assert!(prepare_folder(&folder.path().join("no/pictures")).unwrap_err().to_string().contains("make it first"));
        prepare_folder(&folder.path().join("pictures")).unwrap();
        std::fs::write(folder.path().join("file"), "").unwrap();
        assert!(prepare_folder(&folder.path().join("file")).unwrap_err().to_string().contains("no folder"));
        assert_eq!(Output::named(Path::new("-")).unwrap(), Output::Stdout);
    }
}
