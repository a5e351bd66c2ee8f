//! Plants broken on purpose: the evaluator must say exactly what was broken.

use super::read::parse_model;
use super::*;
use heliomap_model::{
    Bench, BenchId, Layer, Line, LineId, Module, ModuleId, ModuleStatus, PlantId, PlantModel, Sector, SectorId,
};
use heliomap_model::{GeodeticReference, Lla};
use nalgebra::Rotation3;
use std::path::Path;

/// Columns of the benches of each line, from the north.
const LINES: [&[u32]; 4] = [&[18, 12, 18], &[18, 18], &[9, 18, 14], &[18, 15, 18]];
const ROWS: u32 = 2;
/// Places without a module: line, bench, row, number.
const HOLES: [(u32, u32, u32, u32); 4] = [(1, 2, 1, 7), (1, 2, 2, 7), (2, 1, 1, 1), (4, 3, 2, 18)];
const MODULES: usize = 348;

/// A plant of four lines on sloping ground, turned by five degrees, with holes.
fn plant() -> PlantModel {
    plant_of(&LINES)
}

fn plant_of(layout: &[&[u32]]) -> PlantModel {
    let id = PlantId::from_name("test");
    let mut model = PlantModel {
        plant: id,
        plant_name: "test".to_owned(),
        version: 1,
        survey: "survey".to_owned(),
        reference: GeodeticReference::new(Lla { latitude_deg: 49.8, longitude_deg: 14.0, height_m: 400.0 }),
        vertical_datum: "unknown".to_owned(),
        alignment: None,
        parameters: None,
        lines: Vec::new(),
        benches: Vec::new(),
        sectors: Vec::new(),
        modules: Vec::new(),
        warnings: Vec::new(),
        serials: [0; 4],
    };
    let heading = Rotation3::from_axis_angle(&Vector3::z_axis(), 5_f64.to_radians());
    let tilt = Rotation3::from_axis_angle(&Vector3::x_axis(), 25_f64.to_radians());
    let [mut line_serial, mut bench_serial, mut sector_serial, mut module_serial] = [0; 4];
    for (l, benches) in (1..).zip(layout) {
        line_serial += 1;
        let line = LineId::from_serial(id, line_serial);
        model.lines.push(Line { id: line, label: format!("L{l:02}"), index: l });
        let mut west_m = 0.7 * f64::from(l % 5);
        for (b, &columns) in (1..).zip(*benches) {
            bench_serial += 1;
            let bench = BenchId::from_serial(id, bench_serial);
            let label = format!("L{l:02}-B{b:02}");
            model.benches.push(Bench {
                id: bench,
                label: label.clone(),
                line,
                index: b,
                rows: ROWS,
                columns,
                open_ended: [false; 2],
                confidence: 1.0,
            });
            for row in 1..=ROWS {
                sector_serial += 1;
                let sector = SectorId::from_serial(id, sector_serial);
                model.sectors.push(Sector { id: sector, label: format!("{label}-R{row}"), line, bench, row });
                for number in 1..=columns {
                    if HOLES.contains(&(l, b, row, number)) {
                        continue;
                    }
                    module_serial += 1;
                    let at = Vector3::new(
                        west_m + 1.02 * f64::from(number - 1),
                        -7.0 * f64::from(l),
                        0.03 * west_m + 0.4 * f64::from(l * l % 3),
                    );
                    let corner = |x: f64, y: f64| heading * (at + tilt * Vector3::new(x, y, 0.0));
                    let up = 1.67 * f64::from(ROWS - row);
                    let corners_enu_m =
                        [corner(0.0, up), corner(1.0, up), corner(1.0, up + 1.65), corner(0.0, up + 1.65)];
                    model.modules.push(Module {
                        id: ModuleId::from_serial(id, module_serial),
                        label: format!("{label}-R{row}-{number:03}"),
                        line,
                        bench,
                        sector,
                        row,
                        number,
                        corners_enu_m,
                        center_enu_m: corner(0.5, up + 0.825),
                        normal_enu: heading * tilt * Vector3::z(),
                        width_m: 1.0,
                        height_m: 1.65,
                        sigma_enu_m: None,
                        images: vec!["a.jpg".to_owned()],
                        status: ModuleStatus::Detected,
                    });
                }
            }
            west_m += 1.02 * f64::from(columns) + 0.8;
        }
    }
    model
}

/// The truth in its own file form: rows and columns from nought, lines and benches by number.
fn truth_of(model: &PlantModel) -> ReferenceModel {
    let origin = model.reference.origin;
    let line_of = |id: LineId| model.lines.iter().position(|line| line.id == id).unwrap();
    let bench_of = |id: BenchId| model.benches.iter().position(|bench| bench.id == id).unwrap();
    let benches: Vec<_> = model
        .benches
        .iter()
        .enumerate()
        .map(|(k, b)| {
            serde_json::json!({"bench": k, "line": line_of(b.line), "index": b.index - 1, "rows": b.rows, "cols": b.columns})
        })
        .collect();
    let modules: Vec<_> = model
        .modules
        .iter()
        .enumerate()
        .map(|(k, m)| {
            serde_json::json!({
                "id": k, "line": line_of(m.line), "bench": bench_of(m.bench), "row": m.row - 1, "col": m.number - 1,
                "corners": m.corners_enu_m.map(|c| [c.x, c.y, c.z]),
                "center": [m.center_enu_m.x, m.center_enu_m.y, m.center_enu_m.z],
            })
        })
        .collect();
    let truth = serde_json::json!({
        "reference": {"lat": origin.latitude_deg, "lon": origin.longitude_deg, "alt": origin.height_m},
        "benches": benches, "modules": modules,
    });
    parse_model(&serde_json::to_vec(&truth).unwrap(), Path::new("truth.json")).unwrap()
}

fn judge(broken: &PlantModel) -> Evaluation {
    let truth = truth_of(&plant());
    evaluate(&ReferenceModel::from_plant(broken).in_frame_of(truth.reference), &truth).unwrap()
}

fn move_module(module: &mut Module, motion: impl Fn(Vector3<f64>) -> Vector3<f64>) {
    module.center_enu_m = motion(module.center_enu_m);
    module.corners_enu_m = module.corners_enu_m.map(motion);
}

fn module<'a>(model: &'a mut PlantModel, label: &str) -> &'a mut Module {
    model.modules.iter_mut().find(|m| m.label == label).unwrap()
}

fn wrong(evaluation: &Evaluation, level: Level) -> usize {
    evaluation.structure.levels.iter().find(|l| l.level == level).unwrap().wrong
}

/// Wrong modules by line, bench, row, number, line order, bench order.
fn all_wrong(evaluation: &Evaluation) -> [usize; 6] {
    [Level::Line, Level::Bench, Level::Row, Level::Number, Level::LineOrder, Level::BenchOrder]
        .map(|level| wrong(evaluation, level))
}

fn messages(evaluation: &Evaluation) -> Vec<String> {
    evaluation.structure.problems.iter().map(|p| format!("{}: {}", p.level.as_str(), p.message)).collect()
}

#[track_caller]
fn assert_all_found(evaluation: &Evaluation) {
    assert_eq!((evaluation.found, evaluation.missing.len(), evaluation.false_modules.len()), (MODULES, 0, 0));
}

#[test]
fn an_unbroken_plant_is_flawless() {
    let evaluation = judge(&plant());
    assert_all_found(&evaluation);
    assert!(evaluation.is_flawless(), "{evaluation}");
    assert_eq!(all_wrong(&evaluation), [0; 6]);
    assert_eq!(evaluation.structure.benches.len(), 11);
    assert_eq!(evaluation.structure.lines[0], ["L01", "0"]);
    assert!(evaluation.as_is.horizontal.max < 1e-9);
    assert!((evaluation.similarity_fit.scale - 1.0).abs() < 1e-12);
    let rows = evaluation.plant_spacing.rows.unwrap();
    assert!((rows.min - 1.02).abs() < 1e-9 && (rows.max - 1.02).abs() < 1e-9, "{rows:?}");
    assert!((evaluation.truth_spacing.columns.unwrap().median - 1.67).abs() < 1e-9);
    assert_eq!(evaluation.plant_spacing.module_m.map(|m| (m * 1e3).round()), [1000.0, 1650.0]);
    let text = evaluation.to_string();
    assert!(text.contains("found        348 of 348") && text.contains("Structure exact"), "{text}");
}

#[test]
fn geojson_reads_back_as_the_same_plant() {
    let model = plant();
    let geojson = serde_json::to_vec(&model.feature_collection(Layer::Modules)).unwrap();
    let read = parse_model(&geojson, Path::new("plant.geojson")).unwrap();
    let truth = truth_of(&model);
    // Another origin than the truth's must make no difference.
    let mut elsewhere = model.clone();
    let moved = Lla { latitude_deg: 49.807, longitude_deg: 13.99, height_m: 350.0 };
    elsewhere.reference = GeodeticReference::new(moved);
    for module in &mut elsewhere.modules {
        move_module(module, |p| elsewhere.reference.enu_from_lla(model.reference.lla_from_enu(p)));
    }
    for plant in [read, ReferenceModel::from_plant(&elsewhere)] {
        let evaluation = evaluate(&plant.in_frame_of(truth.reference), &truth).unwrap();
        assert!(evaluation.is_flawless(), "{evaluation}");
        assert!(evaluation.as_is.horizontal.max < 3e-4 && evaluation.as_is.vertical.max < 3e-4, "{evaluation}");
        // A plant may also be the reference of another.
        let reverse = evaluate(&truth.clone().in_frame_of(plant_frame(&model)), &plant_model(&model)).unwrap();
        assert!(reverse.is_flawless(), "{reverse}");
    }
}

fn plant_frame(model: &PlantModel) -> GeodeticReference {
    model.reference
}

fn plant_model(model: &PlantModel) -> ReferenceModel {
    ReferenceModel::from_plant(model)
}

#[test]
fn one_module_shifted() {
    let mut broken = plant();
    let normal = Vector3::new(0.3, 0.0, 0.0);
    move_module(module(&mut broken, "L03-B02-R2-009"), |p| p + normal);
    let evaluation = judge(&broken);
    assert_all_found(&evaluation);
    assert!(evaluation.structure.exact);
    assert!((evaluation.as_is.x.max - 0.3).abs() < 1e-9);
    assert_eq!((evaluation.as_is.x.q1, evaluation.as_is.x.q3), (0.0, 0.0));
    assert_eq!(evaluation.worst[0].plant.label, "L03-B02-R2-009");
    assert_eq!(evaluation.worst[0].truth.label, "line 2 bench 6 row 1 col 8");
    assert!((evaluation.after_similarity_fit.horizontal.max - 0.3).abs() < 0.005, "{evaluation}");
    assert!(evaluation.after_similarity_fit.horizontal.median < 0.003, "{evaluation}");
}

#[test]
fn one_module_shifted_beyond_half_its_shorter_side() {
    let mut broken = plant();
    move_module(module(&mut broken, "L04-B03-R1-018"), |p| p + Vector3::new(0.6, 0.0, 0.0));
    let evaluation = judge(&broken);
    assert_eq!((evaluation.found, evaluation.missing.len(), evaluation.false_modules.len()), (MODULES - 1, 1, 1));
    assert_eq!(evaluation.missing[0].label, "line 3 bench 10 row 0 col 17");
    assert_eq!(evaluation.false_modules[0].label, "L04-B03-R1-018");
}

#[test]
fn one_module_too_high_is_found_and_its_error_told() {
    let mut broken = plant();
    move_module(module(&mut broken, "L02-B01-R1-009"), |p| p + Vector3::new(0.0, 0.0, 1.1));
    let evaluation = judge(&broken);
    assert_all_found(&evaluation);
    assert!((evaluation.as_is.vertical.max - 1.1).abs() < 1e-9);
}

#[test]
fn one_module_missing() {
    let mut broken = plant();
    broken.modules.retain(|m| m.label != "L02-B02-R1-010");
    let evaluation = judge(&broken);
    assert_eq!((evaluation.found, evaluation.false_modules.len()), (MODULES - 1, 0));
    let missing: Vec<&str> = evaluation.missing.iter().map(|m| m.label.as_str()).collect();
    assert_eq!(missing, ["line 1 bench 4 row 0 col 9"]);
    assert!(evaluation.structure.exact && !evaluation.is_flawless());
    // A hole closed up instead of kept: what follows in the row is one off.
    for module in broken.modules.iter_mut().filter(|m| m.label.starts_with("L02-B02-R1") && m.number > 10) {
        module.number -= 1;
    }
    let evaluation = judge(&broken);
    assert_eq!(all_wrong(&evaluation), [0, 0, 0, 8, 0, 0]);
    assert_eq!(messages(&evaluation), ["number: bench L02-B02: 8 of 35 wrong (10 for 11, 11 for 12, 12 for 13, ...)"]);
}

#[test]
fn one_module_false() {
    let mut broken = plant();
    let mut extra = module(&mut broken, "L01-B03-R1-018").clone();
    extra.id = ModuleId::from_serial(broken.plant, 9999);
    extra.label = "L01-B03-R1-019".to_owned();
    extra.number = 19;
    move_module(&mut extra, |p| p + Vector3::new(1.02, 0.09, 0.0));
    broken.modules.push(extra);
    let evaluation = judge(&broken);
    assert_eq!((evaluation.found, evaluation.missing.len()), (MODULES, 0));
    assert_eq!(evaluation.false_modules.len(), 1);
    assert_eq!(evaluation.false_modules[0].label, "L01-B03-R1-019");
    assert!(evaluation.structure.exact && !evaluation.is_flawless());
    // The same module twice: one of the two is false, and the place is taken twice.
    let mut broken = plant();
    let twin = module(&mut broken, "L01-B03-R1-018").clone();
    broken.modules.push(twin);
    let evaluation = judge(&broken);
    assert_eq!((evaluation.found, evaluation.missing.len(), evaluation.false_modules.len()), (MODULES, 0, 1));
    assert_eq!(messages(&evaluation), ["number: 2 modules of the plant claim bench L01-B03, row 1, number 18"]);
    assert!(!evaluation.structure.exact);
}

/// Gives the modules of two benches each other's bench, with or without the line, and labels to match.
fn swap_benches(model: &mut PlantModel, one: &str, other: &str) {
    let place = |label: &str| {
        let bench = model.benches.iter().find(|b| b.label == label).unwrap();
        (bench.line, bench.id, bench.label.clone())
    };
    let (first, second) = (place(one), place(other));
    for module in &mut model.modules {
        let to = if module.bench == first.1 {
            &second
        } else if module.bench == second.1 {
            &first
        } else {
            continue;
        };
        (module.line, module.bench) = (to.0, to.1);
        module.label = format!("{}-R{}-{:03}", to.2, module.row, module.number);
    }
}

#[test]
fn two_benches_of_a_line_swapped() {
    let mut broken = plant();
    swap_benches(&mut broken, "L04-B01", "L04-B03");
    let evaluation = judge(&broken);
    assert_all_found(&evaluation);
    // Names are free, yet a technician who counts benches would stand before the wrong one.
    assert_eq!(all_wrong(&evaluation), [0, 0, 0, 0, 0, 71]);
    assert!(!evaluation.structure.exact);
    assert_eq!(
        messages(&evaluation),
        [
            "bench order: bench L04-B03 is number 3 of its line, but 36 of its modules stand in number 1",
            "bench order: bench L04-B01 is number 1 of its line, but 35 of its modules stand in number 3",
        ]
    );
}

#[test]
fn two_benches_of_two_lines_swapped() {
    let mut broken = plant();
    swap_benches(&mut broken, "L01-B01", "L02-B02");
    let evaluation = judge(&broken);
    assert_all_found(&evaluation);
    assert_eq!(all_wrong(&evaluation), [72, 0, 0, 0, 72, 72]);
    assert_eq!(
        messages(&evaluation)[..2],
        [
            "line: 36 modules stand in line 0 of the truth, whose name is L01, but the plant says line L02",
            "line: 36 modules stand in line 1 of the truth, whose name is L02, but the plant says line L01",
        ]
    );
}

#[test]
fn two_benches_taken_for_one() {
    let mut broken = plant();
    let west = broken.benches.iter().find(|b| b.label == "L02-B01").unwrap().id;
    let east = broken.benches.iter().find(|b| b.label == "L02-B02").unwrap().id;
    for module in broken.modules.iter_mut().filter(|m| m.bench == east) {
        module.bench = west;
        module.number += 18;
        module.label = format!("L02-B01-R{}-{:03}", module.row, module.number);
    }
    let evaluation = judge(&broken);
    assert_all_found(&evaluation);
    // The western bench has a hole, so the name goes to the eastern one.
    assert_eq!(all_wrong(&evaluation), [0, 35, 0, 36, 0, 36]);
    assert_eq!(
        messages(&evaluation)[0],
        "bench: 35 modules stand in bench 3 of the truth, for which the plant has no name, but the plant says bench L02-B01"
    );
}

#[test]
fn rows_flipped_in_one_bench() {
    let mut broken = plant();
    for module in broken.modules.iter_mut().filter(|m| m.label.starts_with("L01-B02")) {
        module.row = 3 - module.row;
    }
    let evaluation = judge(&broken);
    assert_all_found(&evaluation);
    assert_eq!(all_wrong(&evaluation), [0, 0, 22, 0, 0, 0]);
    assert_eq!(messages(&evaluation), ["row: bench L01-B02: the rows are numbered from the other end"]);
}

#[test]
fn a_line_numbered_from_the_other_end() {
    let mut broken = plant();
    for (bench, columns) in [("L03-B01", 9), ("L03-B02", 18), ("L03-B03", 14)] {
        for module in broken.modules.iter_mut().filter(|m| m.label.starts_with(bench)) {
            module.number = columns + 1 - module.number;
        }
    }
    let evaluation = judge(&broken);
    assert_all_found(&evaluation);
    // The middle of nine keeps its number.
    assert_eq!(all_wrong(&evaluation), [0, 0, 0, 80, 0, 0]);
    assert_eq!(
        messages(&evaluation),
        ["L03-B01", "L03-B02", "L03-B03"]
            .map(|b| format!("number: bench {b}: the modules are numbered from the other end"))
    );
}

#[test]
fn other_conventions_for_the_whole_plant_are_right() {
    let mut other = plant();
    let columns: Vec<(BenchId, u32)> = other.benches.iter().map(|b| (b.id, b.columns)).collect();
    for module in &mut other.modules {
        let columns = columns.iter().find(|(id, _)| *id == module.bench).unwrap().1;
        module.row = 2 - module.row;
        module.number = columns - module.number;
        // Free names: nothing to count lines and benches by.
        module.label = format!("{}/{}", module.row, module.number);
    }
    let evaluation = judge(&other);
    assert!(evaluation.is_flawless(), "{evaluation}");
    assert_eq!(evaluation.structure.levels.len(), 4);
    let row = evaluation.structure.levels[2].convention.unwrap();
    assert_eq!((row.reversed, row.offset), (true, 0));
    // Lines from the south and benches from the east are conventions too.
    let mut other = plant();
    let places: Vec<(BenchId, u32, u32)> =
        other.benches.iter().map(|b| (b.id, b.label[1..3].parse().unwrap(), b.index)).collect();
    for module in &mut other.modules {
        let (_, line, bench) = places.iter().find(|(id, ..)| *id == module.bench).unwrap();
        let (line, bench) = (5 - line, LINES[*line as usize - 1].len() as u32 + 1 - bench);
        module.label = format!("L{line:02}-B{bench:02}-R{}-{:03}", module.row, module.number);
    }
    let evaluation = judge(&other);
    assert!(evaluation.is_flawless(), "{evaluation}");
}

#[test]
fn the_whole_plant_moved_turned_and_scaled() {
    let rotation = Rotation3::from_axis_angle(&Vector3::z_axis(), 0.3_f64.to_radians());
    for (scale, move_m) in [
        (1.01, Vector3::new(2.4, -1.8, 1.5)),
        (0.988, Vector3::new(-3.0, 0.0, -6.0)),
        (1.012, Vector3::new(0.0, 3.5, 0.0)),
        (1.005, Vector3::new(6.1, 1.0, 20.0)),
    ] {
        let mut broken = plant();
        for module in &mut broken.modules {
            move_module(module, |p| scale * (rotation * p) + move_m);
        }
        let evaluation = judge(&broken);
        assert_all_found(&evaluation);
        assert!(evaluation.structure.exact, "{evaluation}");
        assert!((evaluation.similarity_fit.scale - 1.0 / scale).abs() < 1e-9);
        assert!((evaluation.similarity_fit.rotation_deg - 0.3).abs() < 1e-6);
        assert!(evaluation.after_similarity_fit.horizontal.max < 1e-8);
        let expected = (scale - 1.0_f64).abs() * 10.0;
        assert!(evaluation.after_rigid_fit.horizontal.median > expected, "{evaluation}");
        assert!(evaluation.as_is.horizontal.median > 1.0, "{evaluation}");
        let rows = evaluation.plant_spacing.rows.unwrap();
        assert!((rows.median - 1.02 * scale).abs() < 1e-9);
    }
}

#[test]
fn a_bench_shifted_by_one_module() {
    let mut broken = plant();
    let along = Rotation3::from_axis_angle(&Vector3::z_axis(), 5_f64.to_radians()) * Vector3::new(1.02, 0.0, 0.0);
    for module in broken.modules.iter_mut().filter(|m| m.label.starts_with("L04-B03")) {
        move_module(module, |p| p + along);
    }
    let evaluation = judge(&broken);
    // 18 and 17 modules: the west end is bare, the east end stands over, and the hole has moved on.
    let names = |modules: &[Listed]| modules.iter().map(|m| m.label.clone()).collect::<Vec<_>>();
    assert_eq!(names(&evaluation.missing), ["line 3 bench 10 row 0 col 0", "line 3 bench 10 row 1 col 0"]);
    assert_eq!(names(&evaluation.false_modules), ["L04-B03-R1-018", "L04-B03-R2-017"]);
    assert_eq!(all_wrong(&evaluation), [0, 0, 0, 33, 0, 0]);
    assert_eq!(messages(&evaluation), ["number: bench L04-B03: all modules are off by -1"]);
}

#[test]
fn the_whole_plant_moved_by_one_module_along_the_row() {
    let along = Rotation3::from_axis_angle(&Vector3::z_axis(), 5_f64.to_radians()) * Vector3::new(1.02, 0.0, 0.0);
    for modules in [-3.0, -1.0, 1.0, 2.0, 5.0] {
        let mut broken = plant();
        broken.modules.retain(|m| m.number % 7 != 3);
        for module in &mut broken.modules {
            move_module(module, |p| p + along * modules);
        }
        let evaluation = judge(&broken);
        assert_eq!((evaluation.found, evaluation.false_modules.len()), (broken.modules.len(), 0));
        assert!(evaluation.structure.exact, "{evaluation}");
    }
}

#[test]
fn half_a_plant_pairs_where_it_stands() {
    let mut broken = plant();
    broken.modules.retain(|m| m.number > 4 && m.number < 10 && m.label.as_str() < "L03");
    for module in &mut broken.modules {
        move_module(module, |p| p + Vector3::new(0.3, 0.2, 0.5));
    }
    let evaluation = judge(&broken);
    assert_eq!((evaluation.found, evaluation.false_modules.len()), (broken.modules.len(), 0));
    assert!(evaluation.structure.exact, "{evaluation}");
    assert!((evaluation.as_is.x.median - 0.3).abs() < 1e-6, "{evaluation}");
}

#[test]
fn noise_is_measured_and_sigmas_are_judged() {
    let mut broken = plant();
    let mut state = 1_u64;
    // Twelve uniform numbers make a nearly Gaussian one.
    let mut gaussian = || {
        let uniform = |state: &mut u64| {
            *state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (*state >> 11) as f64 / (1_u64 << 53) as f64
        };
        (0..12).map(|_| uniform(&mut state)).sum::<f64>() - 6.0
    };
    for module in &mut broken.modules {
        let error = Vector3::new(0.02 * gaussian(), 0.02 * gaussian(), 0.05 * gaussian());
        move_module(module, |p| p + error);
        module.sigma_enu_m = Some(Vector3::new(0.02, 0.02, 0.025));
    }
    let evaluation = judge(&broken);
    assert_all_found(&evaluation);
    let calibration = evaluation.as_is.calibration.unwrap();
    assert_eq!(calibration.modules, MODULES);
    assert!((calibration.x[0] - 0.683).abs() < 0.06 && calibration.x[2] > 0.98, "{calibration:?}");
    assert!((calibration.z[1] - 0.683).abs() < 0.06, "{calibration:?}");
    assert!((evaluation.as_is.horizontal.median - 0.0235).abs() < 0.003, "{evaluation}");
}

#[test]
fn small_plants_are_compared_too() {
    for layout in [&[&[1_u32][..]][..], &[&[2]], &[&[5]]] {
        for rows in 1..=ROWS {
            let mut small = plant_of(layout);
            small.modules.retain(|m| m.row <= rows);
            let truth = truth_of(&small);
            let mut moved = small.clone();
            for module in &mut moved.modules {
                move_module(module, |p| p + Vector3::new(0.1, 0.1, 0.1));
            }
            let evaluation = evaluate(&ReferenceModel::from_plant(&moved), &truth).unwrap();
            assert_eq!(evaluation.found, small.modules.len());
            assert!(evaluation.is_flawless(), "{evaluation}");
            assert!(evaluation.after_similarity_fit.horizontal.max < 0.02, "{evaluation}");
        }
    }
}

#[test]
fn another_place_pairs_nothing() {
    let truth = truth_of(&plant());
    let mut empty = ReferenceModel::from_plant(&plant());
    empty.modules.clear();
    let error = evaluate(&empty, &truth).unwrap_err().to_string();
    assert!(error.contains("same place"), "{error}");
}

#[test]
fn a_heap_of_modules_on_one_spot_is_no_trap() {
    let mut heap = plant();
    let spot = heap.modules[100].clone();
    for _ in 0..5000 {
        heap.modules.push(spot.clone());
    }
    let evaluation = judge(&heap);
    assert_eq!((evaluation.found, evaluation.false_modules.len()), (MODULES, 5000));
}

#[test]
fn plots_are_written() {
    let mut broken = plant();
    broken.modules.retain(|m| m.label != "L02-B02-R1-010");
    move_module(module(&mut broken, "L04-B03-R1-018"), |p| p + Vector3::new(0.6, 0.0, 0.0));
    let (plant, truth) = (ReferenceModel::from_plant(&broken), truth_of(&plant()));
    let evaluation = evaluate(&plant, &truth).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let written = write_plots(&evaluation, &plant, &truth, &folder.path().join("plots")).unwrap();
    assert_eq!(written.len(), 3);
    for path in written {
        let svg = std::fs::read_to_string(&path).unwrap();
        assert!(svg.starts_with("<svg") && svg.trim_end().ends_with("</svg>"), "{}", path.display());
    }
    let nowhere = Path::new("/dev/null/plots");
    assert!(write_plots(&evaluation, &plant, &truth, nowhere).unwrap_err().to_string().contains("/dev/null/plots"));
}

#[test]
fn equal_input_gives_equal_output() {
    let mut broken = plant();
    broken.modules.retain(|m| m.number % 5 != 0);
    let json = |evaluation: &Evaluation| serde_json::to_string(evaluation).unwrap();
    assert_eq!(json(&judge(&broken)), json(&judge(&broken)));
}

/// Run by hand: `cargo test --release --lib evaluation -- --ignored --nocapture`.
#[test]
#[ignore = "a million modules"]
fn a_million_modules() {
    let line: Vec<u32> = vec![25; 40];
    let layout: Vec<&[u32]> = vec![&line; 500];
    let model = plant_of(&layout);
    let truth = ReferenceModel::from_plant(&model);
    let mut moved = truth.clone();
    let rotation = Rotation3::from_axis_angle(&Vector3::z_axis(), 0.3_f64.to_radians());
    for module in &mut moved.modules {
        module.center_enu_m = 1.008 * (rotation * module.center_enu_m) + Vector3::new(2.0, -3.0, 1.0);
        module.corners_enu_m = module.corners_enu_m.map(|p| 1.008 * (rotation * p) + Vector3::new(2.0, -3.0, 1.0));
    }
    let start = std::time::Instant::now();
    let evaluation = evaluate(&moved, &truth).unwrap();
    println!("{} modules in {:.1} s", model.modules.len(), start.elapsed().as_secs_f64());
    assert!(evaluation.is_flawless(), "{} found", evaluation.found);
}
