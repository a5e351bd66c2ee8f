//! What every blob store must do, on local disk and in a bucket.

use heliomap::store::{Blobs, Bucket, Digest, StagedFile, StoreError, UploadId};
use heliomap_model::PlantId;
use object_store::aws::AmazonS3Builder;
use std::collections::HashSet;
use std::io::Write;
use std::path::Path;
use std::time::Duration;
use uuid::Uuid;

/// Runs the suite on local disk and, where `tests/with-s3.sh` started a server, in a bucket of it.
macro_rules! on_both {
    ($($name:ident),* $(,)?) => {
        mod disk {
            $(
                #[tokio::test]
                async fn $name() {
                    let data = tempfile::tempdir().unwrap();
                    let blobs = super::Blobs::in_folder(data.path()).unwrap();
                    super::$name(&blobs, data.path()).await;
                }
            )*
        }

        mod bucket {
            $(
                #[tokio::test]
                #[ignore = "needs an S3-compatible server; run `make unit`"]
                async fn $name() {
                    let data = tempfile::tempdir().unwrap();
                    let blobs = super::in_bucket(data.path());
                    super::$name(&blobs, data.path()).await;
                }
            )*
        }
    };
}

on_both!(
    stored_bytes_come_back,
    large_files_come_back,
    the_same_bytes_are_stored_once,
    a_deleted_blob_leaves_the_others,
    a_deleted_plant_leaves_nothing,
    what_is_missing_is_told,
    uploads_on_their_way_are_swept_once_nobody_knows_them,
);

/// Blobs in a part of their own of the test server's bucket.
fn in_bucket(data: &Path) -> Blobs {
    beside_each_other(&[data]).remove(0)
}

/// Blobs in one part of that bucket for servers with data folders of their own.
fn beside_each_other(data: &[&Path]) -> Vec<Blobs> {
    let endpoint = std::env::var("HELIOMAP_TEST_S3")
        .expect("HELIOMAP_TEST_S3 must name a server: run `make unit`, or tests/with-s3.sh before cargo test");
    let bucket: Bucket = format!("s3://heliomap-tests/{}", Uuid::new_v4()).parse().unwrap();
    let settings = AmazonS3Builder::new()
        .with_endpoint(endpoint)
        .with_access_key_id("heliomap")
        .with_secret_access_key("heliomap-secret");
    data.iter().map(|data| Blobs::in_bucket(data, &bucket, settings.clone()).unwrap()).collect()
}

fn plant(number: u128) -> PlantId {
    PlantId(Uuid::from_u128(number))
}

fn staged(blobs: &Blobs, bytes: &[u8]) -> StagedFile {
    let mut file = tempfile::NamedTempFile::new_in(blobs.staging()).unwrap();
    file.write_all(bytes).unwrap();
    StagedFile { path: file.into_temp_path(), size: bytes.len() as u64, sha256: Digest::of(bytes) }
}

fn files_below(folder: &Path) -> usize {
    let entries = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap());
    entries.map(|entry| if entry.path().is_dir() { files_below(&entry.path()) } else { 1 }).sum()
}

async fn stored_bytes_come_back(blobs: &Blobs, data: &Path) {
    blobs.ping().await.unwrap();
    let digest = blobs.put_bytes(plant(1), b"a model".to_vec()).await.unwrap();
    assert_eq!(digest, Digest::of(b"a model"));
    assert_eq!(blobs.get(plant(1), digest).await.unwrap(), "a model");
    let target = data.join("placed");
    blobs.place(plant(1), digest, &target).await.unwrap();
    assert_eq!(std::fs::read(&target).unwrap(), b"a model");
    let empty = blobs.put_bytes(plant(1), Vec::new()).await.unwrap();
    assert_eq!(blobs.get(plant(1), empty).await.unwrap(), "");
    assert_eq!(files_below(blobs.staging()), 0);
}

/// Larger than one part of an upload in parts.
async fn large_files_come_back(blobs: &Blobs, data: &Path) {
    let bytes: Vec<u8> = (0..40_000_000_u32).map(|k| (k.wrapping_mul(2_654_435_761) >> 24) as u8).collect();
    let file = staged(blobs, &bytes);
    let digest = file.sha256;
    blobs.put_file(plant(1), file).await.unwrap();
    let target = data.join("placed");
    blobs.place(plant(1), digest, &target).await.unwrap();
    assert!(std::fs::read(&target).unwrap() == bytes);
    assert_eq!(files_below(blobs.staging()), 0);
}

async fn the_same_bytes_are_stored_once(blobs: &Blobs, _data: &Path) {
    let put = async || blobs.put_file(plant(1), staged(blobs, b"photo")).await;
    let (first, second) = tokio::join!(put(), put());
    first.unwrap();
    second.unwrap();
    put().await.unwrap();
    assert_eq!(blobs.get(plant(1), Digest::of(b"photo")).await.unwrap(), "photo");
    // Nobody learns from an upload what another plant holds.
    let elsewhere = blobs.get(plant(2), Digest::of(b"photo")).await;
    assert!(matches!(elsewhere, Err(StoreError::Blob(object_store::Error::NotFound { .. }))), "{elsewhere:?}");
}

/// More blobs than a page of a bucket's list holds.
async fn a_deleted_blob_leaves_the_others(blobs: &Blobs, _data: &Path) {
    let [gone, kept] = ["gone", "kept"].map(|text| blobs.put_bytes(plant(1), text.into()));
    let (gone, kept) = (gone.await.unwrap(), kept.await.unwrap());
    blobs.put_bytes(plant(2), b"gone".to_vec()).await.unwrap();
    blobs.delete(plant(1), gone).await.unwrap();
    assert!(blobs.get(plant(1), gone).await.is_err());
    assert_eq!(blobs.get(plant(1), kept).await.unwrap(), "kept");
    assert_eq!(blobs.get(plant(2), gone).await.unwrap(), "gone");
    blobs.delete(plant(1), gone).await.unwrap();
    assert_eq!(blobs.put_bytes(plant(1), b"gone".to_vec()).await.unwrap(), gone);
    assert_eq!(blobs.get(plant(1), gone).await.unwrap(), "gone");
}

async fn a_deleted_plant_leaves_nothing(blobs: &Blobs, _data: &Path) {
    let puts = (0..1100_u32).map(|k| blobs.put_file(plant(1), staged(blobs, &k.to_le_bytes())));
    let mut puts = futures::stream::StreamExt::buffer_unordered(futures::stream::iter(puts), 16);
    while let Some(put) = futures::StreamExt::next(&mut puts).await {
        put.unwrap();
    }
    let kept = blobs.put_bytes(plant(2), b"kept".to_vec()).await.unwrap();
    blobs.delete_plant(plant(1)).await.unwrap();
    for k in [0_u32, 500, 1099] {
        assert!(blobs.get(plant(1), Digest::of(&k.to_le_bytes())).await.is_err());
    }
    assert_eq!(blobs.get(plant(2), kept).await.unwrap(), "kept");
    blobs.delete_plant(plant(1)).await.unwrap();
}

async fn what_is_missing_is_told(blobs: &Blobs, data: &Path) {
    let missing = Digest::of(b"never stored");
    let got = blobs.get(plant(1), missing).await;
    assert!(matches!(got, Err(StoreError::Blob(object_store::Error::NotFound { .. }))), "{got:?}");
    assert!(blobs.place(plant(1), missing, &data.join("placed")).await.is_err());
}

async fn uploads_on_their_way_are_swept_once_nobody_knows_them(blobs: &Blobs, data: &Path) {
    let (known, unknown) = (UploadId(Uuid::from_u128(1)), UploadId(Uuid::from_u128(2)));
    for id in [known, unknown] {
        std::fs::write(blobs.upload_file(id), b"half a pho").unwrap();
        assert!(blobs.upload_file(id).starts_with(data));
    }
    blobs.sweep_uploads(HashSet::from([known]), Duration::from_secs(3600)).await.unwrap();
    assert!(blobs.upload_file(unknown).exists(), "it may be just beginning");
    blobs.sweep_uploads(HashSet::from([known]), Duration::ZERO).await.unwrap();
    assert!(blobs.upload_file(known).exists() && !blobs.upload_file(unknown).exists());
}

/// As an upload's file is stored, and stored again where that was not noted.
#[tokio::test]
async fn another_name_of_a_stored_file_leaves_none_behind() {
    let data = tempfile::tempdir().unwrap();
    let blobs = Blobs::in_folder(data.path()).unwrap();
    let source = data.path().join("source");
    std::fs::write(&source, b"photo").unwrap();
    for _ in 0..2 {
        let link = blobs.staging().join("link");
        std::fs::hard_link(&source, &link).unwrap();
        let path = tempfile::TempPath::try_from_path(link).unwrap();
        blobs.put_file(plant(1), StagedFile { path, size: 5, sha256: Digest::of(b"photo") }).await.unwrap();
        assert_eq!(files_below(blobs.staging()), 0);
    }
    assert_eq!(blobs.get(plant(1), Digest::of(b"photo")).await.unwrap(), "photo");
}

#[tokio::test]
async fn a_damaged_blob_is_not_handed_out_and_is_whole_once_its_bytes_come_again() {
    let data = tempfile::tempdir().unwrap();
    let blobs = Blobs::in_folder(data.path()).unwrap();
    let digest = blobs.put_bytes(plant(1), b"a model".to_vec()).await.unwrap();
    let text = digest.to_string();
    let file = data.path().join(format!("blobs/plants/{}/{}/{text}", plant(1), &text[..2]));
    // A job holds on to what it has.
    let held = data.path().join("held");
    blobs.place(plant(1), digest, &held).await.unwrap();
    for damaged in ["another", "a mod"] {
        std::fs::remove_file(&file).unwrap();
        std::fs::write(&file, damaged).unwrap();
        let error = blobs.get(plant(1), digest).await.unwrap_err();
        assert!(matches!(&error, StoreError::Damaged { sha256, .. } if *sha256 == digest), "{error}");
        assert!(error.to_string().contains("backup"), "{error}");
        blobs.put_bytes(plant(1), b"a model".to_vec()).await.unwrap();
        assert_eq!(blobs.get(plant(1), digest).await.unwrap(), "a model");
    }
    assert_eq!(std::fs::read(&held).unwrap(), b"a model");
    assert!(std::fs::metadata(&file).unwrap().permissions().readonly());
}

#[tokio::test]
#[ignore = "needs an S3-compatible server; run `make unit`"]
async fn an_upload_goes_on_at_another_server() {
    let [here, there] = [(); 2].map(|()| tempfile::tempdir().unwrap());
    let servers = beside_each_other(&[here.path(), there.path()]);
    let [here, there] = &servers[..] else { panic!("there are two") };
    assert!(here.home().is_some() && here.home() != there.home());
    let id = UploadId(Uuid::from_u128(1));
    let bytes: Vec<u8> = (0..20_000_000_u32).map(|k| (k.wrapping_mul(2_654_435_761) >> 24) as u8).collect();
    let room = || Ok(());
    let file_of = |blobs: &Blobs| std::fs::read(blobs.upload_file(id)).unwrap();
    there.bring_pieces(id, 0, &[], room).await.unwrap();
    assert!(file_of(there).is_empty(), "nothing came yet");

    std::fs::write(here.upload_file(id), &bytes).unwrap();
    let first = here.keep_pieces(id, 0, 18_000_000).await.unwrap();
    assert_eq!((first.len(), first[0].from, first[2].to), (3, 0, 18_000_000));
    assert!(first.iter().all(|piece| Some(piece.home) == here.home()));
    let full = || Err(std::io::ErrorKind::StorageFull.into());
    assert!(there.bring_pieces(id, 0, &first, full).await.unwrap_err().is_full());
    there.bring_pieces(id, 0, &first, room).await.unwrap();
    assert!(file_of(there) == bytes[..18_000_000]);

    // It goes on there from what counted, and here again: what did not count here goes.
    std::fs::write(there.upload_file(id), &bytes).unwrap();
    let second = there.keep_pieces(id, 18_000_000, 20_000_000).await.unwrap();
    std::fs::write(here.upload_file(id), [&bytes[..18_000_000], &[7; 3_000_000]].concat()).unwrap();
    here.bring_pieces(id, 18_000_000, &second, room).await.unwrap();
    assert!(file_of(here) == bytes);

    // Pieces of unknown uploads are deleted.
    let is_there = async || there.bring_pieces(id, 0, &second, room).await.is_ok();
    there.sweep_uploads(HashSet::from([id]), Duration::ZERO).await.unwrap();
    assert!(is_there().await);
    there.sweep_uploads(HashSet::new(), Duration::from_secs(3600)).await.unwrap();
    assert!(is_there().await, "it may be just beginning");
    there.sweep_uploads(HashSet::new(), Duration::ZERO).await.unwrap();
    assert!(!is_there().await);
    std::fs::write(there.upload_file(id), &bytes).unwrap();
    let kept = there.keep_pieces(id, 0, 20).await.unwrap();
    there.drop_pieces(id, &kept).await;
    assert!(there.bring_pieces(id, 0, &kept, room).await.is_err());
    std::fs::write(there.upload_file(id), &bytes).unwrap();
    let kept = there.keep_pieces(id, 0, 20).await.unwrap();
    there.drop_upload(id).await;
    assert!(!there.upload_file(id).exists() && there.bring_pieces(id, 0, &kept, room).await.is_err());
}
