//! The larger data sets, where they are there: `HELIOMAP_DATA` names their folder.

use crate::survey::{can_detect, heliomap};
use heliomap_mapping::reconstruction::photo::{DEFAULT_MAX_PIXELS, examine, inspect};
use rayon::prelude::*;
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// The folder of a data set; says so where it is absent.
fn data(name: &str) -> Option<PathBuf> {
    let folder = std::env::var_os("HELIOMAP_DATA").filter(|path| !path.is_empty()).map(|path| {
        // `make` gives it relative to the package.
        PathBuf::from(env!("CARGO_MANIFEST_DIR")).join(path).join(name)
    });
    let folder = folder.filter(|folder| folder.is_dir());
    if folder.is_none() {
        eprintln!("skipped: the data set {name} is not there (HELIOMAP_DATA names the folder that holds it)");
    }
    folder
}

#[test]
fn the_plant_at_full_resolution_is_right_to_a_centimetre_and_a_half() {
    let Some(folder) = data("small").filter(|_| can_detect()) else { return };
    let out = tempfile::tempdir().unwrap();
    let plant = out.path().join("plant.geojson");
    let said = heliomap(&["map", folder.to_str().unwrap(), "--out", plant.to_str().unwrap()]);
    assert_eq!(said.code, Some(0), "{}", said.stderr);
    let truth = folder.join("truth.json");
    let evaluated = ["evaluate", plant.to_str().unwrap(), truth.to_str().unwrap(), "--strict", "--json", "-"];
    let said = heliomap(&evaluated);
    assert_eq!(said.code, Some(0), "{}", said.stderr);
    let evaluation: Value = serde_json::from_str(&said.stdout).unwrap();
    let error_m = |axis: &str, number: &str| evaluation["after_similarity_fit"][axis][number].as_f64().unwrap();
    assert!(error_m("horizontal", "median") <= 0.015, "{}", error_m("horizontal", "median"));
    assert!(error_m("vertical", "median") <= 0.05, "{}", error_m("vertical", "median"));
    assert!(error_m("horizontal", "max").max(error_m("vertical", "max")) <= 0.25);
}

#[test]
fn every_whole_bench_of_a_real_plant_comes_out_exactly() {
    let Some(folder) = data("missouri-west").filter(|_| can_detect()) else { return };
    let out = tempfile::tempdir().unwrap();
    let plant = out.path().join("plant.geojson");
    let said = heliomap(&["map", folder.to_str().unwrap(), "--out", plant.to_str().unwrap()]);
    assert_eq!(said.code, Some(0), "{}", said.stderr);
    let modules: Value = serde_json::from_slice(&std::fs::read(&plant).unwrap()).unwrap();
    let mut benches: BTreeMap<&str, usize> = BTreeMap::new();
    for module in modules["features"].as_array().unwrap() {
        *benches.entry(module["properties"]["bench"].as_str().unwrap()).or_default() += 1;
    }
    // Ten benches of 54 columns and 3 rows were counted on an orthophoto; all others are shorter.
    let whole = benches.values().filter(|count| **count == 162).count();
    assert_eq!(whole, 10, "{benches:?}");
    assert_eq!(benches.values().max(), Some(&162), "{benches:?}");
}

/// Image files anywhere in a folder, every so many of them.
fn images(folder: &Path, every: usize) -> Vec<PathBuf> {
    let mut found = Vec::new();
    let mut folders = vec![folder.to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            match path.extension().and_then(|ending| ending.to_str()) {
                _ if path.is_dir() => folders.push(path),
                Some("jpg" | "png") => found.push(path),
                _ => {}
            }
        }
    }
    found.sort();
    found.into_iter().step_by(every).collect()
}

#[test]
fn no_good_photo_is_called_blurred_or_badly_exposed() {
    let sets = [("example", 1), ("small", 1), ("train", 3), ("real-labelled", 1), ("missouri-west", 12)];
    for (set, every) in sets {
        let Some(folder) = data(set) else { return };
        images(&folder, every).par_iter().for_each(|path| {
            let name = path.to_str().unwrap();
            let facts = examine(path, name, inspect(path, name, DEFAULT_MAX_PIXELS).unwrap()).unwrap();
            assert_eq!(facts.quality.flaws(), [], "{name}: {:?}", facts.quality);
            // Screen copies tell nothing.
            if ["example", "small", "missouri-west"].contains(&set) && !name.contains("undistorted") {
                assert!(facts.exposure.position.is_some() && facts.exposure.taken.is_some(), "{name}: {facts:?}");
            }
        });
    }
}
