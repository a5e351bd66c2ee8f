//! Signatures of messages: HMAC-SHA256 (RFC 2104) over time and body. A receiver can check the sender and refuse replays.

use crate::store::SigningSecret;
use jiff::Timestamp;
use ring::hmac;

/// The header with the signature: `t=` the seconds since 1970, `v1=` the signature in hexadecimal digits.
pub const HEADER: &str = "heliomap-signature";

fn key(secret: &SigningSecret) -> hmac::Key {
    hmac::Key::new(hmac::HMAC_SHA256, secret.reveal().as_bytes())
}

/// The bytes that are signed.
fn signed(seconds: i64, body: &[u8]) -> Vec<u8> {
    [format!("{seconds}.").as_bytes(), body].concat()
}

/// The header's value for a body that is sent now.
pub fn sign(secret: &SigningSecret, now: Timestamp, body: &[u8]) -> String {
    let seconds = now.as_second();
    let tag = hmac::sign(&key(secret), &signed(seconds, body));
    let digits: String = tag.as_ref().iter().map(|byte| format!("{byte:02x}")).collect();
    format!("t={seconds},v1={digits}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_signature_is_what_openssl_computes() {
        let secret = SigningSecret::given("0123456789abcdef").unwrap();
        let header = sign(&secret, Timestamp::from_second(1_000).unwrap(), b"{}");
        // printf '1000.{}' | openssl dgst -sha256 -hmac 0123456789abcdef
        assert_eq!(header, "t=1000,v1=bd3e8b6d13803a2406a848a68bc7a2e80b251fb9d894858564c77ce80a4aa634");
    }
}
