//! The example plant, from photos to GeoJSON and against its truth.

use crate::boxes::EXAMPLE;
use crate::survey::{Survey, can_detect, heliomap};
use serde_json::Value;

#[test]
fn the_example_is_mapped_without_a_fault_whatever_the_number_of_threads() {
    if !can_detect() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let files = ["plant", "plant-sectors", "plant-benches", "plant-lines"];
    let [one, two] = ["1", "2"].map(|threads| {
        let out = folder.path().join(threads).join("plant.geojson");
        std::fs::create_dir(out.parent().unwrap()).unwrap();
        let said = heliomap(&["map", EXAMPLE, "--out", out.to_str().unwrap(), "--layers", "--threads", threads]);
        assert_eq!(said.code, Some(0), "{}", said.stderr);
        files.map(|name| std::fs::read(out.with_file_name(format!("{name}.geojson"))).unwrap())
    });
    for (name, (one, two)) in files.iter().zip(one.iter().zip(&two)) {
        assert!(one == two, "{name} differs between one thread and two");
    }

    let plant = folder.path().join("1/plant.geojson");
    let truth = format!("{EXAMPLE}/truth.json");
    let said = heliomap(&["evaluate", plant.to_str().unwrap(), &truth, "--strict", "--json", "-"]);
    assert_eq!(said.code, Some(0), "{}", said.stderr);
    let evaluation: Value = serde_json::from_str(&said.stdout).unwrap();
    assert_eq!((&evaluation["found"], &evaluation["structure"]["exact"]), (&434.into(), &true.into()));
    let differences = &evaluation["after_similarity_fit"];
    let at_most = |axis: &str, number: &str, limit_m: f64| {
        let found_m = differences[axis][number].as_f64().unwrap();
        assert!(found_m <= limit_m, "{axis} {number}: {found_m} m, at most {limit_m} m are allowed");
    };
    at_most("horizontal", "median", 0.03);
    at_most("vertical", "median", 0.05);
    at_most("horizontal", "max", 0.25);
    at_most("vertical", "max", 0.25);
}

#[test]
fn true_boxes_in_the_place_of_a_detector_give_the_plant() {
    let survey = Survey::new();
    let summary = survey.maps_with_warnings(true, &[]);
    assert_eq!((&summary["modules"], &summary["warnings"]), (&434.into(), &Value::Array(Vec::new())), "{summary}");
    assert_eq!((&summary["lines"], &summary["benches"], &summary["sectors"]), (&4.into(), &12.into(), &24.into()));
}

#[test]
fn a_known_spacing_is_taken() {
    let survey = Survey::new();
    let said = survey.map(true, &["--spacing", "1.02,1.67", "--rows-per-bench", "2"]);
    assert_eq!(said.code, Some(0), "{}", said.stderr);
    let modules = survey.modules();
    assert_eq!(modules.len(), 434);
    // Metres between neighbours of a row, on a sphere: right to a few millimetres over one module.
    let mut spacing_m: Vec<f64> = modules
        .windows(2)
        .filter(|pair| pair[0]["properties"]["sector"] == pair[1]["properties"]["sector"])
        .map(|pair| {
            let at = |k: usize, axis: usize| pair[k]["properties"]["center"][axis].as_f64().unwrap();
            let degree_m = 111_230.0;
            let east = (at(1, 0) - at(0, 0)) * degree_m * at(0, 1).to_radians().cos();
            let (north, up) = ((at(1, 1) - at(0, 1)) * degree_m, at(1, 2) - at(0, 2));
            (east * east + north * north + up * up).sqrt()
        })
        .collect();
    spacing_m.sort_by(f64::total_cmp);
    let median = spacing_m[spacing_m.len() / 2];
    // Without the option the reconstruction's own scale gives 1.015 m.
    assert!((median - 1.02).abs() < 0.003, "{median}");
}

#[test]
fn the_lattice_errs_by_less_than_a_quarter_of_the_paper_s_refinement() {
    let survey = Survey::new();
    let truth = format!("{EXAMPLE}/truth.json");
    let [lattice, paper] = ["lattice", "paper"].map(|method| {
        let said = survey.map(true, &["--refinement", method]);
        assert_eq!(said.code, Some(0), "{}", said.stderr);
        let plant = survey.path("../out/plant.geojson");
        let said = heliomap(&["evaluate", plant.to_str().unwrap(), &truth, "--json", "-"]);
        let evaluation: Value = serde_json::from_str(&said.stdout).unwrap();
        ["horizontal", "vertical"].map(|axis| evaluation["after_similarity_fit"][axis]["median"].as_f64().unwrap())
    });
    for (axis, (lattice, paper)) in ["horizontal", "vertical"].iter().zip(lattice.iter().zip(&paper)) {
        assert!(4.0 * lattice < *paper, "{axis}: {lattice} m by the lattice, {paper} m by the paper");
    }
}
