//! The identity provider whose tokens are accepted beside keys.

use crate::oidc::keys::Ages;
use crate::oidc::{OidcSettings, OrganisationRule};
use crate::store::Scope;
use clap::Args;
use std::time::Duration;

/// The identity provider whose tokens are accepted beside keys.
#[derive(Debug, Clone, Default, Args)]
#[command(next_help_heading = "Identity provider")]
pub struct OidcArgs {
    /// The exact `issuer` of an OpenID Connect provider whose tokens (RS256, ES256 or EdDSA) are accepted beside keys.
    #[arg(long, env = "HELIOMAP_OIDC_ISSUER", value_name = "URL")]
    pub oidc_issuer: Option<String>,
    /// The audience (`aud`) that a token must have.
    #[arg(long, env = "HELIOMAP_OIDC_AUDIENCE", value_name = "NAME")]
    pub oidc_audience: Option<String>,
    /// The claim that names the caller's organisation; dots select claims within claims.
    #[arg(long, env = "HELIOMAP_OIDC_ORGANISATION_CLAIM", default_value = "organisation", value_name = "CLAIM")]
    pub oidc_organisation_claim: String,
    /// The organisation of all callers, whatever their tokens contain.
    #[arg(long, env = "HELIOMAP_OIDC_ORGANISATION", value_name = "NAME")]
    pub oidc_organisation: Option<String>,
    /// The claim with the scopes of a caller: words separated by blanks, or a list.
    #[arg(long, env = "HELIOMAP_OIDC_SCOPE_CLAIM", default_value = "scope", value_name = "CLAIM")]
    pub oidc_scope_claim: String,
    /// The scope that a word of that claim stands for, `plant-admins=admin`; may be repeated.
    #[arg(long, env = "HELIOMAP_OIDC_SCOPE", value_delimiter = ',', value_parser = parse_scope_word, value_name = "WORD=SCOPE",
        default_value = "heliomap:upload=upload,heliomap:read=read,heliomap:review=review,heliomap:admin=admin")]
    pub oidc_scope: Vec<(String, Scope)>,
}

/// The least time between two fetches of a provider's keys.
const MIN_KEY_REFRESH: Duration = Duration::from_secs(10);

impl OidcArgs {
    /// What tokens are checked by; `None` where no provider is named.
    ///
    /// # Errors
    /// When the audience is missing.
    pub fn settings(&self) -> Result<Option<OidcSettings>, &'static str> {
        let Some(issuer) = self.oidc_issuer.clone() else { return Ok(None) };
        let audience =
            self.oidc_audience.clone().ok_or("--oidc-issuer needs --oidc-audience: the `aud` of its tokens")?;
        let organisation = match &self.oidc_organisation {
            Some(name) => OrganisationRule::Named(name.clone()),
            None => OrganisationRule::Claim(self.oidc_organisation_claim.clone()),
        };
        Ok(Some(OidcSettings {
            issuer,
            audience,
            organisation,
            scope_claim: self.oidc_scope_claim.clone(),
            scopes: self.oidc_scope.clone(),
            ages: Ages::with_min_refresh(MIN_KEY_REFRESH),
        }))
    }
}

fn parse_scope_word(text: &str) -> Result<(String, Scope), String> {
    let parsed = text.rsplit_once('=').and_then(|(word, scope)| Some((word.to_owned(), scope.parse().ok()?)));
    parsed.filter(|(word, _)| !word.is_empty()).ok_or_else(|| {
        "a word and what it stands for are expected, one of upload, read, review and admin: plant-admins=admin"
            .to_owned()
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_of_claims() {
        assert_eq!(parse_scope_word("plant=admins=admin"), Ok(("plant=admins".to_owned(), Scope::Admin)));
        assert!(parse_scope_word("admin").is_err() && parse_scope_word("=admin").is_err());
        assert!(parse_scope_word("a=everything").is_err());
    }
}
