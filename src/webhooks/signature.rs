//! How messages are signed: HMAC-SHA256 (RFC 2104) over the time and the body, so that a receiver knows who sent them and
//! that they are not sent again by someone who overheard them.

use crate::store::SigningSecret;
use jiff::{SignedDuration, Timestamp};
use ring::hmac;

/// The header with the signature: `t=` the seconds since 1970, `v1=` the signature in hexadecimal digits.
pub const HEADER: &str = "heliomap-signature";

fn key(secret: &SigningSecret) -> hmac::Key {
    hmac::Key::new(hmac::HMAC_SHA256, secret.reveal().as_bytes())
}

/// What is signed.
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

/// Whether a header's value is a signature of a body, made at most `patience` before or after now.
pub fn verify(secret: &SigningSecret, header: &str, body: &[u8], now: Timestamp, patience: SignedDuration) -> bool {
    let member = |name: &str| header.split(',').find_map(|pair| pair.trim().strip_prefix(name)?.strip_prefix('='));
    let Some((seconds, digits)) = member("t").and_then(|text| text.parse::<i64>().ok()).zip(member("v1")) else {
        return false;
    };
    let pair = |at: usize| digits.get(at..at + 2).and_then(|pair| u8::from_str_radix(pair, 16).ok());
    let Some(given) = (0..digits.len()).step_by(2).map(pair).collect::<Option<Vec<u8>>>() else { return false };
    let near = now.as_second().abs_diff(seconds) <= patience.as_secs().unsigned_abs();
    near && hmac::verify(&key(secret), &signed(seconds, body), &given).is_ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_signed_verifies_and_nothing_else() {
        let secret = SigningSecret::given("0123456789abcdef").unwrap();
        let (now, patience) = (Timestamp::from_second(1_000).unwrap(), SignedDuration::from_mins(5));
        let header = sign(&secret, now, b"{}");
        // As `printf '1000.{}' | openssl dgst -sha256 -hmac 0123456789abcdef` prints it.
        assert_eq!(header, "t=1000,v1=bd3e8b6d13803a2406a848a68bc7a2e80b251fb9d894858564c77ce80a4aa634");
        assert!(verify(&secret, &header, b"{}", now, patience));
        assert!(verify(&secret, &header, b"{}", now + patience, patience));
        assert!(!verify(&secret, &header, b"{}", now + SignedDuration::from_mins(6), patience));
        assert!(!verify(&secret, &header, b"{ }", now, patience));
        let other = SigningSecret::given("0123456789abcdeF").unwrap();
        assert!(!verify(&other, &header, b"{}", now, patience));
        for wrong in
            ["", "t=1000", "t=1000,v1=", "t=1000,v1=zz", "t=1000,v1=\u{e9}\u{e9}", &header.replace("1000", "1001")]
        {
            assert!(!verify(&secret, wrong, b"{}", now, patience), "{wrong}");
        }
    }
}
