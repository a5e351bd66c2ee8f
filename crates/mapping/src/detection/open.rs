//! Opens model files, of whichever kind they are.

use super::detectors::Both;
use super::runtime::{self, ImageModel, RuntimeSettings};
use super::{DetectionError, Detector, Unet, Yolo};
use std::path::{Path, PathBuf};

/// The shipped models by the names that stand for them.
const SHIPPED: [(&str, &[&str]); 3] =
    [("unet", &["unet.onnx"]), ("yolo", &["yolo.onnx"]), ("both", &["unet.onnx", "yolo.onnx"])];

/// The detector of what a person named: the shipped `unet`, `yolo` or `both`, or paths of ONNX files, one of each kind at most. Which kind a
/// file is, its metadata or its outputs tell.
///
/// # Errors
/// No runtime; a file that is no model, or does not fit; two models of one kind.
pub fn open(named: &[String], settings: RuntimeSettings) -> Result<Box<dyn Detector>, DetectionError> {
    let choice = |what: &str| DetectionError::ModelChoice(format!("{what}: name a U-Net, a YOLO, or one of each"));
    let (mut unet, mut yolo) = (None, None);
    let paths = named.iter().map(|name| files_of(name)).collect::<Result<Vec<_>, _>>()?;
    for path in paths.into_iter().flatten() {
        let model = runtime::open_model(&path, settings)?;
        match is_yolo(&model) {
            true if yolo.is_some() => return Err(choice("two of the models are YOLOs")),
            true => yolo = Some(Yolo::of_model(model)?),
            false if unet.is_some() => return Err(choice("two of the models are U-Nets")),
            false => unet = Some(Unet::of_model(model)?),
        }
    }
    match (unet, yolo) {
        (Some(unet), Some(yolo)) => Ok(Box::new(Both { unet, yolo })),
        (Some(unet), None) => Ok(Box::new(unet)),
        (None, Some(yolo)) => Ok(Box::new(yolo)),
        (None, None) => Err(choice("no detector is named")),
    }
}

/// By its metadata, else by an output of three dimensions, in which the YOLO family has its boxes.
fn is_yolo(model: &ImageModel) -> bool {
    match model.ours("kind") {
        Some(kind) => kind == "yolo",
        None => model.outputs.iter().any(|outlet| outlet.shape.as_ref().is_some_and(|shape| shape.len() == 3)),
    }
}

/// The files of a shipped model, or the path that it is.
fn files_of(name: &str) -> Result<Vec<PathBuf>, DetectionError> {
    match SHIPPED.iter().find(|(shipped, _)| *shipped == name) {
        Some((_, files)) => files.iter().map(|file| shipped(file)).collect(),
        None => Ok(vec![PathBuf::from(name)]),
    }
}

/// Where a shipped model lies: in `models/` of the working directory, else beside the executable or in one of its parents,
/// or in their `share/heliomap/`.
fn shipped(file: &str) -> Result<PathBuf, DetectionError> {
    let here = Path::new("models").join(file);
    let executable = std::env::current_exe().ok();
    let above = executable.iter().flat_map(|path| path.ancestors().skip(1));
    let beside = above.flat_map(|folder| [folder.join(&here), folder.join("share/heliomap").join(&here)]);
    let found = std::iter::once(here.clone()).chain(beside).find(|path| path.is_file());
    found.ok_or_else(|| DetectionError::ShippedModelMissing { name: file.to_owned() })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_shipped_model_that_is_missing_is_told_with_where_it_is_looked_for() {
        assert!(shipped("unet.onnx").is_ok_and(|path| path.is_file()));
        let error = shipped("none.onnx").unwrap_err().to_string();
        assert!(error.contains("none.onnx") && error.contains("share/heliomap/models/"), "{error}");
    }
}
