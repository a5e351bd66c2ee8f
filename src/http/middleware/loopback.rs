//! A service that asks for no keys is for programs and people of its own machine, and not for whatever page one of them looks
//! at: neither one whose name was made to lead here (DNS rebinding), nor a form or script of another site.

use crate::config::NetworkArgs;
use crate::http::error::{ApiError, Code};
use crate::http::middleware::access::refuse;
use axum::extract::{Request, State};
use axum::http::uri::Authority;
use axum::http::{HeaderMap, HeaderValue, Method, header};
use axum::middleware::Next;
use axum::response::Response;
use std::net::IpAddr;
use std::sync::Arc;

/// Lets a request through that names this machine and comes from no other site.
pub async fn only(State(network): State<Arc<NetworkArgs>>, request: Request, next: Next) -> Response {
    let problem = if !names_this_machine(request.headers()) {
        "without keys the service answers on this machine alone, as localhost or by a loopback address"
    } else if changes(request.method()) && is_cross_site(request.headers(), &network) {
        "without keys nothing is changed for pages of other sites; `--cors-origin` lets those of one in"
    } else {
        return next.run(request).await;
    };
    refuse(request, ApiError::new(Code::Forbidden, problem)).await
}

/// Whether the host that a request names is this machine. One that names none comes from no browser.
fn names_this_machine(headers: &HeaderMap) -> bool {
    headers.get(header::HOST).is_none_or(|host| is_this_machine(host.as_bytes()))
}

/// Whether a host, perhaps with a port, is this machine.
fn is_this_machine(host: &[u8]) -> bool {
    let Ok(authority) = Authority::try_from(host) else { return false };
    let host = authority.host().trim_start_matches('[').trim_end_matches(']').to_ascii_lowercase();
    let by_name = host == "localhost" || host.ends_with(".localhost");
    by_name || host.parse::<IpAddr>().is_ok_and(|address| address.is_loopback())
}

fn changes(method: &Method) -> bool {
    !matches!(*method, Method::GET | Method::HEAD | Method::OPTIONS)
}

/// Whether a browser says that a page of another site sends a request, and not one that is let in. Old ones send the page's
/// origin alone.
fn is_cross_site(headers: &HeaderMap, network: &NetworkArgs) -> bool {
    let origin = headers.get(header::ORIGIN);
    if origin.is_some_and(|origin| network.cors_origin.contains(origin)) {
        return false;
    }
    let elsewhere = |origin: &HeaderValue| {
        let host = origin.as_bytes().splitn(3, |byte| *byte == b'/').nth(2);
        !host.is_some_and(is_this_machine)
    };
    headers.get("sec-fetch-site").is_some_and(|site| site == "cross-site") || origin.is_some_and(elsewhere)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hosts() {
        let names = |host: &'static str| {
            names_this_machine(&HeaderMap::from_iter([(header::HOST, HeaderValue::from_static(host))]))
        };
        for host in
            ["localhost", "LOCALHOST:8080", "plant.localhost", "127.0.0.1:8080", "127.1.2.3", "[::1]:8080", "[::1]"]
        {
            assert!(names(host), "{host}");
        }
        for host in
            ["evil.example", "localhost.evil.example", "127.0.0.1.evil.example", "192.168.1.7", "0.0.0.0", "", "[::2]"]
        {
            assert!(!names(host), "{host}");
        }
        assert!(names_this_machine(&HeaderMap::new()));
    }

    #[test]
    fn origins() {
        let network = NetworkArgs::default();
        for (origin, elsewhere) in [
            ("http://localhost:5173", false),
            ("http://127.0.0.1:8080", false),
            ("https://evil.example", true),
            ("http://localhost.evil.example", true),
            ("null", true),
            ("", true),
        ] {
            let headers = HeaderMap::from_iter([(header::ORIGIN, HeaderValue::from_static(origin))]);
            assert_eq!(is_cross_site(&headers, &network), elsewhere, "{origin}");
        }
    }
}
