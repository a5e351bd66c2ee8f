//! Settings of structure from motion.

use clap::Args;
use std::path::PathBuf;

/// Where `make setup` puts the engine, from the repository's root.
const ENGINE: &str = ".venv/reconstruct/bin/python";

/// How photos are reconstructed.
#[derive(Debug, Clone, Args)]
pub struct ReconstructionArgs {
    /// Focal length in pixels over the longer side of the photo; if absent, the drone's calibration or the 35-mm equivalent in
    /// the photos
    #[arg(long, value_name = "SHARE", value_parser = parse_focal)]
    pub focal: Option<f64>,
    /// Python interpreter that has pycolmap; if absent, that of `make setup`, else `python3`
    #[arg(long, env = "HELIOMAP_RECONSTRUCT_PYTHON", value_name = "FILE")]
    pub reconstruct_python: Option<PathBuf>,
}

impl ReconstructionArgs {
    /// The interpreter: the one given, else the one beside the program or the current folder, else the system's.
    pub fn python(&self) -> PathBuf {
        let program = std::env::current_exe().ok();
        let roots = program.iter().flat_map(|program| program.ancestors().skip(1).take(3));
        let near = roots.map(|root| root.join(ENGINE)).chain([PathBuf::from(ENGINE)]).find(|python| python.is_file());
        self.reconstruct_python.clone().or(near).unwrap_or_else(|| PathBuf::from("python3"))
    }
}

/// A focal length that a lens on a drone may have.
fn parse_focal(text: &str) -> Result<f64, String> {
    text.parse()
        .ok()
        .filter(|focal: &f64| (0.2..=10.0).contains(focal))
        .ok_or_else(|| "0.2 to 10 times the longer side is expected".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn focal_lengths_that_no_lens_has_are_refused() {
        assert_eq!(parse_focal("0.7"), Ok(0.7));
        for text in ["0", "-1", "4000", "NaN", "wide"] {
            assert!(parse_focal(text).is_err(), "{text}");
        }
    }
}
