//! Flags before the environment, the environment before the file, the file before the defaults.

use crate::client;
use reqwest::StatusCode;
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Command, Stdio};

/// What the program prints first, or why it ends.
fn run(file: &Path, variables: &[(&str, &str)], arguments: &[&str]) -> Result<String, String> {
    let mut child = Command::new(env!("CARGO_BIN_EXE_heliomap"))
        .arg("serve")
        .args(arguments)
        .env("HELIOMAP_CONFIG", file)
        .envs(variables.iter().copied())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut line = String::new();
    BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
    let status = line.strip_prefix("heliomap is listening on ").map(|base| {
        let limits = client().get(format!("{}/api/v1/usage", base.trim())).send().unwrap();
        assert_eq!(limits.status(), StatusCode::OK);
        limits.text().unwrap()
    });
    let _ = child.kill();
    let output = child.wait_with_output().unwrap();
    status.ok_or_else(|| String::from_utf8(output.stderr).unwrap())
}

#[test]
fn a_file_sets_what_flags_and_environment_do_not() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("heliomap.yaml");
    let data = folder.path().join("data");
    let text = format!(
        "listen: 127.0.0.1:0\ninsecure: true\nno-worker: true\nlog: warn\nquota-plants: 7\ndata-dir: {}\n",
        data.display()
    );
    std::fs::write(&file, &text).unwrap();
    assert!(run(&file, &[], &[]).unwrap().contains("\"max_plants\":7"));
    let variable = [("HELIOMAP_QUOTA_PLANTS", "8")];
    assert!(run(&file, &variable, &[]).unwrap().contains("\"max_plants\":8"));
    assert!(run(&file, &variable, &["--quota-plants", "9"]).unwrap().contains("\"max_plants\":9"));
    // A file that is named by a flag goes before that of the environment.
    let other = folder.path().join("other.yaml");
    std::fs::write(&other, text.replace("plants: 7", "plants: 6")).unwrap();
    let named = ["--config", other.to_str().unwrap()];
    assert!(run(&file, &[], &named).unwrap().contains("\"max_plants\":6"));

    std::fs::write(&file, "quota-plant: 7\n").unwrap();
    let refused = run(&file, &[], &[]).unwrap_err();
    assert!(refused.contains("heliomap.yaml") && refused.contains("did you mean `quota-plants`?"), "{refused}");
    std::fs::write(&file, "listen: nowhere\n").unwrap();
    let refused = run(&file, &[], &[]).unwrap_err();
    assert!(refused.contains("nowhere") && refused.contains("--listen"), "{refused}");
    let refused = run(&folder.path().join("absent.yaml"), &[], &[]).unwrap_err();
    assert!(refused.contains("absent.yaml"), "{refused}");
}
