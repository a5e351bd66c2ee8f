//! The web page, embedded in the program.

use crate::http::error::{ApiError, Code};
use axum::http::{HeaderName, Method, Uri, header};
use axum::response::{Html, IntoResponse, Response};
use rust_embed::RustEmbed;

#[derive(RustEmbed)]
#[folder = "web/dist"]
#[allow_missing = true]
struct Page;

/// Where the program was built without the page.
const PLAIN: &str = "<!doctype html><html lang=en><meta charset=utf-8><title>heliomap</title>\
    <h1>heliomap</h1><p>This service maps photovoltaic plants from drone overview photos. \
    It was built without its web page; the API works: see <a href=/openapi.yaml>its description</a>, \
    <a href=/api/v1/plants>the plants</a>, and <code>docs/API.md</code>.</p></html>";

/// The page keeps a key: it runs no script, loads nothing and tells nothing but from and to where it came from, and stands
/// in no frame. The map draws pictures that it makes itself.
const GUARDED: [(HeaderName, &str); 3] = [
    (
        header::CONTENT_SECURITY_POLICY,
        "default-src 'none'; script-src 'self'; worker-src 'self' blob:; style-src 'self'; img-src 'self' data: blob:; \
         connect-src 'self' blob:; base-uri 'none'; form-action 'self'; frame-ancestors 'none'",
    ),
    (header::X_FRAME_OPTIONS, "DENY"),
    (header::REFERRER_POLICY, "no-referrer"),
];

/// A file of the page, or a problem.
pub async fn serve(method: Method, uri: Uri) -> Response {
    let path = match uri.path().trim_start_matches('/') {
        "" => "index.html",
        path => path,
    };
    match Page::get(path) {
        Some(_) if method != Method::GET && method != Method::HEAD => {
            let problem = ApiError::new(Code::MethodNotAllowed, "the page can only be read: use GET");
            ([(header::ALLOW, "GET,HEAD")], problem).into_response()
        }
        Some(file) => {
            // Built files carry a digest in their names.
            let caching = if path.starts_with("assets/") { "public, max-age=31536000, immutable" } else { "no-cache" };
            let headers = [
                (header::CONTENT_TYPE, file.metadata.mimetype().to_owned()),
                (header::CACHE_CONTROL, caching.to_owned()),
            ];
            (headers, GUARDED, file.data).into_response()
        }
        None if path == "index.html" && method == Method::GET => (GUARDED, Html(PLAIN)).into_response(),
        None => ApiError::new(
            Code::NotFound,
            format!("{method} {} leads nowhere; /openapi.yaml tells what this service offers", uri.path()),
        )
        .into_response(),
    }
}
