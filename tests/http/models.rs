use crate::app::{Act, App, assert_problem, plant_path};
use reqwest::{Method, StatusCode};
use serde_json::{Value, json};

fn labels(collection: &Value) -> Vec<&str> {
    collection["features"].as_array().unwrap().iter().map(|f| f["properties"]["label"].as_str().unwrap()).collect()
}

#[tokio::test]
async fn layers_are_geojson_that_says_what_it_is() {
    let app = App::new(&[Act::Map(3)]).await;
    let survey = app.complete_survey().await;
    app.map(&survey).await;
    let plant = plant_path(&survey);
    for layer in ["modules", "sectors", "benches", "lines"] {
        let path = format!("{plant}/models/latest/{layer}");
        let response = app.request(Method::GET, &path).send().await.unwrap();
        assert_eq!(response.headers()["content-type"], "application/geo+json");
        let text = response.text().await.unwrap();
        text.parse::<geojson::FeatureCollection>().unwrap();
        let collection: Value = serde_json::from_str(&text).unwrap();
        assert_eq!((&collection["layer"], &collection["model_version"]), (&json!(layer), &json!(1)));
        assert!(survey.ends_with(collection["survey"].as_str().unwrap()));
        assert_eq!(collection["vertical_datum"], "as the drone wrote it");
        assert!(collection["reference_frame"]["coordinates"].as_str().unwrap().contains("WGS84"));
        assert_eq!(labels(&collection).len(), if layer == "modules" { 3 } else { 1 });
    }
    assert_problem(app.get(&format!("{plant}/models/latest/roofs")).await, 404, "not_found", "roofs");
    assert_problem(app.get(&format!("{plant}/models/2/modules")).await, 404, "model_not_found", "1 to 1");
    assert_problem(app.get(&format!("{plant}/models/newest/modules")).await, 404, "model_not_found", "latest");
}

#[tokio::test]
async fn parts_and_boxes() {
    let app = App::new(&[Act::Map(5)]).await;
    let survey = app.complete_survey().await;
    app.map(&survey).await;
    let modules = format!("{}/models/latest/modules", plant_path(&survey));
    let (_, whole) = app.get(&modules).await;
    let all = labels(&whole);

    let mut next = Some(format!("{modules}?limit=2"));
    let mut seen = Vec::new();
    while let Some(path) = next {
        let response = app.request(Method::GET, &path).send().await.unwrap();
        let link = response.headers().get("link").map(|link| link.to_str().unwrap().to_owned());
        let part: Value = response.json().await.unwrap();
        assert_eq!(part["numberReturned"], labels(&part).len());
        seen.extend(labels(&part).into_iter().map(str::to_owned));
        next = part["links"][0]["href"].as_str().map(str::to_owned);
        assert_eq!(link, next.as_ref().map(|next| format!("<{next}>; rel=\"next\"")));
    }
    assert_eq!(seen, all);

    // The box of the third module's middle: it alone touches it.
    let center = &whole["features"][2]["properties"]["center"];
    let around = |size: f64| {
        let (lon, lat) = (center[0].as_f64().unwrap(), center[1].as_f64().unwrap());
        format!("{},{},{},{}", lon - size, lat - size, lon + size, lat + size)
    };
    let (_, third) = app.get(&format!("{modules}?bbox={}", around(1e-7))).await;
    assert_eq!(labels(&third), [all[2]]);
    let (_, every) = app.get(&format!("{modules}?bbox={}&limit=10", around(1.0))).await;
    assert_eq!(labels(&every), all);
    let (_, none) = app.get(&format!("{modules}?bbox=0,0,1,1")).await;
    assert!(labels(&none).is_empty());
    let (_, two) = app.get(&format!("{modules}?bbox={}&limit=2", around(1.0))).await;
    let (_, rest) = app.get(two["links"][0]["href"].as_str().unwrap()).await;
    assert_eq!(labels(&rest), all[2..4]);

    for (query, names) in [
        ("bbox=1,2,3", "bbox"),
        ("bbox=1,2,3,x", "bbox"),
        ("bbox=181,1,2,2", "bbox"),
        ("bbox=3,2,4,1", "bbox"),
        ("limit=0", "limit"),
        ("box=1", "box"),
    ] {
        assert_problem(app.get(&format!("{modules}?{query}")).await, 400, "invalid_query", names);
    }
}

#[tokio::test]
async fn a_module_keeps_its_identifier_from_model_to_model() {
    let app = App::new(&[Act::Map(3), Act::Map(2)]).await;
    let survey = app.complete_survey().await;
    app.map(&survey).await;
    let plant = plant_path(&survey);
    let (_, first) = app.get(&format!("{plant}/models/1/modules")).await;
    let id = |index: usize| first["features"][index]["id"].as_str().unwrap();
    let job = app.map(&survey).await;
    assert_eq!(job["model_version"], 2);

    let (status, module) = app.get(&format!("{plant}/modules/{}", id(0))).await;
    assert_eq!(
        (status, &module["properties"]["label"]),
        (StatusCode::OK, &first["features"][0]["properties"]["label"])
    );
    assert_problem(
        app.get(&format!("{plant}/modules/{}", id(2))).await,
        404,
        "module_not_found",
        "newest that does is 1",
    );
    let (_, old) = app.get(&format!("{plant}/modules/{}?version=1", id(2))).await;
    assert_eq!(old, first["features"][2]);
    let bench = first["features"][0]["properties"]["bench"].as_str().unwrap();
    assert_problem(app.get(&format!("{plant}/modules/{bench}")).await, 404, "module_not_found", "no model");
    let (_, models) = app.get(&format!("{plant}/models")).await;
    assert_eq!((&models["items"][0]["version"], &models["items"][1]["version"]), (&json!(2), &json!(1)));
}

#[tokio::test]
async fn a_large_layer_is_streamed_whole() {
    let app = App::new(&[Act::Map(5001)]).await;
    let survey = app.complete_survey().await;
    app.map(&survey).await;
    let modules = format!("{}/models/latest/modules", plant_path(&survey));
    let (_, whole) = app.get(&modules).await;
    let labels = labels(&whole);
    assert_eq!((labels.len(), labels[0], labels[5000]), (5001, "L01-B01-R1-001", "L01-B01-R1-5001"));
}

#[tokio::test]
async fn a_plant_across_the_line_of_180_degrees_is_cut_there_and_found_there_alone() {
    let app = App::new(&[Act::MapAcross(5)]).await;
    let survey = app.complete_survey().await;
    app.map(&survey).await;
    let plant = plant_path(&survey);
    for layer in ["modules", "sectors", "benches", "lines"] {
        let (_, whole) = app.get(&format!("{plant}/models/latest/{layer}")).await;
        let features = whole["features"].as_array().unwrap();
        let cut = features.iter().filter(|feature| feature["geometry"]["type"] == "MultiPolygon");
        let parts: Vec<_> = cut.map(|feature| feature["geometry"]["coordinates"].clone()).collect();
        assert_eq!(parts.len(), 1, "{whole}");
        for part in parts[0].as_array().unwrap() {
            let ring = part[0].as_array().unwrap();
            assert_eq!(ring.first(), ring.last());
            let longitudes: Vec<f64> = ring.iter().map(|position| position[0].as_f64().unwrap()).collect();
            let width = longitudes.iter().copied().fold(f64::MIN, f64::max)
                - longitudes.iter().copied().fold(f64::MAX, f64::min);
            assert!(width < 0.001, "{longitudes:?}");
        }
    }
    let modules = format!("{plant}/models/latest/modules");
    for (bbox, count) in [
        ("8,-17,9,60", 0),
        ("-180,49,-179.9,51", 5),
        ("179.9,49,180,51", 1),
        ("179.9,49,-179.9,51", 5),
        ("-179.9,49,179.9,51", 0),
        ("-180,-90,180,90", 5),
        ("179.9,-90,-179.9,0", 0),
    ] {
        let (status, found) = app.get(&format!("{modules}?bbox={bbox}")).await;
        assert_eq!((status, labels(&found).len()), (StatusCode::OK, count), "{bbox}");
    }
    let (_, first) = app.get(&format!("{modules}?bbox=179.9,49,-179.9,51&limit=2")).await;
    let next = first["links"][0]["href"].as_str().unwrap();
    let (_, second) = app.get(next).await;
    assert_eq!((labels(&first).len(), labels(&second).len()), (2, 2), "{next}");
    let (_, model) = app.get(&format!("{plant}/models/latest")).await;
    let bbox: Vec<f64> = serde_json::from_value(model["layers"][0]["bbox"].clone()).unwrap();
    assert!(bbox[0] > 179.9 && bbox[2] < -179.9, "{bbox:?}");
}
