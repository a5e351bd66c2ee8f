//! Compares a plant with a truth or with any reference model (paper, 4.3): which modules were found, whether each has
//! its place in the structure, and how far it lies off.

mod align;
pub mod detection;
mod model;
mod plots;
mod read;
mod report;
mod statistics;
mod structure;
#[cfg(test)]
mod tests;

pub use model::{ReferenceBench, ReferenceLine, ReferenceModel, ReferenceModule};
pub use plots::write_plots;
pub use read::read_model;
pub use statistics::{Calibration, Differences, Distances, FiveNumbers, Spacing};
pub use structure::{Convention, Level, LevelAgreement, Problem, Structure};

use heliomap_mapping::geometry::Similarity;
use nalgebra::Vector3;
use serde::Serialize;
use std::path::PathBuf;

/// Modules listed as the worst.
const MAX_WORST: usize = 10;

/// Why a comparison could not be made. The sentences name the file and say what to do.
#[derive(Debug, thiserror::Error)]
pub enum EvaluateError {
    #[error("cannot read {}: {reason}", path.display())]
    Read { path: PathBuf, reason: String },
    #[error("{} is larger than {limit_bytes} bytes: evaluate a part of the plant", path.display())]
    TooLarge { path: PathBuf, limit_bytes: u64 },
    #[error("{} is not the JSON that is expected, at line {line}, column {column}: {reason}; give a GeoJSON file of modules or a truth.json", path.display())]
    NotJson { path: PathBuf, line: usize, column: usize, reason: String },
    #[error("{}: {what}; {remedy}", path.display())]
    WrongShape { path: PathBuf, what: String, remedy: &'static str },
    #[error(
        "no alignment pairs any of the {plant_modules} modules of {plant} with the {truth_modules} of {truth}: check that both describe the same place"
    )]
    NothingPairs { plant: String, plant_modules: usize, truth: String, truth_modules: usize },
    #[error("cannot draw {}: {reason}; check that the folder can be written to", path.display())]
    Plot { path: PathBuf, reason: String },
}

/// A module that has no partner, or lies far from it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Listed {
    pub id: String,
    pub label: String,
    /// Its own centre, metres east, north and up of the truth's reference.
    pub center_enu_m: [f64; 3],
}

/// A paired module far from where the truth has it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct WorstModule {
    pub plant: Listed,
    pub truth: Listed,
    /// Plant minus truth after the similarity fit, metres.
    pub difference_m: [f64; 3],
}

/// One bench of the plant after the similarity fit (paper, 4.3.2: deviations are relative shifts between benches).
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct BenchShift {
    pub bench: String,
    /// Modules of it that were paired.
    pub modules: usize,
    /// Mean of plant minus truth, metres.
    pub shift_m: [f64; 3],
}

/// How the plant was moved onto the truth.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Fit {
    /// Length in the truth per length in the plant.
    pub scale: f64,
    /// Angle of the rotation, degrees.
    pub rotation_deg: f64,
    /// How the plant's centroid moves, metres.
    pub move_m: [f64; 3],
}

/// Everything that the comparison found.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Evaluation {
    pub plant: String,
    pub truth: String,
    pub plant_modules: usize,
    pub truth_modules: usize,
    /// Modules of the truth that the plant has.
    pub found: usize,
    pub missing: Vec<Listed>,
    #[serde(rename = "false")]
    pub false_modules: Vec<Listed>,
    pub structure: Structure,
    pub as_is: Differences,
    pub rigid_fit: Fit,
    pub after_rigid_fit: Differences,
    pub similarity_fit: Fit,
    pub after_similarity_fit: Differences,
    /// Distances between modules, which no alignment can mend; `None` where no two stand far enough apart.
    pub distances: Option<Distances>,
    pub plant_spacing: Spacing,
    pub truth_spacing: Spacing,
    /// The furthest off after the similarity fit.
    pub worst: Vec<WorstModule>,
    pub benches: Vec<BenchShift>,
    /// What plots need beyond this; the indices are those of the models that were compared.
    #[serde(skip)]
    pub pairs: Vec<(usize, usize)>,
    /// Brings the plant onto the truth.
    #[serde(skip)]
    pub truth_from_plant: Similarity,
    /// Plant minus truth of each pair after the similarity fit, metres.
    #[serde(skip)]
    pub residuals_m: Vec<Vector3<f64>>,
}

impl Evaluation {
    /// Every module found, none false, every place right.
    pub fn is_flawless(&self) -> bool {
        self.missing.is_empty() && self.false_modules.is_empty() && self.structure.exact
    }
}

/// Compares a plant with a truth, both in the truth's frame (see [`ReferenceModel::in_frame_of`]). A module of the truth
/// is found if, after the best alignment, one of the plant lies within half its shorter side in the horizontal plane;
/// heights are judged by the differences alone.
pub fn evaluate(plant: &ReferenceModel, truth: &ReferenceModel) -> Result<Evaluation, EvaluateError> {
    let centers = |model: &ReferenceModel| model.modules.iter().map(|m| m.center_enu_m).collect::<Vec<_>>();
    let (plant_m, truth_m) = (centers(plant), centers(truth));
    let gates_m: Vec<f64> = truth.modules.iter().map(|m| m.shorter_side_m() / 2.0).collect();
    let nothing_pairs = || EvaluateError::NothingPairs {
        plant: plant.name.clone(),
        plant_modules: plant_m.len(),
        truth: truth.name.clone(),
        truth_modules: truth_m.len(),
    };
    let pairs = align::pair(&plant_m, &truth_m, &gates_m).ok_or_else(nothing_pairs)?;
    let (mut found_in_plant, mut found_in_truth) = (vec![false; plant_m.len()], vec![false; truth_m.len()]);
    for &(p, t) in &pairs {
        (found_in_plant[p], found_in_truth[t]) = (true, true);
    }
    let unpaired = |model: &ReferenceModel, found: &[bool]| {
        (0..found.len()).filter(|&k| !found[k]).map(|k| listed(model, k)).collect::<Vec<_>>()
    };

    let sigmas_m: Vec<Option<Vector3<f64>>> = pairs.iter().map(|&(p, _)| plant.modules[p].sigma_enu_m).collect();
    let residuals = |transform: &Similarity| -> Vec<Vector3<f64>> {
        pairs.iter().map(|&(p, t)| transform.apply(&plant_m[p]) - truth_m[t]).collect()
    };
    let fit = |with_scale| align::fit_of_pairs(&plant_m, &truth_m, &pairs, with_scale).ok_or_else(nothing_pairs);
    let (rigid, similarity) = (fit(false)?, fit(true)?);
    let differences =
        |transform: &Similarity| Differences::of(&residuals(transform), &sigmas_m).ok_or_else(nothing_pairs);
    let residuals_m = residuals(&similarity);
    let centroid_m = pairs.iter().map(|&(p, _)| plant_m[p]).sum::<Vector3<f64>>() / pairs.len() as f64;
    let described = |transform: &Similarity| Fit {
        scale: transform.scale,
        rotation_deg: transform.rotation.angle().to_degrees(),
        move_m: (transform.apply(&centroid_m) - centroid_m).into(),
    };

    Ok(Evaluation {
        plant: plant.name.clone(),
        truth: truth.name.clone(),
        plant_modules: plant_m.len(),
        truth_modules: truth_m.len(),
        found: pairs.len(),
        missing: unpaired(truth, &found_in_truth),
        false_modules: unpaired(plant, &found_in_plant),
        structure: structure::compare(plant, truth, &pairs),
        as_is: differences(&Similarity::identity())?,
        rigid_fit: described(&rigid),
        after_rigid_fit: differences(&rigid)?,
        similarity_fit: described(&similarity),
        after_similarity_fit: differences(&similarity)?,
        distances: Distances::of(&pairs.iter().map(|&(p, t)| (plant_m[p], truth_m[t])).collect::<Vec<_>>()),
        plant_spacing: Spacing::of(plant),
        truth_spacing: Spacing::of(truth),
        worst: worst(plant, truth, &pairs, &residuals_m),
        benches: bench_shifts(plant, &pairs, &residuals_m),
        pairs,
        truth_from_plant: similarity,
        residuals_m,
    })
}

fn listed(model: &ReferenceModel, k: usize) -> Listed {
    let module = &model.modules[k];
    Listed { id: module.id.clone(), label: module.label.clone(), center_enu_m: module.center_enu_m.into() }
}

fn worst(
    plant: &ReferenceModel,
    truth: &ReferenceModel,
    pairs: &[(usize, usize)],
    residuals_m: &[Vector3<f64>],
) -> Vec<WorstModule> {
    let mut order: Vec<usize> = (0..pairs.len()).collect();
    order.sort_by(|&i, &j| residuals_m[j].norm().total_cmp(&residuals_m[i].norm()).then(i.cmp(&j)));
    order
        .into_iter()
        .take(MAX_WORST)
        .map(|k| WorstModule {
            plant: listed(plant, pairs[k].0),
            truth: listed(truth, pairs[k].1),
            difference_m: residuals_m[k].into(),
        })
        .collect()
}

fn bench_shifts(plant: &ReferenceModel, pairs: &[(usize, usize)], residuals_m: &[Vector3<f64>]) -> Vec<BenchShift> {
    let mut sums = vec![(0_usize, Vector3::zeros()); plant.benches.len()];
    for (&(p, _), residual) in pairs.iter().zip(residuals_m) {
        let (count, sum) = &mut sums[plant.modules[p].bench];
        *count += 1;
        *sum += residual;
    }
    let shifts = plant.benches.iter().zip(sums).filter(|(_, (count, _))| *count > 0);
    shifts
        .map(|(bench, (modules, sum))| BenchShift {
            bench: bench.name.clone(),
            modules,
            shift_m: (sum / modules as f64).into(),
        })
        .collect()
}
