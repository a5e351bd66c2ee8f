//! `heliomap doctor` on a service that is well, and on one for each thing that may be wrong with it.

use serde_json::Value;
use std::path::Path;
use std::process::Command;

/// Whether it says that all is well, and its checks.
fn examine(data: &Path, variables: &[(&str, &str)], arguments: &[&str]) -> (bool, Vec<Value>) {
    let output = Command::new(env!("CARGO_BIN_EXE_heliomap"))
        .args(["doctor", "--json"])
        .args(arguments)
        .env("HELIOMAP_DATA_DIR", data)
        .envs(variables.iter().copied())
        .output()
        .unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    (output.status.success(), serde_json::from_str(&text).unwrap())
}

/// A data folder with a database and a key.
fn healthy() -> tempfile::TempDir {
    let data = tempfile::tempdir().unwrap();
    let made = Command::new(env!("CARGO_BIN_EXE_heliomap"))
        .args(["keys", "create", "--name", "first", "--scope", "admin"])
        .env("HELIOMAP_DATA_DIR", data.path())
        .output()
        .unwrap();
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    data
}

/// Asserts that this check alone fails, and says so and what to do.
#[track_caller]
fn assert_fails(outcome: (bool, Vec<Value>), name: &str, found: &str) {
    let (well, checks) = outcome;
    assert!(!well);
    let failed: Vec<_> = checks.iter().filter(|check| check["verdict"] == "failed").collect();
    assert_eq!(failed.len(), 1, "{checks:?}");
    assert_eq!(failed[0]["name"], name, "{checks:?}");
    assert!(failed[0]["found"].as_str().unwrap().contains(found), "{checks:?}");
    assert!(!failed[0]["advice"].as_str().unwrap().is_empty());
}

/// A connection that is encrypted, and is trusted by whoever knows the authority alone.
#[test]
#[ignore = "needs Postgres; run `make unit`"]
fn a_database_behind_tls() {
    let data = tempfile::tempdir().unwrap();
    let script = r#"for query in "sslmode=verify-full&sslrootcert=$HELIOMAP_TEST_POSTGRES_AUTHORITY" sslmode=require \
        sslmode=verify-full sslmode=disable
    do "$0" doctor --json --database "$HELIOMAP_TEST_POSTGRES/postgres?$query"; done; true"#;
    let output = Command::new("tests/with-postgres.sh")
        .args(["bash", "-c", script, env!("CARGO_BIN_EXE_heliomap")])
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .env("HELIOMAP_DATA_DIR", data.path())
        .env("HELIOMAP_TEST_TLS", "1")
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let answers = serde_json::Deserializer::from_slice(&output.stdout).into_iter::<Vec<Value>>();
    let databases =
        answers.map(|checks| checks.unwrap().into_iter().find(|check| check["name"] == "database").unwrap());
    let databases: Vec<_> = databases.map(|check| (check["verdict"].clone(), check["found"].to_string())).collect();
    assert_eq!(databases.len(), 4, "{databases:?}");
    for (verdict, found) in &databases[..2] {
        assert!(verdict == "warning" && found.contains("answers and is empty"), "{databases:?}");
    }
    assert!(databases[2].0 == "failed" && databases[2].1.contains("certificate"), "{databases:?}");
    assert!(databases[3].0 == "failed" && databases[3].1.contains("no encryption"), "{databases:?}");
}

#[test]
fn a_service_that_is_well() {
    let data = healthy();
    let (well, checks) = examine(data.path(), &[], &[]);
    assert!(well, "{checks:?}");
    let verdicts: Vec<_> = checks.iter().map(|check| check["name"].as_str().unwrap()).collect();
    assert_eq!(
        verdicts,
        ["configuration", "data folder", "database", "storage", "detector", "certificates", "identity provider"]
    );
    // A machine may have no certificates of public authorities.
    for check in &checks[..5] {
        assert_eq!(check["verdict"], "ok", "{check}");
    }
    assert!(checks[4]["found"].as_str().unwrap().contains("ONNX Runtime on CPU"), "{checks:?}");
    let output = Command::new(env!("CARGO_BIN_EXE_heliomap"))
        .args(["doctor", "--insecure"])
        .env("HELIOMAP_DATA_DIR", data.path())
        .output()
        .unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(output.status.success() && text.contains("warning  configuration: --insecure"), "{text}");
    assert!(text.contains("         -> omit --insecure"), "{text}");
}

#[test]
fn a_folder_that_is_not_there_yet_is_no_failure() {
    let folder = tempfile::tempdir().unwrap();
    let data = folder.path().join("new");
    let (well, checks) = examine(&data, &[], &[]);
    assert!(well && !data.exists(), "{checks:?}");
    assert_eq!(checks[1]["verdict"], "warning", "{checks:?}");
}

#[test]
fn each_thing_that_is_wrong_is_named() {
    let data = healthy();
    let ask = |arguments: &[&str]| examine(data.path(), &[], arguments);
    assert_fails(ask(&["--listen", "0.0.0.0:8080", "--insecure"]), "configuration", "no loopback address");
    assert_fails(ask(&["--disk-reserve", "9000000T"]), "data folder", "--disk-reserve");
    assert_fails(ask(&["--detector", "/nowhere.onnx"]), "detector", "nowhere.onnx");
    let advice = |(_, checks): (bool, Vec<Value>)| checks[4]["advice"].to_string();
    assert!(!advice(ask(&["--detector", "/nowhere.onnx"])).contains("ORT_DYLIB_PATH"));
    let library = [("ORT_DYLIB_PATH", "/nowhere/libonnxruntime.so")];
    assert_fails(examine(data.path(), &library, &[]), "detector", "/nowhere/libonnxruntime.so");
    assert!(advice(examine(data.path(), &library, &[])).contains("ORT_DYLIB_PATH"));
    let provider = ["--oidc-issuer", "http://127.0.0.1:9", "--oidc-audience", "heliomap"];
    assert_fails(ask(&provider), "identity provider", "http://127.0.0.1:9");
    let unreachable = ["--database", "postgres://heliomap:pa55w0rd@127.0.0.1:9/heliomap"];
    let outcome = ask(&unreachable);
    assert!(!format!("{outcome:?}").contains("pa55w0rd"), "{outcome:?}");
    assert_fails(outcome, "database", "does not answer");

    let blobs = data.path().join("blobs");
    std::fs::remove_dir_all(&blobs).unwrap();
    std::fs::write(&blobs, "no folder").unwrap();
    assert_fails(ask(&[]), "storage", "blobs");

    let data = healthy();
    std::fs::write(data.path().join("heliomap.db"), "no database".repeat(100)).unwrap();
    assert_fails(examine(data.path(), &[], &[]), "database", "does not answer");

    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("file");
    std::fs::write(&file, "no folder").unwrap();
    let (well, checks) = examine(&file, &[], &[]);
    assert!(!well && checks[1]["verdict"] == "failed", "{checks:?}");
}

#[test]
fn a_database_of_another_version_is_told() {
    let data = healthy();
    let change = |statement: &'static str| {
        let file = data.path().join("heliomap.db");
        tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap().block_on(async {
            let options = sqlx::sqlite::SqliteConnectOptions::new().filename(&file);
            let pool = sqlx::SqlitePool::connect_with(options).await.unwrap();
            sqlx::query(statement).execute(&pool).await.unwrap();
            pool.close().await;
        });
    };
    change("UPDATE _sqlx_migrations SET version = 9999 WHERE version = (SELECT MAX(version) FROM _sqlx_migrations)");
    assert_fails(examine(data.path(), &[], &[]), "database", "newer version");
    change("DELETE FROM _sqlx_migrations WHERE version = 9999");
    let (well, checks) = examine(data.path(), &[], &[]);
    assert!(well && checks[2]["verdict"] == "warning", "{checks:?}");
    assert!(checks[2]["found"].as_str().unwrap().contains("1 changes"), "{checks:?}");
}
