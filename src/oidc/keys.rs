//! The provider's public keys: found by its discovery document, cached, and fetched again when a token names an unknown key.
//! Fetches are rate-limited, since anyone may send such a token.

use jsonwebtoken::jwk::{AlgorithmParameters, EllipticCurve, Jwk, PublicKeyUse};
use jsonwebtoken::{Algorithm, DecodingKey};
use reqwest::{Client, Url, redirect};
use serde::Deserialize;
use serde_json::Value;
use std::sync::{Arc, PoisonError, RwLock};
use std::time::{Duration, Instant};
use tokio::sync::Mutex;

/// Age up to which keys are used without a new fetch.
const FRESH: Duration = Duration::from_secs(3600);
/// Age up to which keys are used while the provider does not answer.
const MAX_AGE: Duration = Duration::from_secs(24 * 3600);
/// Time limit of a fetch.
const TIMEOUT: Duration = Duration::from_secs(5);
/// Maximum size of an answer of the provider, bytes.
const MAX_BYTES: usize = 256 << 10;
/// Maximum number of keys.
const MAX_KEYS: usize = 100;

/// Why there are no keys.
#[derive(Debug, Clone, thiserror::Error)]
pub enum KeyError {
    #[error("cannot fetch keys from {url}: the URL must begin with https://, or name this machine")]
    Url { url: String },
    #[error("cannot send requests: {0}; install the certificates of public authorities")]
    Client(String),
    #[error("{url}: {what}")]
    Fetch { url: String, what: String },
}

/// A public key of the provider.
#[derive(Debug, Clone)]
struct Known {
    id: Option<String>,
    algorithm: Algorithm,
    key: DecodingKey,
}

#[derive(Debug, Default)]
struct Kept {
    keys: Vec<Known>,
    /// When they were fetched.
    fetched: Option<Instant>,
    /// When a fetch was last tried.
    tried: Option<Instant>,
    /// Why the last fetch failed, where it did.
    failure: Option<KeyError>,
}

/// How old keys may be.
#[derive(Debug, Clone, Copy)]
pub struct Ages {
    /// Minimum time between two fetches.
    pub min_refresh: Duration,
    /// Age up to which keys are used without a new fetch.
    pub fresh: Duration,
    /// Age from which keys are not used.
    pub max: Duration,
}

impl Ages {
    /// Default ages, with a minimum time between two fetches.
    pub fn with_min_refresh(min_refresh: Duration) -> Self {
        Self { min_refresh, fresh: FRESH, max: MAX_AGE }
    }
}

/// The provider's keys.
#[derive(Debug)]
pub struct Keys {
    issuer: String,
    discovery: Url,
    client: Client,
    ages: Ages,
    /// Held during a fetch.
    turn: Mutex<()>,
    kept: RwLock<Arc<Kept>>,
}

impl Kept {
    fn is_younger(&self, age: Duration) -> bool {
        self.fetched.is_some_and(|fetched| fetched.elapsed() < age)
    }
}

/// The discovery document (OpenID Connect Discovery 1.0, section 3).
#[derive(Deserialize)]
struct Discovery {
    issuer: String,
    jwks_uri: String,
}

#[derive(Deserialize)]
struct KeySet {
    keys: Vec<Value>,
}

impl Keys {
    /// The keys of an issuer; nothing is fetched yet.
    pub fn new(issuer: &str, ages: Ages) -> Result<Self, KeyError> {
        let discovery = checked(&format!("{}/.well-known/openid-configuration", issuer.trim_end_matches('/')))?;
        crate::tls::provide();
        let client = Client::builder().timeout(TIMEOUT).redirect(redirect::Policy::none()).build();
        let client = client.map_err(|error| KeyError::Client(error.to_string()))?;
        let (turn, kept) = (Mutex::default(), RwLock::default());
        Ok(Self { issuer: issuer.to_owned(), discovery, client, ages, turn, kept })
    }

    /// The key of this identifier for this algorithm; without an identifier, the only key for the algorithm. A cached key is
    /// returned at once; where it is not fresh, keys are fetched in the background.
    pub async fn key(
        self: &Arc<Self>,
        id: Option<&str>,
        algorithm: Algorithm,
    ) -> Result<Option<DecodingKey>, KeyError> {
        let known = self.kept();
        if let Some(key) = pick(&known.keys, id, algorithm).filter(|_| known.is_younger(self.ages.max)) {
            let asked = self.turn.try_lock().is_err() || self.tried_lately(&known);
            if !known.is_younger(self.ages.fresh) && !asked {
                let keys = self.clone();
                tokio::spawn(async move { keys.refresh_unless_lately().await });
            }
            return Ok(Some(key));
        }
        // Concurrent callers wait for the same fetch.
        self.refresh_unless_lately().await;
        let known = self.kept();
        let holds = known.is_younger(self.ages.max);
        match &known.failure {
            Some(failure) if !holds => Err(failure.clone()),
            _ => Ok(pick(&known.keys, id, algorithm).filter(|_| holds)),
        }
    }

    fn tried_lately(&self, kept: &Kept) -> bool {
        kept.tried.is_some_and(|tried| tried.elapsed() < self.ages.min_refresh)
    }

    async fn refresh_unless_lately(&self) {
        let _turn = self.turn.lock().await;
        if !self.tried_lately(&self.kept()) {
            // The reason of a failure is kept in `failure`.
            let _ = self.refresh().await;
        }
    }

    fn kept(&self) -> Arc<Kept> {
        self.kept.read().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Fetches the keys; how many there are.
    pub async fn refresh(&self) -> Result<usize, KeyError> {
        let (before, tried) = (self.kept(), Some(Instant::now()));
        let fetched = self.fetch().await;
        let kept = match &fetched {
            Ok(keys) => {
                tracing::info!(issuer = self.issuer, count = keys.len(), "fetched the identity provider's keys");
                Kept { keys: keys.clone(), fetched: Some(Instant::now()), tried, failure: None }
            }
            Err(error) => {
                tracing::warn!(%error, "cannot fetch the identity provider's keys");
                Kept { keys: before.keys.clone(), fetched: before.fetched, tried, failure: Some(error.clone()) }
            }
        };
        *self.kept.write().unwrap_or_else(PoisonError::into_inner) = Arc::new(kept);
        fetched.map(|keys| keys.len())
    }

    async fn fetch(&self) -> Result<Vec<Known>, KeyError> {
        let discovery: Discovery = self.get(self.discovery.clone()).await?;
        if discovery.issuer != self.issuer {
            let what = format!("its issuer is `{}`, not `{}`", discovery.issuer, self.issuer);
            return Err(KeyError::Fetch { url: self.discovery.to_string(), what });
        }
        let set: KeySet = self.get(checked(&discovery.jwks_uri)?).await?;
        // Keys for other purposes or of unknown kinds are skipped.
        let keys = set.keys.into_iter().take(MAX_KEYS).filter_map(|key| known(serde_json::from_value(key).ok()?));
        Ok(keys.collect())
    }

    /// A JSON document.
    async fn get<T: serde::de::DeserializeOwned>(&self, url: Url) -> Result<T, KeyError> {
        let failed = |what: String| KeyError::Fetch { url: url.to_string(), what };
        let unsent = |error: reqwest::Error| failed(error.without_url().to_string());
        let mut answer = self.client.get(url.clone()).send().await.map_err(unsent)?;
        if !answer.status().is_success() {
            return Err(failed(format!("it answered {}", answer.status())));
        }
        let mut body = Vec::new();
        while let Some(chunk) = answer.chunk().await.map_err(unsent)? {
            body.extend_from_slice(&chunk);
            if body.len() > MAX_BYTES {
                return Err(failed(format!("it answered more than {MAX_BYTES} bytes")));
            }
        }
        serde_json::from_slice(&body).map_err(|error| failed(format!("its answer cannot be read: {error}")))
    }
}

/// A URL that keys may be fetched from: encrypted, or on this machine.
fn checked(text: &str) -> Result<Url, KeyError> {
    let url = Url::parse(text).map_err(|_| KeyError::Url { url: text.to_owned() })?;
    let here = matches!(url.host_str(), Some("127.0.0.1" | "[::1]" | "localhost"));
    match url.scheme() {
        "https" => Ok(url),
        "http" if here => Ok(url),
        _ => Err(KeyError::Url { url: text.to_owned() }),
    }
}

/// A key for signatures by one of the accepted algorithms.
fn known(jwk: Jwk) -> Option<Known> {
    let algorithm = match &jwk.algorithm {
        AlgorithmParameters::RSA(_) => Algorithm::RS256,
        AlgorithmParameters::EllipticCurve(curve) if curve.curve == EllipticCurve::P256 => Algorithm::ES256,
        AlgorithmParameters::OctetKeyPair(pair) if pair.curve == EllipticCurve::Ed25519 => Algorithm::EdDSA,
        _ => return None,
    };
    let signs = jwk.common.public_key_use.as_ref().is_none_or(|usage| *usage == PublicKeyUse::Signature);
    let stated = jwk.common.key_algorithm.map(|stated| stated.to_string());
    let fits = stated.is_none_or(|stated| stated == format!("{algorithm:?}"));
    let key = DecodingKey::from_jwk(&jwk).ok()?;
    (signs && fits).then_some(Known { id: jwk.common.key_id, algorithm, key })
}

fn pick(keys: &[Known], id: Option<&str>, algorithm: Algorithm) -> Option<DecodingKey> {
    let mut fitting =
        keys.iter().filter(|known| known.algorithm == algorithm && (id.is_none() || known.id.as_deref() == id));
    match (fitting.next(), fitting.next()) {
        (Some(known), None) => Some(known.key.clone()),
        _ => None,
    }
}
