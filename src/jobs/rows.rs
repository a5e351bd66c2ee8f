//! A plant model as the store keeps it: layers of features, each with its extent.

use crate::store::{GeoBox, NewFeature, NewLayer};
use heliomap_model::{Layer, PlantModel};
use serde_json::Value;

/// The layers of a model.
pub fn layers(model: &PlantModel) -> Vec<NewLayer> {
    Layer::ALL
        .into_iter()
        .map(|layer| NewLayer {
            layer,
            properties: Value::Object(model.collection_properties(layer)).to_string(),
            features: model.features(layer).iter().map(feature).collect(),
        })
        .collect()
}

fn feature(feature: &Value) -> NewFeature {
    let text = |value: &Value| value.as_str().unwrap_or_default().to_owned();
    let mut positions = Vec::new();
    collect_positions(&feature["geometry"]["coordinates"], &mut positions);
    NewFeature {
        id: text(&feature["id"]),
        label: text(&feature["properties"]["label"]),
        json: feature.to_string(),
        extent: extent(&positions),
    }
}

/// The box around positions; of a feature across the line of 180 degrees one that goes on beyond it.
fn extent(positions: &[[f64; 2]]) -> Option<GeoBox> {
    let extent = GeoBox::around(positions.iter().copied())?;
    if extent.width_deg() <= 180.0 {
        return Some(extent);
    }
    GeoBox::around(positions.iter().map(|[lon, lat]| [if *lon < 0.0 { lon + 360.0 } else { *lon }, *lat]))
}

/// The longitudes and latitudes of coordinates nested however deep.
fn collect_positions(coordinates: &Value, positions: &mut Vec<[f64; 2]>) {
    let Some(members) = coordinates.as_array() else { return };
    match (members.first().and_then(Value::as_f64), members.get(1).and_then(Value::as_f64)) {
        (Some(lon), Some(lat)) => positions.push([lon, lat]),
        _ => members.iter().for_each(|member| collect_positions(member, positions)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn extent_of_a_polygon() {
        let polygon = json!({
            "id": "a",
            "geometry": {"coordinates": [[[1.0, 50.0, 3.0], [2.0, 49.0, 3.0], [1.5, 51.0, 3.0], [1.0, 50.0, 3.0]]]},
            "properties": {"label": "L01"},
        });
        let row = feature(&polygon);
        assert_eq!((row.id.as_str(), row.label.as_str()), ("a", "L01"));
        assert_eq!(row.extent, Some(GeoBox { min_lon: 1.0, min_lat: 49.0, max_lon: 2.0, max_lat: 51.0 }));
        assert_eq!(feature(&json!({"id": "b", "geometry": null})).extent, None);
        let across = json!({"geometry": {"coordinates": [[[[179.0, 1.0, 0.0], [180.0, 2.0, 0.0]]], [[[-180.0, 1.0], [-178.0, 2.0]]]]}});
        let extent = GeoBox { min_lon: 179.0, min_lat: 1.0, max_lon: 182.0, max_lat: 2.0 };
        assert_eq!(feature(&across).extent, Some(extent));
    }
}
