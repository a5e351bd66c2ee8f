//! Whether a file came as it was sent: `Repr-Digest` and `Content-Digest` (RFC 9530), which are the same here.

use crate::http::error::{ApiError, Code};
use crate::store::Digest;
use axum::http::HeaderMap;
use base64::Engine;
use base64::prelude::BASE64_STANDARD;

/// Refuses bytes that are not those whose SHA-256 digest the headers tell. Other algorithms are ignored, as the RFC asks.
pub fn require(headers: &HeaderMap, sha256: &Digest) -> Result<(), ApiError> {
    for name in ["repr-digest", "content-digest"] {
        for value in headers.get_all(name) {
            let wrong = || ApiError::new(Code::BadRequest, format!("{name} must look like `sha-256=:BASE64:`"));
            for member in value.to_str().map_err(|_| wrong())?.split(',') {
                let Some(told) = member.trim().strip_prefix("sha-256=") else { continue };
                let told = told.strip_prefix(':').and_then(|told| told.strip_suffix(':')).ok_or_else(wrong)?;
                if BASE64_STANDARD.decode(told).map_err(|_| wrong())? != sha256.0 {
                    let what =
                        format!("what came has the SHA-256 digest {sha256}, not the one in {name}; send it again");
                    return Err(ApiError::new(Code::ChecksumMismatch, what));
                }
            }
        }
    }
    Ok(())
}
