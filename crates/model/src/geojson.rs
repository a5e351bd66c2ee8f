//! GeoJSON (RFC 7946) of a plant model: one layer each for modules, sectors, benches and lines.

use crate::antimeridian;
use crate::geodesy::{GeodeticReference, Lla};
use crate::plant::{Module, PlantModel};
use nalgebra::Vector3;
use serde_json::{Map, Value, json};
use std::collections::HashMap;
use std::fmt;
use std::str::FromStr;
use uuid::Uuid;

/// A kind of feature.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Layer {
    Modules,
    Sectors,
    Benches,
    Lines,
}

impl Layer {
    /// All layers, modules first.
    pub const ALL: [Self; 4] = [Self::Modules, Self::Sectors, Self::Benches, Self::Lines];

    /// The word in paths and properties.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Modules => "modules",
            Self::Sectors => "sectors",
            Self::Benches => "benches",
            Self::Lines => "lines",
        }
    }
}

impl fmt::Display for Layer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

impl FromStr for Layer {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        Self::ALL
            .into_iter()
            .find(|layer| layer.as_str() == text)
            .ok_or_else(|| format!("`{text}` is no layer: modules, sectors, benches or lines"))
    }
}

impl PlantModel {
    /// The members of a feature collection that say what it is: model version, survey, reference frame, vertical datum.
    pub fn collection_properties(&self, layer: Layer) -> Map<String, Value> {
        let origin = self.reference.origin;
        let Value::Object(mut members) = json!({
            "name": self.plant_name,
            "plant": self.plant,
            "layer": layer.as_str(),
            "model_version": self.version,
            "survey": self.survey,
            "reference_frame": {
                "coordinates": "WGS84 longitude, latitude in degrees, height in metres (EPSG:4979)",
                "local_frame": "east-north-up tangent plane, metres",
                "origin": [round(origin.longitude_deg, 9), round(origin.latitude_deg, 9), round(origin.height_m, 4)],
            },
            "vertical_datum": self.vertical_datum,
            "warnings": self.warnings,
        }) else {
            unreachable!("an object literal is an object")
        };
        if let Some(alignment) = &self.alignment {
            members.insert("alignment".to_owned(), json!(alignment));
        }
        if let Some(parameters) = &self.parameters {
            members.insert("parameters".to_owned(), json!(parameters));
        }
        members
    }

    /// The features of one layer, in the order of the model.
    pub fn features(&self, layer: Layer) -> Vec<Value> {
        let mut members: HashMap<Uuid, Vec<&Module>> = HashMap::new();
        for module in &self.modules {
            let group = match layer {
                Layer::Modules => break,
                Layer::Sectors => module.sector.0,
                Layer::Benches => module.bench.0,
                Layer::Lines => module.line.0,
            };
            members.entry(group).or_default().push(module);
        }
        match layer {
            Layer::Modules => self.modules.iter().map(|module| self.module_feature(module)).collect(),
            Layer::Sectors => self
                .sectors
                .iter()
                .map(|sector| {
                    let members = members.get(&sector.id.0).map_or(&[][..], Vec::as_slice);
                    let properties = json!({
                        "id": sector.id, "label": sector.label, "plant": self.plant, "line": sector.line,
                        "bench": sector.bench, "sector": sector.id, "row": sector.row,
                    });
                    self.group_feature(sector.id.to_string(), members, properties)
                })
                .collect(),
            Layer::Benches => self
                .benches
                .iter()
                .map(|bench| {
                    let members = members.get(&bench.id.0).map_or(&[][..], Vec::as_slice);
                    let properties = json!({
                        "id": bench.id, "label": bench.label, "plant": self.plant, "line": bench.line, "bench": bench.id,
                        "index": bench.index, "rows": bench.rows, "columns": bench.columns,
                        "open_ended": {"west": bench.open_ended[0], "east": bench.open_ended[1]},
                        "confidence": round(bench.confidence, 3),
                    });
                    self.group_feature(bench.id.to_string(), members, properties)
                })
                .collect(),
            Layer::Lines => self
                .lines
                .iter()
                .map(|line| {
                    let benches = self.benches.iter().filter(|bench| bench.line == line.id);
                    let members = members.get(&line.id.0).map_or(&[][..], Vec::as_slice);
                    let properties = json!({
                        "id": line.id, "label": line.label, "plant": self.plant, "line": line.id, "index": line.index,
                        "benches": benches.count(),
                    });
                    self.group_feature(line.id.to_string(), members, properties)
                })
                .collect(),
        }
    }

    /// A whole layer as one feature collection.
    pub fn feature_collection(&self, layer: Layer) -> Value {
        let mut collection = Map::new();
        collection.insert("type".to_owned(), json!("FeatureCollection"));
        collection.append(&mut self.collection_properties(layer));
        collection.insert("features".to_owned(), Value::Array(self.features(layer)));
        Value::Object(collection)
    }

    /// One module as a polygon of its four corners.
    pub fn module_feature(&self, module: &Module) -> Value {
        json!({
            "type": "Feature",
            "id": module.id,
            "geometry": polygon(&self.reference, &module.corners_enu_m),
            "properties": {
                "id": module.id,
                "label": module.label,
                "plant": self.plant,
                "line": module.line,
                "bench": module.bench,
                "sector": module.sector,
                "row": module.row,
                "number": module.number,
                "center": position(self.reference.lla_from_enu(module.center_enu_m)),
                "tilt_deg": round(module.tilt_deg(), 3),
                "azimuth_deg": round(module.azimuth_deg(), 3),
                "width_m": round(module.width_m, 4),
                "height_m": round(module.height_m, 4),
                "sigma_m": module.sigma_enu_m.map(|s| [round(s.x, 4), round(s.y, 4), round(s.z, 4)]),
                "views": module.images.len(),
                "images": module.images,
                "status": module.status.as_str(),
            },
        })
    }

    /// A group of modules: its outline is the four outermost corners along the group's own axes, so that it hugs a
    /// bench, sector or line whatever its azimuth.
    fn group_feature(&self, id: String, members: &[&Module], mut properties: Value) -> Value {
        properties["modules"] = json!(members.len());
        let geometry = match outline(members) {
            Some(outline) => {
                let center = outline.iter().sum::<Vector3<f64>>() / 4.0;
                properties["center"] = position(self.reference.lla_from_enu(center));
                let tilt = members.iter().map(|m| m.tilt_deg()).sum::<f64>() / members.len() as f64;
                let normal = members.iter().map(|m| m.normal_enu).sum::<Vector3<f64>>();
                properties["tilt_deg"] = json!(round(tilt, 3));
                properties["azimuth_deg"] = json!(round(normal.x.atan2(normal.y).to_degrees().rem_euclid(360.0), 3));
                polygon(&self.reference, &outline)
            }
            None => Value::Null,
        };
        json!({"type": "Feature", "id": id, "geometry": geometry, "properties": properties})
    }
}

/// The south-west, south-east, north-east and north-west corners of a group of modules, metres: counter-clockwise as
/// RFC 7946 wants rings. `None` without members.
fn outline(members: &[&Module]) -> Option<[Vector3<f64>; 4]> {
    let first = members.first()?;
    let along = members
        .iter()
        .map(|m| m.corners_enu_m[1] - m.corners_enu_m[0] + m.corners_enu_m[2] - m.corners_enu_m[3])
        .sum::<Vector3<f64>>()
        .try_normalize(1e-12)?;
    let up = members
        .iter()
        .map(|m| m.corners_enu_m[3] - m.corners_enu_m[0] + m.corners_enu_m[2] - m.corners_enu_m[1])
        .sum::<Vector3<f64>>()
        .try_normalize(1e-12)?;
    let mut corners = [first.corners_enu_m[0]; 4];
    for (slot, (sign_along, sign_up)) in corners.iter_mut().zip([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)]) {
        let reach = |corner: &Vector3<f64>| sign_along * along.dot(corner) + sign_up * up.dot(corner);
        *slot = *members.iter().flat_map(|m| m.corners_enu_m.iter()).max_by(|a, b| reach(a).total_cmp(&reach(b)))?;
    }
    Some(corners)
}

/// A polygon by its corners in the local frame, metres; of several parts across the line of 180 degrees.
fn polygon(reference: &GeodeticReference, corners_enu_m: &[Vector3<f64>]) -> Value {
    let corners: Vec<Lla> = corners_enu_m.iter().map(|corner| reference.lla_from_enu(*corner)).collect();
    let ring = |part: Vec<Lla>| {
        let mut ring: Vec<Value> = part.into_iter().map(position).collect();
        ring.extend(ring.first().cloned());
        ring
    };
    let mut rings: Vec<Vec<Value>> = antimeridian::cut(&corners).into_iter().map(ring).collect();
    match rings.len() {
        1 => json!({"type": "Polygon", "coordinates": [rings.remove(0)]}),
        _ => {
            let parts: Vec<_> = rings.into_iter().map(|ring| [ring]).collect();
            json!({"type": "MultiPolygon", "coordinates": parts})
        }
    }
}

/// Longitude, latitude (9 decimals, 0.1 mm) and height (0.1 mm).
fn position(lla: Lla) -> Value {
    json!([round(lla.longitude_deg, 9), round(lla.latitude_deg, 9), round(lla.height_m, 4)])
}

fn round(value: f64, decimals: i32) -> f64 {
    let scale = 10_f64.powi(decimals);
    let rounded = (value * scale).round() / scale;
    if rounded == 0.0 { 0.0 } else { rounded }
}
