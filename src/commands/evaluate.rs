//! `heliomap evaluate`: a plant against a truth or any reference model.

use super::output::{Output, prepare_folder, print};
use anyhow::bail;
use heliomap_evaluation::{self as evaluation, read_model};
use std::path::PathBuf;

/// Compare a plant with a truth or any reference model.
///
/// Finds the alignment between both, pairs their modules, and reports modules found, missing and false, whether every
/// module has its line, bench, row and number, and how far positions differ as is, after a rigid fit and after a
/// similarity fit.
#[derive(Debug, clap::Args)]
pub struct EvaluateArgs {
    /// GeoJSON of the plant's modules, as `heliomap map` writes it.
    plant: PathBuf,
    /// What it should be: a truth.json, or GeoJSON of modules.
    truth: PathBuf,
    /// Write everything as JSON too; `-` prints it instead of the text.
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Draw differences, spacing and the plant from above as SVG into this folder.
    #[arg(long, value_name = "DIR")]
    plots: Option<PathBuf>,
    /// Fail unless every module is found, none is false and the structure is exact.
    #[arg(long)]
    strict: bool,
}

/// Runs the comparison and prints it.
pub fn run(args: &EvaluateArgs) -> anyhow::Result<()> {
    let json = args.json.as_deref().map(Output::named).transpose()?;
    if let Some(folder) = &args.plots {
        prepare_folder(folder)?;
    }
    let truth = read_model(&args.truth, None)?;
    let plant = read_model(&args.plant, Some(truth.reference))?;
    let evaluation = evaluation::evaluate(&plant, &truth)?;
    let to_stdout = json == Some(Output::Stdout);
    match &json {
        Some(Output::Stdout) => print(format_args!("{}\n", serde_json::to_string_pretty(&evaluation)?))?,
        json => {
            print(&evaluation)?;
            json.as_ref().map_or(Ok(()), |json| json.write_json(&evaluation))?;
        }
    }
    if let Some(folder) = &args.plots {
        let written = evaluation::write_plots(&evaluation, &plant, &truth, folder)?;
        if !to_stdout {
            let names: Vec<String> = written.iter().map(|path| path.display().to_string()).collect();
            print(format_args!("\nPlots: {}\n", names.join(", ")))?;
        }
    }
    if args.strict && !evaluation.is_flawless() {
        bail!(
            "{} missing, {} false, structure {}",
            evaluation.missing.len(),
            evaluation.false_modules.len(),
            if evaluation.structure.exact { "exact" } else { "not exact" }
        );
    }
    Ok(())
}
