//! Tokens of an identity provider (OpenID Connect): a token that the provider signed for this service grants what its claims
//! state.

pub mod keys;

mod crypto;

use crate::store::Scope;
use jsonwebtoken::{Algorithm, Validation, decode, decode_header};
use keys::{Ages, KeyError, Keys};
use serde_json::Value;
use std::collections::BTreeSet;
use std::sync::Arc;

/// Maximum size of a token, bytes.
const MAX_TOKEN_BYTES: usize = 16 << 10;
/// Tolerated difference between the clocks of provider and service, seconds.
const LEEWAY_S: u64 = 30;
/// Accepted algorithms: current ones with public keys.
const ALGORITHMS: [Algorithm; 3] = [Algorithm::RS256, Algorithm::ES256, Algorithm::EdDSA];

/// Whose tokens are accepted, and what their claims mean.
#[derive(Debug, Clone)]
pub struct OidcSettings {
    /// The provider's `issuer`, to the letter.
    pub issuer: String,
    /// The required `aud`.
    pub audience: String,
    pub organisation: OrganisationRule,
    /// The claim that grants scopes: words, or a list of them.
    pub scope_claim: String,
    /// The scope that a word of that claim grants.
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

/// The caller that presented a token.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Bearer {
    /// The claim `sub`.
    pub subject: String,
    /// The name of the organisation.
    pub organisation: String,
    pub scopes: BTreeSet<Scope>,
}

/// Why a token is refused.
#[derive(Debug, thiserror::Error)]
pub enum OidcError {
    /// The token is not valid.
    #[error("the token {0}")]
    Refused(String),
    /// The token cannot be checked now.
    #[error("cannot fetch the keys of the identity provider: {0}")]
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
    /// A checker with these settings. The provider's keys are fetched when the first token comes.
    ///
    /// # Errors
    /// An issuer that keys may not be fetched from, or no certificates of authorities on this system.
    pub fn new(settings: OidcSettings) -> Result<Self, KeyError> {
        crypto::provide();
        let keys = Arc::new(Keys::new(&settings.issuer, settings.ages)?);
        Ok(Self { settings, keys })
    }

    /// The caller that this token identifies.
    ///
    /// # Errors
    /// A token that the provider did not sign for this service, or that is not valid now.
    pub async fn bearer(&self, token: &str) -> Result<Bearer, OidcError> {
        if token.len() > MAX_TOKEN_BYTES {
            return Err(refused("is longer than 16 KiB"));
        }
        let header = decode_header(token).map_err(|_| refused("cannot be read"))?;
        if !ALGORITHMS.contains(&header.alg) {
            return Err(refused("is not signed by RS256, ES256 or EdDSA"));
        }
        let key = self.keys.key(header.kid.as_deref(), header.alg).await?;
        let key = key.ok_or_else(|| refused("is signed by a key that the provider does not publish"))?;
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
                ErrorKind::ImmatureSignature => "is not valid yet".to_owned(),
                ErrorKind::InvalidIssuer => format!("is not of {}", self.settings.issuer),
                ErrorKind::InvalidAudience => format!("is not for {}", self.settings.audience),
                ErrorKind::MissingRequiredClaim(claim) => format!("lacks the claim {claim}"),
                _ => "has an invalid signature".to_owned(),
            })
        })?;
        self.read_claims(&decoded.claims)
    }

    /// The caller that claims describe.
    fn read_claims(&self, claims: &Value) -> Result<Bearer, OidcError> {
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

    /// Fetches the provider's keys and returns their number.
    ///
    /// # Errors
    /// Keys that cannot be fetched.
    pub async fn fetch(&self) -> Result<usize, KeyError> {
        self.keys.refresh().await
    }

    /// The issuer.
    pub fn issuer(&self) -> &str {
        &self.settings.issuer
    }
}

/// Whether a text may be a name in the log: one line of 1 to 200 characters.
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
    fn claims_identify_the_caller_and_grant_scopes() {
        let by_claim = oidc(OrganisationRule::Claim("org".to_owned()), "realm.roles");
        let bearer = by_claim
            .read_claims(&json!({"sub": "7", "org": "sun", "realm": {"roles": ["pilots", "others", 3]}}))
            .unwrap();
        assert_eq!((bearer.subject.as_str(), bearer.organisation.as_str()), ("7", "sun"));
        assert_eq!(bearer.scopes, BTreeSet::from([Scope::Upload]));
        let fixed = oidc(OrganisationRule::Named("sun".to_owned()), "scope");
        let bearer = fixed.read_claims(&json!({"sub": "7", "scope": "openid pilots plant-admins"})).unwrap();
        assert_eq!(bearer.scopes, BTreeSet::from([Scope::Upload, Scope::Admin]));
        assert!(fixed.read_claims(&json!({"sub": "7", "scope": "pilot"})).unwrap().scopes.is_empty());
        for wrong in [
            json!({"sub": "7"}),
            json!({"sub": "7", "org": ""}),
            json!({"sub": "7", "org": "a\nb"}),
            json!({"org": "sun"}),
        ] {
            assert!(by_claim.read_claims(&wrong).is_err(), "{wrong}");
        }
    }
}
