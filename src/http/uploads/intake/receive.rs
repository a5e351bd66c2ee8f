//! From the network to a file, within bounds.

use super::{disk, too_large};
use crate::http::error::{ApiError, Code};
use crate::store::{Digest, StagedFile};
use axum::http::{HeaderMap, header};
use bytes::Bytes;
use futures::{Stream, StreamExt};
use sha2::Digest as _;
use std::path::Path;
use std::time::Duration;
use tokio::io::{AsyncWriteExt, BufWriter};

/// How much may come in and how long it may stand still.
#[derive(Debug, Clone, Copy)]
pub struct Bounds<'a> {
    /// What the file is called where something is wrong with it.
    pub name: &'a str,
    pub max_bytes: u64,
    pub idle: Duration,
}

/// Streams a body to a file of its own in `folder`; the file is whole and synced when this returns.
pub async fn receive<S, E>(mut body: S, folder: &Path, bounds: Bounds<'_>) -> Result<StagedFile, ApiError>
where
    S: Stream<Item = Result<Bytes, E>> + Unpin,
    E: std::fmt::Display,
{
    let (file, path) = tempfile::Builder::new()
        .prefix("upload-")
        .tempfile_in(folder)
        .map_err(|error| disk(folder, error))?
        .into_parts();
    let mut writer = BufWriter::with_capacity(256 << 10, tokio::fs::File::from_std(file));
    let mut hasher = sha2::Sha256::new();
    let mut size = 0;
    loop {
        let chunk = match tokio::time::timeout(bounds.idle, body.next()).await {
            Err(_) => {
                return Err(ApiError::new(
                    Code::UploadStalled,
                    format!("nothing of {} came for {} s; send it again", bounds.name, bounds.idle.as_secs_f64()),
                ));
            }
            Ok(None) => break,
            Ok(Some(Err(error))) => {
                tracing::debug!(%error, file = bounds.name, "upload interrupted");
                return Err(ApiError::new(
                    Code::UploadInterrupted,
                    format!(
                        "{} came in part only after {size} bytes; nothing of it was stored, send it again",
                        bounds.name
                    ),
                ));
            }
            Ok(Some(Ok(chunk))) => chunk,
        };
        size += chunk.len() as u64;
        if size > bounds.max_bytes {
            return Err(too_large(bounds.name, bounds.max_bytes));
        }
        hasher.update(&chunk);
        writer.write_all(&chunk).await.map_err(|error| disk(&path, error))?;
    }
    writer.flush().await.map_err(|error| disk(&path, error))?;
    writer.get_ref().sync_all().await.map_err(|error| disk(&path, error))?;
    Ok(StagedFile { path, size, sha256: Digest(hasher.finalize().into()) })
}

/// Whether a client waits to be asked for the body of its request (`Expect: 100-continue`, RFC 9110, 10.1.1): the first look
/// at the body asks for it.
pub fn waits_to_be_asked(headers: &HeaderMap) -> bool {
    headers.get_all(header::EXPECT).iter().any(|value| value.as_bytes().eq_ignore_ascii_case(b"100-continue"))
}

/// Takes the rest of a refused body, within reason: a client that is still sending when the connection closes does not
/// get to read why.
pub async fn drain<S, E>(mut body: S, problem: &ApiError)
where
    S: Stream<Item = Result<Bytes, E>> + Unpin,
{
    if matches!(problem.code, Code::UploadStalled | Code::UploadInterrupted) {
        return;
    }
    const MOST: usize = 16 << 20;
    let rest = async {
        let mut size = 0;
        while let Some(Ok(chunk)) = body.next().await {
            size += chunk.len();
            if size > MOST {
                break;
            }
        }
    };
    let _ = tokio::time::timeout(Duration::from_secs(5), rest).await;
}
