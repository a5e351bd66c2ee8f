use crate::app::{App, assert_problem, encoded, jpeg};
use crate::stub;
use flate2::Compression;
use flate2::write::GzEncoder;
use heliomap::config::Limits;
use reqwest::StatusCode;
use serde_json::{Value, json};
use std::io::{Cursor, Read, Write};
use zip::write::{FullFileOptions, SimpleFileOptions};

const RECONSTRUCTION: &[u8] = stub::RECONSTRUCTION.as_bytes();
const REFERENCE: &[u8] = stub::REFERENCE.as_bytes();

fn zip(entries: &[(&str, &[u8])]) -> Vec<u8> {
    let mut archive = zip::ZipWriter::new(Cursor::new(Vec::new()));
    for (name, bytes) in entries {
        archive.start_file(*name, SimpleFileOptions::default()).unwrap();
        archive.write_all(bytes).unwrap();
    }
    archive.finish().unwrap().into_inner()
}

/// A tar with names as they are, however bad.
fn tar(entries: &[(&str, tar::EntryType, &[u8])]) -> Vec<u8> {
    let mut archive = tar::Builder::new(Vec::new());
    for (name, kind, bytes) in entries {
        let mut header = tar::Header::new_ustar();
        header.as_mut_bytes()[..name.len()].copy_from_slice(name.as_bytes());
        header.set_entry_type(*kind);
        header.set_size(bytes.len() as u64);
        header.set_mode(0o644);
        if kind.is_symlink() {
            header.set_link_name("/etc/passwd").unwrap();
        }
        header.set_cksum();
        archive.append(&header, *bytes).unwrap();
    }
    archive.into_inner().unwrap()
}

fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut encoder = GzEncoder::new(Vec::new(), Compression::default());
    encoder.write_all(bytes).unwrap();
    encoder.finish().unwrap()
}

fn paths(survey: &Value) -> Vec<&str> {
    survey["files"].as_array().unwrap().iter().map(|file| file["path"].as_str().unwrap()).collect()
}

#[tokio::test]
async fn a_survey_says_what_it_lacks() {
    let app = App::new(&[]).await;
    let survey = app.survey().await;
    let missing = async || {
        let (_, survey) = app.get(&survey).await;
        let codes: Vec<String> =
            survey["missing"].as_array().unwrap().iter().map(|m| m["code"].as_str().unwrap().to_owned()).collect();
        assert_eq!(survey["complete"], json!(codes.is_empty()));
        codes
    };
    assert_eq!(missing().await, ["too_few_images", "no_reconstruction", "no_reference"]);
    let (status, problem) = app.post(&format!("{survey}/jobs"), json!({})).await;
    assert_eq!((status.as_u16(), &problem["code"]), (409, &json!("survey_incomplete")));
    assert_eq!(problem["missing"][1]["code"], "no_reconstruction");
    app.fill(&survey).await;
    assert!(missing().await.is_empty());
}

#[tokio::test]
async fn files_of_a_reconstruction_are_checked() {
    let app = App::new(&[]).await;
    let survey = app.survey().await;
    let put = async |path: &str, body: &[u8]| app.put(&format!("{survey}/reconstruction/{path}"), body.to_vec()).await;
    for (path, body) in [
        ("reconstruction.json", RECONSTRUCTION),
        ("reference_lla.json", REFERENCE),
        ("camera_models.json", b"{}".as_slice()),
        ("undistorted/reconstruction.json", RECONSTRUCTION),
        ("undistorted/undistorted_shot_ids.json", b"{}"),
        ("undistorted/images/a.JPG.jpg", &jpeg(8, 8)),
        ("undistorted/depthmaps/merged.ply", &stub::cloud(500)),
        ("reconstruction.topocentric.json", RECONSTRUCTION),
        ("odm_georeferencing/coords.txt", b"WGS84 UTM 32N\n500000 5500000\n"),
    ] {
        let (status, answer) = put(path, body).await;
        assert_eq!((status, &answer["path"]), (StatusCode::CREATED, &json!(path)), "{answer}");
    }
    assert_problem(put("reports/x.json", b"{}").await, 422, "unknown_file", "reports/x.json");
    assert_problem(put("../reconstruction.json", b"[]").await, 404, "not_found", "");
    assert_problem(put("..%2freconstruction.json", b"[]").await, 422, "unknown_file", "..");
    let short = String::from_utf8(stub::cloud(500)).unwrap().replace("vertex 1", "vertex 300");
    let one = stub::reconstruction_of(&[&["a.jpg"]]);
    let unknown = stub::RECONSTRUCTION.replace("perspective", "equirectangular");
    for (path, body, code, words) in [
        (
            "reconstruction.json",
            b"{}".as_slice(),
            "reconstruction_malformed",
            "reconstruction.json is not what OpenSfM",
        ),
        ("reconstruction.json", b"[{", "reconstruction_malformed", "cut short"),
        ("reconstruction.json", b"", "reconstruction_malformed", "cut short"),
        ("reconstruction.json", b"[NaN]", "reconstruction_not_finite", "reconstruction.json holds NaN"),
        ("reconstruction.json", b"[]", "too_few_images", "holds 0 shots"),
        ("reconstruction.json", one.as_bytes(), "too_few_images", "holds 1 shots"),
        ("reconstruction.json", unknown.as_bytes(), "camera_model_unknown", "equirectangular"),
        ("undistorted/reconstruction.json", b"[7]", "reconstruction_malformed", "undistorted/reconstruction.json"),
        ("undistorted/undistorted_shot_ids.json", b"[]", "reconstruction_malformed", "undistorted_shot_ids.json"),
        ("reference_lla.json", b"[]", "reconstruction_malformed", "reference_lla.json"),
        ("reference_lla.json", b"{}", "reconstruction_malformed", "latitude"),
        (
            "reference_lla.json",
            b"{\"latitude\": 95, \"longitude\": 0, \"altitude\": 0}",
            "reconstruction_malformed",
            "no place on earth",
        ),
        ("camera_models.json", b"[]", "file_unreadable", "camera_models.json"),
        ("boxes.json", b"{\"images\": 1}", "boxes_invalid", "boxes.json"),
        ("undistorted/depthmaps/merged.ply", b"plop", "reconstruction_malformed", "merged.ply"),
        (
            "undistorted/depthmaps/merged.ply",
            short.as_bytes(),
            "point_cloud_truncated",
            "merged.ply promises 300 points",
        ),
        ("odm_georeferencing/coords.txt", b"\xff\xfe", "file_unreadable", "coords.txt"),
    ] {
        let (status, problem) = put(path, body).await;
        let incoming = app.folder.path().to_str().unwrap();
        assert!(!problem.to_string().contains(incoming), "{problem}");
        assert_problem((status, problem), 422, code, words);
    }
    assert_problem(put("undistorted/images/a.jpg", b"x").await, 422, "image_unreadable", "undistorted/images/a.jpg");
}

#[tokio::test]
async fn an_archive_of_a_whole_folder_makes_a_survey_complete() {
    let photo = jpeg(8, 8);
    let app = App::new(&[]).await;
    let entries: Vec<(&str, &[u8])> = vec![
        ("project/", b""),
        ("project/images/a.jpg", &photo),
        ("project/images/b.jpg", &photo),
        ("project/reconstruction.json", RECONSTRUCTION),
        ("project/reference_lla.json", REFERENCE),
        ("project/undistorted/reconstruction.json", RECONSTRUCTION),
        ("project/undistorted/images/thumbs/x.jpg", b"not known"),
        ("project/backup/reconstruction.json", b"older"),
        ("project/reports/stats.json", b"{}"),
    ];
    let files: Vec<_> = entries
        .iter()
        .filter(|(name, _)| !name.ends_with('/'))
        .map(|(n, b)| (*n, tar::EntryType::Regular, *b))
        .collect();
    let expected = [
        "images/a.jpg",
        "images/b.jpg",
        "reconstruction.json",
        "reference_lla.json",
        "undistorted/reconstruction.json",
    ];
    for (name, archive) in [("zip", zip(&entries[1..])), ("tar", tar(&files)), ("tar.gz", gzip(&tar(&files)))] {
        let plant = app.post("/api/v1/plants", json!({"name": name})).await.1;
        let surveys = format!("/api/v1/plants/{}/surveys", plant["id"].as_str().unwrap());
        let survey = app.post(&surveys, json!({"name": "x"})).await.1;
        let survey = format!("{surveys}/{}", survey["id"].as_str().unwrap());
        let (status, answer) = app.put(&format!("{survey}/reconstruction"), archive).await;
        assert_eq!(status, StatusCode::OK, "{name}: {answer}");
        assert_eq!(answer["ignored_count"], 3, "{name}: {answer}");
        let (_, survey) = app.get(&survey).await;
        assert_eq!((paths(&survey).as_slice(), &survey["complete"]), (expected.as_slice(), &json!(true)), "{name}");
    }
    assert_eq!(std::fs::read_dir(app.folder.path().join("incoming")).unwrap().count(), 0);
}

#[tokio::test]
async fn bad_archives_are_refused_as_a_whole() {
    use tar::EntryType::{Fifo, Regular, Symlink};
    let limits = Limits { max_entries: 5, max_unpacked_size: 1 << 20, ..Limits::default() };
    let app = App::with_limits(&[], limits).await;
    let survey = app.survey().await;
    let put = async |body: Vec<u8>| app.put(&format!("{survey}/reconstruction"), body).await;
    let good = ("reconstruction.json", RECONSTRUCTION);
    let file = ("reconstruction.json", Regular, RECONSTRUCTION);

    assert_problem(put(b"hello".to_vec()).await, 415, "unsupported_archive", "zip");
    assert_problem(put(Vec::new()).await, 415, "unsupported_archive", "zip");
    assert_problem(put(b"PK\x03\x04rest".to_vec()).await, 422, "archive_unreadable", "");
    assert_problem(put(zip(&[("x.txt", b"")])).await, 422, "archive_empty", "reconstruction.json");
    for name in ["../x.json", "a/../../x", "/etc/x", "C:\\x", "..\\x"] {
        assert_problem(put(zip(&[good, (name, b"x")])).await, 422, "archive_unsafe", name);
        assert_problem(put(tar(&[file, (name, Regular, b"x")])).await, 422, "archive_unsafe", name);
    }
    assert_problem(put(tar(&[file, ("x", Symlink, b"")])).await, 422, "archive_unsafe", "`x` is a link");
    assert_problem(put(tar(&[file, ("x", Fifo, b"")])).await, 422, "archive_unsafe", "`x`");
    let mut linked = zip::ZipWriter::new(Cursor::new(zip(&[good])));
    linked.add_symlink("images/a.jpg", "/etc/passwd", SimpleFileOptions::default()).unwrap();
    let linked = linked.finish().unwrap().into_inner();
    assert_problem(put(linked).await, 422, "archive_unsafe", "images/a.jpg");

    let zeros = vec![b' '; 2 << 20];
    assert_problem(put(zip(&[good, ("big", &zeros)])).await, 413, "archive_too_large", "1048576");
    assert_problem(put(gzip(&tar(&[file, ("big", Regular, &zeros)]))).await, 413, "archive_too_large", "1048576");
    let many: Vec<(&str, &[u8])> = ["1", "2", "3", "4", "5", "6"].map(|name| (name, b"".as_slice())).to_vec();
    assert_problem(put(zip(&many)).await, 413, "archive_too_large", "5 entries");
    let cut = gzip(&tar(&[file]));
    assert_problem(put(cut[..cut.len() / 2].to_vec()).await, 422, "archive_unreadable", "");

    let png = encoded(8, 8, image::ImageFormat::Png);
    assert_problem(put(zip(&[good, ("images/a.jpg", &png)])).await, 422, "image_format_mismatch", "images/a.jpg");
    assert_problem(
        put(zip(&[("reconstruction.json", b"{}")])).await,
        422,
        "reconstruction_malformed",
        "reconstruction.json",
    );
    let twice = tar(&[file, file]);
    assert_problem(put(twice).await, 422, "archive_unsafe", "reconstruction.json");

    assert!(paths(&app.get(&survey).await.1).is_empty());
    assert_eq!(std::fs::read_dir(app.folder.path().join("incoming")).unwrap().count(), 0);
}

#[tokio::test]
async fn an_archive_may_not_unpack_to_many_times_its_size() {
    let app = App::with_limits(&[], Limits { max_unpacked_ratio: 10, ..Limits::default() }).await;
    let survey = app.survey().await;
    let zeros = vec![b' '; 80 << 20];
    let bomb = zip(&[("reconstruction.json", &zeros)]);
    assert_problem(app.put(&format!("{survey}/reconstruction"), bomb).await, 413, "archive_too_large", "bytes");
}

#[tokio::test]
async fn names_and_directories_that_would_fill_the_memory_are_refused() {
    use tar::EntryType::{GNULongName, Regular, XHeader};
    let app = App::with_limits(&[], Limits { max_entries: 30, ..Limits::default() }).await;
    let survey = app.survey().await;
    let put = async |body: Vec<u8>| app.put(&format!("{survey}/reconstruction"), body).await;
    let file = ("reconstruction.json", Regular, RECONSTRUCTION);
    for kind in [GNULongName, XHeader] {
        let long = vec![b'x'; 2 << 20];
        let answer = put(gzip(&tar(&[("././@LongLink", kind, &long), file]))).await;
        assert_problem(answer, 422, "archive_unreadable", "before an entry is too long");
    }
    let name = vec![b'x'; 2000];
    assert_problem(put(tar(&[("l", GNULongName, &name), file])).await, 422, "archive_unsafe", "no usable name");
    // No more entries than allowed, but a directory as of many.
    let mut archive = zip::ZipWriter::new(Cursor::new(Vec::new()));
    for index in 0..20 {
        let options = FullFileOptions::default().with_file_comment("x".repeat(65_000));
        archive.start_file(format!("{index}"), options).unwrap();
    }
    assert_problem(put(archive.finish().unwrap().into_inner()).await, 413, "archive_too_large", "30 entries");
    // Names as long as file systems have them are as good as any.
    let deep = format!("{}/reconstruction.json", ["folder"; 40].join("/"));
    let mut archive = tar::Builder::new(Vec::new());
    let mut header = tar::Header::new_gnu();
    header.set_size(RECONSTRUCTION.len() as u64);
    archive.append_data(&mut header, deep, RECONSTRUCTION).unwrap();
    assert_eq!(put(archive.into_inner().unwrap()).await.0, StatusCode::OK);
}

#[tokio::test]
async fn an_archive_that_would_fill_the_disk_is_refused() {
    let app = App::new(&[]).await;
    let survey = app.survey().await;
    // Room for 32 MiB, and an archive that unpacks to much more.
    let reserve = app.blobs().free_bytes().unwrap() - (32 << 20);
    let limits = Limits { disk_reserve: reserve, max_unpacked_ratio: 10_000, ..Limits::default() };
    let tight = app.beside(limits).await;
    let mut archive = tar::Builder::new(GzEncoder::new(Vec::new(), Compression::fast()));
    let mut header = tar::Header::new_gnu();
    let size = 512 << 20;
    header.set_size(size);
    let content = b"ply\n".chain(std::io::repeat(b' ')).take(size);
    archive.append_data(&mut header, "undistorted/depthmaps/merged.ply", content).unwrap();
    let archive = archive.into_inner().unwrap().finish().unwrap();
    let answer = tight.put(&format!("{survey}/reconstruction"), archive).await;
    assert_problem(answer, 507, "storage_full", "");
    assert_eq!(std::fs::read_dir(app.folder.path().join("incoming")).unwrap().count(), 0);
}

#[tokio::test]
async fn a_reconstruction_of_more_images_than_any_survey_has_is_refused() {
    let app = App::new(&[]).await;
    let survey = app.survey().await;
    let pose = r#"{"rotation":[0,0,0],"translation":[0,0,1],"camera":"c"}"#;
    let camera = r#"{"projection_type":"perspective","width":32,"height":24,"focal":0.8}"#;
    let component = |from: usize| {
        let shots: Vec<String> = (from..from + 60_000).map(|shot| format!("\"{shot}.jpg\":{pose}")).collect();
        format!("{{\"cameras\":{{\"c\":{camera}}},\"shots\":{{{}}}}}", shots.join(","))
    };
    let put = async |body: String| app.put(&format!("{survey}/reconstruction/reconstruction.json"), body).await;
    let both = format!("[{},{}]", component(0), component(60_000));
    assert_problem(put(both).await, 422, "reconstruction_malformed", "more than 100000 images");
    assert_eq!(put(format!("[{}]", component(0))).await.0, StatusCode::CREATED);
    let (_, told) = app.get(&format!("{survey}?limit=1")).await;
    assert_eq!(told["images"]["not_uploaded_count"], 60_000);
    assert_eq!(told["images"]["not_uploaded"].as_array().unwrap().len(), 1000);
}

/// An archive that came changed, cut or with more than itself, by what was done to it.
fn spoilt() -> Vec<(&'static str, Vec<u8>)> {
    let file = tar::EntryType::Regular;
    let whole = tar(&[("reference_lla.json", file, REFERENCE), ("notes.txt", file, b"nothing")]);
    let other = tar(&[("reconstruction.json", file, RECONSTRUCTION)]);
    // Not compressed, so that a byte of the file can be changed.
    let mut stored = GzEncoder::new(Vec::new(), Compression::none());
    stored.write_all(&whole).unwrap();
    let stored = stored.finish().unwrap();
    let changed = |archive: &[u8], content: &[u8], to: u8| {
        let at = archive.windows(content.len()).position(|window| window == content).unwrap();
        let mut archive = archive.to_vec();
        archive[at] = to;
        archive
    };
    let packed = gzip(&whole);
    let mut plain = zip::ZipWriter::new(Cursor::new(Vec::new()));
    for (name, bytes) in [("reference_lla.json", REFERENCE), ("notes.txt", b"nothing")] {
        let options = SimpleFileOptions::default().compression_method(zip::CompressionMethod::Stored);
        plain.start_file(name, options).unwrap();
        plain.write_all(bytes).unwrap();
    }
    let plain = plain.finish().unwrap().into_inner();
    let entries = whole.len() - 1024;
    vec![
        ("a digit of a tar.gz", changed(&stored, b"50.0", b'1')),
        ("a byte of an entry that is ignored", changed(&stored, b"nothing", b'N')),
        ("a tar.gz without its trailer", packed[..packed.len() - 8].to_vec()),
        ("a tar.gz without the end of its trailer", packed[..packed.len() - 2].to_vec()),
        ("a tar.gz and a byte", [&packed[..], b"x"].concat()),
        ("two tar.gz", [packed.clone(), gzip(&other)].concat()),
        ("two tars", [whole.clone(), other.clone()].concat()),
        ("a tar cut between two entries", whole[..entries].to_vec()),
        ("a gzipped tar cut between two entries", gzip(&whole[..entries])),
        ("a tar and a byte", [&whole[..], b"x"].concat()),
        ("a digit of a zip", changed(&plain, b"50.0", b'1')),
        ("a byte of a zip's entry that is ignored", changed(&plain, b"nothing", b'N')),
        ("a zip and a byte", [&plain[..], b"x"].concat()),
        ("two zips", [plain.clone(), zip(&[("reconstruction.json", RECONSTRUCTION)])].concat()),
        ("a zip without its last byte", plain[..plain.len() - 1].to_vec()),
    ]
}

#[tokio::test]
async fn an_archive_that_came_changed_is_refused_and_nothing_of_it_is_stored() {
    let app = App::new(&[]).await;
    let survey = app.survey().await;
    for (what, archive) in spoilt() {
        let (status, problem) = app.put(&format!("{survey}/reconstruction"), archive).await;
        assert_eq!((status.as_u16(), &problem["code"]), (422, &json!("archive_unreadable")), "{what}: {problem}");
        assert_eq!(app.get(&survey).await.1["files"], json!([]), "{what}");
    }
    assert_eq!(std::fs::read_dir(app.folder.path().join("incoming")).unwrap().count(), 0);
}

#[tokio::test]
async fn archives_of_other_kinds_are_refused_by_their_names() {
    let app = App::new(&[]).await;
    let survey = app.survey().await;
    let begins: [(&[u8], &str); 5] = [
        (b"\xfd7zXZ\0\0\x04", "xz"),
        (b"BZh91AY&SY", "bzip2"),
        (b"\x28\xb5\x2f\xfd\x04", "Zstandard"),
        (b"7z\xbc\xaf\x27\x1c\0\x04", "7z"),
        (b"Rar!\x1a\x07\x01\0", "RAR"),
    ];
    for (begin, kind) in begins {
        let answer = app.put(&format!("{survey}/reconstruction"), [begin, &[7; 600]].concat()).await;
        assert_problem(answer, 415, "unsupported_archive", kind);
    }
}

#[tokio::test]
async fn an_archive_may_be_in_pieces_that_are_one() {
    let app = App::new(&[]).await;
    let survey = app.survey().await;
    let file = tar::EntryType::Regular;
    let whole = tar(&[("reference_lla.json", file, REFERENCE), ("reconstruction.json", file, RECONSTRUCTION)]);
    let (front, back) = whole.split_at(700);
    let mut commented = zip::ZipWriter::new(Cursor::new(Vec::new()));
    commented.set_comment("made by a person").unwrap();
    commented.start_file("reference_lla.json", SimpleFileOptions::default()).unwrap();
    commented.write_all(REFERENCE).unwrap();
    for archive in [
        // Several members of gzip are one stream (RFC 1952, 2.2).
        [gzip(front), gzip(back)].concat(),
        // Records of tar are filled up with zeros.
        [&whole[..], &[0; 8192]].concat(),
        commented.finish().unwrap().into_inner(),
    ] {
        let (status, answer) = app.put(&format!("{survey}/reconstruction"), archive).await;
        assert_eq!(status, StatusCode::OK, "{answer}");
    }
}

#[tokio::test]
async fn archives_that_people_make_lose_nothing_silently() {
    let app = App::new(&[]).await;
    let photo = jpeg(8, 8);
    // A program of Windows; a zip of macOS; photos in folders, one of them twice.
    let entries: Vec<(&str, &[u8])> = vec![
        ("flight\\reconstruction.json", RECONSTRUCTION),
        ("flight\\reference_lla.json", REFERENCE),
        ("flight\\undistorted\\depthmaps\\merged.ply", b"ply"),
        ("flight\\images\\100MEDIA\\a.jpg", &photo),
        ("flight\\images\\ho\u{308}he.jpg", &photo),
        ("__MACOSX/flight/images/._a.jpg", b"x"),
        ("flight/.DS_Store", b"x"),
        ("flight/orthophoto.tif", b"x"),
        ("flight/old/merged.ply", b"x"),
        ("flight/notes.txt", b"x"),
    ];
    let cloud = stub::cloud(400);
    let entries: Vec<(&str, &[u8])> =
        entries.into_iter().map(|(name, bytes)| (name, if bytes == b"ply" { &cloud[..] } else { bytes })).collect();
    let survey = app.survey().await;
    let (status, answer) = app.put(&format!("{survey}/reconstruction"), zip(&entries)).await;
    assert_eq!(status, StatusCode::OK, "{answer}");
    let expected = [
        "images/a.jpg",
        "images/h\u{f6}he.jpg",
        "reconstruction.json",
        "reference_lla.json",
        "undistorted/depthmaps/merged.ply",
    ];
    assert_eq!(paths(&app.get(&survey).await.1), expected);
    let left_out: Vec<&str> =
        answer["left_out"].as_array().unwrap().iter().map(|left_out| left_out["entry"].as_str().unwrap()).collect();
    assert_eq!(left_out, ["flight/orthophoto.tif", "flight/old/merged.ply"], "{answer}");
    assert_eq!(answer["ignored_count"], 5);

    let twice = zip(&[("images/100MEDIA/a.jpg", &photo), ("images/101MEDIA/a.jpg", &photo)]);
    let answer = app.put(&format!("{survey}/reconstruction"), twice).await;
    assert_problem(answer, 422, "archive_unsafe", "`images/100MEDIA/a.jpg` and `images/101MEDIA/a.jpg`");
    // Two entries of one name, as no writer makes them.
    let mut same = zip(&[("reference_lla.json", REFERENCE), ("reference_llb.json", REFERENCE)]);
    while let Some(at) = same.windows(18).position(|window| window == b"reference_llb.json") {
        same[at + 12] = b'a';
    }
    let answer = app.put(&format!("{survey}/reconstruction"), same).await;
    assert_problem(answer, 422, "archive_unsafe", "two entries are named `reference_lla.json`");
}

#[tokio::test]
async fn names_that_differ_in_case_or_form_alone_are_one_where_that_is_clear() {
    let app = App::new(&[]).await;
    let survey = app.survey().await;
    let reconstruction = stub::reconstruction_of(&[&["DJI_1.JPG", "ho\u{308}he.jpg", "DJI_2.jpg"]]);
    assert_eq!(app.put(&format!("{survey}/reconstruction/reconstruction.json"), reconstruction).await.0.as_u16(), 201);
    for name in ["dji_1.jpg", "h%C3%B6he.jpg", "Dji_2.jpg", "DJI_2.JPG"] {
        assert_eq!(app.put(&format!("{survey}/images/{name}"), jpeg(8, 8)).await.0.as_u16(), 201, "{name}");
    }
    let (_, told) = app.get(&survey).await;
    assert_eq!(told["images"]["not_uploaded"], json!(["DJI_2.jpg"]), "{told}");
    assert_eq!(told["images"]["not_reconstructed"], json!([]));
    // One plant, however its name is composed.
    let (_, first) = app.post("/api/v1/plants", json!({"name": "Ho\u{308}he"})).await;
    let (status, again) = app.post("/api/v1/plants", json!({"name": "H\u{f6}he"})).await;
    assert_eq!((status, &again["id"]), (StatusCode::OK, &first["id"]));
}
