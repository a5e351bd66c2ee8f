//! The command line.

mod commands;

use clap::{Parser, Subcommand};
use heliomap::config::{KeysArgs, LogArgs, OpenapiArgs, OrganisationsArgs, ServeArgs, WorkerArgs};

/// Maps photovoltaic plants from drone overview photos: every module georeferenced, with its place in the plant.
#[derive(Debug, Parser)]
#[command(name = "heliomap", version, about, max_term_width = 110)]
struct Cli {
    #[command(flatten)]
    log: LogArgs,
    #[command(subcommand)]
    command: Command,
}

/// What to do.
#[derive(Debug, Subcommand)]
enum Command {
    /// Serve the HTTP API and the web page, with a worker inside.
    Serve(ServeArgs),
    /// Run mapping jobs for a service with the same data folder.
    Worker(WorkerArgs),
    /// Make, list, rotate and revoke keys to the service.
    Keys(KeysArgs),
    /// List organisations, and say what each may keep.
    Organisations(OrganisationsArgs),
    /// Map the plant in a folder as OpenSfM leaves it; no server is needed.
    Map(commands::map::MapArgs),
    /// Find the modules in photos and write their boxes.
    Detect(commands::detect::DetectArgs),
    /// Compare a plant with a truth or any reference model.
    Evaluate(commands::evaluate::EvaluateArgs),
    /// Measure a detector, or a file of boxes, against labelled photos.
    EvaluateDetection(commands::evaluate_detection::EvaluateDetectionArgs),
    /// Print the description of the HTTP API.
    Openapi(OpenapiArgs),
}

fn main() -> anyhow::Result<()> {
    let cli = Cli::parse();
    heliomap::telemetry::init(&cli.log)?;
    match cli.command {
        Command::Serve(args) => commands::serve::run(args),
        Command::Worker(args) => commands::worker::run(args),
        Command::Keys(args) => commands::keys::run(args),
        Command::Organisations(args) => commands::organisations::run(args),
        Command::Map(args) => commands::map::run(&args),
        Command::Detect(args) => commands::detect::run(&args),
        Command::EvaluateDetection(args) => commands::evaluate_detection::run(&args),
        Command::Evaluate(args) => commands::evaluate::run(&args),
        Command::Openapi(args) => commands::openapi::run(&args),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;
    use heliomap::config::Limits;

    #[test]
    fn the_command_line_is_consistent() {
        Cli::command().debug_assert();
    }

    #[test]
    fn defaults_agree() {
        let cli = Cli::parse_from(["heliomap", "serve"]);
        let Command::Serve(serve) = cli.command else { panic!("serve was asked for") };
        assert_eq!(format!("{:?}", serve.limits), format!("{:?}", Limits::default()));
    }
}
