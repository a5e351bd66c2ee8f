//! The evaluation as pictures: box plots as in Figs. 16 to 18 of the paper, and the plant from above.

use super::model::{ReferenceModel, ReferenceModule};
use super::{EvaluateError, Evaluation, FiveNumbers};
use nalgebra::Vector3;
use plotters::coord::Shift;
use plotters::prelude::*;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// More paired modules than this are drawn as one strip per row of a bench.
const MAX_DRAWN: usize = 20_000;
const INK: RGBColor = RGBColor(40, 44, 52);
const FAINT: RGBColor = RGBColor(215, 219, 225);
const BLUE: RGBColor = RGBColor(49, 104, 160);
const ORANGE: RGBColor = RGBColor(214, 110, 20);
const TEAL: RGBColor = RGBColor(40, 140, 125);
const RED: RGBColor = RGBColor(200, 30, 45);

type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;
type Drawn = Result<(), DrawingAreaErrorKind<std::io::Error>>;

/// Writes `differences.svg`, `spacing.svg` and `plan.svg` into `folder`, which is made where it is missing, and says
/// which files these are.
pub fn write_plots(
    evaluation: &Evaluation,
    plant: &ReferenceModel,
    truth: &ReferenceModel,
    folder: &Path,
) -> Result<Vec<PathBuf>, EvaluateError> {
    let failed = |path: &Path, reason: String| EvaluateError::Plot { path: path.to_owned(), reason };
    std::fs::create_dir_all(folder).map_err(|error| failed(folder, error.to_string()))?;
    let (plan_width, plan_height) = plan_size(truth, plant);
    let mut written = Vec::new();
    let mut write = |name: &str, size: (u32, u32), draw: &dyn Fn(&Area<'_>) -> Drawn| {
        let path = folder.join(name);
        let area = SVGBackend::new(&path, size).into_drawing_area();
        let drawn = area.fill(&WHITE).and_then(|()| draw(&area)).and_then(|()| area.present());
        drawn.map_err(|error| failed(&path, error.to_string()))?;
        written.push(path.clone());
        Ok(())
    };
    write("differences.svg", (1080, 460), &|area| draw_differences(area, evaluation))?;
    write("spacing.svg", (760, 460), &|area| draw_spacing(area, evaluation))?;
    write("plan.svg", (plan_width, plan_height), &|area| draw_plan(area, evaluation, plant, truth))?;
    Ok(written)
}

/// One box: minimum and maximum as whiskers, the quartiles as the box.
struct NamedBox<'a> {
    name: &'a str,
    summary: FiveNumbers,
    color: RGBColor,
}

fn draw_differences(area: &Area<'_>, evaluation: &Evaluation) -> Drawn {
    let fits = [
        ("as is", &evaluation.as_is),
        ("after a rigid fit", &evaluation.after_rigid_fit),
        ("after a similarity fit", &evaluation.after_similarity_fit),
    ];
    for (panel, (title, differences)) in area.split_evenly((1, 3)).iter().zip(fits) {
        let boxes = [("x", &differences.x, BLUE), ("y", &differences.y, TEAL), ("z", &differences.z, ORANGE)]
            .map(|(name, summary, color)| NamedBox { name, summary: *summary, color });
        draw_boxes(panel, &format!("Plant minus truth, {title}"), &boxes, &[0.0])?;
    }
    Ok(())
}

fn draw_spacing(area: &Area<'_>, evaluation: &Evaluation) -> Drawn {
    let models = [("plant", &evaluation.plant_spacing), ("truth", &evaluation.truth_spacing)];
    for (panel, (title, spacing)) in area.split_evenly((1, 2)).iter().zip(models) {
        let boxes: Vec<NamedBox<'_>> = [("rows", spacing.rows, BLUE), ("columns", spacing.columns, TEAL)]
            .into_iter()
            .filter_map(|(name, summary, color)| Some(NamedBox { name, summary: summary?, color }))
            .collect();
        let title = format!("Neighbour distance, {title} (dashed: module size)");
        draw_boxes(panel, &title, &boxes, &spacing.module_m)?;
    }
    Ok(())
}

/// Boxes side by side over a common axis in metres, with dashed lines across.
fn draw_boxes(area: &Area<'_>, title: &str, boxes: &[NamedBox<'_>], dashed_m: &[f64]) -> Drawn {
    let values = || boxes.iter().flat_map(|b| b.summary.values()).chain(dashed_m.iter().copied());
    let (low, high) = values().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
    if boxes.is_empty() {
        return area.draw(&Text::new("no two neighbours", (20, 20), ("sans-serif", 14).into_font().color(&INK)));
    }
    let signed = low < 0.0;
    let margin = ((high - low) * 0.06).max(0.005);
    let right = boxes.len() as f64;
    let mut chart = ChartBuilder::on(area)
        .caption(title, ("sans-serif", 15).into_font().color(&INK))
        .margin(12)
        .x_label_area_size(58)
        .y_label_area_size(62)
        .build_cartesian_2d(0.0..right, low - margin..high + margin)?;
    chart
        .configure_mesh()
        .disable_x_mesh()
        .disable_x_axis()
        .light_line_style(WHITE)
        .bold_line_style(FAINT)
        .axis_style(INK)
        .y_labels(9)
        .y_label_formatter(&|value| metres(*value, false))
        .y_desc("metres")
        .label_style(("sans-serif", 12).into_font().color(&INK))
        .draw()?;
    for &value in dashed_m {
        chart.draw_series(DashedLineSeries::new([(0.0, value), (right, value)], 6, 4, RED.stroke_width(1)))?;
    }
    for (k, named) in boxes.iter().enumerate() {
        let middle = k as f64 + 0.5;
        let (left, right) = (middle - 0.22, middle + 0.22);
        let summary = &named.summary;
        chart.draw_series([
            Rectangle::new([(left, summary.q1), (right, summary.q3)], named.color.mix(0.3).filled()),
            Rectangle::new([(left, summary.q1), (right, summary.q3)], named.color.stroke_width(1)),
        ])?;
        let lines = [
            [(middle, summary.min), (middle, summary.q1)],
            [(middle, summary.q3), (middle, summary.max)],
            [(middle - 0.1, summary.min), (middle + 0.1, summary.min)],
            [(middle - 0.1, summary.max), (middle + 0.1, summary.max)],
        ];
        chart.draw_series(lines.map(|line| PathElement::new(line.to_vec(), named.color.stroke_width(1))))?;
        let median = [(left, summary.median), (right, summary.median)];
        chart.draw_series([PathElement::new(median.to_vec(), named.color.stroke_width(3))])?;
        let center = chart.backend_coord(&(middle, low - margin));
        let centered = plotters::style::text_anchor::Pos::new(
            plotters::style::text_anchor::HPos::Center,
            plotters::style::text_anchor::VPos::Top,
        );
        let style = ("sans-serif", 13).into_font().color(&INK).pos(centered);
        let (base_x, base_y) = area.get_base_pixel();
        let at = (center.0 - base_x, center.1 - base_y + 8);
        area.draw(&Text::new(format!("{} ({})", named.name, metres(summary.median, signed)), at, style.clone()))?;
        let spread = format!("{} to {}", metres(summary.min, signed), metres(summary.max, signed));
        area.draw(&Text::new(spread, (at.0, at.1 + 17), ("sans-serif", 11).into_font().color(&INK).pos(centered)))?;
    }
    Ok(())
}

/// Three decimals, and no sign before nought.
fn metres(value_m: f64, signed: bool) -> String {
    let rounded = (value_m * 1e3).round() / 1e3 + 0.0;
    if signed && rounded != 0.0 { format!("{rounded:+.3}") } else { format!("{rounded:.3}") }
}

/// Least and greatest east and north of all modules, metres.
fn bounds(models: [&ReferenceModel; 2]) -> [[f64; 2]; 2] {
    let corners = models.into_iter().flat_map(|model| model.modules.iter().flat_map(|m| m.corners_enu_m.iter()));
    let mut bounds = [[f64::INFINITY, f64::NEG_INFINITY]; 2];
    for corner in corners {
        for axis in 0..2 {
            bounds[axis] = [bounds[axis][0].min(corner[axis]), bounds[axis][1].max(corner[axis])];
        }
    }
    bounds
}

fn plan_size(truth: &ReferenceModel, plant: &ReferenceModel) -> (u32, u32) {
    let [[west, east], [south, north]] = bounds([truth, plant]);
    let shape = ((north - south) / (east - west).max(1.0)).clamp(0.15, 2.0);
    (1200, (1140.0 * shape) as u32 + 150)
}

fn draw_plan(area: &Area<'_>, evaluation: &Evaluation, plant: &ReferenceModel, truth: &ReferenceModel) -> Drawn {
    let (width, height) = area.dim_in_pixel();
    let [[west, east], [south, north]] = bounds([truth, plant]);
    let metres_per_px =
        ((east - west) / f64::from(width - 60)).max((north - south) / f64::from(height - 150)).max(1e-6);
    let pixel = |point: &Vector3<f64>| {
        let x = f64::from(width) / 2.0 + (point.x - (west + east) / 2.0) / metres_per_px;
        let y = 60.0 + f64::from(height - 120) / 2.0 - (point.y - (south + north) / 2.0) / metres_per_px;
        (x.round() as i32, y.round() as i32)
    };
    let quad = |corners: &[Vector3<f64>; 4]| corners.iter().map(pixel).collect::<Vec<_>>();
    let outline = |corners: &[Vector3<f64>; 4]| {
        let mut ring = quad(corners);
        ring.push(ring[0]);
        ring
    };

    let horizontal_m: Vec<f64> = evaluation.residuals_m.iter().map(|residual| residual.xy().norm()).collect();
    let scale_m = (evaluation.after_similarity_fit.horizontal.max).clamp(0.02, 0.5);
    let shade = |error_m: f64| {
        let share = (error_m / scale_m).clamp(0.0, 1.0);
        let mix = |from: f64, to: f64| (from + (to - from) * share) as u8;
        RGBColor(mix(218.0, 20.0), mix(230.0, 50.0), mix(242.0, 110.0))
    };
    if evaluation.pairs.len() <= MAX_DRAWN {
        for (&(_, t), &error_m) in evaluation.pairs.iter().zip(&horizontal_m) {
            let corners = &truth.modules[t].corners_enu_m;
            area.draw(&Polygon::new(quad(corners), shade(error_m).filled()))?;
            if metres_per_px < 0.3 {
                area.draw(&PathElement::new(outline(corners), WHITE.stroke_width(1)))?;
            }
        }
    } else {
        for (corners, error_m) in strips(evaluation, truth, &horizontal_m) {
            area.draw(&Polygon::new(quad(&corners), shade(error_m).filled()))?;
        }
    }
    let unpaired = |model: &ReferenceModel, is_paired: Vec<bool>| -> Vec<ReferenceModule> {
        model
            .modules
            .iter()
            .zip(is_paired)
            .filter(|(_, paired)| !paired)
            .map(|(m, _)| m.clone())
            .take(MAX_DRAWN)
            .collect()
    };
    let (mut in_plant, mut in_truth) = (vec![false; plant.modules.len()], vec![false; truth.modules.len()]);
    for &(p, t) in &evaluation.pairs {
        (in_plant[p], in_truth[t]) = (true, true);
    }
    for module in unpaired(truth, in_truth) {
        area.draw(&PathElement::new(outline(&module.corners_enu_m), RED.stroke_width(2)))?;
    }
    for module in unpaired(plant, in_plant) {
        let aligned = module.corners_enu_m.map(|corner| evaluation.truth_from_plant.apply(&corner));
        area.draw(&Polygon::new(quad(&aligned), ORANGE.mix(0.7).filled()))?;
    }

    let text = |size: u32| ("sans-serif", size).into_font().color(&INK);
    area.draw(&Text::new("The plant from above", (30, 14), text(20)))?;
    let legend = [
        (
            shade(0.0),
            true,
            format!("{} found: darker the further off, up to {scale_m:.2} m horizontally", evaluation.found),
        ),
        (RED, false, format!("{} missing", evaluation.missing.len())),
        (ORANGE, true, format!("{} false", evaluation.false_modules.len())),
    ];
    let mut x = 30;
    for (color, filled, words) in legend {
        let style = if filled { color.filled() } else { color.stroke_width(2) };
        area.draw(&Rectangle::new([(x, 42), (x + 14, 54)], style))?;
        area.draw(&Text::new(words.clone(), (x + 21, 42), text(14)))?;
        x += 60 + words.len() as i32 * 7;
    }
    let bar_m = 10_f64.powf(((east - west) / 4.0).max(1.0).log10().floor());
    let bar_px = (bar_m / metres_per_px) as i32;
    let bottom = height as i32 - 30;
    area.draw(&PathElement::new(vec![(30, bottom), (30 + bar_px, bottom)], INK.stroke_width(3)))?;
    area.draw(&Text::new(format!("{bar_m:.0} m, north is up"), (30, bottom + 8), text(13)))
}

/// Corners of every row of a bench from its first to its last found module, and its largest error.
fn strips(evaluation: &Evaluation, truth: &ReferenceModel, horizontal_m: &[f64]) -> Vec<([Vector3<f64>; 4], f64)> {
    let mut rows: BTreeMap<(usize, i64), (usize, usize, f64)> = BTreeMap::new();
    for (&(_, t), &error_m) in evaluation.pairs.iter().zip(horizontal_m) {
        let module = &truth.modules[t];
        let (first, last, worst_m) = rows.entry((module.bench, module.row)).or_insert((t, t, 0.0));
        if module.number < truth.modules[*first].number {
            *first = t;
        }
        if module.number > truth.modules[*last].number {
            *last = t;
        }
        *worst_m = worst_m.max(error_m);
    }
    rows.into_values()
        .map(|(first, last, error_m)| {
            let (a, b) = (&truth.modules[first].corners_enu_m, &truth.modules[last].corners_enu_m);
            ([a[0], b[1], b[2], a[3]], error_m)
        })
        .collect()
}
