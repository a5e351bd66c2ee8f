//! A place in an S3-compatible store.

use super::error::StoreError;
use object_store::aws::{AmazonS3Builder, AmazonS3ConfigKey};
use object_store::path::Path as Key;
use object_store::prefix::PrefixStore;
use object_store::{ObjectStore, RetryConfig};
use std::str::FromStr;
use std::sync::Arc;
use std::time::Duration;

/// How often, and for how long, a request that failed for what may pass is sent again.
const RETRIES: usize = 6;
const RETRY_FOR: Duration = Duration::from_secs(30);

/// A bucket, and the part of it that is ours.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Bucket {
    pub name: String,
    /// What the keys of all our objects begin with; empty where the whole bucket is ours.
    pub prefix: String,
}

impl FromStr for Bucket {
    type Err = String;

    /// Reads `s3://BUCKET` or `s3://BUCKET/PREFIX`.
    fn from_str(text: &str) -> Result<Self, String> {
        let expected = "s3://BUCKET or s3://BUCKET/PREFIX is expected, such as s3://plants/heliomap";
        let rest = text.strip_prefix("s3://").ok_or(expected)?;
        let (name, prefix) = rest.split_once('/').unwrap_or((rest, ""));
        // The rule of names, without which a name could reach into the rest of the URL.
        let fits = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || matches!(c, '-' | '.');
        if !(3..=63).contains(&name.len()) || !name.chars().all(fits) {
            return Err(format!("`{name}` is no name of a bucket (3 to 63 of a-z, 0-9, dot and hyphen); {expected}"));
        }
        let prefix = prefix.trim_end_matches('/');
        if !prefix.is_empty() {
            Key::parse(prefix).map_err(|_| format!("`{prefix}` cannot be the beginning of keys; {expected}"))?;
        }
        Ok(Self { name: name.to_owned(), prefix: prefix.to_owned() })
    }
}

impl Bucket {
    /// The store that this place is, with endpoint, region and credentials as in `settings`. An endpoint that begins with
    /// `http://` is spoken to in the clear. Buckets are named in the path unless the settings say otherwise, as most
    /// S3-compatible stores have it.
    ///
    /// # Errors
    /// Settings that do not go together, such as half of a pair of keys.
    pub fn open(&self, settings: AmazonS3Builder) -> Result<Arc<dyn ObjectStore>, StoreError> {
        crate::tls::provide();
        let endpoint = |key| settings.get_config_value(&key);
        let endpoint = endpoint(AmazonS3ConfigKey::S3Endpoint).or_else(|| endpoint(AmazonS3ConfigKey::Endpoint));
        let settings = match endpoint {
            Some(endpoint) if endpoint.starts_with("http://") => settings.with_allow_http(true),
            _ => settings,
        };
        let retry = RetryConfig { max_retries: RETRIES, retry_timeout: RETRY_FOR, ..RetryConfig::default() };
        let store = settings.with_bucket_name(&self.name).with_retry(retry).build()?;
        Ok(match self.prefix.as_str() {
            "" => Arc::new(store),
            prefix => Arc::new(PrefixStore::new(store, Key::parse(prefix).map_err(object_store::Error::from)?)),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places() {
        let place = |name: &str, prefix: &str| Ok(Bucket { name: name.to_owned(), prefix: prefix.to_owned() });
        assert_eq!("s3://plants".parse(), place("plants", ""));
        assert_eq!("s3://plants/".parse(), place("plants", ""));
        assert_eq!("s3://plants/a/b/".parse(), place("plants", "a/b"));
        for wrong in
            ["", "plants", "s3://", "s3:///a", "s3://Plants", "s3://pl@host/a", "s3://plants/a//b", "s3://plants/../a"]
        {
            let error = wrong.parse::<Bucket>().unwrap_err();
            assert!(error.contains("s3://BUCKET"), "{wrong}: {error}");
        }
    }

    #[test]
    fn half_of_a_pair_of_keys_is_refused() {
        let bucket: Bucket = "s3://plants".parse().unwrap();
        assert!(bucket.open(AmazonS3Builder::new().with_access_key_id("id")).is_err());
    }
}
