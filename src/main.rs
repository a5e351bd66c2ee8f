//! The command line.

mod commands;

use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};
use commands::output::notify;
use heliomap::config::{
    BackupArgs, DoctorArgs, KeysArgs, LogArgs, OpenapiArgs, OrganisationsArgs, RestoreArgs, ServeArgs, TraceArgs,
    VerifyArgs, WorkerArgs, file,
};
use rustix::fs::Mode;
use std::process::ExitCode;

/// Maps photovoltaic plants from drone overview photos: every module georeferenced, with its place in the plant.
#[derive(Debug, Parser)]
#[command(name = "heliomap", version, about, max_term_width = 110)]
struct Cli {
    #[command(flatten)]
    log: LogArgs,
    #[command(flatten)]
    traces: TraceArgs,
    #[command(subcommand)]
    command: Command,
}

/// The commands.
#[derive(Debug, Subcommand)]
enum Command {
    /// Serve the HTTP API and the web page, with a worker inside.
    Serve(ServeArgs),
    /// Run mapping jobs for a service with the same data folder.
    Worker(WorkerArgs),
    /// Create, list, rotate and revoke keys to the service.
    Keys(KeysArgs),
    /// List organisations and set their quotas.
    Organisations(OrganisationsArgs),
    /// Back up a service with an SQLite database, running or not.
    Backup(BackupArgs),
    /// Restore a backup into a new data folder.
    Restore(RestoreArgs),
    /// Check that every file that the database names exists.
    Verify(VerifyArgs),
    /// Map the plant in a folder as OpenSfM leaves it; no server is needed.
    Map(commands::map::MapArgs),
    /// Reconstruct photos: where each was taken and which points it shows.
    Reconstruct(commands::reconstruct::ReconstructArgs),
    /// Find the modules in photos and write their boxes.
    Detect(commands::detect::DetectArgs),
    /// Compare a plant with a truth or any reference model.
    Evaluate(commands::evaluate::EvaluateArgs),
    /// Measure a detector, or a file of boxes, against labelled photos.
    EvaluateDetection(commands::evaluate_detection::EvaluateDetectionArgs),
    /// Check what the service needs, with advice for every fault.
    Doctor(DoctorArgs),
    /// Print the description of the HTTP API.
    Openapi(OpenapiArgs),
    /// Print docs/CONFIGURATION.md: every flag, environment variable and setting.
    #[command(hide = true)]
    Configuration,
}

impl Command {
    /// Whether it writes a data folder or a copy of one.
    fn keeps_data(&self) -> bool {
        matches!(
            self,
            Self::Serve(_)
                | Self::Worker(_)
                | Self::Keys(_)
                | Self::Organisations(_)
                | Self::Backup(_)
                | Self::Restore(_)
                | Self::Verify(_)
        )
    }
}

fn main() -> ExitCode {
    match parse().and_then(traced) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            notify(report(&error));
            ExitCode::FAILURE
        }
    }
}

fn traced(cli: Cli) -> anyhow::Result<()> {
    let traces = heliomap::telemetry::init(&cli.log, &cli.traces)?;
    let outcome = run(cli.command);
    if let Some(traces) = traces {
        traces.end();
    }
    outcome
}

/// An error for people: what failed, and every cause whose text is not part of it already. There is no backtrace, because most
/// errors are mistakes in the input.
fn report(error: &anyhow::Error) -> String {
    let mut report = format!("Error: {error}");
    for cause in error.chain().skip(1).map(ToString::to_string) {
        if !report.contains(&cause) {
            report.push_str("\n  because: ");
            report.push_str(&cause);
        }
    }
    report
}

fn run(command: Command) -> anyhow::Result<()> {
    if command.keeps_data() {
        // What it writes is for the user that it runs as, and nobody else of the machine.
        rustix::process::umask(Mode::RWXG | Mode::RWXO);
    }
    match command {
        Command::Serve(args) => commands::serve::run(args),
        Command::Worker(args) => commands::worker::run(args),
        Command::Keys(args) => commands::keys::run(args),
        Command::Organisations(args) => commands::organisations::run(args),
        Command::Backup(args) => commands::backup::backup(args),
        Command::Restore(args) => commands::backup::restore(args),
        Command::Verify(args) => commands::backup::verify(args),
        Command::Map(args) => commands::map::run(&args),
        Command::Reconstruct(args) => commands::reconstruct::run(&args),
        Command::Detect(args) => commands::detect::run(&args),
        Command::EvaluateDetection(args) => commands::evaluate_detection::run(&args),
        Command::Evaluate(args) => commands::evaluate::run(&args),
        Command::Doctor(args) => commands::doctor::run(args),
        Command::Openapi(args) => commands::openapi::run(&args),
        Command::Configuration => commands::configuration::run(&Cli::command()),
    }
}

/// Reads the command line, with the configuration file that it names.
fn parse() -> anyhow::Result<Cli> {
    let command = match file::named(std::env::args_os()) {
        Some(path) => file::with_file(Cli::command(), &path)?,
        None => Cli::command(),
    };
    let command = file::with_renamed_variables(command);
    Ok(Cli::from_arg_matches(&command.get_matches()).unwrap_or_else(|error| error.exit()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use heliomap::config::Limits;
    use std::time::Duration;

    #[test]
    fn causes_are_not_repeated() {
        let cause = std::io::Error::from(std::io::ErrorKind::NotFound);
        let error = anyhow::anyhow!("a.jpg cannot be read: {cause}");
        let chain = anyhow::Error::from(cause).context("opening the door").context("getting in: opening the door");
        assert_eq!(report(&error), "Error: a.jpg cannot be read: entity not found");
        assert_eq!(report(&chain), "Error: getting in: opening the door\n  because: entity not found");
    }

    #[test]
    fn the_command_line_is_consistent() {
        Cli::command().debug_assert();
    }

    #[test]
    fn flags_of_version_0_1_are_accepted() {
        let map = Cli::command().get_matches_from(["heliomap", "map", "folder", "--max-megapixels", "2"]);
        let map = map.subcommand_matches("map").unwrap();
        assert_eq!(map.get_one("max_image_megapixels"), Some(&2.0));
        let keys = ["heliomap", "keys", "create", "--name", "a", "--scope", "read", "--days", "3"];
        let keys = Cli::command().get_matches_from(keys);
        let create = keys.subcommand_matches("keys").and_then(|keys| keys.subcommand_matches("create")).unwrap();
        assert_eq!(create.get_one("expires_after"), Some(&Duration::from_secs(3 * 24 * 3600)));
        let worker = Cli::command().get_matches_from(["heliomap", "worker", "--lease", "2", "--keep-audit", "7"]);
        let worker = worker.subcommand_matches("worker").unwrap();
        assert_eq!(worker.get_one("lease"), Some(&Duration::from_secs(2)));
        assert_eq!(worker.get_one("keep_audit"), Some(&Duration::from_secs(7 * 24 * 3600)));
    }

    #[test]
    fn every_setting_is_documented() {
        let written = commands::configuration::document(&Cli::command());
        assert!(
            written == include_str!("../docs/CONFIGURATION.md"),
            "run `make configuration` and review the difference"
        );
    }

    #[test]
    fn defaults_agree() {
        let cli = Cli::parse_from(["heliomap", "serve"]);
        let Command::Serve(serve) = cli.command else { panic!("serve was asked for") };
        assert_eq!(format!("{:?}", serve.limits), format!("{:?}", Limits::default()));
    }
}
