//! `heliomap doctor`: checks what the service needs, with advice for every fault.

use super::output::print;
use super::{ROWS, open_blobs, run_async};
use heliomap::config::{DoctorArgs, ServeArgs};
use heliomap::oidc::Oidc;
use heliomap::store::schema::{Examined, Schema};
use heliomap::store::{PostgresStore, SqliteStore};
use heliomap_mapping::detection::DetectionError;
use heliomap_model::PlantId;
use image::RgbImage;
use jiff::{SignedDuration, Timestamp};
use serde::Serialize;
use std::time::{Duration, Instant, SystemTime};

/// A clock that differs by more than this makes leases end too early or too late.
const MAX_CLOCK_DIFFERENCE: SignedDuration = SignedDuration::from_secs(5);
/// How long a check may take.
const PATIENCE: Duration = Duration::from_secs(20);
/// Width and height of the picture that the detector is tried on, pixels.
const TRIAL_PX: u32 = 512;

/// How a check ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
enum Verdict {
    Ok,
    /// The service runs, but its operator should know.
    Warning,
    Failed,
}

/// One check.
#[derive(Debug, Serialize)]
struct Check {
    name: &'static str,
    verdict: Verdict,
    /// What was found.
    found: String,
    /// What to do, where something is to be done.
    #[serde(skip_serializing_if = "Option::is_none")]
    advice: Option<String>,
}

impl Check {
    fn ok(name: &'static str, found: impl Into<String>) -> Self {
        Self { name, verdict: Verdict::Ok, found: found.into(), advice: None }
    }

    fn warning(name: &'static str, found: impl Into<String>, advice: impl Into<String>) -> Self {
        Self { name, verdict: Verdict::Warning, found: found.into(), advice: Some(advice.into()) }
    }

    fn failed(name: &'static str, found: impl Into<String>, advice: impl Into<String>) -> Self {
        Self { name, verdict: Verdict::Failed, found: found.into(), advice: Some(advice.into()) }
    }
}

/// Runs all checks and prints what they found.
///
/// # Errors
/// Where a check fails.
pub fn run(args: DoctorArgs) -> anyhow::Result<()> {
    let json = args.json;
    run_async(async move {
        let checks = examine(&args.serve).await;
        if json {
            print(format_args!("{}\n", serde_json::to_string_pretty(&checks)?))?;
        } else {
            for check in &checks {
                let verdict = match check.verdict {
                    Verdict::Ok => "ok     ",
                    Verdict::Warning => "warning",
                    Verdict::Failed => "FAILED ",
                };
                print(format_args!("{verdict}  {}: {}\n", check.name, check.found))?;
                if let Some(advice) = &check.advice {
                    print(format_args!("         -> {advice}\n"))?;
                }
            }
        }
        let failed = checks.iter().filter(|check| check.verdict == Verdict::Failed).count();
        anyhow::ensure!(failed == 0, "{failed} of {} checks failed", checks.len());
        Ok(())
    })
}

async fn examine(args: &ServeArgs) -> Vec<Check> {
    vec![
        configuration(args),
        data_folder(args),
        within("database", database(args)).await,
        within("storage", storage(args)).await,
        within("detector", detector(args)).await,
        certificates(),
        within("identity provider", identity_provider(args)).await,
    ]
}

/// A check that ends within reason.
async fn within(name: &'static str, check: impl Future<Output = Check>) -> Check {
    let hung = |_| {
        let found = format!("nothing answered within {} s", PATIENCE.as_secs());
        Check::failed(name, found, "see whether the disk, the database or the network behind it hangs")
    };
    tokio::time::timeout(PATIENCE, check).await.unwrap_or_else(hung)
}

fn chain(error: &anyhow::Error) -> String {
    format!("{error:#}")
}

/// Access to the service.
fn configuration(args: &ServeArgs) -> Check {
    let listen = args.listen;
    match (args.insecure, listen.ip().is_loopback()) {
        (true, true) => Check::warning(
            "configuration",
            format!("--insecure: everyone who can reach {listen} on this machine may do everything"),
            "omit --insecure if others use this machine, and create keys with `heliomap keys create`",
        ),
        (true, false) => Check::failed(
            "configuration",
            format!("--insecure on {listen}, which is no loopback address: the service will not start"),
            "omit --insecure, and create keys with `heliomap keys create`",
        ),
        (false, _) => Check::ok("configuration", format!("listens on {listen} and requires keys")),
    }
}

/// The folder with its free space, and the clock of its disk.
fn data_folder(args: &ServeArgs) -> Check {
    const NAME: &str = "data folder";
    let folder = &args.storage.data_dir;
    let shown = folder.display();
    let advice = "create it for the user that runs the service, or choose another with --data-dir";
    match std::fs::metadata(folder) {
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => {
            return Check::warning(NAME, format!("{shown} is not there yet"), "the service makes it when it starts");
        }
        Err(error) => return Check::failed(NAME, format!("{shown}: {error}"), advice),
        Ok(found) if !found.is_dir() => return Check::failed(NAME, format!("{shown} is no folder"), advice),
        Ok(_) => {}
    }
    let written = tempfile::Builder::new().prefix("doctor-").tempfile_in(folder).and_then(|mut file| {
        std::io::Write::write_all(&mut file, b"heliomap doctor")?;
        file.as_file().sync_all()?;
        file.as_file().metadata()?.modified()
    });
    let written = match written {
        Ok(written) => written,
        Err(error) => return Check::failed(NAME, format!("{shown} cannot be written to: {error}"), advice),
    };
    let now = SystemTime::now();
    let off = now.duration_since(written).or_else(|_| written.duration_since(now)).unwrap_or_default();
    if off > MAX_CLOCK_DIFFERENCE.unsigned_abs() {
        let found = format!("the clocks of this machine and of the disk of {shown} differ by {} s", off.as_secs());
        return Check::failed(NAME, found, "set both clocks by NTP: leases of jobs go by them");
    }
    let free = match rustix::fs::statvfs(folder) {
        Ok(found) => found.f_bavail.saturating_mul(found.f_frsize),
        Err(error) => return Check::failed(NAME, format!("{shown}: {error}"), advice),
    };
    let reserve = args.limits.disk_reserve;
    if free < reserve {
        let found =
            format!("{free} bytes are free in {shown}, less than the {reserve} of --disk-reserve: no upload is taken");
        return Check::failed(NAME, found, "make room, or lower --disk-reserve");
    }
    Check::ok(NAME, format!("{shown} can be written to, {free} bytes are free"))
}

/// The database: there, of this program's schema, and good for writing.
async fn database(args: &ServeArgs) -> Check {
    const NAME: &str = "database";
    let (examined, what, advice) = match &args.storage.database {
        Some(url) => (
            PostgresStore::examine(url).await,
            "the database of --database".to_owned(),
            "check its address, name, user and password, and that it takes connections from this machine",
        ),
        None => {
            let file = args.storage.data_dir.join(ROWS);
            let what = file.display().to_string();
            if !file.exists() {
                return Check::warning(NAME, format!("{what} is not there yet"), "the service makes it when it starts");
            }
            let advice = "see that the file belongs to the user that runs the service and that its disk is not full";
            (SqliteStore::examine(&file).await, what, advice)
        }
    };
    let Examined { schema, writable, now, has_keys } = match examined {
        Ok(examined) => examined,
        Err(error) => return Check::failed(NAME, format!("{what} does not answer: {error}"), advice),
    };
    match schema {
        Schema::Absent => {
            let found = format!("{what} answers and is empty");
            return Check::warning(NAME, found, "the service makes its tables when it starts");
        }
        Schema::Behind { missing } => {
            let found = format!("{what} answers, and {missing} changes of this version are not made yet");
            return Check::warning(NAME, found, "back it up; the service makes them when it starts");
        }
        Schema::Ahead => {
            let found = format!("{what} was changed by a newer version of heliomap");
            return Check::failed(NAME, found, "run that version or a newer one");
        }
        Schema::Current => {}
    }
    if let Err(error) = writable {
        return Check::failed(NAME, format!("{what} cannot be written to: {error}"), advice);
    }
    let off = now.map(|now| Timestamp::now().duration_since(now).abs()).unwrap_or_default();
    if off > MAX_CLOCK_DIFFERENCE {
        let found = format!("the clocks of this machine and of the database differ by {} s", off.as_secs());
        return Check::failed(NAME, found, "set both clocks by NTP: leases of jobs go by them");
    }
    let found = format!("{what} answers, is of this version and can be written to");
    if !has_keys && !args.insecure {
        let advice =
            "create the first key with `heliomap keys create --scope admin --name NAME`; every request needs one";
        return Check::warning(NAME, format!("{found}; it holds no key"), advice);
    }
    if let Some(url) = &args.storage.database
        && !PostgresStore::is_guarded(url).unwrap_or(true)
    {
        let advice = "encrypt the connection and check its certificate: add ?sslmode=verify-full to --database, and &sslrootcert=FILE \
                      if the certificate is from your own authority";
        return Check::warning(
            NAME,
            format!("{found}; the connection is not protected against others on the network"),
            advice,
        );
    }
    Check::ok(NAME, found)
}

/// The store of bytes: what is written can be read and deleted.
async fn storage(args: &ServeArgs) -> Check {
    const NAME: &str = "storage";
    const ADVICE: &str = "see that it may be written to by the user that runs the service, and that it is not full";
    if !args.storage.data_dir.is_dir() {
        return Check::warning(
            NAME,
            "it is in the data folder, which is not there yet",
            "the service makes it when it starts",
        );
    }
    let tried = async {
        let blobs = open_blobs(&args.storage).await?;
        // A plant of its own that no other can be.
        let plant = PlantId(uuid::Uuid::new_v4());
        let begun = Instant::now();
        let written = uuid::Uuid::new_v4().to_string().into_bytes();
        let digest = blobs.put_bytes(plant, written.clone()).await?;
        let read = blobs.get(plant, digest).await?;
        blobs.delete_plant(plant).await?;
        anyhow::ensure!(read == written, "what was read is not what was written");
        anyhow::Ok(begun.elapsed())
    };
    match tried.await {
        Ok(took) => Check::ok(NAME, format!("wrote, read and deleted a file in {} ms", took.as_millis())),
        Err(error) => Check::failed(NAME, chain(&error), ADVICE),
    }
}

/// ONNX Runtime and the models: they load, and search an image.
async fn detector(args: &ServeArgs) -> Check {
    const NAME: &str = "detector";
    let detector = args.detector.clone();
    let tried = tokio::task::spawn_blocking(move || {
        let detector = detector.open(0)?;
        let begun = Instant::now();
        let picture = RgbImage::from_fn(TRIAL_PX, TRIAL_PX, |x, y| image::Rgb([(x % 256) as u8, (y % 256) as u8, 90]));
        detector.detect(&picture, None)?;
        Ok::<_, DetectionError>((detector.describe(), begun.elapsed()))
    });
    match tried.await {
        Ok(Ok((described, took))) => {
            Check::ok(NAME, format!("{described}; searched {TRIAL_PX} x {TRIAL_PX} pixels in {} ms", took.as_millis()))
        }
        Ok(Err(error)) => {
            let advice = match error {
                DetectionError::RuntimeMissing
                | DetectionError::RuntimeUnusable { .. }
                | DetectionError::ProviderMissing { .. } => {
                    "jobs fail without it; set ORT_DYLIB_PATH to the library of an ONNX Runtime that works here"
                }
                _ => "jobs fail without it; ONNX Runtime works, so name valid models with --detector",
            };
            Check::failed(NAME, error.to_string(), advice)
        }
        Err(_) => Check::failed(
            NAME,
            "the detector panicked",
            "install the version of ONNX Runtime that `make setup` fetches",
        ),
    }
}

/// Certificates to check other services by.
fn certificates() -> Check {
    const NAME: &str = "certificates";
    heliomap::tls::provide();
    match reqwest::Client::builder().build() {
        Ok(_) => Check::ok(NAME, "other services can be checked by the certificates of this machine"),
        Err(error) => Check::warning(
            NAME,
            format!("no messages can be sent to webhooks: {}", chain(&error.into())),
            "install the certificates of public authorities, on Debian the package ca-certificates",
        ),
    }
}

/// The keys of the identity provider, where there is one.
async fn identity_provider(args: &ServeArgs) -> Check {
    const NAME: &str = "identity provider";
    const ADVICE: &str = "check that --oidc-issuer is the exact issuer, and that this machine can reach the provider";
    let settings = match args.oidc.settings() {
        Ok(None) => return Check::ok(NAME, "none is configured"),
        Ok(Some(settings)) => settings,
        Err(wrong) => return Check::failed(NAME, wrong, "the service does not start before both are given"),
    };
    let fetched = async { Oidc::new(settings)?.fetch().await };
    match fetched.await {
        Ok(0) => Check::failed(NAME, "it has no key that signs by RS256, ES256 or EdDSA", ADVICE),
        Ok(count) => Check::ok(NAME, format!("it has {count} keys")),
        Err(error) => Check::failed(NAME, error.to_string(), ADVICE),
    }
}
