//! Keys and organisations, as the operator of the service manages them.

use super::StorageArgs;
use super::units::{parse_days, parse_grace, parse_size};
use crate::store::usage::UNLIMITED;
use crate::store::{KeyId, Scope, name};
use clap::{Args, Subcommand};
use heliomap_model::PlantId;
use std::time::Duration;

/// `heliomap keys`.
#[derive(Debug, Clone, Args)]
pub struct KeysArgs {
    #[command(flatten)]
    pub storage: StorageArgs,
    #[command(subcommand)]
    pub command: KeysCommand,
}

/// Actions on keys.
#[derive(Debug, Clone, Subcommand)]
pub enum KeysCommand {
    /// Create a key and print its secret, which is not stored.
    Create {
        /// A name for people.
        #[arg(long, value_parser = parse_name, value_name = "NAME")]
        name: String,
        /// A scope of the key; may be repeated.
        #[arg(long, value_enum, value_name = "SCOPE", required = true)]
        scope: Vec<Scope>,
        /// Name of the organisation that the key belongs to; created if missing.
        #[arg(long, value_parser = parse_name, value_name = "NAME", default_value = "default")]
        organisation: String,
        /// A plant that the key may access; may be repeated. All plants if absent.
        #[arg(long, value_name = "UUID")]
        plant: Vec<PlantId>,
        /// Time after which the key expires, 1d to 36500d; never if absent.
        #[arg(long, alias = "days", value_parser = parse_days, value_name = "DURATION")]
        expires_after: Option<Duration>,
    },
    /// List all keys.
    List,
    /// Revoke a key for ever.
    Revoke {
        /// The key's identifier.
        #[arg(value_parser = parse_key_id, value_name = "UUID")]
        id: KeyId,
    },
    /// Give a key a new secret and print it.
    Rotate {
        /// The key's identifier.
        #[arg(value_parser = parse_key_id, value_name = "UUID")]
        id: KeyId,
        /// How long the old secret stays valid, at most 30d.
        #[arg(long, alias = "grace-hours", value_parser = parse_grace, value_name = "DURATION", default_value = "0s")]
        grace: Duration,
    },
}

fn parse_name(text: &str) -> Result<String, name::InvalidName> {
    name::checked(text)
}

fn parse_key_id(text: &str) -> Result<KeyId, uuid::Error> {
    text.parse().map(KeyId)
}

/// `heliomap organisations`.
#[derive(Debug, Clone, Args)]
pub struct OrganisationsArgs {
    #[command(flatten)]
    pub storage: StorageArgs,
    #[command(subcommand)]
    pub command: OrganisationsCommand,
}

/// Actions on organisations.
#[derive(Debug, Clone, Subcommand)]
pub enum OrganisationsCommand {
    /// List all organisations with their usage and quotas.
    List,
    /// Create an organisation, or find the one with that name.
    Create {
        /// The organisation's name.
        #[arg(value_parser = parse_name, value_name = "NAME")]
        name: String,
    },
    /// Set the quotas of an organisation; a quota that is not given stays.
    Quota {
        /// The organisation's name.
        #[arg(value_name = "NAME")]
        name: String,
        /// Bytes of files and models: a size such as 500G, `unlimited`, or `default` for that of `--quota-bytes`.
        #[arg(long, value_name = "SIZE", value_parser = parse_quota)]
        bytes: Option<Quota>,
        /// Plants: a number, `unlimited`, or `default` for that of `--quota-plants`.
        #[arg(long, value_name = "COUNT", value_parser = parse_plant_quota)]
        plants: Option<Quota>,
    },
}

/// A quota of an organisation; `None` for the default of all.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Quota(pub Option<u64>);

fn parse_quota(text: &str) -> Result<Quota, String> {
    quota_of(text, parse_size)
}

fn parse_plant_quota(text: &str) -> Result<Quota, String> {
    quota_of(text, |text| text.parse().map_err(|_| "a whole number, `unlimited` or `default` is expected".to_owned()))
}

fn quota_of(text: &str, parse: impl Fn(&str) -> Result<u64, String>) -> Result<Quota, String> {
    match text {
        "default" => Ok(Quota(None)),
        "unlimited" => Ok(Quota(Some(UNLIMITED))),
        text => parse(text).map(|quota| Quota(Some(quota))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quotas() {
        assert_eq!(parse_quota("500G"), Ok(Quota(Some(500 << 30))));
        assert_eq!(parse_quota("unlimited"), Ok(Quota(Some(UNLIMITED))));
        assert_eq!(parse_quota("default"), Ok(Quota(None)));
        assert!(parse_quota("much").is_err());
        assert_eq!(parse_plant_quota("20"), Ok(Quota(Some(20))));
        assert!(parse_plant_quota("2K").is_err());
    }
}
