//! Simulated plants: truth, photos without pictures, what a detector would find in them, and what structure from motion
//! would make of them. For tests and benchmarks; nothing of the service uses it.
//!
//! ```
//! use heliomap_simulator::{Errors, Flight, PlantSpec, simulate};
//! use rand::{SeedableRng, rngs::StdRng};
//!
//! let spec = PlantSpec::random_plain(&mut StdRng::seed_from_u64(7));
//! let simulation = simulate(&spec, &Flight::plain(), &Errors::paper(), 7);
//! assert_eq!(simulation.detections.len(), simulation.reconstruction.shots.len());
//! ```
//!
//! - [`PlantSpec`] is the plant on paper: blocks of lines of benches over a terrain; [`PlantSpec::build`] puts it on
//!   the ground as a [`PlantTruth`]. Constructors draw plants of many kinds at random ([`LayoutKind`]).
//! - [`Flight`] says from where photos are taken.
//! - [`Errors`] says what goes wrong in detection and reconstruction.
//! - [`simulate`] does it all from one seed; the same seed gives the same result on any number of threads.
//! - [`structure_report`] compares the structure that a mapping found with the truth.
//!
//! # Frames and conventions
//!
//! The truth is in a local east-north-up frame, metres. Lines head east, or south for rows from north to south; row 0
//! of a bench is on the left of the heading (north, or east), column 0 at the start of the bench (west, or north). A
//! single-axis tracker whose motor parts its row in two is two benches with a narrow gap: from the air that gap is the
//! same as any other. A line goes on through a road. A bench keeps its columns where modules are missing.
//!
//! The reconstruction has a frame of its own: shifted, turned a little, wrong in scale by a fraction of a percent, and
//! bent by a smooth drift. Its poses disagree with each other on top of that. Its cloud is made of depth maps: each
//! point is where the view nearest to it puts it, with noise along the viewing ray.

mod flight;
mod layouts;
mod noise;
mod observe;
mod plant;
mod report;
mod sfm;
#[cfg(test)]
mod tests;

pub use flight::Flight;
pub use layouts::LayoutKind;
pub use observe::Glare;
pub use plant::{
    BenchSpec, BlockSpec, LineCurve, LineSpec, PlantSpec, PlantTruth, Terrain, TerrainWave, TruthBench, TruthLine,
    TruthModule,
};
pub use report::{FoundModule, StructureReport, WrongStructure, structure_report};

use heliomap_mapping::detection::ImageDetections;
use heliomap_mapping::reconstruction::{Reconstruction, Shot};
use plant::ModuleGrid;

/// What goes wrong between the plant and the mapping's input.
#[derive(Debug, Clone, PartialEq)]
pub struct Errors {
    /// Share of the modules wholly in a frame that are detected, where neither a gap nor glare makes it worse.
    pub detection_rate: f64,
    /// Share of the gaps (of one row, in one photo) that keep both neighbours; modules at gaps are missed more often
    /// for it.
    pub gap_detection_rate: f64,
    /// Mean number of false detections in a photo. They overlap no module.
    pub false_per_image: f64,
    /// Standard deviation of each coordinate of a detected corner, pixels.
    pub corner_jitter_px: f64,
    /// Standard deviation of each coordinate of a whole detection, pixels.
    pub center_jitter_px: f64,
    /// Standard deviation of a detection's extent along and up, as a share of it.
    pub size_jitter: f64,
    /// Mean number of patches of glare in a photo. What they cover is neither detected nor in the cloud.
    pub glare_per_image: f64,
    /// Least and largest radius of a patch, in modules (root of a module's area).
    pub glare_radius_modules: [f64; 2],
    /// Modules nearer to the frame's edge than this, or cut by it, are not detected. Pixels.
    pub frame_margin_px: f64,

    /// Largest shift of the reconstruction, each coordinate, metres.
    pub shift_m: f64,
    /// Largest scale error, as a share.
    pub scale_error: f64,
    /// Largest turn about the vertical.
    pub heading_error_rad: f64,
    /// Largest turn about each horizontal axis.
    pub levelling_error_rad: f64,
    /// Amplitude of the smooth drift of each coordinate, metres.
    pub drift_m: f64,
    /// Shortest wavelength of the drift, metres.
    pub drift_wavelength_m: f64,
    /// By how much two views may disagree on where a module is, seen from above, metres (drift within a view adds a
    /// little).
    pub view_disagreement_m: f64,
    /// Standard deviation of the dense cloud's points along the viewing ray, metres. Half of the variance is common to
    /// all points of a module.
    pub cloud_noise_m: f64,
    /// Dense points on each square metre of module or open ground; with 0 there is no dense cloud.
    pub cloud_points_per_m2: f64,
    /// Standard deviation of each coordinate of a cloud normal before it is made a unit vector again.
    pub normal_noise_rad: f64,
    /// Tie points for each view.
    pub sparse_points_per_view: usize,
}

impl Errors {
    /// Errors as the paper reports them (4.2, 4.3): 98.5 % of modules and 93 % of gaps found, views that disagree by up
    /// to 0.6 m.
    pub fn paper() -> Self {
        Self {
            detection_rate: 0.985,
            gap_detection_rate: 0.93,
            false_per_image: 0.5,
            corner_jitter_px: 0.5,
            center_jitter_px: 0.5,
            size_jitter: 0.02,
            glare_per_image: 0.3,
            glare_radius_modules: [1.0, 4.0],
            frame_margin_px: 3.0,
            shift_m: 0.8,
            scale_error: 0.006,
            heading_error_rad: 0.002,
            levelling_error_rad: 0.005,
            drift_m: 0.4,
            drift_wavelength_m: 900.0,
            view_disagreement_m: 0.6,
            cloud_noise_m: 0.1,
            cloud_points_per_m2: 8.0,
            normal_noise_rad: 0.15,
            sparse_points_per_view: 300,
        }
    }

    /// No errors at all: every module wholly in a frame detected as it is, true poses, an exact cloud.
    pub fn none() -> Self {
        Self {
            detection_rate: 1.0,
            gap_detection_rate: 1.0,
            false_per_image: 0.0,
            corner_jitter_px: 0.0,
            center_jitter_px: 0.0,
            size_jitter: 0.0,
            glare_per_image: 0.0,
            glare_radius_modules: [0.0, 0.0],
            frame_margin_px: 0.0,
            shift_m: 0.0,
            scale_error: 0.0,
            heading_error_rad: 0.0,
            levelling_error_rad: 0.0,
            drift_m: 0.0,
            drift_wavelength_m: 900.0,
            view_disagreement_m: 0.0,
            cloud_noise_m: 0.0,
            cloud_points_per_m2: 8.0,
            normal_noise_rad: 0.0,
            sparse_points_per_view: 300,
        }
    }

    /// The same errors without a dense cloud.
    pub fn without_cloud(self) -> Self {
        Self { cloud_points_per_m2: 0.0, ..self }
    }
}

/// A plant, its photos and what came of them.
#[derive(Debug, Clone)]
pub struct Simulation {
    pub truth: PlantTruth,
    /// The shots with their true poses in the frame of the truth, in the order of the reconstruction's.
    pub true_shots: Vec<Shot>,
    /// The estimated world.
    pub reconstruction: Reconstruction,
    /// One for each shot, in their order. Detections within a photo are in no particular order.
    pub detections: Vec<ImageDetections>,
    /// The true module of every detection, `None` for a false one.
    pub owners: Vec<Vec<Option<usize>>>,
    /// Patches of glare in each shot.
    pub glare: Vec<Vec<Glare>>,
}

impl Simulation {
    /// In how many photos each module was detected.
    pub fn sightings(&self) -> Vec<u32> {
        let mut sightings = vec![0; self.truth.modules.len()];
        for module in self.owners.iter().flatten().flatten() {
            sightings[*module] += 1;
        }
        sightings
    }
}

/// Builds the plant, flies over it, detects and reconstructs. The flight's camera must be free of distortion and the
/// plant have a module.
pub fn simulate(spec: &PlantSpec, flight: &Flight, errors: &Errors, seed: u64) -> Simulation {
    assert!(flight.camera.is_undistorted(), "simulated photos are undistorted");
    let truth = spec.build();
    assert!(!truth.modules.is_empty(), "a plant has at least one module");
    let grid = ModuleGrid::new(&truth, 6.0);
    let true_shots = flight.shots(&truth, &mut noise::stream(seed, 2, 0));
    let views = observe::observe(&truth, &grid, &true_shots, errors, seed);
    let reconstruction = sfm::reconstruct(&truth, &grid, &true_shots, &views, errors, seed);
    let mut simulation = Simulation {
        truth,
        true_shots,
        reconstruction,
        detections: Vec::with_capacity(views.len()),
        owners: Vec::with_capacity(views.len()),
        glare: Vec::with_capacity(views.len()),
    };
    for view in views {
        simulation.detections.push(view.detections);
        simulation.owners.push(view.owners);
        simulation.glare.push(view.glare);
    }
    simulation
}
