//! The options of a mapping: defined once, for `heliomap map` and for the body of a request that starts a job.

use clap::Args;
use heliomap_mapping::pipeline::MapOptions;
use heliomap_mapping::refinement::Control;
use serde::Deserialize;
use std::io::BufReader;
use std::path::Path;

/// Largest file of control points, bytes.
const MAX_CONTROL_BYTES: u64 = 64 << 20;

/// What a mapping may be told; every member may be left out.
#[derive(Debug, Clone, Default, Args, Deserialize, utoipa::ToSchema)]
#[serde(default, deny_unknown_fields)]
pub struct StartJob {
    /// Rows of modules per bench; inferred where it is not given.
    #[arg(long, value_name = "N")]
    #[schema(minimum = 1, maximum = 64)]
    pub rows_per_bench: Option<u32>,
    /// Ground sampling distance in metres per pixel above which an image does not resolve modules and is left out of
    /// detection; chosen from the images where it is not given.
    #[arg(long = "max-gsd", value_name = "M")]
    #[schema(exclusive_minimum = 0.0)]
    pub max_gsd_m_per_px: Option<f64>,
    /// Known spacing of module centres along and across the row, metres.
    #[arg(long = "spacing", value_name = "ALONG,ACROSS", value_parser = parse_lengths)]
    #[schema(value_type = Option<Vec<f64>>, min_items = 2, max_items = 2)]
    pub spacing_m: Option<[f64; 2]>,
    /// Known size of a module's face, width along the row and height across it, metres; in place of `spacing_m`.
    #[arg(long = "module-size", value_name = "WIDTH,HEIGHT", value_parser = parse_lengths, conflicts_with = "spacing_m")]
    #[schema(value_type = Option<Vec<f64>>, min_items = 2, max_items = 2)]
    pub module_size_m: Option<[f64; 2]>,
    /// Places that are known, to align the model by: `points` marked in images (`name`, `wgs84` or `enu_m`,
    /// `observations` of `image` and `pixel`) and `modules` (`label`, `wgs84` or `enu_m`).
    #[arg(long, value_name = "FILE", value_parser = read_control)]
    #[schema(value_type = Option<Object>)]
    pub control: Option<Control>,
    /// Whether known places set the scale too; where it is not given, they do unless a spacing or module size does.
    #[arg(long, value_name = "BOOL", requires = "control")]
    pub control_scale: Option<bool>,
    /// What heights refer to, stated in the model.
    #[arg(long, value_name = "NAME")]
    #[schema(max_length = 200)]
    pub vertical_datum: Option<String>,
    /// Seed of every random choice, 1 where it is not given.
    #[arg(long, value_name = "SEED")]
    pub seed: Option<u64>,
    /// Among waiting jobs the highest is taken first; 0 where it is not given.
    #[arg(skip)]
    #[schema(minimum = -100, maximum = 100)]
    pub priority: Option<i32>,
}

impl StartJob {
    /// The options as the pipeline takes them.
    ///
    /// # Errors
    /// The first option that cannot be used, and why.
    pub fn into_options(self) -> Result<MapOptions, String> {
        let positive = |value: &f64| value.is_finite() && *value > 0.0;
        if self.rows_per_bench.is_some_and(|rows| !(1..=64).contains(&rows)) {
            return Err("rows_per_bench must be 1 to 64; leave it out to have it inferred".to_owned());
        }
        if self.max_gsd_m_per_px.as_ref().is_some_and(|gsd| !positive(gsd)) {
            return Err("max_gsd_m_per_px must be positive; leave it out to have it chosen from the images".to_owned());
        }
        if self.priority.is_some_and(|priority| !(-100..=100).contains(&priority)) {
            return Err("priority must be -100 to 100; leave it out for 0".to_owned());
        }
        if self.spacing_m.as_ref().is_some_and(|spacing| !spacing.iter().all(positive)) {
            return Err(
                "spacing_m must be two positive numbers of metres; leave it out where it is not known".to_owned()
            );
        }
        let defaults = MapOptions::default();
        let options = MapOptions {
            rows_per_bench: self.rows_per_bench,
            max_gsd_m_per_px: self.max_gsd_m_per_px,
            spacing_m: self.spacing_m,
            module_size_m: self.module_size_m,
            control: self.control,
            control_scale: self.control_scale,
            vertical_datum: self.vertical_datum,
            seed: self.seed.unwrap_or(defaults.seed),
            ..defaults
        };
        options.check().map_err(|error| error.to_string())?;
        Ok(options)
    }
}

fn parse_lengths(text: &str) -> Result<[f64; 2], String> {
    let lengths: Result<Vec<f64>, _> = text.split(',').map(|part| part.trim().parse()).collect();
    let lengths = lengths.ok().and_then(|lengths| <[f64; 2]>::try_from(lengths).ok());
    lengths.ok_or_else(|| "two lengths in metres with a comma between them are expected, such as 1.02,1.67".to_owned())
}

/// Reads the file of `--control`.
fn read_control(path: &str) -> Result<Control, String> {
    let unreadable = |error: std::io::Error| format!("it cannot be read: {error}");
    let file = std::fs::File::open(Path::new(path)).map_err(unreadable)?;
    if file.metadata().map_err(unreadable)?.len() > MAX_CONTROL_BYTES {
        return Err(format!("it is larger than {MAX_CONTROL_BYTES} bytes, more than control points need"));
    }
    serde_json::from_reader(BufReader::new(file))
        .map_err(|error| format!("it does not hold control points as docs/PIPELINE.md describes them: {error}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lengths_are_two() {
        assert_eq!(parse_lengths("1.02,1.67"), Ok([1.02, 1.67]));
        assert_eq!(parse_lengths("1.02, 1.67"), Ok([1.02, 1.67]));
        for wrong in ["", "1.02", "1,2,3", "a,b"] {
            assert!(parse_lengths(wrong).is_err(), "{wrong}");
        }
    }
}
