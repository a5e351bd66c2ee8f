//! How settings write durations and sizes: `30s`, `24h`, `400d`; `256M`, `8GiB`.

use std::time::Duration;

const HOUR: Duration = Duration::from_secs(3600);
const DAY: Duration = Duration::from_secs(24 * 3600);

/// The longest duration of days that a setting takes: a hundred years.
const MAX_DAYS: Duration = Duration::from_secs(36_500 * 24 * 3600);
/// The longest grace of a rotated key.
const MAX_GRACE: Duration = Duration::from_secs(30 * 24 * 3600);

/// A positive duration; a bare number is seconds.
pub(super) fn parse_seconds(text: &str) -> Result<Duration, String> {
    positive(parse_duration(text, Duration::from_secs(1))?)
}

/// A duration of 1 day to a hundred years; a bare number is days, as in version 0.1.
pub(super) fn parse_days(text: &str) -> Result<Duration, String> {
    let duration = parse_duration(text, DAY)?;
    let is_fit = (DAY..=MAX_DAYS).contains(&duration);
    if is_fit { Ok(duration) } else { Err("a duration of 1d to 36500d is expected".to_owned()) }
}

/// A duration of at most 30 days, or none; a bare number is hours, as in version 0.1.
pub(super) fn parse_grace(text: &str) -> Result<Duration, String> {
    let duration = parse_duration(text, HOUR)?;
    if duration <= MAX_GRACE { Ok(duration) } else { Err("a duration of at most 30d is expected".to_owned()) }
}

fn positive(duration: Duration) -> Result<Duration, String> {
    if duration.is_zero() { Err("a duration longer than zero is expected".to_owned()) } else { Ok(duration) }
}

/// A duration with its unit, or a bare number of `unit`.
fn parse_duration(text: &str, unit: Duration) -> Result<Duration, String> {
    let duration = match text.trim().parse::<f64>() {
        Ok(number) => Duration::try_from_secs_f64(number * unit.as_secs_f64()).ok(),
        Err(_) => humantime::parse_duration(text.trim()).ok(),
    };
    duration.ok_or_else(|| "a duration with its unit is expected, such as 30s, 10m, 24h or 400d".to_owned())
}

/// A number of bytes; K, M, G and T are powers of 1024, with or without `B` or `iB` after them.
pub(super) fn parse_size(text: &str) -> Result<u64, String> {
    let parsed = parse_size::Config::new().with_binary().parse_size(text);
    parsed.map_err(|error| format!("a size such as 256M or 8G is expected: {error}"))
}

/// A number of megapixels.
pub(super) fn parse_megapixels(text: &str) -> Result<f64, String> {
    let parsed = text.parse::<f64>().ok().filter(|megapixels| megapixels.is_finite() && *megapixels > 0.0);
    parsed.ok_or_else(|| "a positive number of millions of pixels is expected".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn durations_have_units_and_bare_numbers_keep_theirs() {
        assert_eq!(parse_seconds("30s"), Ok(Duration::from_secs(30)));
        assert_eq!(parse_seconds("0.5"), Ok(Duration::from_millis(500)));
        assert_eq!(parse_seconds("24h"), Ok(DAY));
        assert_eq!(parse_days("400"), parse_days("400d"));
        assert_eq!(parse_grace("2"), Ok(2 * HOUR));
        assert_eq!(parse_grace("0"), Ok(Duration::ZERO));
        for wrong in ["", "s", "-1", "nan", "inf", "1e300", "24 parsecs"] {
            assert!(parse_duration(wrong, HOUR).is_err(), "{wrong}");
        }
        assert!(parse_seconds("0").is_err() && parse_seconds("0s").is_err());
        assert!(parse_days("23h").is_err() && parse_days("0").is_err() && parse_days("36501d").is_err());
        assert!(parse_grace("31d").is_err());
    }

    #[test]
    fn sizes_count_in_powers_of_1024() {
        assert_eq!(parse_size("256M"), Ok(256 << 20));
        assert_eq!(parse_size("8 GiB"), Ok(8 << 30));
        assert_eq!(parse_size("500G"), Ok(500 << 30));
        assert_eq!(parse_size("2TB"), Ok(2 << 40));
        assert_eq!(parse_size("17"), Ok(17));
        for wrong in ["", "M", "12X", "-1", "99999999999T"] {
            assert!(parse_size(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn megapixels() {
        assert_eq!(parse_megapixels("0.5"), Ok(0.5));
        for wrong in ["0", "-1", "nan", "inf", "many"] {
            assert!(parse_megapixels(wrong).is_err(), "{wrong}");
        }
    }
}
