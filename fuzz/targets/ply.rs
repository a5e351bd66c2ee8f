//! A point cloud as it is uploaded and mapped.

#![no_main]

use heliomap_fuzz::memory::Allowance;
use libfuzzer_sys::fuzz_target;

/// Buffers, and a point of six doubles for the shortest line that can hold one.
const CLOUD: Allowance = Allowance { bytes: 4 << 20, per_input_byte: 64 };

fuzz_target!(|bytes: &[u8]| {
    let file = heliomap_fuzz::file("merged.ply");
    std::fs::write(&file, bytes).unwrap();
    if let Ok(cloud) = CLOUD.within(bytes.len(), "a cloud", || heliomap_mapping::reconstruction::ply::read(&file)) {
        assert!(cloud.normals.is_empty() || cloud.normals.len() == cloud.positions_m.len());
        assert!(cloud.positions_m.iter().flatten().all(|value| value.is_finite()));
    }
});
