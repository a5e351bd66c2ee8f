//! How bodies may be coded: those of answers as `Accept-Encoding` allows, those of requests not at all.

use crate::http::error::{ApiError, Code};
use axum::extract::Request;
use axum::http::{HeaderMap, HeaderValue, Method, header};
use axum::middleware::Next;
use axum::response::Response;

/// Answers in gzip where the client takes no plain body, and plain where it takes neither. The compression would refuse the latter
/// with 406, and only after the request was done.
pub async fn choose(mut request: Request, next: Next) -> Response {
    match Accepted::of(request.headers()) {
        Accepted { plain: true, .. } => {}
        Accepted { gzip: true, .. } => {
            request.headers_mut().insert(header::ACCEPT_ENCODING, HeaderValue::from_static("gzip"));
        }
        _ => {
            request.headers_mut().remove(header::ACCEPT_ENCODING);
        }
    }
    next.run(request).await
}

/// What `Accept-Encoding` takes of what there is (RFC 9110, 12.5.3).
#[derive(Debug, PartialEq, Eq)]
struct Accepted {
    plain: bool,
    gzip: bool,
}

impl Accepted {
    /// What is not named is taken, unless `*` refuses it.
    fn of(headers: &HeaderMap) -> Self {
        let values = headers.get_all(header::ACCEPT_ENCODING).iter().filter_map(|value| value.to_str().ok());
        let (mut plain, mut gzip, mut others) = (None, None, None);
        for coding in values.flat_map(|value| value.split(',')) {
            let (name, weight) = coding.split_once(';').unwrap_or((coding, ""));
            let weight = weight.trim().strip_prefix("q=").map(str::trim);
            let taken = weight.and_then(|weight| weight.parse::<f32>().ok()).is_none_or(|weight| weight > 0.0);
            match name.trim().to_ascii_lowercase().as_str() {
                "identity" => plain = Some(taken),
                "gzip" | "x-gzip" => gzip = Some(taken),
                "*" => others = Some(taken),
                _ => {}
            }
        }
        let taken = |named: Option<bool>| named.or(others).unwrap_or(true);
        Self { plain: taken(plain), gzip: taken(gzip) }
    }
}

/// Refuses an upload that is only a part of a file, or is coded: its bytes are stored as they come.
pub fn require_as_it_is(method: &Method, headers: &HeaderMap) -> Result<(), ApiError> {
    if method == Method::PUT && headers.contains_key(header::CONTENT_RANGE) {
        let what =
            "`PUT` takes whole files, and `content-range` tells of a part; send files in parts by tus, POST …/uploads";
        return Err(ApiError::new(Code::BadRequest, what));
    }
    let codings = headers.get_all(header::CONTENT_ENCODING).iter();
    if codings.into_iter().any(|coding| !coding.as_bytes().eq_ignore_ascii_case(b"identity")) {
        let what = "bytes are stored as they come: send the file itself, without `content-encoding`";
        return Err(ApiError::new(Code::UnsupportedMediaType, what));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn accept_encoding_is_parsed() {
        for (header, plain, gzip) in [
            ("", true, true),
            ("gzip, br", true, true),
            ("identity;q=0", false, true),
            ("identity; q=0.0, gzip", false, true),
            ("*;q=0", false, false),
            ("*;q=0, gzip;q=0.5", false, true),
            ("*;q=0, IDENTITY", true, false),
            ("gzip;q=0, identity;q=0", false, false),
        ] {
            let headers = HeaderMap::from_iter([(header::ACCEPT_ENCODING, HeaderValue::from_static(header))]);
            assert_eq!(Accepted::of(&headers), Accepted { plain, gzip }, "{header}");
        }
        assert_eq!(Accepted::of(&HeaderMap::new()), Accepted { plain: true, gzip: true });
    }
}
