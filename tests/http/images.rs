use crate::app::{App, assert_problem, encoded, jpeg, json_of};
use heliomap::config::Limits;
use image::ImageFormat;
use reqwest::multipart::{Form, Part};
use reqwest::{Method, StatusCode};
use serde_json::json;
use std::time::Duration;
use tokio::io::{AsyncReadExt, AsyncWriteExt};

async fn files(app: &App, survey: &str) -> Vec<String> {
    let (_, survey) = app.get(survey).await;
    survey["files"].as_array().unwrap().iter().map(|file| file["path"].as_str().unwrap().to_owned()).collect()
}

/// Nothing may be left of uploads that ended.
fn incoming(app: &App) -> usize {
    std::fs::read_dir(app.folder.path().join("incoming")).unwrap().count()
}

#[tokio::test]
async fn a_photo_is_stored_once_however_often_it_is_sent() {
    let app = App::new(&[]).await;
    let survey = app.survey().await;
    let path = format!("{survey}/images/DJI_0001.JPG");
    let (status, file) = app.put(&path, jpeg(32, 24)).await;
    assert_eq!((status, &file["result"]), (StatusCode::CREATED, &json!("created")));
    assert_eq!((&file["path"], &file["width_px"]), (&json!("images/DJI_0001.JPG"), &json!(32)));
    let (status, file) = app.put(&path, jpeg(32, 24)).await;
    assert_eq!((status, &file["result"]), (StatusCode::OK, &json!("unchanged")));
    let (status, file) = app.put(&path, jpeg(16, 24)).await;
    assert_eq!((status, &file["result"], &file["width_px"]), (StatusCode::OK, &json!("replaced"), &json!(16)));
    for (name, format) in [("b.png", ImageFormat::Png), ("c.tif", ImageFormat::Tiff)] {
        let (status, file) = app.put(&format!("{survey}/images/{name}"), encoded(20, 10, format)).await;
        assert_eq!((status, &file["height_px"]), (StatusCode::CREATED, &json!(10)));
    }
    assert_eq!(files(&app, &survey).await, ["images/DJI_0001.JPG", "images/b.png", "images/c.tif"]);
    assert_eq!(incoming(&app), 0);
}

#[tokio::test]
async fn broken_photos_are_refused_and_leave_nothing() {
    let limits = Limits { max_image_size: 20_000, max_image_megapixels: 0.01, ..Limits::default() };
    let app = App::with_limits(&[], limits).await;
    let survey = app.survey().await;
    let put = async |name: &str, body: Vec<u8>| app.put(&format!("{survey}/images/{name}"), body).await;
    let whole = jpeg(64, 48);
    let cut = |bytes: &[u8]| bytes[..bytes.len() - 20].to_vec();

    let png = encoded(64, 48, ImageFormat::Png);
    assert_problem(put("a.jpg", cut(&whole)).await, 422, "image_truncated", "images/a.jpg");
    assert_problem(put("a.png", cut(&png)).await, 422, "image_truncated", "images/a.png");
    let tiff = encoded(64, 48, ImageFormat::Tiff);
    assert_eq!(put("a.tif", cut(&tiff)).await.0, StatusCode::UNPROCESSABLE_ENTITY);
    assert_problem(put("a.jpg", png).await, 422, "image_format_mismatch", "images/a.jpg holds a PNG");
    assert_problem(put("a.jpg", b"hello".to_vec()).await, 422, "image_unreadable", "images/a.jpg");
    assert_problem(put("a.jpg", Vec::new()).await, 422, "image_unreadable", "images/a.jpg");
    assert_problem(put("a.jpg", jpeg(200, 100)).await, 413, "image_too_large", "200 x 100");
    assert_problem(put("a.jpg", vec![0; 30_000]).await, 413, "too_large", "images/a.jpg");
    assert_problem(put("a.exe", whole.clone()).await, 422, "invalid_name", "a.exe");
    assert_problem(put("..%2fa.jpg", whole.clone()).await, 422, "invalid_name", "/");
    assert_eq!(files(&app, &survey).await, Vec::<String>::new());
    assert_eq!(incoming(&app), 0);
    assert_eq!(put("a.jpg", whole).await.0, StatusCode::CREATED);
}

#[tokio::test]
async fn a_large_body_without_a_length_is_cut_off() {
    let app = App::with_limits(&[], Limits { max_image_size: 100_000, ..Limits::default() }).await;
    let survey = app.survey().await;
    let chunks = futures::stream::iter((0..100).map(|_| Ok::<_, std::io::Error>(vec![0_u8; 10_000])));
    let body = reqwest::Body::wrap_stream(chunks);
    assert_problem(app.put(&format!("{survey}/images/a.jpg"), body).await, 413, "too_large", "100000");
}

#[tokio::test]
async fn a_pixel_bomb_is_refused_by_its_header() {
    let app = App::new(&[]).await;
    let survey = app.survey().await;
    let mut bomb = jpeg(32, 24);
    let frame = bomb.windows(2).position(|pair| pair == [0xff, 0xc0]).unwrap();
    bomb[frame + 5..frame + 9].copy_from_slice(&[0xff, 0xdc, 0xff, 0xdc]);
    let answer = app.put(&format!("{survey}/images/a.jpg"), bomb).await;
    assert_problem(answer, 413, "image_too_large", "65500 x 65500");
}

#[tokio::test]
async fn many_photos_at_once_each_with_its_verdict() {
    let app = App::new(&[]).await;
    let survey = app.survey().await;
    let post = async |parts: Vec<(&'static str, Vec<u8>)>| {
        let form = parts
            .into_iter()
            .fold(Form::new(), |form, (name, bytes)| form.part("file", Part::bytes(bytes).file_name(name)));
        json_of(app.request(Method::POST, &format!("{survey}/images")).multipart(form).send().await.unwrap()).await
    };
    let (status, answer) = post(vec![("a.jpg", jpeg(8, 8)), ("b.jpg", jpeg(9, 8))]).await;
    assert_eq!(status, StatusCode::OK, "{answer}");
    assert_eq!(answer["files"][1]["path"], "images/b.jpg");

    let (status, answer) =
        post(vec![("c.jpg", b"nothing".to_vec()), ("d.jpg", jpeg(8, 9)), ("a.jpg", jpeg(8, 8))]).await;
    assert_eq!((status.as_u16(), &answer["code"]), (422, &json!("files_refused")));
    assert_eq!(
        (&answer["refused"][0]["name"], &answer["refused"][0]["code"]),
        (&json!("c.jpg"), &json!("image_unreadable"))
    );
    assert_eq!(
        (&answer["files"][0]["result"], &answer["files"][1]["result"]),
        (&json!("created"), &json!("unchanged"))
    );
    assert_eq!(files(&app, &survey).await, ["images/a.jpg", "images/b.jpg", "images/d.jpg"]);

    assert_problem(post(Vec::new()).await, 400, "bad_request", "");
    let plain = app.request(Method::POST, &format!("{survey}/images")).body("x").send().await.unwrap();
    assert_problem(json_of(plain).await, 415, "unsupported_media_type", "multipart/form-data");
}

#[tokio::test]
async fn an_upload_that_stands_still_is_ended() {
    let limits = Limits { request_timeout: Duration::from_millis(100), ..Limits::default() };
    let app = App::with_limits(&[], limits).await;
    let survey = app.survey().await;
    let mut socket = tokio::net::TcpStream::connect(app.base.trim_start_matches("http://")).await.unwrap();
    let head = format!("PUT {survey}/images/a.jpg HTTP/1.1\r\nhost: localhost\r\ncontent-length: 1000\r\n\r\nabc");
    socket.write_all(head.as_bytes()).await.unwrap();
    let mut answer = vec![0; 4096];
    let count = socket.read(&mut answer).await.unwrap();
    let answer = String::from_utf8_lossy(&answer[..count]).into_owned();
    assert!(answer.starts_with("HTTP/1.1 408") && answer.contains("upload_stalled"), "{answer}");
    assert_eq!(incoming(&app), 0);
}

#[tokio::test]
async fn parts_of_files_and_coded_ones_are_no_files() {
    let app = App::new(&[]).await;
    let survey = app.survey().await;
    let put = async |name: &'static str, value: &'static str| {
        let request = app.request(Method::PUT, &format!("{survey}/images/a.jpg")).header(name, value);
        json_of(request.body(jpeg(16, 12)).send().await.unwrap()).await
    };
    assert_problem(put("content-range", "bytes 0-99/1000").await, 400, "bad_request", "by tus");
    assert_problem(put("content-encoding", "gzip").await, 415, "unsupported_media_type", "as they come");
    assert_eq!(app.get(&survey).await.1["files"], json!([]));
    assert_eq!(put("content-encoding", "identity").await.0, StatusCode::CREATED);
}

/// A form of parts, each with its headers as they are.
fn form(parts: &[(&[u8], &[u8])]) -> Vec<u8> {
    let part = |(head, content): &(&[u8], &[u8])| {
        [b"--bbb\r\ncontent-disposition: form-data; name=\"file\"; ", *head, b"\r\n\r\n", content, b"\r\n"].concat()
    };
    [parts.iter().map(part).collect::<Vec<_>>().concat(), b"--bbb--\r\n".to_vec()].concat()
}

#[tokio::test]
async fn forms_of_many_programs_are_read() {
    let app = App::new(&[]).await;
    let survey = app.survey().await;
    let post = async |body: Vec<u8>| {
        let request = app.request(Method::POST, &format!("{survey}/images"));
        let request = request.header("content-type", "multipart/form-data; boundary=bbb").body(body);
        json_of(request.send().await.unwrap()).await
    };
    let photo = jpeg(16, 12);
    for (head, path) in [
        (b"filename*=utf-8''h%C3%B6he1.jpg".as_slice(), "images/h\u{f6}he1.jpg"),
        (b"filename=\"=?utf-8?B?aMO2aGUyLmpwZw==?=\"; filename*=utf-8''h%C3%B6he2.jpg", "images/h\u{f6}he2.jpg"),
        (b"filename=\"=?utf-8?B?aMO2aGUzLmpwZw==?=\"", "images/h\u{f6}he3.jpg"),
        (b"filename=\"h\xf6he4.jpg\"", "images/h\u{f6}he4.jpg"),
        ("filename=\"ho\u{308}he5.jpg\"".as_bytes(), "images/h\u{f6}he5.jpg"),
        (b"filename=\"C:\\Users\\me\\c.jpg\"", "images/c.jpg"),
    ] {
        let (status, answer) = post(form(&[(head, &photo)])).await;
        assert_eq!((status, &answer["files"][0]["path"]), (StatusCode::OK, &json!(path)), "{answer}");
    }
    let other = jpeg(20, 12);
    let (status, answer) = post(form(&[(b"filename=f.jpg", &photo), (b"filename=f.jpg", &other)])).await;
    assert_eq!((status.as_u16(), &answer["refused"][0]["code"]), (422, &json!("name_twice")), "{answer}");
    assert_eq!(answer["files"][0]["width_px"], 16);
    assert_eq!(post(form(&[(b"filename=f.jpg", &photo), (b"filename=f.jpg", &photo)])).await.0, StatusCode::OK);
    let (_, coded) = post(form(&[(b"filename=g.jpg\r\ncontent-transfer-encoding: base64", b"/9j/")])).await;
    assert_eq!(coded["refused"][0]["code"], "unsupported_media_type", "{coded}");
}
