//! Names of files in forms, as browsers, libraries and old programs write them.

use crate::http::error::{ApiError, Code};
use axum::http::{HeaderMap, header};
use base64::Engine;
use base64::prelude::BASE64_STANDARD;

/// The name of the file that a part of a form holds: `filename*` (RFC 6266 and 8187) before `filename`, which may be UTF-8,
/// Latin-1 or of encoded words (RFC 2047). Of a path only its last part, as browsers and old programs send one.
pub fn file_name(headers: &HeaderMap) -> Option<String> {
    let parameters = parameters(headers.get(header::CONTENT_DISPOSITION)?.as_bytes());
    let value = |name: &str| parameters.iter().find(|(found, _)| found == name).map(|(_, value)| value.as_slice());
    let extended = value("filename*").and_then(extended);
    let name = extended.or_else(|| Some(with_words(&text(value("filename")?))))?;
    let last = name.rsplit(['/', '\\']).next().unwrap_or(&name);
    Some(last.to_owned())
}

/// Refuses a part whose bytes are not those of its file.
pub fn require_as_it_is(headers: &HeaderMap) -> Result<(), ApiError> {
    let coded = |name: &str, plain: &[&str]| {
        let value =
            headers.get(name).and_then(|value| value.to_str().ok()).unwrap_or(plain[0]).trim().to_ascii_lowercase();
        (!plain.contains(&value.as_str())).then_some(value)
    };
    let coding = coded("content-transfer-encoding", &["binary", "8bit", "7bit"])
        .or_else(|| coded("content-encoding", &["identity"]));
    match coding {
        None => Ok(()),
        Some(coding) => {
            let what = format!("the part is coded as `{coding}`: send the bytes of the file as they are");
            Err(ApiError::new(Code::UnsupportedMediaType, what))
        }
    }
}

/// The parameters behind the first word of a header, names in lower case. Of escapes in quotes only that of a quote counts:
/// old programs write paths with plain backslashes.
fn parameters(value: &[u8]) -> Vec<(String, Vec<u8>)> {
    let mut parameters = Vec::new();
    let mut rest = value;
    while let Some(at) = rest.iter().position(|byte| *byte == b';') {
        rest = rest[at + 1..].trim_ascii_start();
        let Some(equals) = rest.iter().position(|byte| matches!(byte, b'=' | b';')) else { break };
        if rest[equals] == b';' {
            rest = &rest[equals..];
            continue;
        }
        let name = String::from_utf8_lossy(rest[..equals].trim_ascii()).to_ascii_lowercase();
        rest = rest[equals + 1..].trim_ascii_start();
        let mut value = Vec::new();
        if let Some(mut quoted) = rest.strip_prefix(b"\"") {
            loop {
                match quoted {
                    [b'\\', b'"', after @ ..] => {
                        value.push(b'"');
                        quoted = after;
                    }
                    [b'"', after @ ..] => {
                        quoted = after;
                        break;
                    }
                    [byte, after @ ..] => {
                        value.push(*byte);
                        quoted = after;
                    }
                    [] => break,
                }
            }
            rest = quoted;
        } else {
            let end = rest.iter().position(|byte| *byte == b';').unwrap_or(rest.len());
            value.extend_from_slice(rest[..end].trim_ascii());
            rest = &rest[end..];
        }
        parameters.push((name, value));
    }
    parameters
}

/// Bytes as text: UTF-8, or else Latin-1.
fn text(bytes: &[u8]) -> String {
    match std::str::from_utf8(bytes) {
        Ok(text) => text.to_owned(),
        Err(_) => latin_1(bytes),
    }
}

fn latin_1(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| char::from(*byte)).collect()
}

/// Bytes in a character set that is named.
fn in_charset(charset: &str, bytes: &[u8]) -> Option<String> {
    match charset.to_ascii_lowercase().as_str() {
        "utf-8" | "utf8" | "us-ascii" => String::from_utf8(bytes.to_vec()).ok(),
        "iso-8859-1" | "latin1" | "windows-1252" => Some(latin_1(bytes)),
        _ => None,
    }
}

/// Two hexadecimal digits after an escape.
fn unescaped(bytes: &[u8], escape: u8) -> Vec<u8> {
    let mut plain = Vec::with_capacity(bytes.len());
    let mut rest = bytes;
    while let [byte, after @ ..] = rest {
        let pair = after.first_chunk::<2>().and_then(|pair| std::str::from_utf8(pair).ok());
        match pair.and_then(|pair| u8::from_str_radix(pair, 16).ok()).filter(|_| *byte == escape) {
            Some(value) => {
                plain.push(value);
                rest = &after[2..];
            }
            None => {
                plain.push(*byte);
                rest = after;
            }
        }
    }
    plain
}

/// `CHARSET'LANGUAGE'TEXT`, its bytes after `%` (RFC 8187).
fn extended(value: &[u8]) -> Option<String> {
    let mut parts = value.splitn(3, |byte| *byte == b'\'');
    let (charset, _, text) = (parts.next()?, parts.next()?, parts.next()?);
    in_charset(std::str::from_utf8(charset).ok()?, &unescaped(text, b'%'))
}

/// Text whose encoded words, `=?CHARSET?B or Q?TEXT?=`, are decoded (RFC 2047); spaces between two are none.
fn with_words(text: &str) -> String {
    let mut decoded = String::new();
    let mut rest = text;
    let mut after_word = false;
    while let Some(at) = rest.find("=?") {
        let (before, word) = rest.split_at(at);
        let Some((found, length)) = word_at(word) else {
            decoded.push_str(&rest[..at + 2]);
            rest = &rest[at + 2..];
            after_word = false;
            continue;
        };
        if !(after_word && before.trim().is_empty()) {
            decoded.push_str(before);
        }
        decoded.push_str(&found);
        rest = &word[length..];
        after_word = true;
    }
    decoded + rest
}

/// The encoded word that a text begins with, and its length.
fn word_at(text: &str) -> Option<(String, usize)> {
    let inner = text.strip_prefix("=?")?;
    let (charset, inner) = inner.split_once('?')?;
    let (encoding, inner) = inner.split_once('?')?;
    let (coded, after) = inner.split_once("?=")?;
    let bytes = match encoding {
        "B" | "b" => BASE64_STANDARD.decode(coded).ok()?,
        "Q" | "q" => unescaped(coded.replace('_', " ").as_bytes(), b'='),
        _ => return None,
    };
    Some((in_charset(charset, &bytes)?, text.len() - after.len()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use axum::http::HeaderValue;

    fn named(disposition: &[u8]) -> Option<String> {
        let value = HeaderValue::from_bytes(&[b"form-data; name=\"file\"; ", disposition].concat()).unwrap();
        file_name(&HeaderMap::from_iter([(header::CONTENT_DISPOSITION, value)]))
    }

    #[test]
    fn names_of_many_programs() {
        for (disposition, name) in [
            (b"filename=\"a.jpg\"".as_slice(), "a.jpg"),
            (b"filename=b.jpg; filename*=utf-8''b.jpg", "b.jpg"),
            ("filename=\"h\u{f6}he.jpg\"".as_bytes(), "h\u{f6}he.jpg"),
            (b"filename=\"h\xf6he.jpg\"", "h\u{f6}he.jpg"),
            (b"filename*=utf-8''h%C3%B6he.jpg", "h\u{f6}he.jpg"),
            (b"filename*=ISO-8859-1'de'h%F6he.jpg", "h\u{f6}he.jpg"),
            (b"filename=\"=?utf-8?B?aMO2aGUuanBn?=\"", "h\u{f6}he.jpg"),
            (b"filename=\"=?utf-8?Q?h=C3=B6he_1.jpg?=\"", "h\u{f6}he 1.jpg"),
            (b"filename=\"=?utf-8?B?aMO2?= =?utf-8?B?aGUuanBn?=\"", "h\u{f6}he.jpg"),
            (b"filename=\"=?none?B?aMO2?=.jpg\"", "=?none?B?aMO2?=.jpg"),
            (b"filename=\"C:\\Users\\me\\c.jpg\"", "c.jpg"),
            (b"filename=\"DCIM/100MEDIA/d.jpg\"", "d.jpg"),
            (b"FileName = \"a;b.jpg\" ; x=y", "a;b.jpg"),
            (b"filename=\"a\\\"b.jpg\"", "a\"b.jpg"),
            (b"filename=\"\"", ""),
            (b"filename*=utf-8''%FF; filename=\"e.jpg\"", "e.jpg"),
        ] {
            assert_eq!(named(disposition).as_deref(), Some(name), "{}", text(disposition));
        }
        assert_eq!(named(b"x; y=\"z"), None);
        assert_eq!(file_name(&HeaderMap::new()), None);
    }
}
