//! Projects as other programs and people leave them: mapped as the plain one is, or refused by name.

use crate::boxes::EXAMPLE;
use crate::survey::{CLOUD, Survey, heliomap};
use serde_json::{Value, json};

/// Fails unless the survey is mapped exactly.
#[track_caller]
fn is_exact(survey: &Survey) {
    let mapped = survey.map(true, &[]);
    assert_eq!(mapped.code, Some(0), "{}", mapped.stderr);
    let plant = survey.path("../out/plant.geojson");
    let evaluated = heliomap(&["evaluate", plant.to_str().unwrap(), &format!("{EXAMPLE}/truth.json"), "--strict"]);
    assert_eq!(evaluated.code, Some(0), "{}{}", evaluated.stdout, evaluated.stderr);
}

/// Fails unless the survey is refused with each of `words` in the message.
#[track_caller]
fn is_refused(survey: &Survey, words: &[&str]) {
    let mapped = survey.map(true, &[]);
    assert_eq!(mapped.code, Some(1), "{}", mapped.stderr);
    assert!(words.iter().all(|word| mapped.stderr.contains(word)), "{}", mapped.stderr);
}

fn shots(reconstruction: &mut Value) -> impl Iterator<Item = &mut Value> {
    reconstruction[0]["shots"].as_object_mut().unwrap().values_mut()
}

#[test]
fn odm_project_folder_is_read_in_its_local_frame() {
    let survey = Survey::new();
    std::fs::create_dir_all(survey.path("opensfm/undistorted/depthmaps")).unwrap();
    let moved =
        [("reconstruction.json", "reconstruction.topocentric.json"), ("reference_lla.json", "reference_lla.json")];
    for (from, to) in moved {
        std::fs::rename(survey.path(from), survey.path("opensfm").join(to)).unwrap();
    }
    std::fs::rename(survey.path(CLOUD), survey.path("opensfm").join(CLOUD)).unwrap();
    // What ODM rewrote to UTM is not looked at where the local frame is there.
    survey.write("opensfm/reconstruction.json", b"[]");
    is_exact(&survey);
}

/// Puts the reconstruction into UTM less `offset_m`, as OpenSfM's `export_geocoords` does.
fn write_in_utm(survey: &Survey, offset_m: [f64; 3]) {
    // The reference in EPSG:32633, and how its east axis is turned and scaled there, from PROJ 9.
    let (origin, turn_rad, scale) = ([428_983.25, 5_519_254.303_5], -0.013_166_f64, 0.999_661_9);
    let reference: Value = serde_json::from_slice(&survey.read("reference_lla.json")).unwrap();
    assert!((reference["latitude"].as_f64().unwrap() - 49.8215).abs() < 1e-3);
    survey.edit(|reconstruction| {
        let turn = nalgebra::Rotation3::from_axis_angle(&nalgebra::Vector3::z_axis(), turn_rad);
        let to_utm = |local: nalgebra::Vector3<f64>| {
            let turned = turn * local;
            let utm = nalgebra::Vector3::new(origin[0] + scale * turned.x, origin[1] + scale * turned.y, local.z);
            utm - nalgebra::Vector3::from(offset_m)
        };
        let vector = |value: &Value| nalgebra::Vector3::from_fn(|axis, _| value[axis].as_f64().unwrap());
        for shot in shots(reconstruction) {
            let rotation = nalgebra::Rotation3::new(vector(&shot["rotation"]));
            let center = to_utm(-(rotation.inverse() * vector(&shot["translation"])));
            let turned = rotation * turn.inverse();
            shot["rotation"] = json!(turned.scaled_axis().as_slice());
            shot["translation"] = json!((-(turned * center)).as_slice());
        }
        for point in reconstruction[0]["points"].as_object_mut().unwrap().values_mut() {
            point["coordinates"] = json!(to_utm(vector(&point["coordinates"])).as_slice());
        }
    });
}

#[test]
fn whole_utm_coordinates_are_brought_back_to_the_local_frame() {
    let survey = Survey::new();
    survey.remove(CLOUD);
    write_in_utm(&survey, [0.0; 3]);
    is_exact(&survey);
    survey.edit(|reconstruction| {
        for shot in shots(reconstruction) {
            shot["translation"] = json!([3.0e7, 0.0, 0.0]);
        }
    });
    is_refused(&survey, &["reconstruction.json", "local frame", "topocentric"]);
}

#[test]
fn utm_less_an_offset_that_no_file_states_is_not_mapped_turned() {
    let survey = Survey::new();
    survey.remove(CLOUD);
    let plain = survey.map(true, &[]);
    assert_eq!(plain.code, Some(0), "{}", plain.stderr);
    let expected = module_places(&survey);
    write_in_utm(&survey, [428_983.0, 5_519_254.0, -400.0]);
    is_exact(&survey);
    let found = module_places(&survey);
    assert_eq!(found.len(), expected.len());
    for (label, place) in &expected {
        let metres = [(found[label][0] - place[0]) * 71_800.0, (found[label][1] - place[1]) * 111_200.0];
        assert!(metres[0].hypot(metres[1]) < 0.02, "{label} is off by {metres:?} m");
    }
}

/// Longitude and latitude of the first corner of each mapped module, degrees, by label.
fn module_places(survey: &Survey) -> std::collections::BTreeMap<String, [f64; 2]> {
    let plant: Value = serde_json::from_slice(&std::fs::read(survey.path("../out/plant.geojson")).unwrap()).unwrap();
    let modules = plant["features"].as_array().unwrap().iter().map(|feature| {
        let corner = &feature["geometry"]["coordinates"][0][0];
        let label = feature["properties"]["label"].as_str().unwrap().to_owned();
        (label, [0, 1].map(|axis| corner[axis].as_f64().unwrap()))
    });
    modules.collect()
}

#[test]
fn reconstruction_without_gnss_is_refused() {
    let survey = Survey::new();
    survey.write("reference_lla.json", json!({"latitude": 0.0, "longitude": 0.0, "altitude": 0.0}).to_string());
    survey.edit(|reconstruction| {
        for shot in shots(reconstruction) {
            shot["gps_position"] = json!([0.0, 0.0, 0.0]);
            shot["gps_dop"] = json!(999_999.0);
        }
    });
    is_refused(&survey, &["no photo has a GNSS position", "EXIF"]);
}

#[test]
fn cloud_of_another_frame_is_refused_by_name() {
    let survey = Survey::new();
    let header = "ply\nformat ascii 1.0\nelement vertex 1000\nproperty double x\nproperty double y\nproperty double z\nend_header\n";
    let points = (0..1000).map(|k| format!("{} {} 420\n", 428_900 + k % 100, 5_519_000 + k / 10));
    survey.write(CLOUD, header.to_owned() + &points.collect::<String>());
    is_refused(&survey, &["merged.ply", "lies elsewhere"]);
}

#[test]
fn photo_turned_by_a_viewer_is_refused_by_name() {
    let survey = Survey::new();
    let photo = image::load_from_memory(&survey.read("images/DJI_0002.jpg")).unwrap();
    let mut bytes = std::io::Cursor::new(Vec::new());
    photo.rotate90().write_to(&mut bytes, image::ImageFormat::Jpeg).unwrap();
    survey.write("images/DJI_0002.jpg", bytes.into_inner());
    is_refused(&survey, &["DJI_0002.jpg", "912 x 1368", "turned"]);
}

#[test]
fn panoramas_are_left_out_and_unused_cameras_ignored() {
    let survey = Survey::new();
    survey.edit(|reconstruction| {
        let panorama = json!({"projection_type": "spherical", "width": 8192, "height": 4096});
        reconstruction[0]["cameras"]["panorama"] = panorama;
    });
    is_exact(&survey);
    survey.edit(|reconstruction| {
        let mut shot = shots(reconstruction).next().unwrap().clone();
        shot["camera"] = json!("panorama");
        reconstruction[0]["shots"]["DJI_0099.jpg"] = shot;
    });
    survey.maps_with_warnings(true, &[("shots_left_out", &[])]);
}

#[test]
fn photos_are_found_whatever_their_folder_case_or_unicode_form() {
    let survey = Survey::new();
    std::fs::create_dir_all(survey.path("images/100MEDIA")).unwrap();
    std::fs::rename(survey.path("images/DJI_0001.jpg"), survey.path("images/100MEDIA/DJI_0001.jpg")).unwrap();
    std::fs::rename(survey.path("images/DJI_0002.jpg"), survey.path("images/dji_0002.JPG")).unwrap();
    let (composed, decomposed) = ("S\u{fc}d_0003.jpg", "Su\u{308}d_0003.jpg");
    std::fs::rename(survey.path("images/DJI_0003.jpg"), survey.path("images").join(decomposed)).unwrap();
    survey.edit(|reconstruction| {
        let shots = reconstruction[0]["shots"].as_object_mut().unwrap();
        let shot = shots.remove("DJI_0003.jpg").unwrap();
        shots.insert(composed.to_owned(), shot);
    });
    let mut boxes: Value = serde_json::from_slice(&std::fs::read(survey.boxes()).unwrap()).unwrap();
    for image in boxes["images"].as_array_mut().unwrap() {
        if image["image"] == "DJI_0003.jpg" {
            image["image"] = json!(composed);
        }
    }
    survey.change_boxes(boxes);
    is_exact(&survey);
    // Two photos that differ in case alone decide nothing.
    std::fs::copy(survey.path("images/dji_0002.JPG"), survey.path("images/Dji_0002.jpg")).unwrap();
    is_refused(&survey, &["DJI_0002.jpg", "no image"]);
}

#[test]
fn undistorted_images_take_the_camera_that_opensfm_gave_them() {
    let survey = Survey::new();
    std::fs::create_dir_all(survey.path("undistorted/images")).unwrap();
    let camera = {
        let reconstruction: Value = serde_json::from_slice(&survey.read("reconstruction.json")).unwrap();
        reconstruction[0]["cameras"].as_object().unwrap().values().next().unwrap().clone()
    };
    // The originals are of a lens that no undistorted image has; the boxes are those of the undistorted ones.
    for number in 1..=10 {
        let name = format!("DJI_{number:04}.jpg");
        let link = survey.path("undistorted/images").join(format!("{name}.jpg"));
        std::os::unix::fs::symlink(format!("{EXAMPLE}/images/{name}"), link).unwrap();
    }
    survey.edit(|reconstruction| {
        for entry in reconstruction[0]["cameras"].as_object_mut().unwrap().values_mut() {
            let focal = camera["focal"].clone();
            *entry = json!({"projection_type": "brown", "width": 1368, "height": 912, "focal_x": focal, "focal_y": focal,
                "c_x": 0.02, "c_y": -0.015, "k1": -0.05, "k2": 0.02, "p1": 0.0008, "p2": -0.0006, "k3": -0.003});
        }
    });
    is_exact(&survey);
}
