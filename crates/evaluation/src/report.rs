//! The evaluation as text that a person reads.

use super::structure::Convention;
use super::{Differences, Evaluation, Fit, FiveNumbers, Level, Listed, Spacing};
use std::fmt;

/// Modules and problems listed before the rest is only counted.
const MAX_LISTED: usize = 20;

impl fmt::Display for Evaluation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "{} ({} modules) against {} ({} modules)",
            self.plant, self.plant_modules, self.truth, self.truth_modules
        )?;
        writeln!(f)?;
        writeln!(f, "Modules")?;
        writeln!(f, "  found    {:>7} of {}", self.found, self.truth_modules)?;
        listing(f, "missing", &self.missing)?;
        listing(f, "false", &self.false_modules)?;
        writeln!(f)?;
        self.structure(f)?;
        writeln!(f)?;
        self.positions(f)?;
        writeln!(f)?;
        if let Some(distances) = &self.distances {
            let percent = |share: f64| share * 100.0;
            writeln!(
                f,
                "Distances of {} m and more are off by {:.3} % (median), {:.3} % at most",
                distances.least_m,
                percent(distances.median),
                percent(distances.largest)
            )?;
            writeln!(f)?;
        }
        writeln!(f, "Distance between neighbouring modules, metres")?;
        header(f)?;
        spacing(f, "plant", &self.plant_spacing)?;
        spacing(f, "truth", &self.truth_spacing)?;
        let size = |spacing: &Spacing| format!("{:.3} x {:.3}", spacing.module_m[0], spacing.module_m[1]);
        writeln!(
            f,
            "  module size {} m in the plant, {} m in the truth",
            size(&self.plant_spacing),
            size(&self.truth_spacing)
        )?;
        if let Some(worst) = self.worst.first() {
            writeln!(f)?;
            let [x, y, z] = worst.difference_m;
            writeln!(f, "Furthest off after the similarity fit: {} by {x:+.3} {y:+.3} {z:+.3} m", worst.plant.label)?;
        }
        Ok(())
    }
}

impl Evaluation {
    fn structure(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "Structure {}", if self.structure.exact { "exact" } else { "NOT exact" })?;
        for level in &self.structure.levels {
            let right = level.compared - level.wrong;
            let convention =
                level.convention.map_or_else(String::new, |c| format!("  ({})", convention(level.level, c)));
            writeln!(f, "  {:<12} {right:>7} of {} agree{convention}", level.level.as_str(), level.compared)?;
        }
        for problem in self.structure.problems.iter().take(MAX_LISTED) {
            let first = problem.modules.first().map_or_else(String::new, |label| format!(" [{label}]"));
            writeln!(f, "  - {}: {}{first}", problem.level.as_str(), problem.message)?;
        }
        more(f, self.structure.problems.len())
    }

    fn positions(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "Position, plant minus truth, metres")?;
        header(f)?;
        differences(f, "as is", &self.as_is)?;
        differences(f, &format!("after a rigid fit ({})", described(&self.rigid_fit)), &self.after_rigid_fit)?;
        let percent = (1.0 / self.similarity_fit.scale - 1.0) * 100.0;
        let size = if percent < 0.0 { "small" } else { "large" };
        let described = described(&self.similarity_fit);
        let title = format!(
            "after a similarity fit (scale {:.5}: the plant is {:.2} % too {size}; {described})",
            self.similarity_fit.scale,
            percent.abs()
        );
        differences(f, &title, &self.after_similarity_fit)
    }
}

fn listing(f: &mut fmt::Formatter<'_>, word: &str, modules: &[Listed]) -> fmt::Result {
    writeln!(f, "  {word:<8} {:>7}", modules.len())?;
    for module in modules.iter().take(MAX_LISTED) {
        let [x, y, z] = module.center_enu_m;
        let id = if module.id == module.label { String::new() } else { format!(", id {}", module.id) };
        writeln!(f, "  - {} at {x:.2} {y:.2} {z:.2}{id}", module.label)?;
    }
    more(f, modules.len())
}

fn more(f: &mut fmt::Formatter<'_>, count: usize) -> fmt::Result {
    if count > MAX_LISTED { writeln!(f, "  - and {} more", count - MAX_LISTED) } else { Ok(()) }
}

fn described(fit: &Fit) -> String {
    let [x, y, z] = fit.move_m;
    format!("moved by {x:+.3} {y:+.3} {z:+.3} m, turned by {:.3} degrees", fit.rotation_deg)
}

fn convention(level: Level, convention: Convention) -> String {
    let (forward, backward) = match level {
        Level::Number | Level::BenchOrder => ("as in the truth", "from the other end"),
        _ => ("as in the truth", "from the other side"),
    };
    let direction = if convention.reversed { backward } else { forward };
    match convention.offset {
        0 => format!("counted {direction}"),
        offset => format!("counted {direction}, {offset:+}"),
    }
}

fn header(f: &mut fmt::Formatter<'_>) -> fmt::Result {
    writeln!(f, "  {:<12}{:>10}{:>10}{:>10}{:>10}{:>10}", "", "min", "q1", "median", "q3", "max")
}

fn five(f: &mut fmt::Formatter<'_>, name: &str, summary: &FiveNumbers) -> fmt::Result {
    write!(f, "  {name:<12}")?;
    for value in summary.values() {
        // Rounding must not leave a minus before nought.
        let rounded = (value * 1e4).round() / 1e4 + 0.0;
        write!(f, "{rounded:>10.4}")?;
    }
    writeln!(f)
}

fn differences(f: &mut fmt::Formatter<'_>, title: &str, differences: &Differences) -> fmt::Result {
    writeln!(f, "  {title}")?;
    five(f, "  x east", &differences.x)?;
    five(f, "  y north", &differences.y)?;
    five(f, "  z up", &differences.z)?;
    five(f, "  horizontal", &differences.horizontal)?;
    five(f, "  vertical", &differences.vertical)?;
    if let Some(calibration) = &differences.calibration {
        let percent = |shares: [f64; 3]| shares.map(|share| format!("{:.1}", share * 100.0)).join(" / ");
        writeln!(
            f,
            "    within 1 / 2 / 3 stated sigma (68.3 / 95.4 / 99.7 % if honest): x {} %, y {} %, z {} %",
            percent(calibration.x),
            percent(calibration.y),
            percent(calibration.z)
        )?;
    }
    Ok(())
}

fn spacing(f: &mut fmt::Formatter<'_>, name: &str, spacing: &Spacing) -> fmt::Result {
    for (direction, summary) in [("rows", &spacing.rows), ("columns", &spacing.columns)] {
        if let Some(summary) = summary {
            five(f, &format!("{name} {direction}"), summary)?;
        }
    }
    Ok(())
}
