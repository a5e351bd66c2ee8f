//! Layout, locate, fusion and refinement on a simulated plant of the paper's size (4974 modules, about 20 photos).

use criterion::{BatchSize, Criterion, criterion_group, criterion_main};
use heliomap_mapping::fusion::{self, FusionOptions, View};
use heliomap_mapping::layout::{self, Layout, LayoutOptions};
use heliomap_mapping::refinement::{self, RefinementOptions};
use heliomap_simulator::{Errors, Flight, PlantSpec, simulate};
use rand::SeedableRng;
use rand::rngs::StdRng;

/// So many that the plant has about the 1.4 million points of the paper's cloud.
const POINTS_PER_M2: f64 = 32.0;

fn stages(criterion: &mut Criterion) {
    let spec = PlantSpec::paper_pp1(&mut StdRng::seed_from_u64(1));
    let errors = Errors { cloud_points_per_m2: POINTS_PER_M2, ..Errors::paper() };
    let simulation = simulate(&spec, &Flight::paper_pp1(), &errors, 1);
    let detections: usize = simulation.detections.iter().map(|image| image.detections.len()).sum();
    let lay_out = || -> Vec<Layout> {
        let infer = |detections| layout::infer(detections, None, &LayoutOptions::default());
        simulation.detections.iter().map(infer).collect()
    };
    let layouts = lay_out();
    let views: Vec<View<'_>> = simulation
        .reconstruction
        .shots
        .iter()
        .zip(&simulation.detections)
        .zip(&layouts)
        .map(|((shot, detections), layout)| View { shot, detections, layout })
        .collect();
    let cloud = simulation.reconstruction.dense.clone().unwrap_or_default();
    let located = fusion::locate::locate(&views, &cloud);
    let fused = fusion::fuse(&views, located.clone(), &FusionOptions::default());

    let mut group = criterion.benchmark_group("paper-sized plant");
    group.sample_size(10);
    group.bench_function("layout", |b| b.iter(lay_out));
    group.bench_function("locate", |b| b.iter(|| fusion::locate::locate(&views, &cloud)));
    group.bench_function("fuse", |b| {
        b.iter_batched(
            || located.clone(),
            |located| fusion::fuse(&views, located, &FusionOptions::default()),
            BatchSize::PerIteration,
        );
    });
    group.bench_function("refine", |b| b.iter(|| refinement::refine(&views, &fused, &RefinementOptions::default())));
    let points = cloud.positions_m.len() as f64 / 1e6;
    group.bench_function(format!("{detections} detections, {points:.2} million points: locate to refine"), |b| {
        b.iter(|| {
            let located = fusion::locate::locate(&views, &cloud);
            let fused = fusion::fuse(&views, located, &FusionOptions::default());
            refinement::refine(&views, &fused, &RefinementOptions::default())
        });
    });
    group.finish();
}

criterion_group!(benches, stages);
criterion_main!(benches);
