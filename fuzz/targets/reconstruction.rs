//! The JSON files of a reconstruction, of which the input is one: which one, its first byte says.

#![no_main]

use heliomap_fuzz::memory::Allowance;
use heliomap_mapping::reconstruction::opensfm;
use libfuzzer_sys::fuzz_target;
use std::path::{Path, PathBuf};
use std::sync::LazyLock;

const FILES: [&str; 3] = ["reconstruction.json", "reference_lla.json", "undistorted/reconstruction.json"];

/// The survey's other files, and a document of which every few bytes may be a value of its own.
const PROJECT: Allowance = Allowance { bytes: 8 << 20, per_input_byte: 256 };

/// The corpus' own survey of two small photos, whole.
static SURVEY: LazyLock<PathBuf> = LazyLock::new(|| {
    let folder = heliomap_fuzz::file("survey");
    std::fs::create_dir_all(folder.join("images")).unwrap();
    std::fs::create_dir_all(folder.join("undistorted")).unwrap();
    let seeds = Path::new(env!("CARGO_MANIFEST_DIR")).join("seeds");
    for name in ["a.jpg", "b.jpg"] {
        std::fs::copy(seeds.join("photo.jpg"), folder.join("images").join(name)).unwrap();
    }
    for name in &FILES[..2] {
        std::fs::copy(seeds.join(name), folder.join(name)).unwrap();
    }
    folder
});

fuzz_target!(|bytes: &[u8]| {
    let Some((which, document)) = bytes.split_first() else { return };
    let path = SURVEY.join(FILES[usize::from(*which) % FILES.len()]);
    let before = std::fs::read(&path).ok();
    std::fs::write(&path, document).unwrap();
    // What comes is looked at by itself first.
    let _ = PROJECT.within(bytes.len(), "a look at a reconstruction", || opensfm::check::reconstruction(&path, 0));
    if let Ok(project) = PROJECT.within(bytes.len(), "a reconstruction", || opensfm::read(&*SURVEY, 1_000_000)) {
        assert_eq!(project.photos.len(), project.reconstruction.shots.len());
        for shot in &project.reconstruction.shots {
            assert!(shot.camera.focal_px().is_finite() && shot.camera.focal_px() > 0.0);
        }
    }
    match before {
        Some(before) => std::fs::write(&path, before).unwrap(),
        None => std::fs::remove_file(&path).unwrap(),
    }
});
