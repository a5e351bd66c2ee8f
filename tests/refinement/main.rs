//! How far refined modules lie off, on simulated plants: against the paper's refinement on the same inputs, against the
//! deviations that are stated, and whatever the order of the views, the frame of the world and the number of threads.

use heliomap::fusion::{self, Fused, FusionOptions, View};
use heliomap::geometry::{PointCloud, Similarity};
use heliomap::layout::{self, Layout, LayoutOptions};
use heliomap::refinement::{self, Method, Refined, RefinementOptions};
use heliomap::simulator::{Errors, Flight, PlantSpec, Simulation, simulate};
use nalgebra::Vector3;
use rand::SeedableRng;
use rand::rngs::StdRng;

/// A simulated plant, fused.
struct Plant {
    simulation: Simulation,
    layouts: Vec<Layout>,
    fused: Fused,
}

/// Where a module was put, where it is, and the deviation stated for it, metres.
struct Compared {
    error_m: Vector3<f64>,
    sigma_m: Option<Vector3<f64>>,
}

impl Plant {
    fn new(simulation: Simulation) -> Self {
        let layouts: Vec<Layout> =
            simulation.detections.iter().map(|d| layout::infer(d, None, &LayoutOptions::default())).collect();
        let mut plant = Self { simulation, layouts, fused: Fused { lines: vec![], benches: vec![], doubts: vec![] } };
        let cloud = plant.simulation.reconstruction.dense.clone().unwrap_or_else(|| plant.sparse_cloud());
        let views = plant.views();
        let located = fusion::locate::locate(&views, &cloud);
        plant.fused = fusion::fuse(&views, &located, &FusionOptions::default());
        plant
    }

    fn random(seed: u64, errors: &Errors) -> Self {
        let spec = PlantSpec::random_plain(&mut StdRng::seed_from_u64(seed));
        let flight = Flight::random(&mut StdRng::seed_from_u64(seed ^ 0x55));
        Self::new(simulate(&spec, &flight, errors, seed))
    }

    fn sparse_cloud(&self) -> PointCloud {
        let points = &self.simulation.reconstruction.sparse_points_m;
        PointCloud { positions_m: points.iter().map(|p| p.cast::<f32>().into()).collect(), normals: vec![] }
    }

    fn views(&self) -> Vec<View<'_>> {
        let shots = &self.simulation.reconstruction.shots;
        shots
            .iter()
            .zip(&self.simulation.detections)
            .zip(&self.layouts)
            .map(|((shot, detections), layout)| View { shot, detections, layout })
            .collect()
    }

    fn refine(&self, method: Method) -> Refined {
        refinement::refine(&self.views(), &self.fused, &RefinementOptions { method, ..RefinementOptions::default() })
    }

    /// Every module whose owner is known, after a similarity fit.
    fn compare(&self, refined: &Refined) -> Vec<Compared> {
        let mut found = Vec::new();
        let (mut from, mut to) = (Vec::new(), Vec::new());
        for (bench, positions) in self.fused.benches.iter().zip(&refined.benches) {
            for (module, position) in bench.modules.iter().zip(&positions.modules) {
                let seen = &module.observations[0];
                if let Some(owner) = self.simulation.owners[seen.view][seen.detection] {
                    from.push(position.center_m);
                    to.push(self.simulation.truth.modules[owner].center_enu_m);
                    found.push(position.sigma_m);
                }
            }
        }
        let fit = Similarity::fit(&from, &to, true).unwrap();
        let errors = from.iter().zip(&to).map(|(from, to)| fit.apply(from) - to);
        errors.zip(found).map(|(error_m, sigma_m)| Compared { error_m, sigma_m }).collect()
    }
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

fn median_error_m(compared: &[Compared]) -> f64 {
    median(compared.iter().map(|c| c.error_m.norm()).collect())
}

/// Share of errors within so many stated deviations, east, north and up together, and each.
fn within(compared: &[Compared], sigmas: f64) -> [f64; 3] {
    [0, 1, 2].map(|axis| {
        let stated = compared.iter().filter_map(|c| Some((c.error_m[axis], c.sigma_m?[axis])));
        let (mut inside, mut count) = (0.0, 0.0);
        for (error, sigma) in stated {
            inside += f64::from(u8::from(error.abs() <= sigmas * sigma));
            count += 1.0;
        }
        inside / count
    })
}

#[test]
fn the_lattice_errs_by_at_most_a_quarter_of_the_paper_s_refinement_on_twenty_plants() {
    let mut shares = Vec::new();
    for seed in 0..20 {
        let plant = Plant::random(seed, &Errors::paper());
        let lattice = plant.compare(&plant.refine(Method::Lattice));
        let paper = median_error_m(&plant.compare(&plant.refine(Method::Paper)));
        let own = median_error_m(&lattice);
        let (one, two) = (within(&lattice, 1.0), within(&lattice, 2.0));
        println!(
            "seed {seed}: {own:.4} m by the lattice, {paper:.4} m by the paper, {:.3}; within 1 {one:.2?} 2 {two:.2?}",
            own / paper
        );
        shares.push(own / paper);
    }
    assert!(median(shares.clone()) <= 0.25, "{shares:?}");
}
