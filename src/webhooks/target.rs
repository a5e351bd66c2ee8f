//! Where messages may go. A webhook names an address that this service then connects to from within its own network (server-side
//! request forgery). By default only public addresses are accepted. They are checked when the connection is made, since
//! a name may resolve to another address by then.

use reqwest::Url;
use reqwest::dns::{Addrs, Name, Resolve, Resolving};
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};

/// Longest URL, bytes.
const MAX_URL_BYTES: usize = 2000;

/// Which addresses messages may go to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Targets {
    /// Public ones, by TLS.
    #[default]
    Public,
    /// Any, this machine's and its network's included, and without TLS.
    Any,
}

/// Why messages do not go to a URL.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
pub enum TargetError {
    #[error("the URL cannot be read: {0}")]
    Unreadable(String),
    #[error("the URL is longer than 2000 bytes")]
    TooLong,
    #[error("the URL must begin with https://")]
    NotHttps,
    #[error("the URL holds a user name or a password; put a secret into its path or rely on the signature")]
    Credentials,
    #[error("the URL leads to {0}, which is not a public address")]
    Private(IpAddr),
    #[error("{0} leads to no public address")]
    PrivateName(String),
}

impl Targets {
    /// Public targets alone, or private ones as well.
    pub fn allowing_private(private: bool) -> Self {
        if private { Self::Any } else { Self::Public }
    }

    /// Reads a URL that messages may go to. A name is looked up only when a message is sent.
    pub fn check(self, url: &str) -> Result<Url, TargetError> {
        if url.len() > MAX_URL_BYTES {
            return Err(TargetError::TooLong);
        }
        let url = Url::parse(url).map_err(|error| TargetError::Unreadable(error.to_string()))?;
        match (url.scheme(), self) {
            ("https", _) | ("http", Self::Any) => {}
            _ => return Err(TargetError::NotHttps),
        }
        if !url.username().is_empty() || url.password().is_some() {
            return Err(TargetError::Credentials);
        }
        let host = url.host_str().unwrap_or_default();
        let address = host.trim_start_matches('[').trim_end_matches(']').parse::<IpAddr>();
        match address {
            Ok(address) if self == Self::Public && !is_public(address) => Err(TargetError::Private(address)),
            Err(_) if self == Self::Public && is_local_name(host) => Err(TargetError::PrivateName(host.to_owned())),
            _ => Ok(url),
        }
    }
}

/// Whether a host's name is one of this machine or its network, whatever it leads to: without a dot, or of a domain that is
/// reserved for that (RFC 6761, 6762, 8375, and `internal` by ICANN).
fn is_local_name(host: &str) -> bool {
    let host = host.trim_end_matches('.').to_ascii_lowercase();
    let is_of = |domain: &str| host.strip_suffix(domain).is_some_and(|rest| rest.is_empty() || rest.ends_with('.'));
    !host.contains('.') || ["localhost", "local", "internal", "home.arpa"].into_iter().any(is_of)
}

impl Resolve for Targets {
    fn resolve(&self, name: Name) -> Resolving {
        let targets = *self;
        Box::pin(async move {
            let found = tokio::net::lookup_host((name.as_str(), 0)).await?;
            let allowed: Vec<SocketAddr> =
                found.filter(|address| targets == Self::Any || is_public(address.ip())).collect();
            if allowed.is_empty() {
                return Err(TargetError::PrivateName(name.as_str().to_owned()).into());
            }
            Ok(Box::new(allowed.into_iter()) as Addrs)
        })
    }
}

/// Whether an address is one of the public internet, by IANA's registries of special addresses.
fn is_public(address: IpAddr) -> bool {
    match address {
        IpAddr::V4(address) => is_public_v4(address),
        IpAddr::V6(address) => is_public_v6(address),
    }
}

fn is_public_v4(address: Ipv4Addr) -> bool {
    let [a, b, c, _] = address.octets();
    let special = address.is_private()
        || address.is_loopback()
        || address.is_link_local()
        || address.is_documentation()
        || address.is_multicast()
        || a == 0
        || a >= 240
        // Between a provider and its customers (RFC 6598).
        || (a == 100 && (64..128).contains(&b))
        // Assignments of the IETF, the former relays of 6to4, and measurements (RFC 6890, 7526, 2544).
        || (a, b, c) == (192, 0, 0)
        || (a, b, c) == (192, 88, 99)
        || (a == 198 && (18..20).contains(&b));
    !special
}

fn is_public_v6(address: Ipv6Addr) -> bool {
    if let Some(address) = address.to_ipv4_mapped() {
        return is_public_v4(address);
    }
    let words = address.segments();
    let within = |high: u16, low: u16| Ipv4Addr::from((u32::from(high) << 16) | u32::from(low));
    match words {
        // Translated to IPv4 by the network (RFC 6052), or carried in it (6to4, RFC 3056).
        [0x64, 0xff9b, 0, 0, 0, 0, high, low] => is_public_v4(within(high, low)),
        [0x2002, high, low, ..] => is_public_v4(within(high, low)),
        // Teredo, benchmarks and other assignments of the IETF (RFC 2928), and documentation.
        [0x2001, 0..0x200, ..] | [0x2001, 0xdb8, ..] | [0x3fff, 0..0x1000, ..] => false,
        // What is given out to networks.
        [first, ..] => first & 0xe000 == 0x2000,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_public_addresses_are_public() {
        let public = |text: &str| is_public(text.parse().unwrap());
        for address in [
            "8.8.8.8",
            "100.63.0.1",
            "172.32.0.1",
            "198.20.0.1",
            "2606:4700::1111",
            "::ffff:8.8.8.8",
            "64:ff9b::808:808",
        ] {
            assert!(public(address), "{address}");
        }
        for address in [
            "0.0.0.0",
            "127.0.0.1",
            "127.8.8.8",
            "10.1.2.3",
            "172.16.0.1",
            "192.168.1.1",
            "169.254.169.254",
            "100.64.0.1",
            "192.0.0.8",
            "192.0.2.1",
            "198.18.0.1",
            "224.0.0.1",
            "240.0.0.1",
            "255.255.255.255",
            "::",
            "::1",
            "fe80::1",
            "fec0::1",
            "fd00::1",
            "ff02::1",
            "::ffff:127.0.0.1",
            "::ffff:a00:1",
            "64:ff9b::7f00:1",
            "2002:7f00:1::",
            "2001::1",
            "2001:db8::1",
            "::7f00:1",
        ] {
            assert!(!public(address), "{address}");
        }
    }

    #[test]
    fn urls() {
        let public = |url: &str| Targets::Public.check(url);
        assert!(public("https://example.org/hook?token=1").is_ok() && public("https://8.8.8.8:8443/").is_ok());
        assert_eq!(public("http://example.org/"), Err(TargetError::NotHttps));
        assert_eq!(public("ftp://example.org/"), Err(TargetError::NotHttps));
        assert_eq!(public("https://me:pw@example.org/"), Err(TargetError::Credentials));
        assert!(matches!(public("example.org"), Err(TargetError::Unreadable(_))));
        assert_eq!(public(&format!("https://example.org/{}", "x".repeat(2000))), Err(TargetError::TooLong));
        // However it is written.
        for host in
            ["127.0.0.1", "2130706433", "0x7f.1", "017700000001", "[::1]", "[::ffff:127.0.0.1]", "169.254.169.254"]
        {
            let refused = public(&format!("https://{host}/"));
            assert!(matches!(refused, Err(TargetError::Private(_))), "{host}: {refused:?}");
        }
        for host in ["localhost", "LOCALHOST.", "a.localhost", "nas.local", "intranet", "metadata.google.internal"] {
            let refused = public(&format!("https://{host}/x"));
            assert!(matches!(refused, Err(TargetError::PrivateName(_))), "{host}: {refused:?}");
        }
        assert!(public("https://notlocal.example.org/").is_ok());
        assert!(
            Targets::Any.check("http://127.0.0.1:8080/").is_ok() && Targets::Any.check("http://localhost/").is_ok()
        );
    }

    #[tokio::test]
    async fn names_of_this_machine_are_refused() {
        let resolve = |targets: Targets| targets.resolve("localhost".parse().unwrap());
        let refused = resolve(Targets::Public).await.err().unwrap().to_string();
        assert_eq!(refused, "localhost leads to no public address");
        assert!(resolve(Targets::Any).await.unwrap().all(|address| address.ip().is_loopback()));
    }
}
