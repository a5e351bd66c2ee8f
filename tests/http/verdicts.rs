//! What the pilot hears of the photos before leaving the field.

use crate::app::{App, assert_problem, json_of};
use crate::stub;
use exif::experimental::Writer;
use exif::{Field, In, Rational, Tag, Value as Exif};
use image::{GrayImage, Luma};
use reqwest::{Method, StatusCode};
use serde_json::{Value, json};
use std::io::Cursor;

/// Benches in a field, sharp.
fn picture() -> GrayImage {
    GrayImage::from_fn(256, 192, |x, y| {
        let bench = (y / 30) % 2 == 0 && x % 13 > 1 && y % 15 > 1;
        let weed = (x.wrapping_mul(2_654_435_761) ^ y.wrapping_mul(40_503)).wrapping_mul(2_246_822_519) >> 24;
        Luma([if bench { 40 } else { 120 + (weed / 4) as u8 }])
    })
}

/// A JPEG as a drone writes it: taken at noon at a longitude of `minutes` past 8 degrees.
fn photo(picture: &GrayImage, minutes: u32) -> Vec<u8> {
    let rationals = |parts: &[u32]| Exif::Rational(parts.iter().map(|num| Rational { num: *num, denom: 1 }).collect());
    let ascii = |text: &str| Exif::Ascii(vec![text.as_bytes().to_vec()]);
    let fields = [
        (Tag::Make, ascii("DJI")),
        (Tag::Model, ascii("FC6310")),
        (Tag::DateTimeOriginal, ascii("2026:06:21 12:00:00")),
        (Tag::GPSLatitudeRef, ascii("N")),
        (Tag::GPSLatitude, rationals(&[50, 30, 0])),
        (Tag::GPSLongitudeRef, ascii("E")),
        (Tag::GPSLongitude, rationals(&[8, minutes, 0])),
        (Tag::GPSAltitude, rationals(&[150])),
    ]
    .map(|(tag, value)| Field { tag, ifd_num: In::PRIMARY, value });
    let mut writer = Writer::new();
    fields.iter().for_each(|field| writer.push_field(field));
    let mut tiff = Cursor::new(Vec::new());
    writer.write(&mut tiff, false).unwrap();
    let mut plain = Cursor::new(Vec::new());
    picture.write_to(&mut plain, image::ImageFormat::Jpeg).unwrap();
    let segment = [b"Exif\0\0".as_slice(), tiff.get_ref()].concat();
    let length = u16::try_from(segment.len() + 2).unwrap().to_be_bytes();
    [&plain.get_ref()[..2], &[0xff, 0xe1], &length, &segment, &plain.get_ref()[2..]].concat()
}

fn codes(file: &Value) -> Vec<&str> {
    let warnings = file["warnings"].as_array();
    warnings.into_iter().flatten().map(|warning| warning["code"].as_str().unwrap()).collect()
}

async fn put(app: &App, survey: &str, name: &str, bytes: Vec<u8>) -> Value {
    let (status, file) = app.put(&format!("{survey}/images/{name}"), bytes).await;
    assert_eq!(status, StatusCode::CREATED, "{file}");
    file
}

async fn names(app: &App, path: &str) -> Vec<String> {
    let (status, list) = app.get(path).await;
    assert_eq!(status, StatusCode::OK, "{list}");
    list["items"].as_array().unwrap().iter().map(|image| image["name"].as_str().unwrap().to_owned()).collect()
}

/// A survey with a good photo, a blurred one, a dark one without EXIF, and the good one again.
async fn flown(app: &App) -> String {
    let survey = app.survey().await;
    let good = put(app, &survey, "good.jpg", photo(&picture(), 15)).await;
    assert_eq!(codes(&good), [""; 0], "{good}");
    assert_eq!(good["photo"]["camera"], "DJI FC6310");
    assert_eq!(good["photo"]["taken"], "2026-06-21T12:00:00");
    assert_eq!(good["photo"]["position"], json!([8.25, 50.5, 150.0]));
    assert!(good["photo"]["sharpness"].as_f64().unwrap() > 0.3, "{good}");
    let blurred = image::imageops::blur(&picture(), 3.0);
    let blurred = put(app, &survey, "blurred.jpg", photo(&blurred, 30)).await;
    assert_eq!(codes(&blurred), ["blurred"], "{blurred}");
    let mut dark = Cursor::new(Vec::new());
    GrayImage::new(200, 200).write_to(&mut dark, image::ImageFormat::Png).unwrap();
    let dark = put(app, &survey, "dark.png", dark.into_inner()).await;
    assert_eq!(codes(&dark), ["underexposed", "no_position", "no_time"], "{dark}");
    let again = put(app, &survey, "good again.jpg", photo(&picture(), 15)).await;
    assert_eq!(codes(&again), ["duplicate"]);
    assert!(again["warnings"][0]["message"].as_str().unwrap().contains("good.jpg"), "{again}");
    survey
}

#[tokio::test]
async fn every_photo_has_its_verdict_at_once_and_in_the_list() {
    let app = App::new(&[]).await;
    let survey = flown(&app).await;
    let images = format!("{survey}/images");
    assert_eq!(names(&app, &images).await, ["blurred.jpg", "dark.png", "good again.jpg", "good.jpg"]);
    assert_eq!(names(&app, &format!("{images}?warning=duplicate")).await, ["good again.jpg", "good.jpg"]);
    assert_eq!(names(&app, &format!("{images}?warning=blurred")).await, ["blurred.jpg"]);
    assert_eq!(names(&app, &format!("{images}?reconstructed=false")).await, [""; 0]);

    assert_eq!(names(&app, &format!("{images}?name=good")).await, ["good again.jpg", "good.jpg"]);
    assert_eq!(names(&app, &format!("{images}?name=good%20&warning=duplicate")).await, ["good again.jpg"]);
    assert_eq!(names(&app, &format!("{images}?name=Good")).await, [""; 0]);
    assert_eq!(names(&app, &format!("{images}?name=images/")).await, [""; 0]);
    assert_eq!(names(&app, &format!("{images}?warning=none")).await, [""; 0]);

    // Part by part, the filter kept.
    let seen = walked(&app, &format!("{images}?warning=any&limit=1"), "items", "name").await;
    assert_eq!(seen, ["blurred.jpg", "dark.png", "good again.jpg", "good.jpg"]);
    let seen = walked(&app, &format!("{images}?name=good&limit=1"), "items", "name").await;
    assert_eq!(seen, ["good again.jpg", "good.jpg"]);
    for query in ["warning=ugly", "cursor=x", "limit=0", "limit=1001", "reconstructed=maybe", "unknown=1"] {
        assert_problem(app.get(&format!("{images}?{query}")).await, 400, "invalid_query", "");
    }
}

/// What all parts of a list tell, one after the other; `limit` is 1.
async fn walked(app: &App, first: &str, list: &str, member: &str) -> Vec<String> {
    let (mut next, mut seen) = (first.to_owned(), Vec::new());
    loop {
        let answer = app.request(Method::GET, &next).send().await.unwrap();
        let link = answer.headers().get("link").map(|link| link.to_str().unwrap().to_owned());
        let (_, part) = json_of(answer).await;
        let items = part[list].as_array().unwrap();
        assert!(items.len() <= 1, "{part}");
        seen.extend(items.iter().map(|item| item[member].as_str().unwrap().to_owned()));
        match part["next"].as_str() {
            Some(told) => next = told.to_owned(),
            None => return seen,
        }
        assert_eq!(link, Some(format!("<{next}>; rel=\"next\"")));
    }
}

#[tokio::test]
async fn the_files_of_a_survey_are_told_in_part() {
    let app = App::new(&[]).await;
    let survey = flown(&app).await;
    app.put(&format!("{survey}/reconstruction/reconstruction.json"), stub::RECONSTRUCTION).await;
    let undistorted = format!("{survey}/reconstruction/undistorted/images/good.jpg");
    assert_eq!(app.put(&undistorted, photo(&picture(), 45)).await.0, StatusCode::CREATED);
    let paths = async |query: &str| walked(&app, &format!("{survey}?limit=1&{query}"), "files", "path").await;
    let photos = ["images/blurred.jpg", "images/dark.png", "images/good again.jpg", "images/good.jpg"];
    let others = ["reconstruction.json", "undistorted/images/good.jpg"];
    assert_eq!(paths("").await, [&photos[..], &others[..]].concat());
    assert_eq!(paths("kind=image&path=images/good").await, photos[2..]);
    assert_eq!(paths("path=undistorted/").await, others[1..]);
    assert_eq!(paths("warning=any").await, photos);
    assert_eq!(paths("warning=none").await, others);
    assert_eq!(paths("warning=duplicate&path=images/good.").await, photos[3..]);
    assert!(paths("path=elsewhere/").await.is_empty());
    // Whatever is told of all files does not depend on which are listed.
    let (_, whole) = app.get(&survey).await;
    let (_, part) = app.get(&format!("{survey}?limit=1&path=undistorted/")).await;
    for member in ["complete", "missing", "images"] {
        assert_eq!(part[member], whole[member]);
    }
    assert_eq!((whole["files"].as_array().unwrap().len(), whole.get("next")), (6, None));

    // What comes or changes between two parts moves nothing: what was there is told once.
    let (_, first) = app.get(&format!("{survey}?warning=any&limit=2")).await;
    put(&app, &survey, "a first one.jpg", photo(&picture(), 50)).await;
    put(&app, &survey, "early.jpg", photo(&picture(), 15)).await;
    let (status, answer) = app.put(&format!("{survey}/images/dark.png"), sharp_png()).await;
    assert_eq!((status, &answer["result"]), (StatusCode::OK, &json!("replaced")), "{answer}");
    let rest = walked(&app, &first["next"].as_str().unwrap().replace("limit=2", "limit=1"), "files", "path").await;
    assert_eq!(rest, ["images/early.jpg", "images/good again.jpg", "images/good.jpg"]);
    for query in ["warning=ugly", "cursor=x", "limit=0", "limit=1001", "kind=photo", "unknown=1"] {
        assert_problem(app.get(&format!("{survey}?{query}")).await, 400, "invalid_query", "");
    }
}

/// Without EXIF.
fn sharp_png() -> Vec<u8> {
    let mut png = Cursor::new(Vec::new());
    picture().write_to(&mut png, image::ImageFormat::Png).unwrap();
    png.into_inner()
}

#[tokio::test]
async fn photos_are_on_the_map() {
    let app = App::new(&[]).await;
    let survey = flown(&app).await;
    let (status, map) = app.get(&format!("{survey}/images.geojson")).await;
    assert_eq!((status, &map["type"]), (StatusCode::OK, &json!("FeatureCollection")), "{map}");
    let features = map["features"].as_array().unwrap();
    assert_eq!(features.len(), 3, "the dark one tells no position");
    assert_eq!(features[0]["id"], "blurred.jpg");
    assert_eq!(features[0]["geometry"], json!({"type": "Point", "coordinates": [8.5, 50.5, 150.0]}));
    assert_eq!(features[0]["properties"]["warnings"], json!(["blurred"]));
    assert_eq!(features[0]["properties"]["reconstructed"], Value::Null);
}

#[tokio::test]
async fn a_survey_says_what_is_complete_and_what_is_missing() {
    let app = App::new(&[]).await;
    let survey = flown(&app).await;
    let (_, told) = app.get(&survey).await;
    let expected = json!({
        "uploaded": 4, "with_position": 3, "with_warning": 4, "not_reconstructed": [], "not_reconstructed_count": 0, "not_uploaded": [], "not_uploaded_count": 0,
    });
    assert_eq!(told["images"], expected);
    let codes = |told: &Value| {
        let missing = told["missing"].as_array().unwrap();
        missing.iter().map(|missing| missing["code"].as_str().unwrap().to_owned()).collect::<Vec<_>>()
    };
    assert_eq!(codes(&told), ["no_reconstruction", "no_reference"]);

    let reconstruction = stub::reconstruction_of(&[&["good.jpg", "lost.jpg"], &["blurred.jpg"]]);
    for (path, body) in [("reconstruction.json", reconstruction), ("reference_lla.json", stub::REFERENCE.to_owned())] {
        let (status, answer) = app.put(&format!("{survey}/reconstruction/{path}"), body).await;
        assert_eq!(status, StatusCode::CREATED, "{answer}");
    }
    let (_, told) = app.get(&survey).await;
    assert_eq!((&told["complete"], &codes(&told)[..]), (&json!(false), &["images_not_uploaded".to_owned()][..]));
    assert_eq!(told["images"]["reconstructed"], 3);
    assert_eq!(told["images"]["not_uploaded"], json!(["lost.jpg"]));
    assert_eq!(
        (&told["images"]["not_uploaded_count"], &told["images"]["not_reconstructed_count"]),
        (&json!(1), &json!(2))
    );
    assert_eq!(told["images"]["not_reconstructed"], json!(["dark.png", "good again.jpg"]));
    assert_problem(app.post(&format!("{survey}/jobs"), json!({})).await, 409, "survey_incomplete", "lost.jpg");
    let used = format!("{survey}/images?reconstructed=true");
    assert_eq!(names(&app, &used).await, ["blurred.jpg", "good.jpg"]);
    // The undistorted image does as well as the photo.
    let path = format!("{survey}/reconstruction/undistorted/images/lost.jpg");
    assert_eq!(app.put(&path, photo(&picture(), 45)).await.0, StatusCode::CREATED);
    assert_eq!(app.get(&survey).await.1["complete"], json!(true));
}

#[tokio::test]
async fn a_photo_that_does_not_decode_is_refused() {
    let app = App::new(&[]).await;
    let survey = app.survey().await;
    let mut broken = sharp_png();
    // The chunks are whole, what is in them is not.
    let middle = broken.len() / 2;
    broken[middle..middle + 64].fill(0xaa);
    assert_problem(app.put(&format!("{survey}/images/a.png"), broken).await, 422, "image_unreadable", "images/a.png");
}

#[tokio::test]
async fn a_damaged_photo_has_its_verdict() {
    let app = App::new(&[]).await;
    let survey = app.survey().await;
    let whole = photo(&picture(), 15);
    let zeroed = |from: usize| [&whole[..from], &[0; 1000], &whole[from + 1000..]].concat();
    for (name, bytes, damaged) in [
        ("whole.jpg", whole.clone(), false),
        ("middle.jpg", zeroed(whole.len() / 2), true),
        ("half.jpg", [&whole[..whole.len() / 2], &[0xff, 0xd9]].concat(), true),
    ] {
        let file = put(&app, &survey, name, bytes).await;
        assert_eq!(codes(&file).contains(&"damaged"), damaged, "{file}");
    }
    assert_eq!(names(&app, &format!("{survey}/images?warning=damaged")).await, ["half.jpg", "middle.jpg"]);
}
