//! Surveys that cannot be mapped: a sentence that names the file and says what to do, and nothing written.

use crate::survey::{CLOUD, Survey};
use serde_json::{Value, json};

/// The cloud with its header changed; as it is behind it.
fn with_header(survey: &Survey, change: impl FnOnce(String) -> String, body: bool) {
    let cloud = survey.read(CLOUD);
    let end = b"end_header\n";
    let at = cloud.windows(end.len()).position(|window| window == end).unwrap() + end.len();
    let mut changed = change(String::from_utf8(cloud[..at].to_vec()).unwrap()).into_bytes();
    if body {
        changed.extend_from_slice(&cloud[at..]);
    }
    survey.write(CLOUD, changed);
}

fn small_png() -> Vec<u8> {
    let mut bytes = std::io::Cursor::new(Vec::new());
    image::RgbImage::new(16, 12).write_to(&mut bytes, image::ImageFormat::Png).unwrap();
    bytes.into_inner()
}

#[test]
fn no_reconstruction() {
    let survey = Survey::new();
    survey.remove("reconstruction.json");
    survey.is_refused(&[], &["plant/reconstruction.json is missing", "reconstruct the images first"]);
}

#[test]
fn no_reference() {
    let survey = Survey::new();
    survey.remove("reference_lla.json");
    survey.edit(|reconstruction| {
        reconstruction[0].as_object_mut().unwrap().remove("reference_lla");
    });
    survey.is_refused(&[], &["plant/reference_lla.json is missing", "give that folder"]);
}

#[test]
fn a_reconstruction_of_other_images() {
    let survey = Survey::new();
    survey.edit(|reconstruction| {
        let shots = reconstruction[0]["shots"].as_object_mut().unwrap();
        *shots = std::mem::take(shots).into_iter().map(|(name, shot)| (format!("June_{name}"), shot)).collect();
    });
    survey.is_refused(
        &[],
        &["reconstruction.json is of other images", "June_DJI_0001.jpg", "there: DJI_0001.jpg", "add the images"],
    );
}

#[test]
fn a_shot_without_its_image() {
    let survey = Survey::new();
    survey.remove("images/DJI_0003.jpg");
    survey.is_refused(&[], &["1 shots of reconstruction.json have no image", "DJI_0003.jpg", "add them"]);
}

#[test]
fn an_image_cut_short() {
    let survey = Survey::new();
    let photo = survey.read("images/DJI_0004.jpg");
    survey.write("images/DJI_0004.jpg", &photo[..photo.len() / 2]);
    survey.is_refused(&[], &["DJI_0004.jpg is cut short", "copy it"]);
}

#[test]
fn a_png_named_as_a_jpeg() {
    let survey = Survey::new();
    survey.write("images/DJI_0005.jpg", small_png());
    survey.is_refused(&[], &["DJI_0005.jpg", "PNG", "JPEG", "convert it"]);
}

#[test]
fn a_file_that_is_no_image() {
    let survey = Survey::new();
    survey.write("images/DJI_0006.jpg", "<html>sign in first</html>");
    survey.is_refused(&[], &["DJI_0006.jpg is no image", "copy it"]);
}

#[test]
fn an_image_larger_than_the_limit() {
    let survey = Survey::new();
    survey.is_refused(&["--max-megapixels", "1"], &["DJI_0001.jpg is 1368 x 912 pixels", "1000000", "raise the limit"]);
}

#[test]
fn an_empty_point_cloud() {
    let survey = Survey::new();
    with_header(&survey, |header| header.replace("vertex 323052", "vertex 0"), false);
    survey.is_refused(&[], &["merged.ply holds no points", "densify again"]);
}

#[test]
fn a_point_cloud_that_promises_more_than_it_holds() {
    let survey = Survey::new();
    with_header(&survey, |header| header.replace("vertex 323052", "vertex 423052"), true);
    survey.is_refused(&[], &["merged.ply promises 423052 points but ends after 323052", "copy it again"]);
    with_header(&survey, |header| header.replace("vertex 423052", "vertex 99999999999"), true);
    survey.is_refused(&[], &["merged.ply holds a cloud of 99999999999 points", "thin it first"]);
}

#[test]
fn a_pose_that_is_no_number() {
    let survey = Survey::new();
    let text = String::from_utf8(survey.read("reconstruction.json")).unwrap();
    let at = text.find("\"translation\":[").unwrap() + "\"translation\":[".len();
    let end = at + text[at..].find(',').unwrap();
    for word in ["NaN", "-Infinity"] {
        survey.write("reconstruction.json", format!("{}{word}{}", &text[..at], &text[end..]));
        survey.is_refused(&[], &["reconstruction.json holds", word.trim_start_matches('-'), "reconstruct again"]);
    }
}

#[test]
fn json_of_the_wrong_shape() {
    let survey = Survey::new();
    for text in ["{}", "[7]", "[{\"shots\": 7}]", "[{\"cameras\": {}, \"shots\"", "", "\u{0}"] {
        survey.write("reconstruction.json", text);
        survey.is_refused(&[], &["reconstruction.json is not what OpenSfM writes", "export it again"]);
    }
}

#[test]
fn a_reference_that_is_no_place_on_earth() {
    let survey = Survey::new();
    survey.write("reference_lla.json", "{\"latitude\": 149.8, \"longitude\": 14.0, \"altitude\": 412.0}");
    survey.is_refused(&[], &["reference_lla.json", "no place on earth", "export it again"]);
}

#[test]
fn an_unknown_camera_model() {
    let survey = Survey::new();
    survey.edit(|reconstruction| {
        for camera in reconstruction[0]["cameras"].as_object_mut().unwrap().values_mut() {
            camera["projection_type"] = json!("spherical");
        }
    });
    survey.is_refused(&[], &["reconstruction.json", "unknown model `spherical`", "undistort the images"]);
}

#[test]
fn a_shot_of_a_camera_that_is_not_there() {
    let survey = Survey::new();
    survey.edit(|reconstruction| reconstruction[0]["shots"]["DJI_0002.jpg"]["camera"] = json!("v2 lost"));
    survey.is_refused(&[], &["reconstruction.json", "DJI_0002.jpg", "v2 lost", "export it again"]);
}

#[test]
fn fewer_than_two_images() {
    let survey = Survey::new();
    survey.edit(|reconstruction| {
        reconstruction[0]["shots"].as_object_mut().unwrap().retain(|name, _| name == "DJI_0001.jpg");
    });
    survey.is_refused(&[], &["reconstruction.json holds 1 shots", "fewer than two images"]);
    survey.write("reconstruction.json", "[]");
    survey.is_refused(&[], &["reconstruction.json holds 0 shots", "fewer than two images"]);
}

#[test]
fn no_points_at_all() {
    let survey = Survey::new();
    survey.remove(CLOUD);
    survey.edit(|reconstruction| reconstruction[0]["points"] = json!({}));
    survey.is_refused(&[], &["merged.ply", "reconstruction.json", "run the reconstruction again"]);
}

#[test]
fn no_modules_anywhere() {
    let survey = Survey::new();
    survey.write_boxes(|_| false);
    survey.is_refused(&[], &["no module was found in any of 8 images"]);
}

#[test]
fn broken_boxes() {
    let survey = Survey::new();
    let image =
        |boxes: Value| json!({"images": [{"image": "DJI_0001.jpg", "width": 1368, "height": 912, "boxes": boxes}]});
    survey.change_boxes(json!([]));
    survey.is_refused(&[], &["boxes.json is not a file of boxes"]);
    survey.change_boxes(image(json!([{"corners": [[1, 1], [1, 1], [1, 1], [1, 1]]}])));
    survey.is_refused(&[], &["boxes.json: box 0 of DJI_0001.jpg"]);
    survey.change_boxes(json!({"images": [{"image": "photos/DJI_0001", "width": 1368, "height": 912, "boxes": []}]}));
    survey.is_refused(&[], &["none of its 1 images", "`photos/DJI_0001`", "such as `DJI_0001.jpg`"]);
    survey.change_boxes(json!({"images": [{"image": "DJI_0001.jpg", "width": 2736, "height": 1824, "boxes": []}]}));
    survey.is_refused(&[], &["DJI_0001.jpg", "2736 x 1824", "1368 x 912"]);
}

#[test]
fn options_out_of_range() {
    let survey = Survey::new();
    survey.is_refused(&["--rows-per-bench", "0"], &["rows_per_bench must be 1 to 64", "leave it out"]);
    survey.is_refused(&["--max-gsd", "5"], &["max_gsd_m_per_px must be 0.001 to 1", "correct it"]);
    survey.is_refused(&["--max-gsd", "NaN"], &["max_gsd_m_per_px", "leave it out"]);
    survey.is_refused(&["--spacing", "1.0,50"], &["spacing_m", "0.1 to 10 metres"]);
    survey.is_refused(&["--spacing", "1.0"], &["--spacing", "two lengths in metres"]);
    survey.is_refused(&["--refinement", "best"], &["--refinement", "lattice"]);
    survey.is_refused(&["--detector"], &["--detector"]);
}
