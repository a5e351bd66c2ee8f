//! Keys and organisations, as whoever runs the service makes them.

use super::StorageArgs;
use super::limits::parse_size;
use crate::store::usage::UNLIMITED;
use crate::store::{KeyId, Scope, name};
use clap::{Args, Subcommand};
use heliomap_model::PlantId;

/// `heliomap keys`.
#[derive(Debug, Clone, Args)]
pub struct KeysArgs {
    #[command(flatten)]
    pub storage: StorageArgs,
    #[command(subcommand)]
    pub command: KeysCommand,
}

/// What is done about keys.
#[derive(Debug, Clone, Subcommand)]
pub enum KeysCommand {
    /// Make a key and print its secret, which is kept nowhere.
    Create {
        /// What people call it.
        #[arg(long, value_parser = parse_name, value_name = "NAME")]
        name: String,
        /// What it is good for; may be given more than once.
        #[arg(long, value_enum, value_name = "SCOPE", required = true)]
        scope: Vec<Scope>,
        /// The organisation that it belongs to, by name; made where there is none.
        #[arg(long, value_parser = parse_name, value_name = "NAME", default_value = "default")]
        organisation: String,
        /// A plant that it is good for; may be given more than once; all plants where it is not given.
        #[arg(long, value_name = "UUID")]
        plant: Vec<PlantId>,
        /// Days after which it ends, 1 to 36500; never where it is not given.
        #[arg(long, value_parser = clap::value_parser!(u32).range(1..=36_500), value_name = "N")]
        days: Option<u32>,
    },
    /// List all keys.
    List,
    /// Make a key good for nothing, for ever.
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
        /// Hours for which the secret so far stays good, up to 720 (30 days).
        #[arg(long, value_parser = clap::value_parser!(u32).range(..=720), value_name = "N", default_value_t = 0)]
        grace_hours: u32,
    },
}

fn parse_name(text: &str) -> Result<String, name::InvalidName> {
    name::checked(text).map(str::to_owned)
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

/// What is done about organisations.
#[derive(Debug, Clone, Subcommand)]
pub enum OrganisationsCommand {
    /// List all organisations with what they keep and may keep.
    List,
    /// Make an organisation, or find the one of that name.
    Create {
        /// The organisation's name.
        #[arg(value_parser = parse_name, value_name = "NAME")]
        name: String,
    },
    /// Say what an organisation may keep; what is not given stays as it is.
    Quota {
        /// The organisation's name.
        #[arg(value_name = "NAME")]
        name: String,
        /// Bytes of files and models: a size such as 500G, `unlimited`, or `default` for what `--quota-bytes` says.
        #[arg(long, value_name = "SIZE", value_parser = parse_quota)]
        bytes: Option<Quota>,
        /// Plants: a number, `unlimited`, or `default` for what `--quota-plants` says.
        #[arg(long, value_name = "COUNT", value_parser = parse_quota)]
        plants: Option<Quota>,
    },
}

/// A quota of an organisation; `None` for what holds for all.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Quota(pub Option<u64>);

fn parse_quota(text: &str) -> Result<Quota, String> {
    match text {
        "default" => Ok(Quota(None)),
        "unlimited" => Ok(Quota(Some(UNLIMITED))),
        text => parse_size(text).map(|size| Quota(Some(size))),
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
    }
}
