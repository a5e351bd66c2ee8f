//! Secrets of keys.

use super::access::SecretRecord;
use super::digest::Digest;
use std::fmt;

/// Marks a secret of this service, so that scanners recognise a leaked one.
const MARK: &str = "hm_";
const RANDOM_BYTES: usize = 32;
/// Length of the visible beginning of a secret.
const PREFIX: usize = MARK.len() + 8;

/// A key's secret: `hm_` and 64 hexadecimal digits. It is shown once and not stored.
#[derive(Clone)]
pub struct Secret(String);

impl Secret {
    /// A new one, of the operating system's randomness.
    pub fn random() -> Result<Self, getrandom::Error> {
        let mut bytes = [0; RANDOM_BYTES];
        getrandom::fill(&mut bytes)?;
        Ok(Self(format!("{MARK}{}", Digest(bytes))))
    }

    /// The record to be stored.
    pub fn record(&self) -> SecretRecord {
        SecretRecord { sha256: Digest::of(self.0.as_bytes()), prefix: self.0[..PREFIX].to_owned() }
    }

    /// The secret itself, to be shown once.
    pub fn reveal(&self) -> &str {
        &self.0
    }
}

/// Shows only the beginning of the secret.
impl fmt::Debug for Secret {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Secret({}…)", &self.0[..PREFIX])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn secrets_differ_and_are_not_printed() {
        let (one, other) = (Secret::random().unwrap(), Secret::random().unwrap());
        assert_ne!(one.reveal(), other.reveal());
        assert_eq!(one.reveal().len(), MARK.len() + 2 * RANDOM_BYTES);
        assert!(!format!("{one:?}").contains(&one.reveal()[PREFIX..]));
        assert!(one.reveal().starts_with(&one.record().prefix));
        assert_eq!(one.record().sha256, Digest::of(one.reveal().as_bytes()));
    }
}
