//! A point cloud as it is uploaded and mapped.

#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let file = heliomap_fuzz::file("merged.ply");
    std::fs::write(&file, bytes).unwrap();
    if let Ok(cloud) = heliomap_mapping::reconstruction::ply::read(&file) {
        assert!(cloud.normals.is_empty() || cloud.normals.len() == cloud.positions_m.len());
        assert!(cloud.positions_m.iter().flatten().all(|value| value.is_finite()));
    }
});
