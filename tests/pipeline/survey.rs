//! A copy of the example plant that may be broken, and the program run on it.

use crate::boxes::{EXAMPLE, true_boxes};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::process::Command;
use tempfile::TempDir;

pub const CLOUD: &str = "undistorted/depthmaps/merged.ply";

/// What the program said.
#[derive(Debug)]
pub struct Said {
    pub code: Option<i32>,
    pub stdout: String,
    pub stderr: String,
}

/// Runs the program in the folder of the package.
pub fn heliomap(arguments: &[&str]) -> Said {
    let output = Command::new(env!("CARGO_BIN_EXE_heliomap"))
        .args(arguments)
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .env_remove("HELIOMAP_DETECTOR")
        .env_remove("HELIOMAP_THREADS")
        .env_remove("HELIOMAP_MAX_MEGAPIXELS")
        .env_remove("HELIOMAP_MAX_IMAGE_MEGAPIXELS")
        .output()
        .unwrap();
    Said {
        code: output.status.code(),
        stdout: String::from_utf8(output.stdout).unwrap(),
        stderr: String::from_utf8(output.stderr).unwrap(),
    }
}

/// Whether the detector can run here; says so where it cannot.
pub fn can_detect() -> bool {
    let named = std::env::var_os("ORT_DYLIB_PATH").is_some_and(|path| !path.is_empty());
    let there = named || Path::new(env!("CARGO_MANIFEST_DIR")).join(".ort/libonnxruntime.so").exists();
    if !there {
        eprintln!("skipped: ONNX Runtime is not installed (`make setup` installs it)");
    }
    there
}

/// A folder that holds the example plant by links, and a file of its true boxes.
pub struct Survey {
    folder: TempDir,
}

impl Survey {
    pub fn new() -> Self {
        let survey = Self { folder: tempfile::tempdir().unwrap() };
        let link = |name: &str| {
            let path = survey.path(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::os::unix::fs::symlink(Path::new(EXAMPLE).join(name), path).unwrap();
        };
        ["reconstruction.json", "reference_lla.json", CLOUD].into_iter().for_each(link);
        for number in 1..=10 {
            link(&format!("images/DJI_{number:04}.jpg"));
        }
        survey.write_boxes(|_| true);
        survey
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join("plant").join(name)
    }

    pub fn read(&self, name: &str) -> Vec<u8> {
        std::fs::read(self.path(name)).unwrap()
    }

    /// Puts a file in the place of another, or of none.
    pub fn write(&self, name: &str, bytes: impl AsRef<[u8]>) {
        let path = self.path(name);
        if path.exists() {
            self.remove(name);
        }
        std::fs::write(path, bytes).unwrap();
    }

    pub fn remove(&self, name: &str) {
        std::fs::remove_file(self.path(name)).unwrap();
    }

    /// Changes the reconstruction.
    pub fn edit(&self, change: impl FnOnce(&mut Value)) {
        let mut reconstruction = serde_json::from_slice(&self.read("reconstruction.json")).unwrap();
        change(&mut reconstruction);
        self.write("reconstruction.json", serde_json::to_vec(&reconstruction).unwrap());
    }

    pub fn boxes(&self) -> PathBuf {
        self.folder.path().join("boxes.json")
    }

    /// Writes the true boxes of the modules that `keep` is true for.
    pub fn write_boxes(&self, keep: impl Fn(&Value) -> bool) {
        self.change_boxes(true_boxes(keep));
    }

    pub fn change_boxes(&self, boxes: Value) {
        std::fs::write(self.boxes(), serde_json::to_vec(&boxes).unwrap()).unwrap();
    }

    fn out(&self) -> PathBuf {
        self.folder.path().join("out")
    }

    /// Maps the plant by its boxes, or by the detector.
    pub fn map(&self, with_boxes: bool, options: &[&str]) -> Said {
        let (folder, boxes, out) = (self.path(""), self.boxes(), self.out().join("plant.geojson"));
        std::fs::create_dir_all(self.out()).unwrap();
        let mut arguments = vec!["map", folder.to_str().unwrap(), "--out", out.to_str().unwrap(), "--layers", "--json"];
        if with_boxes {
            arguments.extend(["--detections", boxes.to_str().unwrap()]);
        }
        arguments.extend(options);
        heliomap(&arguments)
    }

    /// Maps the plant and gives the summary, which must warn of `warnings`, each by its code and images.
    #[track_caller]
    pub fn maps_with_warnings(&self, with_boxes: bool, warnings: &[(&str, &[&str])]) -> Value {
        let said = self.map(with_boxes, &[]);
        assert_eq!(said.code, Some(0), "{}", said.stderr);
        let summary: Value = serde_json::from_str(&said.stdout).unwrap();
        let found = summary["warnings"].as_array().unwrap();
        assert!(
            found.iter().all(|warning| warning["message"].as_str().is_some_and(|text| text.len() > 20)),
            "{summary}"
        );
        for (code, images) in warnings {
            let is_there = |warning: &Value| {
                warning["code"] == *code && warning.get("images").unwrap_or(&json!([])) == &json!(images)
            };
            assert!(found.iter().any(is_there), "`{code}` of {images:?} is not in {summary}");
        }
        for name in ["plant", "plant-sectors", "plant-benches", "plant-lines"] {
            assert!(self.out().join(format!("{name}.geojson")).is_file());
        }
        summary
    }

    /// The modules that were written.
    pub fn modules(&self) -> Vec<Value> {
        let text = std::fs::read(self.out().join("plant.geojson")).unwrap();
        serde_json::from_slice::<Value>(&text).unwrap()["features"].as_array().unwrap().clone()
    }

    /// The plant must be refused in a sentence that holds all of `words`, and nothing be written.
    #[track_caller]
    pub fn is_refused(&self, options: &[&str], words: &[&str]) {
        let said = self.map(true, options);
        assert!(said.code.is_some_and(|code| code != 0 && code != 101), "{said:?}");
        for word in words {
            assert!(said.stderr.contains(word), "`{word}` is not in `{}`", said.stderr);
        }
        assert!(said.stdout.is_empty(), "{}", said.stdout);
        assert_eq!(std::fs::read_dir(self.out()).unwrap().count(), 0, "something was written");
    }
}
