//! `heliomap map`: a folder in, a plant out, no server.

use super::output::{Output, notify, prepare_folder, print};
use super::progress::Progress;
use super::reconstruct;
use anyhow::{Context, bail, ensure};
use clap::Args;
use heliomap::config::{DetectorArgs, ImageSizeArgs, ReconstructionArgs, StartJob};
use heliomap_mapping::pipeline::{self, Boxes, MapOptions, Observer, Stage, Subject};
use heliomap_mapping::refinement::Method;
use heliomap_model::{Layer, PlantId, PlantModel};
use heliomap_overlay as overlay;
use serde_json::json;
use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Map the plant in a folder as OpenSfM leaves it.
#[derive(Debug, Args)]
#[command(after_help = "The folder holds reconstruction.json, reference_lla.json, images/ and, where there is one, \
                        undistorted/ with images/ and depthmaps/merged.ply. With --reconstruct, images/ \
                        is enough.\n\n\
                        Example: heliomap map my-survey --out plant.geojson --overlay pictures --timings")]
pub struct MapArgs {
    /// Folder with the reconstruction and the images
    folder: PathBuf,
    /// GeoJSON file of all modules to write, `-` for standard output; sectors, benches and lines come beside it with
    /// `--layers`
    #[arg(short, long, value_name = "FILE", default_value = "plant.geojson")]
    out: PathBuf,
    /// Also write sectors, benches and lines, as FILE-sectors.geojson and so on
    #[arg(long)]
    layers: bool,
    /// Draw detections, rows, gaps, hypotheses and labels on the photos, and the plant from above, into this folder
    #[arg(long, value_name = "DIR")]
    overlay: Option<PathBuf>,
    /// Use these boxes instead of searching the images (the format of `heliomap detect`)
    #[arg(long, value_name = "FILE")]
    detections: Option<PathBuf>,
    #[command(flatten)]
    detector: DetectorArgs,
    /// Threads to use; all cores if absent
    #[arg(long, env = "HELIOMAP_THREADS", value_name = "N")]
    threads: Option<usize>,
    /// Name of the plant: the same name gives the same identifiers
    #[arg(long, value_name = "NAME")]
    plant: Option<String>,
    /// Model of an earlier survey (the --model-out of that run), whose identifiers are kept
    #[arg(long, value_name = "FILE")]
    previous: Option<PathBuf>,
    /// Write the whole model as JSON, for --previous of the next survey
    #[arg(long, value_name = "FILE")]
    model_out: Option<PathBuf>,
    /// Reconstruct the photos first, as `heliomap reconstruct` does, where the folder has no reconstruction
    #[arg(long)]
    reconstruct: bool,
    #[command(flatten)]
    reconstruction: ReconstructionArgs,
    #[command(flatten)]
    options: StartJob,
    /// How positions are refined
    #[arg(long, value_enum, default_value_t = MethodArg::Lattice)]
    refinement: MethodArg,
    #[command(flatten)]
    image_size: ImageSizeArgs,
    /// Print seconds and peak memory of every stage
    #[arg(long)]
    timings: bool,
    /// Print warnings and the summary as JSON on standard output
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Clone, Copy, clap::ValueEnum)]
enum MethodArg {
    /// The lattice of each bench from the pixels of all views
    Lattice,
    /// The paper's lines and uniform spacing (3.6)
    Paper,
}

/// Runs the command.
pub fn run(args: &MapArgs) -> anyhow::Result<()> {
    let outputs = Outputs::named(args)?;
    let cores = std::thread::available_parallelism().map_or(2, usize::from);
    let threads = args.threads.unwrap_or(cores).max(1);
    rayon::ThreadPoolBuilder::new().num_threads(threads).build_global().context("starting the threads")?;
    let options = MapOptions {
        refinement: match args.refinement {
            MethodArg::Lattice => Method::Lattice,
            MethodArg::Paper => Method::Paper,
        },
        max_image_pixels: args.image_size.max_pixels(),
        ..args.options.clone().into_options().map_err(anyhow::Error::msg)?
    };
    let folder_name = args.folder.canonicalize().ok().and_then(|f| Some(f.file_name()?.to_string_lossy().into_owned()));
    let survey = folder_name.unwrap_or_else(|| args.folder.display().to_string());
    let previous = args.previous.as_deref().map(read_model).transpose()?.map(Arc::new);
    let plant_name = args
        .plant
        .clone()
        .or_else(|| previous.as_ref().map(|model| model.plant_name.clone()))
        .unwrap_or_else(|| survey.clone());
    let plant = previous.as_ref().map_or_else(|| PlantId::from_name(&plant_name), |model| model.plant);
    let subject = Subject { plant, plant_name, survey, previous };

    let detector = match args.detections {
        Some(_) => None,
        None => Some(args.detector.open(threads)?),
    };
    let boxes = match (&args.detections, &detector) {
        (Some(file), _) => Boxes::File(file),
        (None, Some(detector)) => Boxes::Detector(&**detector),
        (None, None) => bail!("neither a detector nor boxes were given"),
    };
    if args.reconstruct && !args.folder.join("reconstruction.json").exists() {
        let made = reconstruct::reconstruct(&args.folder, &args.reconstruction, args.threads, args.image_size)?;
        reconstruct::announce(&made);
    }
    let report = Report(Progress::new());
    let mapping = pipeline::map_folder(&args.folder, boxes, &options, &subject, &report)?;
    report.0.finish();

    let model = &mapping.model;
    for (layer, output) in &outputs.layers {
        output.write_json(&model.feature_collection(*layer))?;
    }
    if let Some(output) = &outputs.model {
        output.write_json(model)?;
    }
    if let Some(folder) = &args.overlay {
        overlay::draw(&mapping, folder)?;
    }
    if args.json {
        let summary = json!({
            "modules": model.modules.len(), "sectors": model.sectors.len(), "benches": model.benches.len(),
            "lines": model.lines.len(), "warnings": model.warnings, "out": args.out,
            "timings": mapping.timings.iter().map(|t| json!({
                "stage": t.stage.as_str(), "seconds": t.wall.as_secs_f64(), "peak_memory_bytes": t.peak_memory_bytes,
            })).collect::<Vec<_>>(),
        });
        print(format_args!("{summary:#}\n"))?;
    } else {
        let mut summary = String::new();
        for warning in &model.warnings {
            writeln!(summary, "warning ({}): {}", warning.code, warning.message)?;
        }
        writeln!(
            summary,
            "{} modules in {} sectors, {} benches and {} lines: {}",
            model.modules.len(),
            model.sectors.len(),
            model.benches.len(),
            model.lines.len(),
            args.out.display()
        )?;
        match outputs.take_stdout() {
            true => notify(summary.trim_end()),
            false => print(summary)?,
        }
    }
    if args.timings {
        notify(format_args!("{:<10} {:>9} {:>14}", "stage", "seconds", "peak memory"));
        for timing in &mapping.timings {
            let memory = timing.peak_memory_bytes.map_or_else(|| "?".to_owned(), |b| format!("{} MB", b / 1_000_000));
            notify(format_args!("{:<10} {:>9.3} {:>14}", timing.stage.as_str(), timing.wall.as_secs_f64(), memory));
        }
    }
    Ok(())
}

/// What the command writes, checked before it works.
struct Outputs {
    layers: Vec<(Layer, Output)>,
    model: Option<Output>,
}

impl Outputs {
    fn named(args: &MapArgs) -> anyhow::Result<Self> {
        let modules = Output::named(&args.out)?;
        let mut layers = vec![(Layer::Modules, modules.clone())];
        if args.layers {
            ensure!(modules != Output::Stdout, "--layers writes files beside --out: name a file there");
            let stem = args.out.file_stem().unwrap_or_default().to_string_lossy().into_owned();
            for layer in [Layer::Sectors, Layer::Benches, Layer::Lines] {
                layers.push((layer, Output::named(&args.out.with_file_name(format!("{stem}-{layer}.geojson")))?));
            }
        }
        let model = args.model_out.as_deref().map(Output::named).transpose()?;
        if let Some(model) = &model {
            let twice = layers.iter().any(|(_, output)| output == model);
            ensure!(!twice, "--out and --model-out both name {model}: name two files");
        }
        if let Some(folder) = &args.overlay {
            prepare_folder(folder)?;
        }
        let outputs = Self { layers, model };
        ensure!(!(args.json && outputs.take_stdout()), "--json prints to standard output: write the plant to a file");
        Ok(outputs)
    }

    /// Whether a document goes to standard output, so that nothing else may.
    fn take_stdout(&self) -> bool {
        let layers = self.layers.iter().map(|(_, output)| output);
        layers.chain(&self.model).any(|output| *output == Output::Stdout)
    }
}

fn read_model(path: &Path) -> anyhow::Result<PlantModel> {
    let what = || format!("{} is no model that `heliomap map --model-out` wrote", path.display());
    let file = std::fs::File::open(path).with_context(|| format!("reading {}", path.display()))?;
    serde_json::from_reader(std::io::BufReader::new(file)).with_context(what)
}

struct Report(Progress);

impl Observer for Report {
    fn progress(&self, stage: Stage, done: usize, total: usize) {
        self.0.show(stage.as_str(), done, total);
    }
}
