//! `heliomap map`: a folder in, a plant out, no server.

use super::output::{Output, prepare_folder, print, tell};
use anyhow::{Context, bail, ensure};
use clap::Args;
use heliomap::config::DetectorArgs;
use heliomap_mapping::pipeline::{self, Boxes, MapOptions, Observer, Stage, Subject};
use heliomap_mapping::refinement::{Control, Method};
use heliomap_model::{Layer, PlantId, PlantModel};
use heliomap_overlay as overlay;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use serde_json::json;
use std::fmt::Write;
use std::io::IsTerminal;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

/// Map the plant in a folder as OpenSfM leaves it.
#[derive(Debug, Args)]
#[command(after_help = "The folder holds reconstruction.json, reference_lla.json, images/ and, where there is one, \
                        undistorted/ with images/ and depthmaps/merged.ply.\n\n\
                        Example: heliomap map my-survey --out plant.geojson --overlay pictures --timings")]
pub struct MapArgs {
    /// Folder with the reconstruction and the images
    folder: PathBuf,
    /// GeoJSON file of all modules to write, `-` for standard output; sectors, benches and lines come beside it with
    /// `--layers`
    #[arg(short, long, value_name = "FILE", default_value = "plant.geojson")]
    out: PathBuf,
    /// Write sectors, benches and lines too, as FILE-sectors.geojson and so on
    #[arg(long)]
    layers: bool,
    /// Draw detections, rows, gaps, hypotheses and labels on the photos, and the plant from above, into this folder
    #[arg(long, value_name = "DIR")]
    overlay: Option<PathBuf>,
    /// Take these boxes instead of searching the images (the form that detectors write)
    #[arg(long, value_name = "FILE")]
    detections: Option<PathBuf>,
    #[command(flatten)]
    detector: DetectorArgs,
    /// Threads to use; all cores where it is not given
    #[arg(long, env = "HELIOMAP_THREADS", value_name = "N")]
    threads: Option<usize>,
    /// Name of the plant: the same name gives the same identifiers
    #[arg(long, value_name = "NAME")]
    plant: Option<String>,
    /// Model of an earlier survey (the --model-out of that run), whose identifiers live on
    #[arg(long, value_name = "FILE")]
    previous: Option<PathBuf>,
    /// Write the whole model as JSON, for --previous of the next survey
    #[arg(long, value_name = "FILE")]
    model_out: Option<PathBuf>,
    /// Rows of modules per bench, if all have the same; inferred otherwise
    #[arg(long, value_name = "N")]
    rows_per_bench: Option<u32>,
    /// Coarsest ground sampling distance of images to search, metres per pixel [default: 0.06]
    #[arg(long, value_name = "M")]
    max_gsd: Option<f64>,
    /// Known spacing of module centres along and across the row in metres, for example 1.02,1.67: fixes the scale
    #[arg(long, value_name = "ALONG,ACROSS", value_delimiter = ',')]
    spacing: Option<Vec<f64>>,
    /// Known size of a module's face in metres, width along the row and height across it, for example 1.00,1.65: fixes
    /// the scale
    #[arg(long, value_name = "WIDTH,HEIGHT", value_delimiter = ',', conflicts_with = "spacing")]
    module_size: Option<Vec<f64>>,
    /// Control points and known modules to align the model by, a JSON file (docs/PIPELINE.md tells its form)
    #[arg(long, value_name = "FILE")]
    control: Option<PathBuf>,
    /// Whether control sets the scale too [default: unless --spacing or --module-size does]
    #[arg(long, value_name = "BOOL", requires = "control")]
    control_scale: Option<bool>,
    /// What heights refer to, stated in the model, for example "EGM2008 height"
    #[arg(long, value_name = "NAME")]
    vertical_datum: Option<String>,
    /// How positions are refined
    #[arg(long, value_enum, default_value_t = MethodArg::Lattice)]
    refinement: MethodArg,
    /// Most megapixels that an image may have
    #[arg(long, env = "HELIOMAP_MAX_MEGAPIXELS", value_name = "MP", default_value_t = 100)]
    max_megapixels: u64,
    /// Seed of every random choice
    #[arg(long, default_value_t = 1)]
    seed: u64,
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
    let spacing_m =
        two_lengths(args.spacing.as_deref(), "--spacing takes two lengths in metres, along and across the row")?;
    let module_size_m =
        two_lengths(args.module_size.as_deref(), "--module-size takes two lengths in metres, width and height")?;
    let options = MapOptions {
        rows_per_bench: args.rows_per_bench,
        max_gsd_m_per_px: args.max_gsd,
        spacing_m,
        module_size_m,
        control: args.control.as_deref().map(read_control).transpose()?,
        control_scale: args.control_scale,
        vertical_datum: args.vertical_datum.clone(),
        refinement: match args.refinement {
            MethodArg::Lattice => Method::Lattice,
            MethodArg::Paper => Method::Paper,
        },
        max_image_pixels: args.max_megapixels.saturating_mul(1_000_000),
        seed: args.seed,
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
    let report = Report::new();
    let mapping = pipeline::map_folder(&args.folder, boxes, &options, &subject, &report)?;
    report.finish();

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
            true => tell(summary.trim_end()),
            false => print(summary)?,
        }
    }
    if args.timings {
        tell(format_args!("{:<10} {:>9} {:>14}", "stage", "seconds", "peak memory"));
        for timing in &mapping.timings {
            let memory = timing.peak_memory_bytes.map_or_else(|| "?".to_owned(), |b| format!("{} MB", b / 1_000_000));
            tell(format_args!("{:<10} {:>9.3} {:>14}", timing.stage.as_str(), timing.wall.as_secs_f64(), memory));
        }
    }
    Ok(())
}

/// What the command writes, looked at before it works.
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

fn two_lengths(given: Option<&[f64]>, expected: &'static str) -> anyhow::Result<Option<[f64; 2]>> {
    match given {
        None => Ok(None),
        Some(&[first, second]) => Ok(Some([first, second])),
        Some(_) => bail!(expected),
    }
}

fn read_control(path: &Path) -> anyhow::Result<Control> {
    const MOST_BYTES: u64 = 64 << 20;
    let what = || format!("reading {}", path.display());
    let file = std::fs::File::open(path).with_context(what)?;
    if file.metadata().with_context(what)?.len() > MOST_BYTES {
        bail!("{} is larger than {MOST_BYTES} bytes, more than control points need", path.display());
    }
    serde_json::from_reader(std::io::BufReader::new(file))
        .with_context(|| format!("{} is no file of control points as docs/PIPELINE.md describes it", path.display()))
}

fn read_model(path: &Path) -> anyhow::Result<PlantModel> {
    let what = || format!("{} is no model that `heliomap map --model-out` wrote", path.display());
    let file = std::fs::File::open(path).with_context(|| format!("reading {}", path.display()))?;
    serde_json::from_reader(std::io::BufReader::new(file)).with_context(what)
}

/// A bar on a terminal, a line per tenth elsewhere.
struct Report {
    bar: Option<ProgressBar>,
    last: Mutex<Option<(Stage, usize)>>,
}

impl Report {
    fn new() -> Self {
        let bar = std::io::stderr().is_terminal().then(|| {
            let bar = ProgressBar::with_draw_target(Some(1), ProgressDrawTarget::stderr());
            if let Ok(style) = ProgressStyle::with_template("{msg:<10} [{bar:40}] {pos}/{len} {elapsed}") {
                bar.set_style(style.progress_chars("=> "));
            }
            bar
        });
        Self { bar, last: Mutex::new(None) }
    }

    fn finish(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}

impl Observer for Report {
    fn progress(&self, stage: Stage, done: usize, total: usize) {
        if let Some(bar) = &self.bar {
            bar.set_message(stage.as_str());
            bar.set_length(total as u64);
            bar.set_position(done as u64);
            return;
        }
        let tenth = (done * 10).checked_div(total).unwrap_or(10);
        if let Ok(mut last) = self.last.lock()
            && *last != Some((stage, tenth))
        {
            *last = Some((stage, tenth));
            tell(format_args!("{}: {done} of {total}", stage.as_str()));
        }
    }
}
