//! `heliomap keys`: the operator manages keys, among them the first one of each organisation.

use super::output::{notify, print, print_once};
use super::{open_storage_beside, open_storage_there, run_async};
use anyhow::{Context, bail};
use heliomap::config::{KeysArgs, KeysCommand};
use heliomap::store::{ApiKey, Created, KeyId, NewKey, OrganisationId, Page, Secret, Store, TimeSpan};
use heliomap_model::PlantId;
use jiff::Timestamp;

/// Runs the command.
pub fn run(args: KeysArgs) -> anyhow::Result<()> {
    run_async(async {
        let (store, _) = match args.command {
            KeysCommand::Create { .. } => open_storage_beside(&args.storage).await?,
            _ => open_storage_there(&args.storage).await?,
        };
        let now = Timestamp::now();
        match args.command {
            KeysCommand::Create { name, scope, organisation, plant, expires_after } => {
                let organisation = organisation_named(&*store, &organisation, now).await?;
                let plants: Vec<PlantId> = plant;
                for id in &plants {
                    let found = store.plant(*id).await?;
                    if found.is_none_or(|found| found.organisation != organisation) {
                        bail!("the organisation has no plant {id}; GET /api/v1/plants lists them");
                    }
                }
                let secret = Secret::random()?;
                let new = NewKey {
                    organisation,
                    name,
                    secret: secret.record(),
                    scopes: scope.into_iter().collect(),
                    plants: (!plants.is_empty()).then_some(plants),
                    expires: expires_after.map(|duration| now.checked_add(duration)).transpose()?,
                };
                let key = store.create_key(&new, now).await?;
                notify(format_args!("key {} is created; its secret is shown only now:", key.id));
                if let Err(error) = print_once(format_args!("{}\n", secret.reveal())) {
                    store.revoke_key(organisation, key.id, None, now).await?;
                    return Err(error)
                        .context(format!("the secret of key {} could not be printed: the key is revoked", key.id));
                }
            }
            KeysCommand::List => {
                let mut after = None;
                loop {
                    let keys = store.keys(None, TimeSpan::default(), Page { after, limit: 500 }).await?;
                    let Some(last) = keys.last() else { break };
                    after = Some(last.seq);
                    for key in &keys {
                        print(format_args!("{}\n", line(key, now)))?;
                    }
                }
            }
            KeysCommand::Revoke { id } => {
                let key = key_of_any(&*store, id).await?;
                store.revoke_key(key.organisation, id, None, now).await?;
                notify(format_args!("key {id} ({}) is revoked", key.name));
            }
            KeysCommand::Rotate { id, grace } => {
                let key = key_of_any(&*store, id).await?;
                let secret = Secret::random()?;
                let until = now.checked_add(grace)?;
                let rotated = store.rotate_key(key.organisation, id, None, &secret.record(), until).await?;
                rotated.with_context(|| format!("key {id} is revoked; make another with `heliomap keys create`"))?;
                notify(format_args!("key {id} ({}) has a new secret, which is shown only now:", key.name));
                print_once(format_args!("{}\n", secret.reveal())).with_context(|| {
                    format!("the new secret of key {id} could not be printed: rotate it once more, or revoke it")
                })?;
            }
        }
        Ok(())
    })
}

async fn organisation_named(store: &dyn Store, name: &str, now: Timestamp) -> anyhow::Result<OrganisationId> {
    Ok(match store.create_organisation(name, now).await? {
        Created::New(organisation) | Created::Existing(organisation) => organisation.id,
    })
}

/// The key with an identifier, of any organisation.
async fn key_of_any(store: &dyn Store, id: KeyId) -> anyhow::Result<ApiKey> {
    let mut after = None;
    loop {
        let keys = store.keys(None, TimeSpan::default(), Page { after, limit: 500 }).await?;
        let Some(last) = keys.last() else { bail!("no key has the identifier {id}; `heliomap keys list` shows them") };
        after = Some(last.seq);
        if let Some(key) = keys.into_iter().find(|key| key.id == id) {
            return Ok(key);
        }
    }
}

/// A key in a line for people.
fn line(key: &ApiKey, now: Timestamp) -> String {
    let scopes: Vec<&str> = key.scopes.iter().map(|scope| scope.as_str()).collect();
    let plants =
        key.plants.as_ref().map_or_else(|| "all plants".to_owned(), |plants| format!("{} plants", plants.len()));
    let state = match (key.revoked, key.expires) {
        (Some(revoked), _) => format!("revoked {revoked:.0}"),
        (None, Some(expires)) if expires <= now => format!("expired {expires:.0}"),
        (None, Some(expires)) => format!("until {expires:.0}"),
        (None, None) => "good".to_owned(),
    };
    let used = key.last_used.map_or_else(|| "never used".to_owned(), |used| format!("last used {used:.0}"));
    let scopes = scopes.join(",");
    format!(
        "{}  {}…  {scopes}  {plants}  {state}  {used}  organisation {}  {}",
        key.id, key.prefix, key.organisation, key.name
    )
}
