//! Where a file stands in a survey's folder, which is laid out as OpenSfM leaves it. Parsed where it enters: a value of
//! these types is safe to join to a folder.

use super::name::steers;
use std::fmt;
use unicode_normalization::UnicodeNormalization;

/// Names longer than this do not fit every file system.
const MAX_NAME_BYTES: usize = 200;

/// File name endings of images, lower case.
const IMAGE_ENDINGS: [&str; 5] = ["jpg", "jpeg", "png", "tif", "tiff"];

/// The reconstruction's files that are no images.
const RECONSTRUCTION_FILES: [&str; 9] = [
    "boxes.json",
    "reconstruction.json",
    "reconstruction.topocentric.json",
    "reference_lla.json",
    "camera_models.json",
    "undistorted/reconstruction.json",
    "undistorted/undistorted_shot_ids.json",
    "undistorted/depthmaps/merged.ply",
    "odm_georeferencing/coords.txt",
];

/// Whether a file has an image's ending and is none of the hidden files that systems put beside photos.
pub fn looks_like_photo(name: &str) -> bool {
    let ending = name.rsplit_once('.').map(|(_, ending)| ending.to_ascii_lowercase());
    !name.starts_with('.') && ending.is_some_and(|ending| IMAGE_ENDINGS.contains(&ending.as_str()))
}

/// Why a text is no place in a survey's folder.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
pub enum InvalidPath {
    /// The name of an image.
    #[error("`{name}` cannot be the name of an image: {reason}")]
    Name { name: String, reason: &'static str },
    /// A path that no reader looks at.
    #[error(
        "`{path}` is no file of a reconstruction: expected are boxes.json, reconstruction.json, reference_lla.json, \
         camera_models.json, undistorted/reconstruction.json, undistorted/undistorted_shot_ids.json, \
         undistorted/images/NAME and undistorted/depthmaps/merged.ply, of ODM also reconstruction.topocentric.json and \
         odm_georeferencing/coords.txt"
    )]
    Unknown { path: String },
}

/// What a file is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum FileKind {
    /// A photo as the drone took it.
    Image,
    /// A part of the reconstruction.
    Reconstruction,
}

impl FileKind {
    /// The word in rows and answers.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Image => "image",
            Self::Reconstruction => "reconstruction",
        }
    }
}

/// What a file must contain.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Content {
    Image,
    /// A JSON document that is an array (`true`) or an object.
    Json {
        array: bool,
    },
    Ply,
    /// Lines of text.
    Text,
}

/// The file name of an image, in Unicode's composed form (NFC): file systems and archives decompose names, which look the
/// same.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ImageName(String);

impl ImageName {
    /// Reads a name: one path component that every file system takes, with the ending of an image.
    pub fn parse(name: &str) -> Result<Self, InvalidPath> {
        let name = &*name.nfc().collect::<String>();
        let refuse = |reason| Err(InvalidPath::Name { name: name.chars().take(80).collect(), reason });
        if name.is_empty() {
            return refuse("it is empty");
        }
        if name.len() > MAX_NAME_BYTES {
            return refuse("it is longer than 200 bytes");
        }
        if name.chars().any(|c| steers(c) || matches!(c, '/' | '\\' | ':' | '*' | '?' | '"' | '<' | '>' | '|')) {
            return refuse("it holds a character that steers how text is shown, or one of / \\ : * ? \" < > |");
        }
        if name.starts_with('.') || name.starts_with(' ') {
            return refuse("it begins with a dot or a space");
        }
        match name.rsplit_once('.') {
            Some((_, ending)) if IMAGE_ENDINGS.contains(&ending.to_ascii_lowercase().as_str()) => {
                Ok(Self(name.to_owned()))
            }
            _ => refuse("it must end in .jpg, .jpeg, .png, .tif or .tiff"),
        }
    }

    /// The name.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl fmt::Display for ImageName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// The place of a file in a survey's folder.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct SurveyPath(String);

impl SurveyPath {
    /// The place of a photo.
    pub fn of_image(name: &ImageName) -> Self {
        Self(format!("images/{name}"))
    }

    /// The place of a part of the reconstruction.
    pub fn of_reconstruction(path: &str) -> Result<Self, InvalidPath> {
        if RECONSTRUCTION_FILES.contains(&path) {
            return Ok(Self(path.to_owned()));
        }
        match path.strip_prefix("undistorted/images/") {
            Some(name) => Ok(Self(format!("undistorted/images/{}", ImageName::parse(name)?))),
            None => Err(InvalidPath::Unknown { path: path.chars().take(120).collect() }),
        }
    }

    /// Whether some file of a reconstruction has this name.
    pub fn is_file_of_reconstruction(name: &str) -> bool {
        RECONSTRUCTION_FILES.iter().any(|path| path.rsplit('/').next() == Some(name))
    }

    /// Any place in the folder.
    pub fn parse(path: &str) -> Result<Self, InvalidPath> {
        match path.strip_prefix("images/") {
            Some(name) => Ok(Self::of_image(&ImageName::parse(name)?)),
            None => Self::of_reconstruction(path),
        }
    }

    /// A place as an earlier version may have stored it: checked, and not brought to another Unicode form.
    pub fn stored(path: String) -> Result<Self, InvalidPath> {
        Self::parse(&path).map(|_| Self(path))
    }

    /// The path with `/` between its components, relative to the survey's folder.
    pub fn as_str(&self) -> &str {
        &self.0
    }

    /// The last component.
    pub fn file_name(&self) -> &str {
        self.0.rsplit('/').next().unwrap_or(&self.0)
    }

    /// What the file is for.
    pub fn kind(&self) -> FileKind {
        if self.0.starts_with("images/") { FileKind::Image } else { FileKind::Reconstruction }
    }

    /// What the file must contain.
    pub fn content(&self) -> Content {
        match self.0.rsplit('.').next() {
            Some("json") => Content::Json { array: self.file_name().starts_with("reconstruction.") },
            Some("ply") => Content::Ply,
            Some("txt") => Content::Text,
            _ => Content::Image,
        }
    }
}

impl fmt::Display for SurveyPath {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_that_leave_the_folder_are_refused() {
        for name in ["", "..", "../a.jpg", "a/b.jpg", "a\\b.jpg", ".a.jpg", "a.jpg\0", "a.exe", "jpg", "C:a.jpg"] {
            assert!(ImageName::parse(name).is_err(), "{name:?}");
        }
        assert_eq!(ImageName::parse("ho\u{308}he.jpg"), ImageName::parse("h\u{f6}he.jpg"));
        for name in ["DJI_0001.JPG", "DJI 0001 (2).jpg", "höhe.png", "x.JPG.jpg", "a..b.tif"] {
            assert_eq!(ImageName::parse(name).unwrap().as_str(), name);
        }
    }

    #[test]
    fn only_known_places_are_taken() {
        for path in ["/reconstruction.json", "../reconstruction.json", "undistorted/x.json", "images", "images/"] {
            assert!(SurveyPath::parse(path).is_err(), "{path:?}");
        }
        let image = SurveyPath::parse("undistorted/images/DJI_0001.JPG.jpg").unwrap();
        assert_eq!((image.kind(), image.content()), (FileKind::Reconstruction, Content::Image));
        assert_eq!(SurveyPath::parse("images/a.jpg").unwrap().kind(), FileKind::Image);
        assert!(SurveyPath::of_reconstruction("images/a.jpg").is_err());
        let shots = SurveyPath::parse("undistorted/reconstruction.json").unwrap();
        assert_eq!(shots.content(), Content::Json { array: true });
    }
}
