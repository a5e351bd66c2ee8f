//! The example plant and where its modules are in its photos.

use heliomap_mapping::geometry::{Camera, camera::Lens};
use nalgebra::{Matrix3, Vector2, Vector3};
use serde_json::{Value, json};
use std::path::Path;

pub const EXAMPLE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/examples/plant");
/// A module this close to the edge of an image counts as cut, pixels.
const EDGE_PX: f64 = 3.0;

/// The boxes of modules in the undistorted images that resolve them, from the true cameras.
pub fn true_boxes(keep: impl Fn(&Value) -> bool) -> Value {
    let read = |name: &str| -> Value {
        serde_json::from_slice(&std::fs::read(Path::new(EXAMPLE).join(name)).unwrap()).unwrap()
    };
    let (truth, reconstruction) = (read("truth.json"), read("reconstruction.json"));
    let number = |value: &Value| value.as_f64().unwrap();
    let camera = |focal: &Value, k1: &Value, k2: &Value| {
        let mut camera = Camera::pinhole(1368, 912, number(focal));
        camera.lens = Lens::Radial { k1: number(k1), k2: number(k2), k3: 0.0, p1: 0.0, p2: 0.0 };
        camera
    };
    let rendered = &truth["camera"];
    let rendered = camera(&rendered["focal_norm"], &rendered["k1"], &rendered["k2"]);
    let estimated = reconstruction[0]["cameras"].as_object().unwrap().values().next().unwrap();
    let estimated = camera(&estimated["focal"], &estimated["k1"], &estimated["k2"]);
    let images = truth["shots"].as_array().unwrap().iter().filter(|shot| shot["role"] == "detection").map(|shot| {
        let rotation = Matrix3::from_fn(|row, column| number(&shot["R"][row][column]));
        let center = vector(&shot["center"]);
        let pixel = |corner: &Value| -> Option<Vector2<f64>> {
            let seen = rendered.project(&(rotation * (vector(corner) - center)))?;
            let straight = estimated.normalised_from_pixel(seen);
            let pixel = estimated.undistorted().pixel_from_normalised(straight.x, straight.y);
            let inside = |value: f64, size: f64| value > EDGE_PX && value < size - 1.0 - EDGE_PX;
            (inside(pixel.x, 1368.0) && inside(pixel.y, 912.0)).then_some(pixel)
        };
        let boxes = truth["modules"].as_array().unwrap().iter().filter(|module| keep(module)).filter_map(|module| {
            let corners: Option<Vec<_>> = module["corners"].as_array().unwrap().iter().map(pixel).collect();
            Some(json!({"corners": corners?}))
        });
        json!({"image": shot["name"], "width": 1368, "height": 912, "boxes": boxes.collect::<Vec<_>>()})
    });
    json!({"images": images.collect::<Vec<_>>()})
}

fn vector(value: &Value) -> Vector3<f64> {
    Vector3::from_fn(|axis, _| value[axis].as_f64().unwrap())
}
