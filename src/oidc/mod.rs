//! Tokens of an identity provider (OpenID Connect): who shows one that the provider signed for this service is let in as its
//! claims say.

pub mod keys;

mod crypto;

use crate::store::Scope;
use jsonwebtoken::{Algorithm, Validation, decode, decode_header};
use keys::{Ages, KeyError, Keys};
use serde_json::Value;
use std::collections::BTreeSet;
use std::sync::Arc;

/// Longest token, bytes.
const MAX_TOKEN_BYTES: usize = 16 << 10;
/// By how much the clocks of provider and service may differ, seconds.
const LEEWAY_S: u64 = 30;
/// Signatures that are taken: what can be checked by a public key, and nothing older.
const ALGORITHMS: [Algorithm; 3] = [Algorithm::RS256, Algorithm::ES256, Algorithm::EdDSA];

/// Whose tokens are taken, and what their claims mean.
#[derive(Debug, Clone)]
pub struct OidcSettings {
    /// The provider's `issuer`, to the letter.
    pub issuer: String,
    /// What must stand in `aud`.
    pub audience: String,
    pub organisation: OrganisationRule,
    /// The claim that holds what the caller may do: words, or a list of them.
    pub scope_claim: String,
    /// What a word of that claim stands for.
    pub scopes: Vec<(String, Scope)>,
    /// How old the provider's keys may be.
    pub ages: Ages,
}

/// Which organisation a caller belongs to.
#[derive(Debug, Clone)]
pub enum OrganisationRule {
    /// The one of this name.
    Named(String),
    /// The one that this claim names.
    Claim(String),
}

/// Who showed a token.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Bearer {
    /// The claim `sub`.
    pub subject: String,
    /// The name of the organisation.
    pub organisation: String,
    pub scopes: BTreeSet<Scope>,
}

/// Why a token lets nobody in.
#[derive(Debug, thiserror::Error)]
pub enum OidcError {
    /// Whoever shows it needs another.
    #[error("the token {0}")]
    Refused(String),
    /// It cannot be checked now.
    #[error("the keys of the identity provider cannot be fetched: {0}")]
    Unavailable(#[from] KeyError),
}

fn refused(what: impl Into<String>) -> OidcError {
    OidcError::Refused(what.into())
}

/// Checks tokens.
#[derive(Debug)]
pub struct Oidc {
    settings: OidcSettings,
    keys: Arc<Keys>,
}

impl Oidc {
    /// One that takes tokens by these settings. The provider is asked for its keys when the first token comes.
    ///
    /// # Errors
    /// Where the issuer is no URL that keys may be fetched from, or the system gives no certificates to check it by.
    pub fn new(settings: OidcSettings) -> Result<Self, KeyError> {
        crypto::provide();
        let keys = Arc::new(Keys::new(&settings.issuer, settings.ages)?);
        Ok(Self { settings, keys })
    }

    /// Who showed this token.
    ///
    /// # Errors
    /// Where it is not one that the provider signed for this service and that holds now.
    pub async fn bearer(&self, token: &str) -> Result<Bearer, OidcError> {
        if token.len() > MAX_TOKEN_BYTES {
            return Err(refused("is longer than 16 KiB"));
        }
        let header = decode_header(token).map_err(|_| refused("cannot be read"))?;
        if !ALGORITHMS.contains(&header.alg) {
            return Err(refused("is not signed by RS256, ES256 or EdDSA"));
        }
        let key = self.keys.key(header.kid.as_deref(), header.alg).await?;
        let key = key.ok_or_else(|| refused("is signed by a key that the provider does not have"))?;
        let mut validation = Validation::new(header.alg);
        validation.leeway = LEEWAY_S;
        validation.validate_nbf = true;
        validation.set_issuer(&[&self.settings.issuer]);
        validation.set_audience(&[&self.settings.audience]);
        validation.set_required_spec_claims(&["exp", "iss", "aud", "sub"]);
        let decoded = decode::<Value>(token, &key, &validation).map_err(|error| {
            use jsonwebtoken::errors::ErrorKind;
            refused(match error.kind() {
                ErrorKind::ExpiredSignature => "has expired".to_owned(),
                ErrorKind::ImmatureSignature => "does not hold yet".to_owned(),
                ErrorKind::InvalidIssuer => format!("is not of {}", self.settings.issuer),
                ErrorKind::InvalidAudience => format!("is not for {}", self.settings.audience),
                ErrorKind::MissingRequiredClaim(claim) => format!("lacks the claim {claim}"),
                _ => "has a signature that does not hold".to_owned(),
            })
        })?;
        self.told(&decoded.claims)
    }

    /// What the claims of a token say.
    fn told(&self, claims: &Value) -> Result<Bearer, OidcError> {
        let subject = claims["sub"].as_str().filter(|subject| is_name(subject));
        let subject = subject.ok_or_else(|| refused("names no subject in `sub`"))?;
        let organisation = match &self.settings.organisation {
            OrganisationRule::Named(name) => name.as_str(),
            OrganisationRule::Claim(claim) => found(claims, claim)
                .and_then(Value::as_str)
                .filter(|name| is_name(name))
                .ok_or_else(|| refused(format!("names no organisation in `{claim}`")))?,
        };
        let words = match found(claims, &self.settings.scope_claim) {
            Some(Value::String(text)) => text.split_whitespace().collect(),
            Some(Value::Array(items)) => items.iter().filter_map(Value::as_str).collect(),
            _ => Vec::new(),
        };
        let meant = |(word, scope): &(String, Scope)| words.contains(&word.as_str()).then_some(*scope);
        Ok(Bearer {
            subject: subject.to_owned(),
            organisation: organisation.to_owned(),
            scopes: self.settings.scopes.iter().filter_map(meant).collect(),
        })
    }

    /// Fetches the provider's keys; how many there are.
    ///
    /// # Errors
    /// Where they cannot be fetched.
    pub async fn fetch(&self) -> Result<usize, KeyError> {
        self.keys.refresh().await
    }

    /// What the provider is called.
    pub fn issuer(&self) -> &str {
        &self.settings.issuer
    }
}

/// Whether a text may be a name in the log: not empty, not endless, on one line.
fn is_name(text: &str) -> bool {
    (1..=200).contains(&text.chars().count()) && !text.chars().any(char::is_control)
}

/// A claim by its name, or by names with dots between them where it is within another.
fn found<'a>(claims: &'a Value, name: &str) -> Option<&'a Value> {
    claims.get(name).or_else(|| name.split('.').try_fold(claims, |value, part| value.get(part)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn oidc(organisation: OrganisationRule, scope_claim: &str) -> Oidc {
        let scopes = vec![("plant-admins".to_owned(), Scope::Admin), ("pilots".to_owned(), Scope::Upload)];
        Oidc::new(OidcSettings {
            issuer: "https://id.example.org".to_owned(),
            audience: "heliomap".to_owned(),
            organisation,
            scope_claim: scope_claim.to_owned(),
            scopes,
            ages: Ages::with_min_refresh(std::time::Duration::from_secs(10)),
        })
        .unwrap()
    }

    #[test]
    fn claims_say_who_one_is_and_what_one_may() {
        let by_claim = oidc(OrganisationRule::Claim("org".to_owned()), "realm.roles");
        let told =
            by_claim.told(&json!({"sub": "7", "org": "sun", "realm": {"roles": ["pilots", "others", 3]}})).unwrap();
        assert_eq!((told.subject.as_str(), told.organisation.as_str()), ("7", "sun"));
        assert_eq!(told.scopes, BTreeSet::from([Scope::Upload]));
        let fixed = oidc(OrganisationRule::Named("sun".to_owned()), "scope");
        let told = fixed.told(&json!({"sub": "7", "scope": "openid pilots plant-admins"})).unwrap();
        assert_eq!(told.scopes, BTreeSet::from([Scope::Upload, Scope::Admin]));
        assert!(fixed.told(&json!({"sub": "7", "scope": "pilot"})).unwrap().scopes.is_empty());
        for wrong in [
            json!({"sub": "7"}),
            json!({"sub": "7", "org": ""}),
            json!({"sub": "7", "org": "a\nb"}),
            json!({"org": "sun"}),
        ] {
            assert!(by_claim.told(&wrong).is_err(), "{wrong}");
        }
    }
}
