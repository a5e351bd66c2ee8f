//! The parameters that a model is mapped with.

use super::coverage::CoverageParams;
use crate::fusion::{FusionOptions, FusionParams};
use crate::layout::LayoutOptions;
use crate::refinement::{RefinementOptions, RefinementParams};
use sha2::{Digest, Sha256};

/// Bytes of the digest: enough to tell any two sets of parameters apart.
const DIGEST_BYTES: usize = 8;

/// All parameters of the steps after detection, whose own stand with the detector's name and version.
#[derive(Debug, Clone, Copy)]
#[expect(dead_code, reason = "the digest reads all of them")]
pub(super) struct Parameters {
    pub(super) coverage: CoverageParams,
    pub(super) layout: LayoutOptions,
    pub(super) max_disparity_m: f64,
    pub(super) fusion: FusionParams,
    pub(super) refinement: RefinementParams,
}

impl Parameters {
    /// Those that every mapping takes.
    pub(super) fn usual() -> Self {
        let FusionOptions { max_disparity_m, params: fusion, .. } = FusionOptions::default();
        Self {
            coverage: CoverageParams::default(),
            layout: LayoutOptions::default(),
            max_disparity_m,
            fusion,
            refinement: RefinementOptions::default().params,
        }
    }

    /// A digest of all names and values, hexadecimal.
    pub(super) fn digest(&self) -> String {
        let digest = Sha256::digest(format!("{self:?}"));
        digest.iter().take(DIGEST_BYTES).map(|byte| format!("{byte:02x}")).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_parameter_is_in_the_digest() {
        let usual = Parameters::usual();
        let mut other = usual;
        other.fusion.end_cost += 1e-9;
        assert_eq!(usual.digest(), Parameters::usual().digest());
        assert_ne!(usual.digest(), other.digest());
        assert_eq!(usual.digest().len(), 2 * DIGEST_BYTES);
    }
}
