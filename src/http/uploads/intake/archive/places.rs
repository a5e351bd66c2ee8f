//! Which entries of an archive are files of a survey, however people packed it, and why others are left out.

use super::{ArchiveError, shown};
use crate::store::{FileKind, ImageName, InvalidPath, SurveyPath, looks_like_photo};
use serde::Serialize;
use std::collections::BTreeMap;

/// An entry that looks like a photo or a part of a reconstruction and was not taken.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, utoipa::ToSchema)]
pub struct LeftOut {
    /// Its name in the archive.
    #[schema(example = "odm_orthophoto/odm_orthophoto.tif")]
    pub entry: String,
    /// Why it was left out.
    #[schema(example = "photos are taken from images/ alone")]
    pub reason: String,
}

/// What becomes of an archive's entries.
#[derive(Debug, Default)]
pub(super) struct Places {
    /// The files of a survey, by the index of their entry.
    pub taken: BTreeMap<usize, SurveyPath>,
    pub left_out: Vec<LeftOut>,
}

/// Names of files that systems put beside what people pack.
const OF_SYSTEMS: [&str; 4] = ["__MACOSX", ".DS_Store", "Thumbs.db", "desktop.ini"];
/// Endings of clouds and archives, which people may take for part of what is read.
const CLOUDS: [&str; 3] = [".ply", ".las", ".laz"];
const ARCHIVES: [&str; 5] = [".zip", ".tar", ".tgz", ".gz", ".7z"];

/// An entry that may be a file of a survey.
struct Candidate {
    index: usize,
    /// The folder of the project that it is in.
    project: String,
    path: SurveyPath,
    /// How many folders lie above it.
    depth: usize,
}

/// Places the entries of an archive. It may hold the project's folder, what is in it, or folders above it; ODM's project
/// holds OpenSfM's in `opensfm/`; photos may lie in folders below `images/`. Of several projects, the one nearest the top
/// counts.
pub(super) fn places(names: &[String]) -> Result<Places, ArchiveError> {
    let mut places = Places::default();
    let mut found = Vec::new();
    for (index, name) in names.iter().enumerate() {
        let parts: Vec<&str> = name.split('/').filter(|part| !part.is_empty() && *part != ".").collect();
        if parts.iter().any(|part| OF_SYSTEMS.contains(part) || part.starts_with("._")) {
            continue;
        }
        match candidate(index, name, &parts)? {
            Some(candidate) => found.push(candidate),
            None => places.left_out.extend(reason(&parts).map(|reason| left_out(name, reason))),
        }
    }
    let of_reconstruction = |candidate: &&Candidate| candidate.path.kind() == FileKind::Reconstruction;
    let nearest = |project: &&str| (project.split('/').filter(|part| !part.is_empty()).count(), (*project).to_owned());
    let projects: Vec<&str> = found.iter().filter(of_reconstruction).map(|found| found.project.as_str()).collect();
    let project = projects.iter().copied().min_by_key(nearest).map(str::to_owned);
    let mut by_path: BTreeMap<&SurveyPath, Vec<&Candidate>> = BTreeMap::new();
    for candidate in &found {
        let elsewhere = project.as_ref().is_some_and(|project| *project != candidate.project);
        if elsewhere && (of_reconstruction(&candidate) || projects.contains(&candidate.project.as_str())) {
            let of = project.as_deref().filter(|project| !project.is_empty()).unwrap_or("the archive's top");
            let reason = format!("it is of another project than the one in {of}, which was taken");
            places.left_out.push(left_out(&names[candidate.index], reason));
        } else {
            by_path.entry(&candidate.path).or_default().push(candidate);
        }
    }
    for (path, mut candidates) in by_path {
        candidates.sort_by_key(|candidate| (candidate.depth, candidate.index));
        let Some((first, others)) = candidates.split_first() else { continue };
        if let Some(same) = others.first().filter(|other| other.depth == first.depth) {
            let [first, second] = [first, same].map(|candidate| shown(&names[candidate.index]));
            return Err(ArchiveError::Twice { path: path.clone(), first, second });
        }
        for other in others {
            let reason = format!("{} was taken as {path}", shown(&names[first.index]));
            places.left_out.push(left_out(&names[other.index], reason));
        }
        places.taken.insert(first.index, path.clone());
    }
    Ok(places)
}

/// What an entry may be, by its path; a photo whose name cannot be used is refused rather than left out.
fn candidate(index: usize, name: &str, parts: &[&str]) -> Result<Option<Candidate>, ArchiveError> {
    let refused = |reason| Err(ArchiveError::Name { entry: shown(name), reason });
    for start in 0..parts.len() {
        let (above, rest) = parts.split_at(start);
        let path = match rest {
            [images, folders @ .., file]
                if images.eq_ignore_ascii_case("images")
                    && above.last() != Some(&"undistorted")
                    && !folders.iter().any(|folder| folder.starts_with('.')) =>
            {
                match ImageName::parse(file) {
                    Ok(name) => Some(SurveyPath::of_image(&name)),
                    Err(InvalidPath::Name { reason, .. }) if looks_like_photo(file) => return refused(reason),
                    Err(_) => return Ok(None),
                }
            }
            _ => match SurveyPath::of_reconstruction(&rest.join("/")) {
                Ok(path) => Some(path),
                Err(InvalidPath::Name { name: photo, reason }) if !photo.contains('/') && looks_like_photo(&photo) => {
                    return refused(reason);
                }
                Err(_) => None,
            },
        };
        if let Some(path) = path {
            let above = above.strip_suffix(&["opensfm"]).unwrap_or(above);
            return Ok(Some(Candidate { index, project: above.join("/"), path, depth: parts.len() }));
        }
    }
    Ok(None)
}

/// Why an entry is not taken that may be thought to be.
fn reason(parts: &[&str]) -> Option<&'static str> {
    let file = parts.last()?.to_ascii_lowercase();
    let ends = |endings: &[&str]| endings.iter().any(|ending| file.ends_with(ending));
    if looks_like_photo(&file) {
        Some("photos are taken from images/ and the folders below it, undistorted ones from undistorted/images/")
    } else if ends(&CLOUDS) {
        Some("the point cloud is undistorted/depthmaps/merged.ply")
    } else if ends(&ARCHIVES) {
        Some("archives within archives are not read: send it by itself")
    } else if SurveyPath::is_file_of_reconstruction(&file) {
        Some("it is not where OpenSfM leaves it")
    } else {
        None
    }
}

fn left_out(entry: &str, reason: impl Into<String>) -> LeftOut {
    LeftOut { entry: shown(entry), reason: reason.into() }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Entries with the places that they are taken to, and those left out.
    fn placed(names: &[&str]) -> (Vec<(String, String)>, Vec<String>) {
        let names: Vec<String> = names.iter().map(|name| (*name).to_owned()).collect();
        let Places { taken, left_out } = places(&names).unwrap();
        let taken = taken.into_iter().map(|(index, path)| (names[index].clone(), path.to_string())).collect();
        (taken, left_out.into_iter().map(|left_out| left_out.entry).collect())
    }

    fn pairs(pairs: &[(&str, &str)]) -> Vec<(String, String)> {
        pairs.iter().map(|(from, to)| ((*from).to_owned(), (*to).to_owned())).collect()
    }

    #[test]
    fn an_odm_project_is_one_project() {
        let (taken, left_out) = placed(&[
            "site/images/100MEDIA/a.JPG",
            "site/opensfm/reconstruction.topocentric.json",
            "site/opensfm/reconstruction.json",
            "site/opensfm/undistorted/images/a.JPG.tif",
            "site/odm_georeferencing/coords.txt",
            "site/odm_orthophoto/odm_orthophoto.tif",
            "site/odm_report/report.pdf",
        ]);
        assert_eq!(
            taken,
            pairs(&[
                ("site/images/100MEDIA/a.JPG", "images/a.JPG"),
                ("site/opensfm/reconstruction.topocentric.json", "reconstruction.topocentric.json"),
                ("site/opensfm/reconstruction.json", "reconstruction.json"),
                ("site/opensfm/undistorted/images/a.JPG.tif", "undistorted/images/a.JPG.tif"),
                ("site/odm_georeferencing/coords.txt", "odm_georeferencing/coords.txt"),
            ])
        );
        assert_eq!(left_out, ["site/odm_orthophoto/odm_orthophoto.tif"]);
    }

    #[test]
    fn photos_may_lie_beside_the_project_but_not_in_another() {
        let (taken, left_out) = placed(&["flight/Images/a.jpg", "sfm/run 1/reconstruction.json"]);
        assert_eq!(taken.len(), 2, "{left_out:?}");
        let names = ["a/reconstruction.json", "a/images/1.jpg", "b/reconstruction.json", "b/images/2.jpg"];
        let (taken, left_out) = placed(&names);
        assert_eq!(
            taken,
            pairs(&[("a/reconstruction.json", "reconstruction.json"), ("a/images/1.jpg", "images/1.jpg")])
        );
        assert_eq!(left_out, names[2..]);
    }

    #[test]
    fn the_photo_nearest_the_top_is_taken_and_two_as_near_are_refused() {
        let (taken, left_out) =
            placed(&["images/a.jpg", "images/thumbs/a.jpg", "images/.cache/b.jpg", "images/._a.jpg"]);
        assert_eq!(taken, pairs(&[("images/a.jpg", "images/a.jpg")]));
        assert_eq!(left_out, ["images/.cache/b.jpg", "images/thumbs/a.jpg"]);
        let names = ["images/100MEDIA/DJI_0001.JPG", "images/101MEDIA/DJI_0001.JPG"].map(str::to_owned);
        assert!(matches!(places(&names), Err(ArchiveError::Twice { first, .. }) if first == names[0]));
        // One name in two Unicode forms.
        let names = ["images/h\u{f6}he.jpg", "images/ho\u{308}he.jpg"].map(str::to_owned);
        assert!(matches!(places(&names), Err(ArchiveError::Twice { .. })));
    }
}
