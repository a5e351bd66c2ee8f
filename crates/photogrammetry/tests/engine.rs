//! The engine as a process: what it makes of real photos, and what becomes of one that fails.

use heliomap_photogrammetry::{Observer, Options, ReconstructError, Report, Stage, reconstruct};
use serde_json::Value;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};
use tempfile::TempDir;

const EXAMPLE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../examples/plant");

fn options(python: PathBuf) -> Options {
    Options { python, focal_share: None, max_image_pixels: 10_000_000, threads: 2, seed: 1 }
}

struct Quiet;

impl Observer for Quiet {
    fn progress(&self, _: Stage, _: usize, _: usize) {}
}

/// A survey of some photos of the example.
fn survey(photos: &[u32]) -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    std::fs::create_dir(folder.path().join("images")).unwrap();
    for number in photos {
        let name = format!("DJI_{number:04}.jpg");
        std::fs::copy(format!("{EXAMPLE}/images/{name}"), folder.path().join("images").join(name)).unwrap();
    }
    folder
}

/// An engine that does what a shell script says.
fn script(folder: &TempDir, body: &str) -> PathBuf {
    let path = folder.path().join("engine.sh");
    std::fs::write(&path, format!("#!/bin/sh\n{body}\n")).unwrap();
    std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o755)).unwrap();
    path
}

fn failure(folder: &TempDir, options: &Options) -> ReconstructError {
    let error = reconstruct(folder.path(), options, &Quiet).unwrap_err();
    assert!(!folder.path().join("reconstruction.json").exists());
    error
}

fn center(shot: &Value) -> [f64; 3] {
    let vector = |value: &Value| [0, 1, 2].map(|axis| value[axis].as_f64().unwrap());
    let rotation = nalgebra::Rotation3::new(vector(&shot["rotation"]).into());
    (-(rotation.inverse() * nalgebra::Vector3::from(vector(&shot["translation"])))).into()
}

fn read(path: impl AsRef<Path>) -> Value {
    serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap()
}

/// Distances of cameras by the reconstruction over those of the truth: alike, whatever GNSS makes of the scale.
fn distance_ratios(folder: &Path) -> Vec<f64> {
    let (made, truth) = (read(folder.join("reconstruction.json")), read(format!("{EXAMPLE}/truth.json")));
    let centers: Vec<([f64; 3], [f64; 3])> = made[0]["shots"]
        .as_object()
        .unwrap()
        .iter()
        .map(|(name, shot)| {
            let known = truth["shots"].as_array().unwrap().iter().find(|known| known["name"] == name.as_str()).unwrap();
            (center(shot), [0, 1, 2].map(|axis| known["center"][axis].as_f64().unwrap()))
        })
        .collect();
    let distance = |a: [f64; 3], b: [f64; 3]| (0..3).map(|axis| (a[axis] - b[axis]).powi(2)).sum::<f64>().sqrt();
    let pairs = (0..centers.len()).flat_map(|a| (0..a).map(move |b| (a, b)));
    pairs.map(|(a, b)| distance(centers[a].0, centers[b].0) / distance(centers[a].1, centers[b].1)).collect()
}

#[test]
#[ignore = "needs pycolmap (make setup)"]
fn photos_are_placed_as_they_were_taken() {
    let folder = survey(&[1, 2, 3, 5, 6]);
    let python = std::env::var_os("HELIOMAP_RECONSTRUCT_PYTHON").expect("HELIOMAP_RECONSTRUCT_PYTHON").into();
    let report: Report = reconstruct(folder.path(), &options(python), &Quiet).unwrap();
    assert_eq!((report.placed, report.components.as_slice()), (5, [5].as_slice()), "{report:?}");
    assert!(report.reprojection_px < 0.5 && report.gnss_median_m < 3.0, "{report:?}");
    let ratios = distance_ratios(folder.path());
    let mean = ratios.iter().sum::<f64>() / ratios.len() as f64;
    assert_eq!(ratios.len(), 10);
    assert!((mean - 1.0).abs() < 0.05, "the scale is off: {mean}");
    assert!(ratios.iter().all(|ratio| (ratio / mean - 1.0).abs() < 0.005), "{ratios:?}");
}

#[test]
fn an_engine_that_fails_is_an_error_with_its_last_words() {
    let folder = survey(&[1, 2, 3]);
    let missing = failure(&folder, &options(folder.path().join("no-such-python")));
    assert_eq!(missing.code(), "engine_missing");
    let crashed = failure(&folder, &options(script(&folder, "echo not json; echo out of memory >&2; kill -9 $$")));
    assert_eq!(crashed.code(), "engine_failed");
    assert!(crashed.to_string().contains("out of memory"), "{crashed}");
    let refused =
        r#"read -r request; echo '{"error": {"code": "nothing_reconstructed", "message": "no two photos fit"}}'"#;
    let refused = failure(&folder, &options(script(&folder, refused)));
    assert_eq!((refused.code(), refused.to_string().as_str()), ("nothing_reconstructed", "no two photos fit"));
    let elsewhere =
        r#"{"result": {"cameras": [null], "components": [{"aligned": true, "points": [], "reprojection_px": 0.1,
        "shots": [{"image": 7, "rotation": [[1,0,0],[0,1,0],[0,0,1]], "translation": [0,0,0], "points": 1,
        "reprojection_px": null}]}]}}"#
            .replace('\n', " ");
    let elsewhere = failure(&folder, &options(script(&folder, &format!("echo '{elsewhere}'"))));
    assert_eq!(elsewhere.code(), "reconstruction_not_aligned");
}

#[test]
fn cancelling_ends_the_engine() {
    struct Impatient(AtomicBool);
    impl Observer for Impatient {
        fn progress(&self, _: Stage, _: usize, _: usize) {
            self.0.store(true, Ordering::SeqCst);
        }
        fn is_cancelled(&self) -> bool {
            self.0.load(Ordering::SeqCst)
        }
    }
    let folder = survey(&[1, 2, 3]);
    let body = r#"echo '{"stage": "features", "done": 1, "total": 3}'; exec sleep 600"#;
    let begun = Instant::now();
    let observer = Impatient(AtomicBool::new(false));
    let error = reconstruct(folder.path(), &options(script(&folder, body)), &observer).unwrap_err();
    assert_eq!(error.code(), "cancelled");
    assert!(begun.elapsed() < Duration::from_secs(60), "the engine ran on");
}

#[test]
fn surveys_that_cannot_be_placed_are_refused() {
    let never = |folder: &TempDir| options(script(folder, "exit 1"));
    let two = survey(&[1, 2]);
    assert_eq!(failure(&two, &never(&two)).code(), "too_few_images");

    let twice = survey(&[1, 2, 3]);
    std::fs::create_dir(twice.path().join("images/again")).unwrap();
    std::fs::copy(twice.path().join("images/DJI_0001.jpg"), twice.path().join("images/again/DJI_0001.jpg")).unwrap();
    assert_eq!(failure(&twice, &never(&twice)).code(), "image_name_twice");

    let one_place = survey(&[1]);
    for copy in ["b.jpg", "c.jpg"] {
        std::fs::copy(one_place.path().join("images/DJI_0001.jpg"), one_place.path().join("images").join(copy))
            .unwrap();
    }
    assert_eq!(failure(&one_place, &never(&one_place)).code(), "images_of_one_place");

    let bare = survey(&[1]);
    for copy in ["b.jpg", "c.jpg", "d.jpg"] {
        image::RgbImage::new(40, 30).save(bare.path().join("images").join(copy)).unwrap();
    }
    assert_eq!(failure(&bare, &never(&bare)).code(), "focal_length_unknown");
    let given = Options { focal_share: Some(0.7), ..never(&bare) };
    assert_eq!(failure(&bare, &given).code(), "too_few_positions");

    let broken = survey(&[1, 2, 3]);
    std::fs::write(broken.path().join("images/DJI_0002.jpg"), b"\xff\xd8\xff\xe0 no photo").unwrap();
    assert!(failure(&broken, &never(&broken)).to_string().contains("DJI_0002.jpg"));
}
