//! `heliomap keys`: keys made by whoever runs the service, the first one of each organisation among them.

use super::output::{print, print_once, tell};
use super::{open_storage_beside, open_storage_there, run_async};
use anyhow::{Context, bail};
use heliomap::config::{KeysArgs, KeysCommand};
use heliomap::store::{ApiKey, Created, KeyId, NewKey, OrganisationId, Page, Secret, Store, TimeSpan};
use heliomap_model::PlantId;
use jiff::{SignedDuration, Timestamp};

/// Runs the command.
pub fn run(args: KeysArgs) -> anyhow::Result<()> {
    run_async(async {
        let (store, _) = match args.command {
            KeysCommand::Create { .. } => open_storage_beside(&args.storage).await?,
            _ => open_storage_there(&args.storage).await?,
        };
        let now = Timestamp::now();
        match args.command {
            KeysCommand::Create { name, scope, organisation, plant, days } => {
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
                    expires: days.map(|days| now + SignedDuration::from_hours(24 * i64::from(days))),
                };
                let key = store.create_key(&new, now).await?;
                tell(format_args!("key {} is made; its secret is shown this once:", key.id));
                if let Err(error) = print_once(format_args!("{}\n", secret.reveal())) {
                    store.revoke_key(organisation, key.id, None, now).await?;
                    return Err(error)
                        .context(format!("nobody can have read the secret of key {}: it is revoked", key.id));
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
                tell(format_args!("key {id} ({}) opens nothing any more", key.name));
            }
            KeysCommand::Rotate { id, grace_hours } => {
                let key = key_of_any(&*store, id).await?;
                let secret = Secret::random()?;
                let until = now + SignedDuration::from_hours(i64::from(grace_hours));
                let rotated = store.rotate_key(key.organisation, id, None, &secret.record(), until).await?;
                rotated.with_context(|| format!("key {id} is revoked; make another with `heliomap keys create`"))?;
                tell(format_args!("key {id} ({}) has a new secret, which is shown this once:", key.name));
                print_once(format_args!("{}\n", secret.reveal())).with_context(|| {
                    format!("nobody can have read the new secret of key {id}: rotate it once more, or revoke it")
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

/// The key, whosever it is.
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
