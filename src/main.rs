//! The command line.

mod commands;

use clap::Parser;
use heliomap::config::{Cli, Command};

fn main() -> anyhow::Result<()> {
    let cli = Cli::parse();
    heliomap::telemetry::init(&cli.log)?;
    match cli.command {
        Command::Serve(args) => commands::serve::run(args),
        Command::Worker(args) => commands::worker::run(args),
        Command::Openapi(args) => commands::openapi::run(&args),
    }
}
