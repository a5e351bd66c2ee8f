//! `heliomap openapi`: the description of the HTTP API.

use super::output::print;
use heliomap::config::OpenapiArgs;
use heliomap::http;

/// Prints the description.
pub fn run(args: &OpenapiArgs) -> anyhow::Result<()> {
    let description = http::openapi();
    match args.json {
        true => print(format_args!("{}\n", description.to_pretty_json()?)),
        false => print(description.to_yaml()?),
    }
}
