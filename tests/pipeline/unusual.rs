//! Surveys that are not as they should be and are mapped all the same, with a word about it.

use crate::boxes::{EXAMPLE, true_boxes};
use crate::survey::{CLOUD, Survey, can_detect, heliomap};
use image::{Rgb, RgbImage};
use serde_json::json;
use std::collections::BTreeSet;

/// Grass, as far as the eye can see: the same on every machine.
fn grass() -> Vec<u8> {
    let mut state = 1_u32;
    let grass = RgbImage::from_fn(1368, 912, |_, _| {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        let shade = (state >> 27) as u8;
        Rgb([60 + shade, 96 + shade, 40 + shade / 2])
    });
    let mut bytes = std::io::Cursor::new(Vec::new());
    grass.write_to(&mut bytes, image::ImageFormat::Jpeg).unwrap();
    bytes.into_inner()
}

#[test]
fn two_components_are_mapped_with_a_warning() {
    let survey = Survey::new();
    survey.edit(|reconstruction| {
        let mut second = reconstruction[0].clone();
        let in_second = |name: &str| ["DJI_0009.jpg", "DJI_0010.jpg"].contains(&name);
        reconstruction[0]["shots"].as_object_mut().unwrap().retain(|name, _| !in_second(name));
        second["shots"].as_object_mut().unwrap().retain(|name, _| in_second(name));
        reconstruction.as_array_mut().unwrap().push(second);
    });
    let summary = survey.maps_with_warnings(true, &[("several_components", &[])]);
    assert_eq!(summary["modules"], 434);
}

#[test]
fn without_a_dense_cloud_every_module_is_mapped_nearly_as_well() {
    let survey = Survey::new();
    let medians_m = || {
        let plant = survey.path("../out/plant.geojson");
        let truth = format!("{EXAMPLE}/truth.json");
        let said = heliomap(&["evaluate", plant.to_str().unwrap(), &truth, "--strict", "--json", "-"]);
        assert_eq!(said.code, Some(0), "{}", said.stderr);
        let evaluation: serde_json::Value = serde_json::from_str(&said.stdout).unwrap();
        ["horizontal", "vertical"].map(|axis| evaluation["after_similarity_fit"][axis]["median"].as_f64().unwrap())
    };
    survey.maps_with_warnings(true, &[]);
    let with = medians_m();
    survey.remove(CLOUD);
    survey.maps_with_warnings(true, &[("no_dense_cloud", &[])]);
    let without = medians_m();
    // The boxes being true, errors are of a millimetre.
    for (with_m, without_m) in with.iter().zip(&without) {
        assert!(*without_m <= 1.5 * with_m + 0.001, "{without_m} m without the cloud, {with_m} m with it");
    }
}

#[test]
fn a_photo_without_modules_is_named() {
    if !can_detect() {
        return;
    }
    let survey = Survey::new();
    survey.write("images/DJI_0004.jpg", grass());
    let summary = survey.maps_with_warnings(
        false,
        &[("images_supplementary", &["DJI_0009.jpg", "DJI_0010.jpg"]), ("image_without_modules", &["DJI_0004.jpg"])],
    );
    assert_eq!(summary["modules"], 434, "{summary}");
    for module in survey.modules() {
        assert!(!module["properties"]["images"].as_array().unwrap().contains(&json!("DJI_0004.jpg")), "{module}");
    }
}

#[test]
fn a_plant_without_a_single_gap_is_mapped() {
    let survey = Survey::new();
    survey.write_boxes(|module| module["bench"] == 4);
    let summary = survey.map(true, &[]);
    assert_eq!(summary.code, Some(0), "{}", summary.stderr);
    let places: BTreeSet<[String; 3]> = survey
        .modules()
        .iter()
        .map(|module| ["bench", "row", "number"].map(|name| module["properties"][name].to_string()))
        .collect();
    // One bench of two rows of twenty, each place once.
    let bench = places.first().unwrap()[0].clone();
    let row = |row: u32| (1..=20).map(move |number| [row.to_string(), number.to_string()]);
    let expected = row(1).chain(row(2)).map(|[row, number]| [bench.clone(), row, number]).collect();
    assert_eq!(places, expected);
}

#[test]
fn poor_boxes_and_images_without_any_are_told() {
    let survey = Survey::new();
    let mut boxes = true_boxes(|_| true);
    let images = boxes["images"].as_array_mut().unwrap();
    images.retain(|image| image["image"] != "DJI_0003.jpg");
    let thin = json!({"corners": [[9, 9], [9, 9], [9, 9], [9, 9]]});
    let first = images.iter_mut().find(|image| image["image"] == "DJI_0001.jpg").unwrap();
    first["boxes"].as_array_mut().unwrap().push(thin);
    survey.change_boxes(boxes);
    survey.maps_with_warnings(
        true,
        &[("boxes_unusable", &["DJI_0001.jpg"]), ("images_without_boxes", &["DJI_0003.jpg"])],
    );
}

#[test]
fn boxes_given_twice_count_once() {
    let survey = Survey::new();
    let mut boxes = true_boxes(|_| true);
    let first = &mut boxes["images"].as_array_mut().unwrap()[0];
    let name = first["image"].as_str().unwrap().to_owned();
    let given = first["boxes"].as_array_mut().unwrap();
    given.extend(given.clone());
    survey.change_boxes(boxes);
    survey.maps_with_warnings(true, &[("boxes_double", &[&name])]);
    assert_eq!(survey.modules().len(), 434);
}

#[test]
fn boxes_of_other_images_are_left_out_with_a_warning() {
    let survey = Survey::new();
    survey.edit(|reconstruction| {
        reconstruction[0]["shots"].as_object_mut().unwrap().remove("DJI_0008.jpg");
    });
    survey.maps_with_warnings(true, &[("boxes_without_shot", &["DJI_0008.jpg"])]);
}

#[test]
fn what_is_said_of_a_plant_is_compared_with_what_is_found() {
    let survey = Survey::new();
    // Swapped: no scale makes that true.
    survey.is_refused(&["--spacing", "1.67,1.02"], &["spacing_m", "along the row first"]);
    survey.is_refused(&["--module-size", "2,1"], &["module_size_m", "along the row first"]);
    for (options, code) in
        [(["--spacing", "5.1,8.35"], "scale_changed"), (["--rows-per-bench", "3"], "rows_contradicted")]
    {
        let said = survey.map(true, &options);
        assert_eq!(said.code, Some(0), "{}", said.stderr);
        assert!(said.stdout.contains(code), "{}", said.stdout);
        assert_eq!(survey.modules().len(), 434);
    }
}

#[test]
fn an_empty_column_is_a_hole_or_a_gap_and_that_is_asked() {
    let survey = Survey::new();
    survey.write_boxes(|module| module["bench"] != 4 || module["col"] != 7);
    let said = survey.map(true, &[]);
    assert_eq!(said.code, Some(0), "{}", said.stderr);
    assert!(said.stdout.contains("bench_or_hole"), "{}", said.stdout);
}

#[test]
fn modules_that_stand_alone_are_told() {
    let survey = Survey::new();
    survey.write_boxes(|module| module["bench"] != 4 || (module["row"] == 0 && module["col"] == 0));
    let said = survey.map(true, &[]);
    assert_eq!(said.code, Some(0), "{}", said.stderr);
    assert!(said.stdout.contains("boxes_alone"), "{}", said.stdout);
}
