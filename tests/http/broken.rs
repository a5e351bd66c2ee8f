//! Surveys that are broken, or not as they should be, mapped in earnest.

use crate::app::{App, assert_problem, plant_path};
use crate::boxes::{EXAMPLE, true_boxes};
use heliomap_mapping::detection::{Detection, DetectionError, Detector, Source};
use heliomap_mapping::geometry::Quad;
use image::{Rgb, RgbImage};
use reqwest::StatusCode;
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::io::Cursor;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

const CLOUD: &str = "undistorted/depthmaps/merged.ply";
/// Step in the shade of grey by which a photo is known.
const SHADE: u8 = 20;

/// A photo that shows nothing but its number.
fn photo(number: u8) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    let shade = Rgb([number * SHADE + SHADE / 2; 3]);
    RgbImage::from_pixel(1368, 912, shade).write_to(&mut bytes, image::ImageFormat::Jpeg).unwrap();
    bytes.into_inner()
}

/// Knows photos by their shade, and what is in them.
pub struct Knowing {
    boxes: BTreeMap<u8, Vec<Detection>>,
}

impl Knowing {
    /// The modules of the example plant that `keep` is true for.
    pub fn new(keep: impl Fn(&Value) -> bool) -> Arc<Self> {
        let mut boxes = BTreeMap::new();
        for image in true_boxes(keep)["images"].as_array().unwrap() {
            let number = image["image"].as_str().unwrap()["DJI_".len()..][..4].parse().unwrap();
            let detections = image["boxes"].as_array().unwrap().iter().map(|found| {
                let corners: [[f64; 2]; 4] = serde_json::from_value(found["corners"].clone()).unwrap();
                let quad = Quad::from_unordered(corners.map(Into::into)).unwrap();
                Detection { quad, score: 1.0, source: Source::External }
            });
            boxes.insert(number, detections.collect());
        }
        Arc::new(Self { boxes })
    }
}

impl Detector for Knowing {
    fn detect(&self, image: &RgbImage, _: Option<f64>) -> Result<Vec<Detection>, DetectionError> {
        let number = image.get_pixel(image.width() / 2, image.height() / 2)[0] / SHADE;
        Ok(self.boxes.get(&number).cloned().unwrap_or_default())
    }

    fn describe(&self) -> String {
        "knows the photos".to_owned()
    }
}

/// The files of a survey.
pub struct Files(BTreeMap<String, Vec<u8>>);

impl Files {
    /// Of the example plant, with its sparse points only.
    pub fn new() -> Self {
        let mut files = BTreeMap::new();
        for name in ["reconstruction.json", "reference_lla.json"] {
            files.insert(name.to_owned(), std::fs::read(Path::new(EXAMPLE).join(name)).unwrap());
        }
        for number in 1..=10 {
            files.insert(format!("images/DJI_{number:04}.jpg"), photo(number));
        }
        Self(files)
    }

    fn with(mut self, name: &str, bytes: impl Into<Vec<u8>>) -> Self {
        self.0.insert(name.to_owned(), bytes.into());
        self
    }

    fn without(mut self, name: &str) -> Self {
        self.0.remove(name).unwrap();
        self
    }

    /// With its reconstruction changed.
    fn edited(self, change: impl FnOnce(&mut Value)) -> Self {
        let mut reconstruction = serde_json::from_slice(&self.0["reconstruction.json"]).unwrap();
        change(&mut reconstruction);
        self.with("reconstruction.json", serde_json::to_vec(&reconstruction).unwrap())
    }

    fn archive(&self) -> Vec<u8> {
        let mut archive = tar::Builder::new(Vec::new());
        for (name, bytes) in &self.0 {
            let mut header = tar::Header::new_ustar();
            header.set_size(bytes.len() as u64);
            header.set_mode(0o644);
            archive.append_data(&mut header, name, &bytes[..]).unwrap();
        }
        archive.into_inner().unwrap()
    }

    /// A new survey of a new plant.
    async fn survey(app: &App) -> String {
        static PLANTS: AtomicU32 = AtomicU32::new(0);
        let name = format!("Plant {}", PLANTS.fetch_add(1, Ordering::Relaxed));
        let (_, plant) = app.post("/api/v1/plants", json!({"name": name})).await;
        let surveys = format!("/api/v1/plants/{}/surveys", plant["id"].as_str().unwrap());
        let (_, survey) = app.post(&surveys, json!({"name": "June"})).await;
        format!("{surveys}/{}", survey["id"].as_str().unwrap())
    }

    pub async fn upload(&self, app: &App) -> String {
        let survey = Self::survey(app).await;
        let (status, answer) = app.put(&format!("{survey}/reconstruction"), self.archive()).await;
        assert_eq!(status, StatusCode::OK, "{answer}");
        survey
    }
}

async fn stored(app: &App, survey: &str) -> Value {
    app.get(survey).await.1["files"].clone()
}

/// The upload is refused, or the job fails at once, with this code and a message that holds all of `words`; what was uploaded stays, and no
/// model comes of it.
async fn fails(app: &App, files: &Files, code: &str, words: &[&str]) -> String {
    let survey = Files::survey(app).await;
    let (status, answer) = app.put(&format!("{survey}/reconstruction"), files.archive()).await;
    if status != StatusCode::OK {
        // What is wrong with a single file is said at its upload.
        words.iter().for_each(|word| assert_problem((status, answer.clone()), 422, code, word));
        assert_eq!(stored(app, &survey).await, json!([]));
        return survey;
    }
    let before = stored(app, &survey).await;
    let job = app.map(&survey).await;
    assert_eq!((&job["state"], &job["error"]["code"]), (&json!("failed"), &json!(code)), "{job}");
    assert_eq!((&job["attempt"], &job["model"]), (&json!(1), &json!(null)), "{job}");
    let message = job["error"]["message"].as_str().unwrap();
    for word in words {
        assert!(message.contains(word), "`{word}` is not in `{message}`");
    }
    assert!(!message.contains(std::env::temp_dir().to_str().unwrap()), "{message}");
    assert_eq!(stored(app, &survey).await, before);
    assert_eq!(before.as_array().unwrap().len(), files.0.len());
    assert_problem(app.get(&format!("{}/models/latest", plant_path(&survey))).await, 404, "model_not_found", "");
    assert_eq!(std::fs::read_dir(app.folder.path().join("incoming")).unwrap().count(), 0);
    survey
}

/// The job must succeed with these warnings; the model.
async fn succeeds(app: &App, files: &Files, warnings: &[&str]) -> Value {
    let survey = files.upload(app).await;
    let job = app.map(&survey).await;
    assert_eq!(job["state"], "succeeded", "{job}");
    for code in warnings {
        let found = job["warnings"].as_array().unwrap();
        assert!(found.iter().any(|warning| warning["code"] == *code), "`{code}` is not in {job}");
    }
    app.get(job["model"].as_str().unwrap()).await.1
}

fn shots(reconstruction: &mut Value) -> &mut serde_json::Map<String, Value> {
    reconstruction[0]["shots"].as_object_mut().unwrap()
}

fn features(model: &Value, layer: &str) -> u64 {
    let layers = model["layers"].as_array().unwrap();
    layers.iter().find(|found| found["layer"] == layer).unwrap()["features"].as_u64().unwrap()
}

#[tokio::test]
async fn images_and_reconstruction_that_do_not_belong_together() {
    let app = App::with_detector(Knowing::new(|_| true)).await;
    let others = Files::new().edited(|reconstruction| {
        let shots = shots(reconstruction);
        *shots = std::mem::take(shots).into_iter().map(|(name, shot)| (format!("June_{name}"), shot)).collect();
    });
    // Said before a job is begun.
    let survey = others.upload(&app).await;
    let refused = app.post(&format!("{survey}/jobs"), json!({})).await;
    assert_problem(refused, 409, "survey_incomplete", "June_DJI_0001.jpg");
    let survey = Files::new().without("images/DJI_0003.jpg").upload(&app).await;
    let refused = app.post(&format!("{survey}/jobs"), json!({})).await;
    assert_eq!(refused.1["missing"][0]["code"], "images_not_uploaded");
    assert_problem(refused, 409, "survey_incomplete", "DJI_0003.jpg");
    // Done as told, the same survey maps.
    let (status, _) = app.put(&format!("{survey}/images/DJI_0003.jpg"), photo(3)).await;
    assert_eq!(status, StatusCode::CREATED);
    assert_eq!(app.map(&survey).await["state"], "succeeded");
}

#[tokio::test]
async fn reconstructions_that_cannot_be_used() {
    let app = App::with_detector(Knowing::new(|_| true)).await;
    for text in ["[7]", "[{\"shots\": 7}]", "[{\"cameras\": {}, \"shots\": []}]"] {
        let files = Files::new().with("reconstruction.json", text);
        let words = ["reconstruction.json is not what OpenSfM writes", "export it again"];
        fails(&app, &files, "reconstruction_malformed", &words).await;
    }
    let spherical = Files::new().edited(|reconstruction| {
        for camera in reconstruction[0]["cameras"].as_object_mut().unwrap().values_mut() {
            camera["projection_type"] = json!("spherical");
        }
    });
    let words = ["reconstruction.json", "unknown model `spherical`", "undistort the images"];
    fails(&app, &spherical, "camera_model_unknown", &words).await;
    let one = Files::new().edited(|reconstruction| shots(reconstruction).retain(|name, _| name == "DJI_0001.jpg"));
    fails(&app, &one, "too_few_images", &["reconstruction.json holds 1 shots", "fewer than two images"]).await;
    let nowhere = Files::new().with("reference_lla.json", "{\"latitude\": 149, \"longitude\": 14, \"altitude\": 4}");
    fails(&app, &nowhere, "reconstruction_malformed", &["reference_lla.json", "no place on earth"]).await;
    let pointless = Files::new().edited(|reconstruction| reconstruction[0]["points"] = json!({}));
    fails(&app, &pointless, "points_missing", &["merged.ply", "run the reconstruction again"]).await;
}

#[tokio::test]
async fn a_pose_that_is_no_number_is_refused_and_what_was_there_stays() {
    let app = App::new(&[]).await;
    let files = Files::new();
    let survey = files.upload(&app).await;
    let before = stored(&app, &survey).await;
    let text = String::from_utf8(files.0["reconstruction.json"].clone()).unwrap();
    let at = text.find("\"translation\":[").unwrap() + "\"translation\":[".len();
    let end = at + text[at..].find(',').unwrap();
    let broken = format!("{}NaN{}", &text[..at], &text[end..]);
    let answer = app.put(&format!("{survey}/reconstruction/reconstruction.json"), broken.clone()).await;
    assert_problem(answer, 422, "reconstruction_not_finite", "reconstruction.json holds NaN");
    let archive = files.with("reconstruction.json", broken).with("images/DJI_0011.jpg", photo(11)).archive();
    let answer = app.put(&format!("{survey}/reconstruction"), archive).await;
    assert_problem(answer, 422, "reconstruction_not_finite", "reconstruction.json holds NaN");
    assert_eq!(stored(&app, &survey).await, before);
    assert_eq!(std::fs::read_dir(app.folder.path().join("incoming")).unwrap().count(), 0);
}

#[tokio::test]
async fn point_clouds_that_cannot_be_used() {
    let app = App::with_detector(Knowing::new(|_| true)).await;
    let cloud = |points: usize| {
        let properties = ["x", "y", "z"].map(|name| format!("property float {name}\n")).concat();
        format!("ply\nformat ascii 1.0\nelement vertex {points}\n{properties}end_header\n1.0 2.0 3.0\n4.0 5.0 6.0\n")
    };
    let fails = async |cloud: String, code: &str, words: &[&str]| {
        fails(&app, &Files::new().with(CLOUD, cloud), code, words).await;
    };
    fails(cloud(0), "point_cloud_empty", &["merged.ply holds no points", "densify again"]).await;
    fails(cloud(3), "point_cloud_truncated", &["merged.ply promises 3 points", "copy it again"]).await;
    fails(cloud(99_999_999_999), "point_cloud_too_large", &["merged.ply", "thin it first"]).await;
    fails("ply\nformat".to_owned(), "reconstruction_malformed", &["merged.ply", "header does not end"]).await;
}

#[tokio::test]
async fn no_modules_anywhere() {
    let app = App::with_detector(Knowing::new(|_| false)).await;
    fails(&app, &Files::new(), "no_modules", &["no module was found in any of 8 images"]).await;
}

#[tokio::test]
async fn what_is_unusual_is_mapped_with_a_warning() {
    let app = App::with_detector(Knowing::new(|_| true)).await;
    let model = succeeds(&app, &Files::new(), &["no_dense_cloud", "images_supplementary"]).await;
    assert!(features(&model, "modules") > 400, "{model}");

    let two = Files::new().edited(|reconstruction| {
        let mut second = reconstruction.clone();
        let in_second = |name: &str| ["DJI_0009.jpg", "DJI_0010.jpg"].contains(&name);
        shots(reconstruction).retain(|name, _| !in_second(name));
        shots(&mut second).retain(|name, _| in_second(name));
        reconstruction.as_array_mut().unwrap().push(second[0].take());
    });
    succeeds(&app, &two, &["several_components", "no_dense_cloud", "images_supplementary"]).await;

    // A shade that stands for no photo with modules.
    let bare = Files::new().with("images/DJI_0004.jpg", photo(9));
    succeeds(&app, &bare, &["no_dense_cloud", "images_supplementary", "image_without_modules"]).await;
}

#[tokio::test]
async fn a_plant_without_a_single_gap_is_mapped() {
    let app = App::with_detector(Knowing::new(|module| module["bench"] == 4)).await;
    let model = succeeds(&app, &Files::new(), &[]).await;
    assert_eq!(features(&model, "benches"), 1, "{model}");
}

/// A detector that must not be asked.
struct Refusing;

impl Detector for Refusing {
    fn detect(&self, _: &RgbImage, _: Option<f64>) -> Result<Vec<Detection>, DetectionError> {
        Err(DetectionError::Inference { what: "the detector was asked".to_owned() })
    }

    fn describe(&self) -> String {
        "refuses".to_owned()
    }
}

#[tokio::test]
async fn boxes_that_come_with_a_survey_stand_in_the_place_of_a_detector() {
    let app = App::with_detector(Arc::new(Refusing)).await;
    let boxes = true_boxes(|_| true);
    let files = Files::new().with("boxes.json", boxes.to_string());
    let model = succeeds(&app, &files, &["no_dense_cloud"]).await;
    assert!(features(&model, "modules") > 400, "{model}");

    let mut other_size = boxes.clone();
    other_size["images"][0]["width"] = json!(4000);
    let files = Files::new().with("boxes.json", other_size.to_string());
    fails(&app, &files, "boxes_invalid", &["4000 x 912 pixels", "1368 x 912", "give boxes in pixels of that image"])
        .await;

    let mut flat = boxes.clone();
    flat["images"][1]["boxes"][3]["corners"] = json!([[1, 1], [2, 2], [3, 3], [4, 4]]);
    let files = Files::new().with("boxes.json", flat.to_string());
    succeeds(&app, &files, &["no_dense_cloud", "boxes_unusable"]).await;
    let nothing_else = &mut flat["images"].as_array_mut().unwrap()[1];
    *nothing_else["boxes"].as_array_mut().unwrap() = vec![nothing_else["boxes"][3].clone()];
    let nothing_else = json!({"images": [nothing_else]});
    let files = Files::new().with("boxes.json", nothing_else.to_string());
    fails(&app, &files, "boxes_invalid", &["boxes.json: box 0 of DJI_0002.jpg", "no convex quadrilateral"]).await;

    let files = Files::new().with("boxes.json", "{\"images\": 7}");
    fails(&app, &files, "boxes_invalid", &["boxes.json is not a file of boxes"]).await;
}
