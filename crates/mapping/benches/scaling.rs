//! Time and memory over the size of the plant: from detections to the model, on simulated plants from 5,000 modules up.
//!
//! `make scaling` runs it; `HELIOMAP_SCALING_SIZES="5000 1000000"` chooses other sizes. Each size runs in a process of its
//! own, so that memory is its own too. What is measured begins when the plant, its detections and its cloud are in memory.

use anyhow::{Context, Result};
use heliomap_mapping::assembly::{Identity, assemble};
use heliomap_mapping::fusion::{self, FusionOptions, View};
use heliomap_mapping::layout::{self, Layout, LayoutOptions};
use heliomap_mapping::refinement::{self, RefinementOptions};
use heliomap_model::PlantId;
use heliomap_simulator::{Errors, Flight, PlantSpec, simulate};
use plotters::prelude::*;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::path::Path;
use std::process::Command;
use std::time::Instant;

const SIZES: [usize; 7] = [5_000, 10_000, 25_000, 100_000, 250_000, 500_000, 1_000_000];
const CHILD: &str = "HELIOMAP_SCALING_CHILD";

/// One stage of one size.
#[derive(Debug, Clone, Serialize, Deserialize)]
struct StageFigures {
    stage: String,
    wall_s: f64,
    /// Of all threads together.
    cpu_s: f64,
}

/// What one size took.
#[derive(Debug, Clone, Serialize, Deserialize)]
struct Figures {
    modules: usize,
    views: usize,
    detections: usize,
    cloud_points: usize,
    mapped: usize,
    warnings: usize,
    stages: Vec<StageFigures>,
    /// Resident when the measurement begins: the plant, its detections and its cloud.
    input_bytes: u64,
    /// Highest resident memory, the input included.
    peak_bytes: u64,
}

impl Figures {
    fn wall_s(&self) -> f64 {
        self.stages.iter().map(|stage| stage.wall_s).sum()
    }

    fn cpu_s(&self) -> f64 {
        self.stages.iter().map(|stage| stage.cpu_s).sum()
    }
}

fn main() -> Result<()> {
    if let Ok(size) = std::env::var(CHILD) {
        let figures = measure(size.parse().context("the size is no number")?);
        println!("{}", serde_json::to_string(&figures)?);
        return Ok(());
    }
    let chosen = std::env::var("HELIOMAP_SCALING_SIZES").unwrap_or_default();
    let mut sizes = chosen
        .split_whitespace()
        .map(|word| word.parse().with_context(|| format!("`{word}` in HELIOMAP_SCALING_SIZES is no number")))
        .collect::<Result<Vec<usize>>>()?;
    if sizes.is_empty() {
        sizes = SIZES.to_vec();
    }
    let mut all = Vec::new();
    for size in sizes {
        let child = Command::new(std::env::current_exe()?).env(CHILD, size.to_string()).output()?;
        anyhow::ensure!(child.status.success(), "{size} modules: {}", String::from_utf8_lossy(&child.stderr));
        let figures: Figures = serde_json::from_slice(&child.stdout)?;
        if all.is_empty() {
            print_header(&figures);
        }
        print_row(&figures);
        all.push(figures);
    }
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../target/scaling");
    std::fs::create_dir_all(&folder)?;
    std::fs::write(folder.join("scaling.json"), serde_json::to_vec_pretty(&all)?)?;
    plot(&all, &folder.join("scaling.svg"))?;
    println!("\nplot and figures: {}", folder.display());
    Ok(())
}

fn print_header(figures: &Figures) {
    let stages: Vec<&str> = figures.stages.iter().map(|stage| stage.stage.as_str()).collect();
    println!(
        "| modules | views | detections | points | {} | all, s | CPU, s | input, GB | peak, GB | mapped |",
        stages.join(", s | ")
    );
    println!("|{}", "---|".repeat(9 + stages.len()));
}

fn print_row(figures: &Figures) {
    let stages: Vec<String> = figures.stages.iter().map(|stage| format!("{:.2}", stage.wall_s)).collect();
    println!(
        "| {} | {} | {} | {} | {} | {:.2} | {:.2} | {:.2} | {:.2} | {} |",
        figures.modules,
        figures.views,
        figures.detections,
        figures.cloud_points,
        stages.join(" | "),
        figures.wall_s(),
        figures.cpu_s(),
        figures.input_bytes as f64 / 1e9,
        figures.peak_bytes as f64 / 1e9,
        figures.mapped
    );
}

/// Simulates a plant of the size and maps it.
fn measure(size: usize) -> Figures {
    let simulation = simulate(&PlantSpec::sized(size), &Flight::sized(), &Errors::paper(), 1);
    let modules = simulation.truth.modules.len();
    let (shots, detections) = (simulation.reconstruction.shots, simulation.detections);
    let cloud = simulation.reconstruction.dense.unwrap_or_default();
    let reference = simulation.reconstruction.reference;
    drop((simulation.truth, simulation.true_shots, simulation.owners, simulation.glare));

    // From here on the highest memory is counted anew, where the system can.
    let _ = std::fs::write("/proc/self/clear_refs", "5");
    let input_bytes = memory_bytes("VmRSS:");
    let mut clock = Clock { stages: Vec::new() };
    let layouts: Vec<Layout> = clock.stage("layout", || {
        detections.par_iter().map(|image| layout::infer(image, None, &LayoutOptions::default())).collect()
    });
    let views: Vec<View<'_>> = shots
        .iter()
        .zip(&detections)
        .zip(&layouts)
        .map(|((shot, detections), layout)| View { shot, detections, layout })
        .collect();
    let located = clock.stage("locate", || fusion::locate::locate(&views, &cloud));
    let fused = clock.stage("fuse", || fusion::fuse(&views, located, &FusionOptions::default()));
    let refined = clock.stage("refine", || refinement::refine(&views, &fused, &RefinementOptions::default()));
    let identity =
        Identity { plant: PlantId::from_name("scaling"), plant_name: "scaling", survey: "flight", previous: None };
    let model =
        clock.stage("assemble", || assemble(&views, &fused, &refined, reference, String::new(), &identity, Vec::new()));
    Figures {
        modules,
        views: shots.len(),
        detections: detections.iter().map(|image| image.detections.len()).sum(),
        cloud_points: cloud.positions_m.len(),
        mapped: model.modules.len(),
        warnings: model.warnings.len(),
        stages: clock.stages,
        input_bytes,
        peak_bytes: memory_bytes("VmHWM:"),
    }
}

struct Clock {
    stages: Vec<StageFigures>,
}

impl Clock {
    fn stage<T>(&mut self, name: &str, work: impl FnOnce() -> T) -> T {
        let (start, cpu_before) = (Instant::now(), cpu_s());
        let value = work();
        let (wall_s, cpu_s) = (start.elapsed().as_secs_f64(), cpu_s() - cpu_before);
        eprintln!("{name}: {wall_s:.2} s, {cpu_s:.2} s of CPU, {:.2} GB", memory_bytes("VmHWM:") as f64 / 1e9);
        self.stages.push(StageFigures { stage: name.to_owned(), wall_s, cpu_s });
        value
    }
}

/// A line of /proc/self/status in bytes; nought where the system has none.
fn memory_bytes(field: &str) -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find(|line| line.starts_with(field)).unwrap_or_default();
    line.split_ascii_whitespace().nth(1).and_then(|kb| kb.parse::<u64>().ok()).unwrap_or(0) * 1024
}

/// Seconds of CPU that the process took, all threads together: ticks of a hundredth on every Linux that Rust supports.
fn cpu_s() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let after_name = stat.rsplit(')').next().unwrap_or_default();
    after_name.split_ascii_whitespace().skip(11).take(2).filter_map(|ticks| ticks.parse::<f64>().ok()).sum::<f64>()
        / 100.0
}

/// A name, and what is drawn.
type Series<'a> = (&'a str, &'a dyn Fn(&Figures) -> f64);

/// Seconds and gigabytes over the number of modules, both axes logarithmic.
fn plot(all: &[Figures], path: &Path) -> Result<()> {
    let area = SVGBackend::new(path, (900, 420)).into_drawing_area();
    area.fill(&WHITE)?;
    let (left, right) = area.split_horizontally(450);
    let modules = |f: &Figures| f.modules as f64;
    let low = all.iter().map(modules).fold(f64::INFINITY, f64::min) * 0.8;
    let high = all.iter().map(modules).fold(0.0, f64::max) * 1.25;
    let series: [Series<'_>; 2] = [("wall clock, s", &Figures::wall_s), ("CPU of all threads, s", &Figures::cpu_s)];
    panel(&left, "Time over modules", [low, high], all, &series)?;
    let series: [Series<'_>; 2] =
        [("peak, GB", &|f| f.peak_bytes as f64 / 1e9), ("input alone, GB", &|f| f.input_bytes as f64 / 1e9)];
    panel(&right, "Memory over modules", [low, high], all, &series)?;
    area.present()?;
    Ok(())
}

fn panel(
    area: &DrawingArea<SVGBackend<'_>, plotters::coord::Shift>,
    title: &str,
    range: [f64; 2],
    all: &[Figures],
    series: &[Series<'_>],
) -> Result<()> {
    let values = || series.iter().flat_map(|(_, value)| all.iter().map(value)).map(|v| v.max(1e-3));
    let (low, high) = (values().fold(f64::INFINITY, f64::min) * 0.7, values().fold(0.0, f64::max) * 1.5);
    let mut chart = ChartBuilder::on(area)
        .caption(title, ("sans-serif", 18))
        .margin(12)
        .x_label_area_size(36)
        .y_label_area_size(52)
        .build_cartesian_2d((range[0]..range[1]).log_scale(), (low..high).log_scale())?;
    chart.configure_mesh().x_desc("modules").draw()?;
    for (index, (name, value)) in series.iter().enumerate() {
        let color = Palette99::pick(index).to_rgba();
        let points: Vec<(f64, f64)> = all.iter().map(|f| (f.modules as f64, value(f).max(1e-3))).collect();
        chart
            .draw_series(LineSeries::new(points.clone(), color.stroke_width(2)))?
            .label(*name)
            .legend(move |(x, y)| PathElement::new([(x, y), (x + 18, y)], color.stroke_width(2)));
        chart.draw_series(points.into_iter().map(|point| Circle::new(point, 3, color.filled())))?;
    }
    chart.configure_series_labels().background_style(WHITE.mix(0.8)).border_style(BLACK).draw()?;
    Ok(())
}
