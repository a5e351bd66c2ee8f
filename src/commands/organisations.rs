//! `heliomap organisations`: their usage and quotas.

use super::output::print;
use super::{open_storage_beside, open_storage_there, run_async};
use anyhow::Context;
use heliomap::config::{OrganisationsArgs, OrganisationsCommand};
use heliomap::store::usage::{Quotas, UNLIMITED, Usage};
use heliomap::store::{Organisation, Store};
use jiff::Timestamp;

/// Runs the command.
pub fn run(args: OrganisationsArgs) -> anyhow::Result<()> {
    run_async(async {
        let (store, _) = match args.command {
            OrganisationsCommand::Create { .. } => open_storage_beside(&args.storage).await?,
            OrganisationsCommand::List | OrganisationsCommand::Quota { .. } => {
                open_storage_there(&args.storage).await?
            }
        };
        match args.command {
            OrganisationsCommand::List => {
                for (organisation, usage) in store.organisations(Timestamp::now()).await? {
                    print(line(&organisation, &usage))?;
                }
            }
            OrganisationsCommand::Create { name } => {
                store.create_organisation(&name, Timestamp::now()).await?;
                let (organisation, usage) = named(&*store, &name).await?;
                print(line(&organisation, &usage))?;
            }
            OrganisationsCommand::Quota { name, bytes, plants } => {
                let (organisation, usage) = named(&*store, &name).await?;
                let own = Quotas {
                    bytes: bytes.map_or(usage.own.bytes, |quota| quota.0),
                    plants: plants.map_or(usage.own.plants, |quota| quota.0),
                };
                store.set_quotas(organisation.id, own).await?;
                print(line(&organisation, &Usage { own, ..usage }))?;
            }
        }
        Ok(())
    })
}

async fn named(store: &dyn Store, name: &str) -> anyhow::Result<(Organisation, Usage)> {
    let all = store.organisations(Timestamp::now()).await?;
    let found = all.into_iter().find(|(organisation, _)| organisation.name == name);
    found.with_context(|| format!("there is no organisation {name}; `heliomap organisations list` shows them"))
}

/// An organisation in a line for people.
fn line(organisation: &Organisation, usage: &Usage) -> String {
    let of = |quota: Option<u64>| match quota {
        None => "as configured for all".to_owned(),
        Some(UNLIMITED) => "unlimited".to_owned(),
        Some(quota) => quota.to_string(),
    };
    format!(
        "{}  bytes {} (quota {})  plants {} (quota {})  {}\n",
        organisation.id,
        usage.bytes,
        of(usage.own.bytes),
        usage.plants,
        of(usage.own.plants),
        organisation.name
    )
}
