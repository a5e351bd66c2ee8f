//! Reads what is compared: the modules of a plant as GeoJSON, or the `truth.json` of a rendered plant.

use super::EvaluateError;
use super::model::{Builder, Place, ReferenceModel};
use heliomap_model::{GeodeticReference, Lla};
use nalgebra::Vector3;
use serde::Deserialize;
use std::collections::BTreeMap;
use std::io::Read;
use std::path::Path;

/// Two million modules as GeoJSON, and some.
const MAX_BYTES: u64 = 3 << 30;
const MAX_TEXT: usize = 200;
/// Rows and numbers beyond this are no counting.
const MAX_COUNT: i64 = 1_000_000_000;
/// No plant is larger, metres from its origin.
const MAX_REACH_M: f64 = 200_000.0;

/// Reads a model. GeoJSON positions become metres about `frame`, or about an origin of the file's own without it.
///
/// # Errors
/// Where the file cannot be read, is too large, or is not of the shape that is expected: each names the file, the
/// feature or module, and what to do.
pub fn read_model(path: &Path, frame: Option<GeodeticReference>) -> Result<ReferenceModel, EvaluateError> {
    let read_error = |error: std::io::Error| EvaluateError::Read { path: path.to_owned(), reason: error.to_string() };
    let file = std::fs::File::open(path).map_err(read_error)?;
    let mut bytes = Vec::new();
    file.take(MAX_BYTES + 1).read_to_end(&mut bytes).map_err(read_error)?;
    if bytes.len() as u64 > MAX_BYTES {
        return Err(EvaluateError::TooLarge { path: path.to_owned(), limit_bytes: MAX_BYTES });
    }
    let model = parse_model(&bytes, path)?;
    Ok(match frame {
        Some(frame) => model.in_frame_of(frame),
        None => model,
    })
}

/// Either form, told apart by its members.
#[derive(Deserialize)]
struct Document {
    r#type: Option<String>,
    layer: Option<String>,
    name: Option<String>,
    features: Option<Vec<Feature>>,
    reference_frame: Option<ReferenceFrame>,
    reference: Option<TruthReference>,
    benches: Option<serde_json::Value>,
    modules: Option<Vec<TruthModule>>,
}

#[derive(Deserialize)]
struct ReferenceFrame {
    origin: Option<[f64; 3]>,
}

#[derive(Deserialize)]
struct Feature {
    id: Option<Name>,
    geometry: Option<Geometry>,
    properties: Option<Properties>,
}

#[derive(Deserialize)]
struct Geometry {
    r#type: String,
    coordinates: serde_json::Value,
}

#[derive(Deserialize)]
struct Properties {
    id: Option<Name>,
    label: Option<String>,
    line: Option<Name>,
    bench: Option<Name>,
    row: Option<i64>,
    number: Option<i64>,
    center: Option<Vec<f64>>,
    sigma_m: Option<Vec<f64>>,
}

/// A name that may have been written as a number.
#[derive(Deserialize)]
#[serde(untagged)]
enum Name {
    Text(String),
    Number(i64),
}

impl Name {
    fn into_text(self) -> String {
        match self {
            Self::Text(text) => text,
            Self::Number(number) => number.to_string(),
        }
    }
}

#[derive(Deserialize)]
struct TruthReference {
    lat: f64,
    lon: f64,
    alt: f64,
}

#[derive(Deserialize)]
struct TruthBench {
    bench: i64,
    index: i64,
    rows: i64,
    cols: i64,
}

#[derive(Deserialize)]
struct TruthModule {
    id: Option<Name>,
    line: i64,
    bench: i64,
    row: i64,
    col: i64,
    corners: [[f64; 3]; 4],
    center: [f64; 3],
}

const GEOJSON_REMEDY: &str = "give the modules layer of a plant as heliomap writes it: one polygon of four corners with height per \
     module and the properties line, bench, row and number";
const TRUTH_REMEDY: &str = "give a truth.json with reference, benches and modules in metres east, north and up";

pub(super) fn parse_model(bytes: &[u8], path: &Path) -> Result<ReferenceModel, EvaluateError> {
    let document: Document = serde_json::from_slice(bytes).map_err(|error| EvaluateError::NotJson {
        path: path.to_owned(),
        line: error.line(),
        column: error.column(),
        reason: clean(&error.to_string()),
    })?;
    let name = path.file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned());
    let shape = |remedy| move |what: String| EvaluateError::WrongShape { path: path.to_owned(), what, remedy };
    let Document { r#type, layer, name: own_name, features, reference_frame, reference, benches, modules } = document;
    if r#type.as_deref() == Some("FeatureCollection") {
        if let Some(layer) = layer.filter(|layer| layer != "modules") {
            return Err(shape(GEOJSON_REMEDY)(format!("these are the {}, not the modules", clean(&layer))));
        }
        let features = features.ok_or_else(|| shape(GEOJSON_REMEDY)("the collection has no `features`".to_owned()))?;
        let origin = reference_frame.and_then(|frame| frame.origin);
        let name = own_name.map_or(name, |own| clean(&own));
        return from_features(name, features, origin).map_err(shape(GEOJSON_REMEDY));
    }
    match (reference, modules) {
        (Some(reference), Some(modules)) => from_truth(name, &reference, benches, modules).map_err(shape(TRUTH_REMEDY)),
        (None, Some(_)) => Err(shape(TRUTH_REMEDY)("`reference` (lat, lon, alt) is not there".to_owned())),
        _ => Err(shape(GEOJSON_REMEDY)(
            "neither a GeoJSON feature collection nor a truth with `reference` and `modules`".to_owned(),
        )),
    }
}

fn from_features(name: String, features: Vec<Feature>, origin: Option<[f64; 3]>) -> Result<ReferenceModel, String> {
    if features.is_empty() {
        return Err("it holds no modules".to_owned());
    }
    let mut reference = origin.map(|origin| lla(&origin)).transpose()?.map(GeodeticReference::new);
    let mut builder = Builder::default();
    for (k, feature) in features.into_iter().enumerate() {
        let told = |what: String| format!("feature {k}: {what}");
        let properties = feature.properties.ok_or_else(|| told("it has no properties".to_owned()))?;
        let lacks = |what: &str| told(format!("the property `{what}` is not there"));
        let place = Place {
            line: text(properties.line.ok_or_else(|| lacks("line"))?.into_text()).map_err(told)?,
            bench: text(properties.bench.ok_or_else(|| lacks("bench"))?.into_text()).map_err(told)?,
            row: count("row", properties.row.ok_or_else(|| lacks("row"))?).map_err(told)?,
            number: count("number", properties.number.ok_or_else(|| lacks("number"))?).map_err(told)?,
        };
        let label = match properties.label {
            Some(label) => text(label).map_err(told)?,
            None => format!("{}/{}/{}/{}", place.line, place.bench, place.row, place.number),
        };
        let id = match feature.id.or(properties.id) {
            Some(id) => text(id.into_text()).map_err(told)?,
            None => label.clone(),
        };
        let geometry = feature.geometry.ok_or_else(|| told("it has no geometry".to_owned()))?;
        let ring = ring(&geometry).map_err(told)?;
        let frame = *reference.get_or_insert(GeodeticReference::new(ring[0]));
        let corners = ring.map(|corner| frame.enu_from_lla(corner));
        let center = match properties.center {
            Some(center) => frame.enu_from_lla(lla(&center).map_err(told)?),
            None => corners.iter().sum::<Vector3<f64>>() / 4.0,
        };
        check(&corners, center).map_err(told)?;
        let sigma = match properties.sigma_m.as_deref() {
            None => None,
            Some(&[x, y, z]) if [x, y, z].iter().all(|s| (0.0..1e6).contains(s)) => Some(Vector3::new(x, y, z)),
            Some(_) => return Err(told("`sigma_m` is not three numbers in metres, none negative".to_owned())),
        };
        builder.push(id, label, place, corners, center, sigma);
    }
    reference.map(|reference| builder.finish(name, reference)).ok_or_else(|| "it holds no modules".to_owned())
}

fn from_truth(
    name: String,
    reference: &TruthReference,
    benches: Option<serde_json::Value>,
    modules: Vec<TruthModule>,
) -> Result<ReferenceModel, String> {
    if modules.is_empty() {
        return Err("it holds no modules".to_owned());
    }
    let reference = GeodeticReference::new(lla(&[reference.lon, reference.lat, reference.alt])?);
    let benches: Vec<TruthBench> = match benches {
        Some(benches) => serde_json::from_value(benches).map_err(|error| format!("`benches`: {error}"))?,
        None => Vec::new(),
    };
    let benches: BTreeMap<i64, TruthBench> = benches.into_iter().map(|bench| (bench.bench, bench)).collect();
    let mut builder = Builder::default();
    for (k, module) in modules.into_iter().enumerate() {
        let told = |what: String| format!("module {k}: {what}");
        let row = count("row", module.row).map_err(told)?;
        let number = count("col", module.col).map_err(told)?;
        let line = count("line", module.line).map_err(told)?;
        let id = text(module.id.map_or_else(|| k.to_string(), Name::into_text)).map_err(told)?;
        let label = format!("line {line} bench {} row {row} col {number}", module.bench);
        let corners = module.corners.map(Vector3::from);
        let center = Vector3::from(module.center);
        check(&corners, center).map_err(told)?;
        let place = Place { line: line.to_string(), bench: module.bench.to_string(), row, number };
        builder.push(id, label, place, corners, center, None);
        let (index, rows, columns) = match benches.get(&module.bench) {
            Some(bench) => (bench.index, bench.rows, bench.cols),
            None => (module.bench, row + 1, number + 1),
        };
        let (rows, columns) = (count("rows", rows).map_err(told)?, count("cols", columns).map_err(told)?);
        builder.number_last(
            (line.to_string(), line),
            (module.bench.to_string(), count("index", index).map_err(told)?),
            [0, rows - 1],
            [0, columns - 1],
        );
    }
    Ok(builder.finish(name, reference))
}

/// A position as it is written.
type Position = Vec<f64>;

/// The four corners of a closed ring, or of the two rings that it was cut into at 180 degrees.
fn ring(geometry: &Geometry) -> Result<[Lla; 4], String> {
    let no_ring = || "the geometry is not a polygon of one ring with four corners".to_owned();
    let positions = match geometry.r#type.as_str() {
        "Polygon" => {
            let rings: Vec<Vec<Position>> = Deserialize::deserialize(&geometry.coordinates).map_err(|_| no_ring())?;
            let [ring] = <[_; 1]>::try_from(rings).map_err(|_| no_ring())?;
            open(ring).ok_or_else(no_ring)?
        }
        "MultiPolygon" => {
            let parts: Vec<[Vec<Position>; 1]> =
                Deserialize::deserialize(&geometry.coordinates).map_err(|_| no_ring())?;
            let [first, second] = <[_; 2]>::try_from(parts).map_err(|_| no_ring())?.map(|[ring]| open(ring));
            joined(first.ok_or_else(no_ring)?, second.ok_or_else(no_ring)?)
        }
        _ => return Err(no_ring()),
    };
    let corners: Result<Vec<Lla>, String> = positions.iter().map(|position| lla(position)).collect();
    <[Lla; 4]>::try_from(corners?).map_err(|_| no_ring())
}

/// A ring without the repetition of its first position; `None` where it is not closed.
fn open(mut ring: Vec<Position>) -> Option<Vec<Position>> {
    let last = ring.pop()?;
    (ring.first() == Some(&last)).then_some(ring)
}

/// The corners of a polygon that was cut at 180 degrees. The part with its first corner begins with that, the other on the
/// line.
fn joined(first: Vec<Position>, second: Vec<Position>) -> Vec<Position> {
    let is_cut = |position: &Position| position.first().is_some_and(|longitude| longitude.abs() == 180.0);
    let (begin, other) = if first.first().is_some_and(is_cut) { (second, first) } else { (first, second) };
    let at = begin.iter().position(is_cut).unwrap_or(begin.len());
    let (before, after) = begin.split_at(at);
    before.iter().chain(&other).chain(after).filter(|position| !is_cut(position)).cloned().collect()
}

/// A position of longitude, latitude and height.
fn lla(position: &[f64]) -> Result<Lla, String> {
    let &[longitude_deg, latitude_deg, height_m] = position else {
        return Err("a position is not longitude, latitude and height".to_owned());
    };
    if longitude_deg.abs() <= 180.0 && latitude_deg.abs() <= 90.0 && height_m.abs() <= 20_000.0 {
        Ok(Lla { latitude_deg, longitude_deg, height_m })
    } else {
        Err(format!(
            "the position {longitude_deg}, {latitude_deg}, {height_m} is not on the earth (degrees, degrees, metres)"
        ))
    }
}

/// Refuses what is no module: coordinates far out or not finite, no area, a centre away from its corners.
fn check(corners_enu_m: &[Vector3<f64>; 4], center_enu_m: Vector3<f64>) -> Result<(), String> {
    let [a, b, c, d] = corners_enu_m;
    let is_near = |p: &Vector3<f64>| p.iter().all(|value| value.abs() <= MAX_REACH_M);
    if !corners_enu_m.iter().all(is_near) || !is_near(&center_enu_m) {
        return Err(format!("it lies more than {} km from the plant's origin", MAX_REACH_M / 1000.0));
    }
    let sides_m = [(b - a + c - d).norm() / 2.0, (c - b + d - a).norm() / 2.0];
    if sides_m.iter().any(|side| !(0.05..=50.0).contains(side)) {
        return Err(format!("its sides measure {:.3} and {:.3} m: no module is of that size", sides_m[0], sides_m[1]));
    }
    if ((a + b + c + d) / 4.0 - center_enu_m).norm() > 0.5 * (sides_m[0] + sides_m[1]) {
        return Err("its centre lies outside its corners".to_owned());
    }
    Ok(())
}

fn count(what: &str, value: i64) -> Result<i64, String> {
    if value.abs() <= MAX_COUNT { Ok(value) } else { Err(format!("`{what}` is {value}: too large for a count")) }
}

fn text(text: String) -> Result<String, String> {
    if text.len() > MAX_TEXT {
        return Err(format!("a name is longer than {MAX_TEXT} bytes"));
    }
    Ok(clean(&text))
}

/// Without control characters, which could play tricks on a terminal.
fn clean(text: &str) -> String {
    text.chars().take(2 * MAX_TEXT).map(|c| if c.is_control() { '\u{fffd}' } else { c }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<ReferenceModel, String> {
        parse_model(text.as_bytes(), Path::new("plant.geojson")).map_err(|error| error.to_string())
    }

    fn feature(ring: &str, properties: &str) -> String {
        format!(
            r#"{{"type":"FeatureCollection","features":[{{"type":"Feature","geometry":{{"type":"Polygon",
            "coordinates":[{ring}]}},"properties":{properties}}}]}}"#
        )
    }

    const RING: &str =
        "[[14.0,49.8,400],[14.00001,49.8,400],[14.00001,49.80001,400.5],[14.0,49.80001,400.5],[14.0,49.8,400]]";

    #[test]
    fn reads_modules_of_other_makers() {
        let properties = r#"{"line": "north", "bench": 7, "row": 1, "number": 3}"#;
        let model = parse(&feature(RING, properties)).unwrap();
        assert_eq!(model.modules[0].label, "north/7/1/3");
        assert_eq!((model.lines[0].name.as_str(), model.lines[0].index), ("north", None));
        let [width_m, height_m] = model.modules[0].extent_m();
        assert!((width_m - 0.719).abs() < 0.01 && (height_m - 1.219).abs() < 0.01, "{width_m} {height_m}");
    }

    #[test]
    fn a_module_that_is_cut_at_180_degrees_is_one() {
        let properties = r#"{"line": "north", "bench": 7, "row": 1, "number": 3}"#;
        let parts = [
            "[[[179.999995,49.8,400],[180,49.8,400],[180,49.80001,400.5],[179.999995,49.80001,400.5],[179.999995,49.8,400]]]",
            "[[[-180,49.8,400],[-179.999995,49.8,400],[-179.999995,49.80001,400.5],[-180,49.80001,400.5],[-180,49.8,400]]]",
        ];
        for order in [[0, 1], [1, 0]] {
            let rings = order.map(|part| parts[part]).join(",");
            let cut = feature(&rings, properties).replace("\"Polygon\"", "\"MultiPolygon\"");
            let [width_m, height_m] = parse(&cut).unwrap().modules[0].extent_m();
            assert!((width_m - 0.719).abs() < 0.01 && (height_m - 1.219).abs() < 0.01, "{width_m} {height_m}");
        }
    }

    #[test]
    fn labels_give_numbers_of_lines_and_benches() {
        let properties =
            r#"{"label":"L03-B02-R1-017","line":"x","bench":"y","row":1,"number":17,"sigma_m":[0.1,0.1,0.2]}"#;
        let model = parse(&feature(RING, properties)).unwrap();
        assert_eq!((model.lines[0].name.as_str(), model.lines[0].index), ("L03", Some(3)));
        assert_eq!((model.benches[0].name.as_str(), model.benches[0].index), ("L03-B02", Some(2)));
        assert_eq!(model.modules[0].sigma_enu_m, Some(Vector3::new(0.1, 0.1, 0.2)));
    }

    #[test]
    fn refuses_what_is_wrong_and_says_where() {
        let good = r#"{"line": 1, "bench": 7, "row": 1, "number": 3}"#;
        let flat = "[[14.0,49.8],[14.1,49.8],[14.1,49.9],[14.0,49.9],[14.0,49.8]]";
        let huge = "[[14.0,49.8,4],[14.1,49.8,4],[14.1,49.9,4],[14.0,49.9,4],[14.0,49.8,4]]";
        let off = "[[14.0,95,4],[14.1,49.8,4],[14.1,49.9,4],[14.0,49.9,4],[14.0,95,4]]";
        let open = "[[14.0,49.8,4],[14.1,49.8,4],[14.1,49.9,4],[14.0,49.9,4],[14.0,49.8,5]]";
        let long = format!(r#"{{"line": "{}", "bench": 7, "row": 1, "number": 3}}"#, "x".repeat(300));
        for (text, expected) in [
            ("{".to_owned(), "line 1, column 1"),
            ("[]".to_owned(), "not the JSON"),
            ("{}".to_owned(), "neither a GeoJSON"),
            (r#"{"type":"FeatureCollection"}"#.to_owned(), "no `features`"),
            (r#"{"type":"FeatureCollection","features":[]}"#.to_owned(), "no modules"),
            (r#"{"type":"FeatureCollection","layer":"benches","features":[]}"#.to_owned(), "these are the benches"),
            (r#"{"modules":[]}"#.to_owned(), "`reference`"),
            (r#"{"modules":[],"reference":{"lat":1,"lon":1,"alt":1}}"#.to_owned(), "no modules"),
            (r#"{"modules":[],"reference":{"lat":1e999,"lon":1,"alt":1}}"#.to_owned(), "out of range"),
            (feature(RING, r#"{"line": 1, "bench": 7, "number": 3}"#), "feature 0: the property `row`"),
            (feature(RING, r#"{"line": 1, "bench": 7, "row": 9999999999999, "number": 3}"#), "too large"),
            (feature(flat, good), "longitude, latitude and height"),
            (feature(huge, good), "no module is of that size"),
            (feature(off, good), "not on the earth"),
            (feature(open, good), "four corners"),
            (feature("", good), "four corners"),
            (feature(RING, &long), "longer than 200 bytes"),
            (feature(RING, r#"{"line":1,"bench":7,"row":1,"number":3,"sigma_m":[-1,0,0]}"#), "sigma_m"),
            (
                feature(RING, r#"{"line":1,"bench":7,"row":1,"number":3,"center":[14.1,49.8,400]}"#),
                "outside its corners",
            ),
        ] {
            let error = parse(&text).unwrap_err();
            assert!(error.contains(expected), "{text}\n{error}");
            assert!(error.starts_with("plant.geojson"), "{error}");
        }
    }

    #[test]
    fn names_carry_no_control_characters() {
        let properties = r#"{"line": "\u001b[2Jx", "bench": 7, "row": 1, "number": 3}"#;
        let model = parse(&feature(RING, properties)).unwrap();
        assert_eq!(model.lines[0].name, "\u{fffd}[2Jx");
    }
}
