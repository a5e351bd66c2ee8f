//! The photos of a survey, each with a verdict: what the pilot should know before leaving the field.

use crate::http::controllers::file_lists::{check_warning, cursor_after, has_warning, path_of};
use crate::http::error::{ApiError, Problem};
use crate::http::extract::{ApiPath, ApiQuery};
use crate::http::paging::{List, list_limit, next_part, prefix_filter, with_filters};
use crate::http::state::AppState;
use crate::http::uploads::intake;
use crate::jobs::{self, ShotNames};
use crate::store::{Digest, FileKind, FileRecord, SurveyId, SurveyPath};
use axum::extract::State;
use axum::http::header;
use axum::response::{IntoResponse, Response};
use heliomap_mapping::reconstruction::PhotoFacts;
use heliomap_mapping::reconstruction::quality::Flaw;
use heliomap_model::PlantId;
use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use serde_json::json;
use std::collections::HashMap;

/// Photos per look into the store.
const CHUNK: u32 = 1000;

/// A file of a survey.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub struct FileView {
    /// Its place in the survey's folder.
    #[schema(example = "images/DJI_0001.jpg")]
    pub path: String,
    /// `image` or `reconstruction`.
    #[schema(example = "image")]
    pub kind: &'static str,
    /// Bytes.
    pub size: u64,
    /// SHA-256 of its bytes, hexadecimal.
    #[schema(
        example = "9f86d081884c7d659a2feaa0c55ad015a3bf4f1b2b0b822cd15d6c15b0f00a08",
        min_length = 64,
        max_length = 64
    )]
    pub sha256: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub width_px: Option<u32>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub height_px: Option<u32>,
    /// What a photo tells of itself and how good it is.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub photo: Option<PhotoView>,
    /// What the pilot should know of a photo before leaving the field.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    #[schema(required = false)]
    pub warnings: Vec<PhotoWarning>,
    #[schema(value_type = String, format = DateTime)]
    pub stored: Timestamp,
}

impl FileView {
    /// A file, and other photos with the same bytes.
    pub fn new(file: FileRecord, twins: &[SurveyPath]) -> Self {
        Self {
            path: file.path.to_string(),
            kind: file.path.kind().as_str(),
            size: file.size,
            sha256: file.sha256.to_string(),
            width_px: file.size_px.map(|size| size[0]),
            height_px: file.size_px.map(|size| size[1]),
            warnings: warnings(&file, twins),
            photo: file.photo.map(PhotoView::from),
            stored: file.stored,
        }
    }
}

/// What a photo tells of itself, and what was measured on it.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub struct PhotoView {
    /// Make and model of the camera.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(example = "DJI FC6310")]
    pub camera: Option<String>,
    /// When it was taken, by the camera's clock; with an offset from UTC only where the file tells one.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(example = "2026-06-21T10:11:12")]
    pub taken: Option<String>,
    /// Longitude, latitude (degrees, WGS 84) and, where the file tells it, height (metres, as the drone wrote it).
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(min_items = 2, max_items = 3, example = json!([8.1032, 50.2011, 162.5]))]
    pub position: Option<Vec<f64>>,
    /// Energy of fine detail over that of coarse detail, 0.5 and more where the photo is sharp; left out where it is too
    /// small to tell.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(example = 0.62)]
    pub sharpness: Option<f64>,
    /// Share of pixels that are black, 0 to 1.
    pub dark_share: f64,
    /// Share of pixels that are white, 0 to 1.
    pub bright_share: f64,
}

impl From<PhotoFacts> for PhotoView {
    fn from(facts: PhotoFacts) -> Self {
        let PhotoFacts { exposure, quality, damaged: _ } = facts;
        // What cannot be told apart need not be told.
        let rounded = |value: f64| (value * 1e4).round() / 1e4;
        Self {
            camera: exposure.camera,
            taken: exposure.taken,
            position: exposure.position.map(|position| {
                [Some(position.longitude_deg), Some(position.latitude_deg), position.height_m]
                    .into_iter()
                    .flatten()
                    .collect()
            }),
            sharpness: quality.fine.map(rounded),
            dark_share: rounded(quality.dark_share),
            bright_share: rounded(quality.bright_share),
        }
    }
}

/// Something that the pilot should know of a photo.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub struct PhotoWarning {
    /// `damaged`, `blurred`, `underexposed`, `overexposed`, `no_position`, `no_time` or `duplicate`.
    #[schema(example = "blurred")]
    pub code: &'static str,
    /// What is wrong and what to do.
    #[schema(example = "the photo is blurred")]
    pub message: String,
}

fn warnings(file: &FileRecord, twins: &[SurveyPath]) -> Vec<PhotoWarning> {
    let Some(photo) = &file.photo else { return Vec::new() };
    let mut warnings = Vec::new();
    let mut warn = |code, message: String| warnings.push(PhotoWarning { code, message });
    if photo.damaged {
        warn("damaged", "the data of its picture is damaged: copy it from the camera again, or take it again".into());
    }
    for flaw in photo.quality.flaws() {
        match flaw {
            Flaw::Blurred => {
                warn(
                    "blurred",
                    "it is blurred: clean the lens, fly slower or shorten the exposure, and take it again".into(),
                );
            }
            Flaw::Underexposed => {
                let share = photo.quality.dark_share * 100.0;
                warn("underexposed", format!("{share:.0} % of it are black: expose longer and take it again"));
            }
            Flaw::Overexposed => {
                let share = photo.quality.bright_share * 100.0;
                warn("overexposed", format!("{share:.0} % of it are white: expose shorter and take it again"));
            }
        }
    }
    if photo.exposure.position.is_none() {
        warn("no_position", "its file tells no position: wait until the drone knows where it is".into());
    }
    if photo.exposure.taken.is_none() {
        warn("no_time", "its file tells no time: send files as the camera wrote them".into());
    }
    if !twins.is_empty() {
        let names: Vec<&str> = twins.iter().map(SurveyPath::file_name).collect();
        warn("duplicate", format!("it has the same bytes as {}: one of them is too many", names.join(", ")));
    }
    warnings
}

/// A photo of a survey.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub struct ImageView {
    /// Its file name.
    #[schema(example = "DJI_0001.jpg")]
    pub name: String,
    /// Whether the reconstruction was made from it; left out where there is no reconstruction yet.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reconstructed: Option<bool>,
    #[serde(flatten)]
    pub file: FileView,
}

/// Which photos.
#[derive(Debug, Deserialize, utoipa::IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct ImagesQuery {
    /// Most items in the answer.
    #[param(minimum = 1, maximum = 1000, default = 100)]
    pub limit: Option<u32>,
    /// Where to go on: taken from the link to the next part.
    #[param(pattern = "^([0-9a-f]{2})+$", max_length = 800)]
    pub cursor: Option<String>,
    /// Only photos whose names begin so.
    #[param(max_length = 200, example = "DJI_00")]
    pub name: Option<String>,
    /// Only photos with this warning: `damaged`, `blurred`, `underexposed`, `overexposed`, `no_position`, `no_time`, `duplicate`, or
    /// `any`; or with `none`.
    #[param(
        pattern = "^(damaged|blurred|underexposed|overexposed|no_position|no_time|duplicate|any|none)$",
        example = "blurred"
    )]
    pub warning: Option<String>,
    /// Only photos from which the reconstruction was made (`true`) or was not (`false`).
    pub reconstructed: Option<bool>,
}

impl ImagesQuery {
    fn wants(&self, image: &ImageView) -> bool {
        has_warning(&image.file, self.warning.as_deref())
            && self.reconstructed.is_none_or(|wanted| image.reconstructed == Some(wanted))
    }

    /// The link to the part after a photo.
    fn next(&self, survey: &str, limit: u32, last: &str) -> String {
        let filters = [
            ("name", self.name.clone()),
            ("warning", self.warning.clone()),
            ("reconstructed", self.reconstructed.map(|only| only.to_string())),
        ];
        next_part(&with_filters(&format!("{survey}/images"), &filters), limit, cursor_after(last))
    }
}

/// Photos of a survey by their bytes.
#[derive(Default)]
struct Alike(HashMap<Digest, Vec<SurveyPath>>);

impl FromIterator<(Digest, SurveyPath)> for Alike {
    fn from_iter<T: IntoIterator<Item = (Digest, SurveyPath)>>(photos: T) -> Self {
        let mut alike = Self::default();
        for (sha256, path) in photos {
            alike.0.entry(sha256).or_default().push(path);
        }
        alike
    }
}

impl Alike {
    /// Other photos with the bytes of a photo, the first few.
    fn twins(&self, file: &FileRecord) -> Vec<SurveyPath> {
        let same = self.0.get(&file.sha256).filter(|_| file.path.kind() == FileKind::Image);
        same.into_iter()
            .flatten()
            .filter(|path| **path != file.path)
            .take(intake::MAX_TWINS as usize)
            .cloned()
            .collect()
    }
}

/// The photos of a survey, part by part, each with its verdict.
struct Photos<'a> {
    state: &'a AppState,
    survey: SurveyId,
    alike: Alike,
    shots: Option<ShotNames>,
}

impl<'a> Photos<'a> {
    async fn of(state: &'a AppState, survey: SurveyId) -> Result<Self, ApiError> {
        let mut shots = None;
        for path in jobs::RECONSTRUCTIONS {
            if let Some(file) = state.store.file(survey, &SurveyPath::of_reconstruction(path)?).await? {
                shots = file.shots.map(|shots| shots.into_iter().collect());
                break;
            }
        }
        let alike = state.store.photos_alike(survey).await?.into_iter().collect();
        Ok(Self { state, survey, alike, shots })
    }

    /// At most `limit` photos after a path, of those whose names begin so.
    async fn part(&self, name: &str, after: &str, limit: u32) -> Result<Vec<ImageView>, ApiError> {
        let mut images = Vec::new();
        for file in self.state.store.photos(self.survey, name, after, limit).await? {
            let twins = self.alike.twins(&file);
            let name = file.path.file_name().to_owned();
            let reconstructed = self.shots.as_ref().map(|shots| shots.contains(&name));
            images.push(ImageView { name, reconstructed, file: FileView::new(file, &twins) });
        }
        Ok(images)
    }
}

fn place(plant: PlantId, survey: SurveyId) -> String {
    format!("/api/v1/plants/{plant}/surveys/{survey}")
}

/// List a survey's photos, each with its verdict
///
/// In the order of their names.
#[utoipa::path(
    get,
    path = "/api/v1/plants/{plant}/surveys/{survey}/images",
    tag = "surveys",
    security(("key" = ["read"]), ("key" = ["review"]), ("key" = ["upload"])),
    params(
        ("plant" = Uuid, Path, description = "The plant's identifier"),
        ("survey" = Uuid, Path, description = "The survey's identifier"),
        ImagesQuery
    ),
    responses(
        (status = 200, body = List<ImageView>),
        (status = "4XX", description = "`plant_not_found`, `survey_not_found`, `invalid_query`", body = Problem,
            content_type = "application/problem+json")
    )
)]
pub async fn list(
    State(state): State<AppState>,
    ApiPath((plant, survey)): ApiPath<(PlantId, SurveyId)>,
    ApiQuery(query): ApiQuery<ImagesQuery>,
) -> Result<List<ImageView>, ApiError> {
    let (limit, mut after) = (list_limit(query.limit)?, path_of(query.cursor.as_deref())?);
    let name = prefix_filter(query.name.as_deref())?;
    check_warning(query.warning.as_deref())?;
    state.require_survey(plant, survey).await?;
    let photos = Photos::of(&state, survey).await?;
    let mut items: Vec<ImageView> = Vec::new();
    // One more than is shown tells whether there is a next part.
    while items.len() <= limit as usize {
        let part = photos.part(&name, &after, CHUNK.min(limit + 1)).await?;
        let Some(last) = part.last() else { break };
        after.clone_from(&last.file.path);
        items.extend(part.into_iter().filter(|image| query.wants(image)));
    }
    let more = items.len() > limit as usize;
    items.truncate(limit as usize);
    let last = items.last().filter(|_| more);
    let next = last.map(|last| query.next(&place(plant, survey), limit, &last.file.path));
    Ok(List { items, next })
}

/// Where a survey's photos were taken, as GeoJSON
///
/// A point for each photo whose file tells a position, as the drone wrote it: longitude, latitude and, where there is one,
/// height.
#[utoipa::path(
    get,
    path = "/api/v1/plants/{plant}/surveys/{survey}/images.geojson",
    tag = "surveys",
    security(("key" = ["read"]), ("key" = ["review"]), ("key" = ["upload"])),
    params(
        ("plant" = Uuid, Path, description = "The plant's identifier"),
        ("survey" = Uuid, Path, description = "The survey's identifier")
    ),
    responses(
        (status = 200, body = ImagePositions, content_type = "application/geo+json"),
        (status = 404, description = "`plant_not_found`, `survey_not_found`", body = Problem,
            content_type = "application/problem+json")
    )
)]
pub async fn positions(
    State(state): State<AppState>,
    ApiPath((plant, survey)): ApiPath<(PlantId, SurveyId)>,
) -> Result<Response, ApiError> {
    state.require_survey(plant, survey).await?;
    let photos = Photos::of(&state, survey).await?;
    let mut features = Vec::new();
    let mut after = String::new();
    loop {
        let part = photos.part("", &after, CHUNK).await?;
        let Some(last) = part.last() else { break };
        after.clone_from(&last.file.path);
        features.extend(part.iter().filter_map(feature));
    }
    let body = json!({"type": "FeatureCollection", "survey": survey, "features": features}).to_string();
    Ok(([(header::CONTENT_TYPE, "application/geo+json")], body).into_response())
}

fn feature(image: &ImageView) -> Option<serde_json::Value> {
    let photo = image.file.photo.as_ref()?;
    let warnings: Vec<&str> = image.file.warnings.iter().map(|warning| warning.code).collect();
    Some(json!({
        "type": "Feature",
        "id": image.name,
        "geometry": {"type": "Point", "coordinates": photo.position.as_ref()?},
        "properties": {
            "name": image.name,
            "camera": photo.camera,
            "taken": photo.taken,
            "reconstructed": image.reconstructed,
            "warnings": warnings,
        },
    }))
}

/// A GeoJSON feature collection of points.
#[derive(utoipa::ToSchema)]
#[expect(dead_code, reason = "it describes what is written as JSON")]
struct ImagePositions {
    /// `FeatureCollection`
    #[schema(example = "FeatureCollection")]
    r#type: String,
    survey: uuid::Uuid,
    features: Vec<ImagePosition>,
}

/// A GeoJSON feature: a point.
#[derive(utoipa::ToSchema)]
#[expect(dead_code, reason = "it describes what is written as JSON")]
struct ImagePosition {
    /// `Feature`
    #[schema(example = "Feature")]
    r#type: String,
    /// The photo's file name.
    #[schema(example = "DJI_0001.jpg")]
    id: String,
    /// A point: longitude, latitude and, where there is one, height.
    #[schema(example = json!({"type": "Point", "coordinates": [8.0, 50.0, 140.0]}))]
    geometry: serde_json::Value,
    /// `name`, `camera`, `taken`, `reconstructed` (null where there is no reconstruction yet) and `warnings` (codes).
    #[schema(example = json!({"name": "DJI_0001.jpg", "reconstructed": true, "warnings": []}))]
    properties: serde_json::Value,
}

/// How a survey's photos and its reconstruction go together.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub struct ImagesSummary {
    /// Photos that were uploaded.
    pub uploaded: usize,
    /// Of these, those whose file tells a position.
    pub with_position: usize,
    /// Of these, those with a warning.
    pub with_warning: usize,
    /// Images from which the reconstruction was made; left out where there is none yet.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reconstructed: Option<usize>,
    /// Photos that were uploaded and from which the reconstruction was not made, the first 1,000 of them.
    #[schema(example = json!(["DJI_0007.jpg"]))]
    pub not_reconstructed: Vec<String>,
    pub not_reconstructed_count: usize,
    /// Images from which the reconstruction was made and that were not uploaded, the first 1,000 of them.
    #[schema(example = json!([]))]
    pub not_uploaded: Vec<String>,
    pub not_uploaded_count: usize,
}

/// How many photos are named where something is said of many.
const MAX_NAMED: usize = 1000;

/// A survey's files, each with its verdict, and how they go together.
pub fn summary(files: Vec<FileRecord>) -> (ImagesSummary, Vec<FileView>) {
    let photo_names =
        |file: &FileRecord| (file.path.kind() == FileKind::Image).then(|| file.path.file_name().to_owned());
    let names: Vec<String> = files.iter().filter_map(photo_names).collect();
    let shots: Option<ShotNames> = jobs::shots(&files).map(|shots| shots.iter().cloned().collect());
    let mut not_uploaded = jobs::shots_without_image(&files);
    let not_uploaded_count = not_uploaded.len();
    not_uploaded.truncate(MAX_NAMED);
    let with_position =
        files.iter().filter(|file| file.photo.as_ref().is_some_and(|photo| photo.exposure.position.is_some())).count();
    let photos = files.iter().filter(|file| file.path.kind() == FileKind::Image);
    let alike: Alike = photos.map(|file| (file.sha256, file.path.clone())).collect();
    let view = |file: FileRecord| {
        let twins = alike.twins(&file);
        FileView::new(file, &twins)
    };
    let views: Vec<FileView> = files.into_iter().map(view).collect();
    let uploaded = names.len();
    let mut not_reconstructed: Vec<String> = match &shots {
        Some(shots) => names.into_iter().filter(|name| !shots.contains(name)).collect(),
        None => Vec::new(),
    };
    let not_reconstructed_count = not_reconstructed.len();
    not_reconstructed.truncate(MAX_NAMED);
    let images = ImagesSummary {
        uploaded,
        with_position,
        with_warning: views.iter().filter(|view| !view.warnings.is_empty()).count(),
        reconstructed: shots.as_ref().map(ShotNames::count),
        not_reconstructed,
        not_reconstructed_count,
        not_uploaded,
        not_uploaded_count,
    };
    (images, views)
}
