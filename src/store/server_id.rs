//! The identifier of a data folder among those that share a bucket.

use std::io::Write;
use std::path::Path;
use uuid::Uuid;

/// The file of a data folder that holds its identifier.
const FILE: &str = "server-id";

/// Reads the identifier of a data folder; a new folder is given one.
pub(super) fn server_id(data: &Path) -> std::io::Result<Uuid> {
    let path = data.join(FILE);
    if !path.exists() {
        let mut file = tempfile::NamedTempFile::new_in(data)?;
        file.write_all(Uuid::new_v4().to_string().as_bytes())?;
        file.as_file().sync_all()?;
        match file.persist_noclobber(&path) {
            Err(error) if error.error.kind() != std::io::ErrorKind::AlreadyExists => return Err(error.error),
            _ => std::fs::File::open(data)?.sync_all()?,
        }
    }
    std::fs::read_to_string(path)?.trim().parse().map_err(std::io::Error::other)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_data_folder_keeps_its_identifier() {
        let [one, other] = [(); 2].map(|()| tempfile::tempdir().unwrap());
        let id = server_id(one.path()).unwrap();
        assert_eq!(server_id(one.path()).unwrap(), id);
        assert_ne!(server_id(other.path()).unwrap(), id);
    }
}
