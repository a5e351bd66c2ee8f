//! `heliomap detect` and `heliomap evaluate-detection`, from the command line.

use crate::boxes::EXAMPLE;
use crate::survey::{can_detect, heliomap};
use serde_json::{Value, json};
use std::path::Path;

fn model(name: &str) -> String {
    format!("{}/crates/mapping/tests/fixtures/detection/{name}.onnx", env!("CARGO_MANIFEST_DIR"))
}

/// A folder with a photo of bright modules on dark ground, in a lattice of 5 x 4; and its labels.
fn bright_modules(folder: &Path) {
    let low = |k: u32| (20 + 27 * (k % 5), 20 + 20 * (k / 5));
    let image = image::RgbImage::from_fn(180, 120, |x, y| {
        let inside = (0..20).map(low).any(|(left, top)| (left..left + 24).contains(&x) && (top..top + 16).contains(&y));
        image::Rgb([if inside { 255 } else { 0 }; 3])
    });
    image.save(folder.join("photo.png")).unwrap();
    let modules: Vec<Value> = (0..20)
        .map(low)
        .map(|(left, top)| {
            let (left, top) = (f64::from(left) - 0.5, f64::from(top) - 0.5);
            json!([[left, top], [left + 24.0, top], [left + 24.0, top + 16.0], [left, top + 16.0]])
        })
        .collect();
    std::fs::write(folder.join("labels.json"), json!({"photo": {"modules": modules}}).to_string()).unwrap();
}

#[test]
fn photos_become_boxes_and_boxes_are_measured() {
    if !can_detect() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    bright_modules(folder.path());
    let at = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let (photo, labels, boxes, pictures) = (at("photo.png"), at("labels.json"), at("boxes.json"), at("pictures"));
    let detector = model("double_size");
    let said = heliomap(&[
        "detect",
        &photo,
        "--out",
        &boxes,
        "--overlay",
        &pictures,
        "--detector",
        &detector,
        "--gsd",
        "0.04",
    ]);
    assert_eq!(said.code, Some(0), "{}", said.stderr);
    let found: Value = serde_json::from_slice(&std::fs::read(&boxes).unwrap()).unwrap();
    let image = &found["images"][0];
    assert_eq!((&image["image"], &image["width"], &image["height"]), (&json!("photo.png"), &json!(180), &json!(120)));
    assert_eq!(image["boxes"].as_array().unwrap().len(), 20);
    assert_eq!(image["boxes"][0]["source"], "unet");
    assert!(Path::new(&pictures).join("photo.png").is_file());

    // The folder in the place of the photo, to standard output.
    let said = heliomap(&["detect", folder.path().to_str().unwrap(), "--detector", &detector, "--gsd", "0.04"]);
    assert_eq!(serde_json::from_str::<Value>(&said.stdout).unwrap(), found, "{}", said.stderr);

    // The detector itself, and the file of boxes, come to the same.
    let detections = ["evaluate-detection", &labels, "--detections", &boxes, "--json", "-"];
    let run = ["evaluate-detection", &labels, "--detector", &detector, "--gsd", "0.04", "--json", "-"];
    let [given, run]: [Value; 2] = [&detections[..], &run[..]].map(|arguments| {
        let said = heliomap(arguments);
        assert_eq!(said.code, Some(0), "{}", said.stderr);
        serde_json::from_str(&said.stdout).unwrap()
    });
    assert_eq!(given["all"], run["all"]);
    assert_eq!((&run["all"]["found"], &run["all"]["boxes"]), (&json!(20), &json!(20)));
    assert!(run["all"]["mean_iou"].as_f64().unwrap() > 0.9, "{}", run["all"]);

    let said = heliomap(&["evaluate-detection", &labels, "--detections", &boxes, "--photos"]);
    assert!(said.stdout.contains("photo.png") && said.stdout.contains("100.00"), "{}", said.stdout);
}

#[test]
fn what_cannot_be_searched_is_refused_in_a_sentence() {
    let folder = tempfile::tempdir().unwrap();
    let empty = folder.path().to_str().unwrap();
    std::fs::write(folder.path().join("letter.txt"), "no photo").unwrap();
    let letter = folder.path().join("letter.txt").to_str().unwrap().to_owned();
    for (arguments, words) in [
        (vec!["detect", empty], "there is no photo"),
        (vec!["detect", &letter], "no image that can be read"),
        (vec!["detect", "missing.jpg"], "missing.jpg cannot be read"),
        (vec!["detect", empty, "--gsd", "7"], "0.001 to 1 metre per pixel"),
        (vec!["evaluate-detection", empty], "truth.json"),
    ] {
        let said = heliomap(&arguments);
        assert!(said.code.is_some_and(|code| code != 0 && code != 101), "{said:?}");
        assert!(said.stderr.contains(words), "{}", said.stderr);
    }
}

#[test]
fn detectors_are_chosen_by_name_or_file_and_what_runs_them_too() {
    if !can_detect() {
        return;
    }
    let photo = format!("{EXAMPLE}/images/DJI_0001.jpg");
    let two = format!("{},{}", model("one_channel"), model("double_size"));
    let other = model("classifier");
    for (options, words) in [
        (["--detector", &two], "two of the models are U-Nets"),
        (["--detector", &other], "does not fit"),
        (["--detector", "missing.onnx"], "cannot be read"),
        (["--execution-provider", "abacus"], "one of cpu, cuda"),
        (["--execution-provider", "cuda"], "cannot run models on CUDA"),
    ] {
        let said = heliomap(&["detect", &photo, options[0], options[1]]);
        assert!(said.code.is_some_and(|code| code != 0 && code != 101), "{said:?}");
        assert!(said.stderr.contains(words), "{}", said.stderr);
    }
}

#[test]
fn boxes_of_a_reconstructed_folder_can_be_mapped() {
    if !can_detect() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let (boxes, plant) = (folder.path().join("boxes.json"), folder.path().join("plant.geojson"));
    let said = heliomap(&["detect", EXAMPLE, "--out", boxes.to_str().unwrap()]);
    assert_eq!(said.code, Some(0), "{}", said.stderr);
    let arguments =
        ["map", EXAMPLE, "--detections", boxes.to_str().unwrap(), "--out", plant.to_str().unwrap(), "--json"];
    let said = heliomap(&arguments);
    assert_eq!(said.code, Some(0), "{}", said.stderr);
    let summary: Value = serde_json::from_str(&said.stdout).unwrap();
    assert_eq!(summary["modules"], 434, "{summary}");
}
