//! Uploads begin, or are put together from their parts.

use super::bytes::bring_here;
use super::finish::finish;
use super::locks::Taken;
use super::place::Place;
use super::protocol::{UPLOAD_EXPIRES, answer, http_date, number, require_version, text, wrong};
use super::{LIFE, place, require_upload};
use crate::http::error::{ApiError, Problem};
use crate::http::extract::ApiPath;
use crate::http::state::AppState;
use crate::http::uploads::intake::{self, disk};
use crate::store::{SurveyId, Upload, UploadBounds, UploadId, keep_free};
use axum::extract::State;
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse, Response};
use heliomap_model::PlantId;
use jiff::Timestamp;
use std::collections::HashSet;
use std::fs::File;
use std::io::{self, Read};
use std::path::{Path, PathBuf};
use uuid::Uuid;

/// Longest metadata that is kept.
const MAX_METADATA_BYTES: usize = 4096;

/// Most parts of one file.
const MAX_PARTS: usize = 1000;

/// How much is put together before the disk is looked at again.
const LOOK_EVERY_BYTES: u64 = 16 << 20;

/// Begin an upload that may be resumed (tus 1.0)
///
/// `Upload-Length` says how large the file is, `Upload-Metadata` where it belongs: `filename` for a photo, or `path` in the
/// survey's folder, or `path` of `reconstruction` for a zip or tar. With `Upload-Concat: partial` it is a part of a file,
/// with `Upload-Concat: final;URL URL …` the file is put together from its parts.
#[utoipa::path(
    post,
    path = "/api/v1/plants/{plant}/surveys/{survey}/uploads",
    tag = "surveys",
    security(("key" = ["upload"])),
    params(
        ("plant" = Uuid, Path, description = "The plant's identifier"),
        ("survey" = Uuid, Path, description = "The survey's identifier"),
        ("tus-resumable" = String, Header, pattern = "^1\\.0\\.0$", description = "`1.0.0`"),
        ("upload-length" = Option<u64>, Header, description = "Bytes of the file"),
        ("upload-metadata" = Option<String>, Header, description = "Names, each with its value in base64"),
        ("upload-concat" = Option<String>, Header, description = "`partial`, or `final;` and the parts")
    ),
    responses(
        (status = 201, description = "Send its bytes to `location`", headers(("location" = String),
            ("upload-expires" = String))),
        (status = "4XX", description = "`plant_not_found`, `survey_not_found`, `upload_not_found` (a part), `tus_version`, \
            `bad_request`, `invalid_name`, `unknown_file`, `too_large`, `too_many_uploads`; a file put together: as `PUT` of that file",
            body = Problem, content_type = "application/problem+json"),
        (status = 507, description = "`storage_full`, `quota_exceeded`", body = Problem, content_type = "application/problem+json")
    )
)]
pub async fn create(
    State(state): State<AppState>,
    ApiPath((plant, survey)): ApiPath<(PlantId, SurveyId)>,
    headers: HeaderMap,
) -> Response {
    answer(create_upload(&state, plant, survey, &headers).await)
}

async fn create_upload(
    state: &AppState,
    plant: PlantId,
    survey: SurveyId,
    headers: &HeaderMap,
) -> Result<Response, ApiError> {
    state.require_survey(plant, survey).await?;
    require_version(headers)?;
    let metadata = text(headers, "upload-metadata")?.unwrap_or_default();
    if metadata.len() > MAX_METADATA_BYTES {
        return Err(wrong(format!("Upload-Metadata is longer than {MAX_METADATA_BYTES} bytes")));
    }
    let concat = text(headers, "upload-concat")?;
    let partial = concat == Some("partial");
    let (parts, _taken) = match concat.and_then(|concat| concat.strip_prefix("final;")) {
        Some(urls) => finished_parts(state, survey, urls).await.map(|(parts, taken)| (Some(parts), taken))?,
        None if concat.is_none() || partial => (None, Vec::new()),
        None => return Err(wrong("Upload-Concat must be `partial`, or `final;` and the URLs of the parts")),
    };
    let length = match &parts {
        Some(parts) => parts.iter().map(|part| part.length).sum(),
        None => number(headers, "upload-length")?,
    };
    let whole = if partial { None } else { Some(Place::of(metadata)?) };
    let (name, limit) = match &whole {
        None => ("the part", state.limits.max_archive_size.max(state.limits.max_file_size)),
        Some(place) => (place.name(), place.max_bytes(state)),
    };
    if length > limit {
        return Err(intake::too_large(name, limit));
    }
    let may_be_there = match &whole {
        Some(place) if parts.is_none() => place.may_hold(state, survey, length).await?,
        _ => false,
    };
    let bounds = UploadBounds { quotas: state.limits.quotas(), open: state.limits.max_uploads, may_be_there };
    let id = UploadId(Uuid::new_v4());
    let file = state.blobs.upload_file(id);
    let sources: Vec<_> = parts.iter().flatten().map(|part| state.blobs.upload_file(part.id)).collect();
    let (target, staging, reserve) = (file.clone(), state.blobs.staging().to_owned(), state.limits.disk_reserve);
    let put_together = tokio::task::spawn_blocking(move || {
        put_together(&sources, &target, || keep_free(&staging, reserve)).inspect_err(|_| {
            let _ = std::fs::remove_file(&target);
        })
    });
    put_together.await.map_err(|error| ApiError::internal(&error))?.map_err(|error| disk(&file, error))?;
    let upload = Upload {
        id,
        survey,
        length,
        received: if parts.is_some() { length } else { 0 },
        partial,
        parts: concat.filter(|_| parts.is_some()).map(str::to_owned),
        metadata: metadata.to_owned(),
        expires: Timestamp::now() + LIFE,
        outcome: None,
        home: state.blobs.home(),
    };
    // What its parts announced is counted already.
    let bounds = parts.is_none().then_some(&bounds);
    if let Err(error) = state.store.create_upload(&upload, bounds, Timestamp::now()).await {
        state.blobs.drop_upload(id).await;
        return Err(error.into());
    }
    if upload.received == length {
        finish(state, plant, &upload).await?;
    }
    for part in parts.iter().flatten() {
        state.store.delete_upload(survey, part.id).await?;
        state.blobs.drop_upload(part.id).await;
    }
    let headers = [(header::LOCATION, place(plant, survey, id)), (UPLOAD_EXPIRES, http_date(upload.expires))];
    Ok((StatusCode::CREATED, headers).into_response())
}

/// Writes the bytes of files one after the other into a new one, as long as the disk has room.
fn put_together(sources: &[PathBuf], target: &Path, has_room: impl Fn() -> io::Result<()>) -> io::Result<()> {
    let mut whole = File::create_new(target)?;
    for source in sources {
        let mut source = File::open(source)?;
        while {
            has_room()?;
            io::copy(&mut Read::by_ref(&mut source).take(LOOK_EVERY_BYTES), &mut whole)? > 0
        } {}
    }
    whole.sync_all()
}

/// The parts of a file, all of which must be whole, and each of which is named once, in the hands of this request.
async fn finished_parts(state: &AppState, survey: SurveyId, urls: &str) -> Result<(Vec<Upload>, Vec<Taken>), ApiError> {
    let (mut parts, mut named, mut taken) = (Vec::new(), HashSet::new(), Vec::new());
    for url in urls.split_ascii_whitespace() {
        let id = url.rsplit('/').next().and_then(|id| Uuid::try_parse(id).ok()).map(UploadId);
        let part =
            require_upload(state, survey, id.ok_or_else(|| wrong(format!("`{url}` is no upload's URL")))?).await?;
        if !part.partial || part.received < part.length {
            return Err(wrong(format!("{url} is no part that is whole")));
        }
        if !named.insert(part.id) {
            return Err(wrong(format!("{url} is named twice")));
        }
        taken.push(state.desk.take(part.id).await?);
        bring_here(state, &part).await?;
        parts.push(part);
        if parts.len() > MAX_PARTS {
            return Err(wrong(format!("a file may have {MAX_PARTS} parts at the most")));
        }
    }
    if parts.is_empty() {
        return Err(wrong("Upload-Concat names no parts"));
    }
    Ok((parts, taken))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_are_put_together_as_long_as_there_is_room() {
        let folder = tempfile::tempdir().unwrap();
        let parts = ["one", "two"].map(|name| folder.path().join(name));
        for part in &parts {
            std::fs::write(part, part.file_name().unwrap().as_encoded_bytes()).unwrap();
        }
        let whole = folder.path().join("whole");
        put_together(&parts, &whole, || Ok(())).unwrap();
        assert_eq!(std::fs::read(&whole).unwrap(), b"onetwo");
        let looks = std::cell::Cell::new(0);
        let full = || {
            looks.set(looks.get() + 1);
            if looks.get() > 2 { Err(io::ErrorKind::StorageFull.into()) } else { Ok(()) }
        };
        let error = put_together(&parts, &folder.path().join("other"), full).unwrap_err();
        assert_eq!(error.kind(), io::ErrorKind::StorageFull);
    }
}
