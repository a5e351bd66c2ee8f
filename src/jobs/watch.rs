//! What the mapping thread and the worker tell each other while a job runs.

use super::share::Share;
use crate::store::{Checkpoint, Progress};
use heliomap_mapping::fusion::Fused;
use heliomap_mapping::pipeline::{Found, ImageRequest, NextImage, Observer, Stage};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, HashMap, VecDeque};
use std::io::{Cursor, Read};
use std::sync::atomic::{AtomicU8, Ordering};
use std::sync::{Mutex, MutexGuard, OnceLock};
use std::time::Instant;
use tracing::Span;

/// How checkpoints of the fused structure are called, before the number of the part: as no image is.
const STRUCTURE: &str = "fused structure/";
/// Bytes of one such part.
const PART_BYTES: usize = 8 << 20;
/// Bytes after which what was found waits for its turn: heartbeats go on in between.
const BYTES_AT_ONCE: usize = PART_BYTES;

/// Why a running job must stop.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stop {
    /// Someone cancelled it.
    Cancelled = 1,
    /// The worker shuts down.
    Shutdown = 2,
    /// The job is in other hands, or gone.
    Lost = 3,
}

/// What each stage of a mapping of so many images took.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Pace {
    pub images: u64,
    pub stage_ms: BTreeMap<String, u64>,
}

impl Pace {
    /// What a stage takes for so many images.
    fn expected_ms(&self, stage: Stage, images: u64) -> Option<u64> {
        Some(self.stage_ms.get(stage.as_str())? * images / self.images.max(1))
    }
}

/// What was seen of a mapping.
#[derive(Debug, Default)]
struct Seen {
    now: Option<(Stage, usize, usize)>,
    /// When each stage was first heard of, in order.
    begun: Vec<(Stage, Instant)>,
    images: u64,
    /// How many images were recalled, which takes no time.
    recalled: u64,
    /// Whether the structure was, too.
    structure_recalled: bool,
    /// The span of the stage that runs, which ends when it is dropped.
    span: Option<Span>,
}

/// What a job has found, and what an earlier attempt at it had.
#[derive(Debug, Default)]
struct Findings {
    fingerprint: String,
    known: HashMap<String, Found>,
    /// The parts of a structure that an earlier attempt had fused, in order.
    structure: Parts,
    fresh: VecDeque<Checkpoint>,
    last: Option<Pace>,
}

/// Bytes in parts, one after the other; what was read is dropped.
#[derive(Debug, Default)]
struct Parts(VecDeque<Cursor<Vec<u8>>>);

impl Read for Parts {
    fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        while let Some(part) = self.0.front_mut() {
            match part.read(buffer)? {
                0 if !buffer.is_empty() => drop(self.0.pop_front()),
                count => return Ok(count),
            }
        }
        Ok(0)
    }
}

/// One job's progress, findings and stop sign.
pub struct Watch {
    seen: Mutex<Seen>,
    findings: Mutex<Findings>,
    stop: AtomicU8,
    /// The job's span, that of its stages stand in.
    span: Span,
    /// How its images are shared with other workers.
    share: OnceLock<Share>,
}

fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(|poisoned| poisoned.into_inner())
}

impl Default for Watch {
    /// Of a job whose span is the current one.
    fn default() -> Self {
        Self {
            seen: Mutex::default(),
            findings: Mutex::default(),
            stop: AtomicU8::new(0),
            span: Span::current(),
            share: OnceLock::new(),
        }
    }
}

impl Watch {
    /// Ends the span of the stage that ran last.
    pub fn end(&self) {
        locked(&self.seen).span = None;
    }

    /// Raises the stop sign; the first reason stays, but a lost job is lost whatever else was asked.
    pub fn stop(&self, reason: Stop) {
        if reason == Stop::Lost {
            self.stop.store(reason as u8, Ordering::Release);
        } else {
            let _ = self.stop.compare_exchange(0, reason as u8, Ordering::AcqRel, Ordering::Acquire);
        }
    }

    /// Why the job must stop, where it must.
    pub fn stopped(&self) -> Option<Stop> {
        match self.stop.load(Ordering::Acquire) {
            1 => Some(Stop::Cancelled),
            2 => Some(Stop::Shutdown),
            3 => Some(Stop::Lost),
            _ => None,
        }
    }

    /// Tells what an earlier attempt had found under this fingerprint, and what the stages of the last job took.
    pub fn begin(&self, fingerprint: String, known: Vec<Checkpoint>, last: Option<Pace>) {
        let (mut parts, images): (Vec<_>, Vec<_>) =
            known.into_iter().partition(|kept| kept.name.starts_with(STRUCTURE));
        let known = images
            .into_iter()
            // One that cannot be read is found again.
            .filter_map(|kept| Some((kept.name, ciborium::from_reader(kept.document.as_slice()).ok()?)))
            .collect();
        parts.sort_by(|one, other| one.name.cmp(&other.name));
        let structure = Parts(parts.into_iter().map(|part| Cursor::new(part.document)).collect());
        *locked(&self.findings) = Findings { fingerprint, known, structure, fresh: VecDeque::new(), last };
    }

    /// Tells how images are shared from now on.
    pub fn share(&self, share: Share) {
        let _ = self.share.set(share);
    }

    /// What was found since the last time, or as much of it as is stored in a moment, and under which fingerprint.
    pub fn take_found(&self) -> (String, Vec<Checkpoint>) {
        let mut findings = locked(&self.findings);
        let mut bytes = 0;
        let parts = findings.fresh.iter().take_while(|found| {
            let begins_in_time = bytes < BYTES_AT_ONCE;
            bytes += found.document.len();
            begins_in_time
        });
        let count = parts.count();
        (findings.fingerprint.clone(), findings.fresh.drain(..count).collect())
    }

    /// Takes back what could not be stored: before what was found since, which may rest on it.
    pub fn give_back(&self, found: Vec<Checkpoint>) {
        let mut findings = locked(&self.findings);
        for checkpoint in found.into_iter().rev() {
            findings.fresh.push_front(checkpoint);
        }
    }

    /// How far the mapping has come.
    pub fn progress(&self) -> Option<Progress> {
        let last = locked(&self.findings).last.clone();
        let seen = locked(&self.seen);
        seen.now.map(|(stage, done, total)| Progress {
            stage: stage.as_str().to_owned(),
            done: done as u64,
            total: total as u64,
            remaining_ms: seen.remaining_ms(last.as_ref(), Instant::now()),
        })
    }

    /// What the stages took; nothing where some of the images were recalled.
    pub fn pace(&self) -> Option<Pace> {
        let seen = locked(&self.seen);
        // No image alone makes a plant: where one is told of, boxes were read instead of a search.
        if seen.recalled > 0 || seen.structure_recalled || seen.images < 2 {
            return None;
        }
        let ends = seen.begun.iter().skip(1).map(|(_, begun)| *begun).chain([Instant::now()]);
        let took = seen.begun.iter().zip(ends).map(|((stage, begun), end)| {
            (stage.as_str().to_owned(), end.saturating_duration_since(*begun).as_millis() as u64)
        });
        Some(Pace { images: seen.images, stage_ms: took.collect() })
    }
}

impl Seen {
    /// Milliseconds until the end: the rest of this stage by its own pace or else the last job's, the later stages by the
    /// last job's. `None` while a part of it is not known.
    fn remaining_ms(&self, last: Option<&Pace>, now: Instant) -> Option<u64> {
        let (stage, done, total) = self.now?;
        let (_, begun) = self.begun.last()?;
        let spent_ms = now.saturating_duration_since(*begun).as_millis() as u64;
        let (done, total) = (done as u64, total as u64);
        let rest_ms = match stage {
            Stage::Detect if done > self.recalled => spent_ms * total.saturating_sub(done) / (done - self.recalled),
            Stage::Detect => last?.expected_ms(stage, total.saturating_sub(done))?.saturating_sub(spent_ms),
            _ => last?.expected_ms(stage, self.images)?.saturating_sub(spent_ms),
        };
        let later = Stage::ALL.iter().filter(|later| **later > stage);
        let later_ms: Option<u64> = later.map(|later| last?.expected_ms(*later, self.images)).sum();
        Some(rest_ms + later_ms?)
    }
}

impl Observer for Watch {
    fn progress(&self, stage: Stage, done: usize, total: usize) {
        let mut seen = locked(&self.seen);
        // Threads report out of order: never step back.
        if seen.now.is_none_or(|(before, done_before, _)| (before, done_before) <= (stage, done)) {
            seen.now = Some((stage, done, total));
        }
        if seen.begun.last().is_none_or(|(last, _)| *last < stage) {
            seen.begun.push((stage, Instant::now()));
            tracing::debug!(stage = stage.as_str(), "stage begins");
            let name = format!("stage {}", stage.as_str());
            // The one before ends first.
            seen.span = None;
            seen.span = Some(tracing::info_span!(parent: &self.span, "stage", otel.name = name));
        }
        if stage == Stage::Detect {
            seen.images = total as u64;
        }
    }

    fn cancelled(&self) -> bool {
        self.stopped().is_some()
    }

    fn load_checkpoint(&self, image: &str) -> Option<Found> {
        let found = locked(&self.findings).known.remove(image)?;
        locked(&self.seen).recalled += 1;
        Some(found)
    }

    fn offer(&self, images: &[ImageRequest]) {
        if self.share.get().is_some_and(|share| !share.offer(images)) {
            self.stop(Stop::Lost);
        }
    }

    fn next(&self, left: &[usize]) -> NextImage {
        self.share.get().map_or(NextImage::Search(left[0]), |share| share.next(left))
    }

    fn save_checkpoint(&self, found: &Found) {
        let mut document = Vec::new();
        if ciborium::into_writer(found, &mut document).is_ok() {
            let name = found.detections.image.clone();
            locked(&self.findings).fresh.push_back(Checkpoint { name, document });
        }
    }

    fn load_structure(&self, of: &str) -> Option<Fused> {
        let parts = std::mem::take(&mut locked(&self.findings).structure);
        // One of which parts are missing is fused again.
        let (was_of, fused): (String, Fused) = ciborium::from_reader(parts).ok()?;
        if was_of != of {
            return None;
        }
        locked(&self.seen).structure_recalled = true;
        Some(fused)
    }

    fn save_structure(&self, fused: &Fused, of: &str) {
        let mut document = Vec::new();
        if ciborium::into_writer(&(of, fused), &mut document).is_ok() {
            let parts = document.chunks(PART_BYTES).enumerate();
            let parts = parts
                .map(|(part, bytes)| Checkpoint { name: format!("{STRUCTURE}{part:09}"), document: bytes.to_vec() });
            locked(&self.findings).fresh.extend(parts);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use heliomap_mapping::detection::{Detection, ImageDetections, Source};
    use heliomap_mapping::geometry::Quad;
    use heliomap_mapping::layout::{self, LayoutOptions};
    use nalgebra::Vector2;
    use std::time::Duration;

    #[test]
    fn progress_never_steps_back() {
        let watch = Watch::default();
        Observer::progress(&watch, Stage::Detect, 2, 3);
        Observer::progress(&watch, Stage::Detect, 1, 3);
        assert_eq!(watch.progress().unwrap().done, 2);
        Observer::progress(&watch, Stage::Layout, 0, 3);
        assert_eq!(watch.progress().unwrap().stage, "layout");
    }

    #[test]
    fn a_lost_job_is_lost() {
        let watch = Watch::default();
        watch.stop(Stop::Cancelled);
        watch.stop(Stop::Shutdown);
        assert_eq!(watch.stopped(), Some(Stop::Cancelled));
        watch.stop(Stop::Lost);
        assert_eq!(watch.stopped(), Some(Stop::Lost));
    }

    #[test]
    fn what_is_recalled_is_what_was_found_to_the_last_digit() {
        let corner = |x: f64, y: f64| Vector2::new(100.0 + x / 3.0, 90.0 + y / 7.0);
        let detections = (0..12).map(|k| {
            let (x, y) = (f64::from(k % 6) * 61.0, f64::from(k / 6) * 151.0);
            let corners = [corner(x, y), corner(x + 60.0, y), corner(x + 60.0, y + 150.0), corner(x, y + 150.0)];
            Detection { quad: Quad { corners }, score: 0.1 + 0.2, source: Source::Unet }
        });
        let image = "a.jpg".to_owned();
        let detections = ImageDetections { image, width_px: 400, height_px: 300, detections: detections.collect() };
        let layout = layout::infer(&detections, None, &LayoutOptions::default());
        assert!(!layout.pieces.is_empty());
        let found = Found { detections, layout };
        let watch = Watch::default();
        watch.save_checkpoint(&found);
        let (_, kept) = watch.take_found();
        assert!(watch.take_found().1.is_empty());
        let again = Watch::default();
        again.begin("f".to_owned(), kept, None);
        let recalled = again.load_checkpoint("a.jpg").unwrap();
        // Debug output of a float has all its digits.
        assert_eq!(format!("{recalled:?}"), format!("{found:?}"));
        assert!(again.load_checkpoint("a.jpg").is_none() && again.load_checkpoint("b.jpg").is_none());
    }

    #[test]
    fn a_structure_is_recalled_whole_or_not_at_all() {
        let bench = |rows| heliomap_mapping::fusion::Doubt {
            code: "bench_conflict".into(),
            message: "x".repeat(PART_BYTES / 2),
            images: vec![format!("{rows}.jpg")],
            benches: vec![rows],
            places_m: vec![Vector2::new(0.1 + 0.2, 1.0 / 3.0)],
        };
        let fused = Fused { lines: Vec::new(), benches: Vec::new(), doubts: (0..12).map(bench).collect() };
        let watch = Watch::default();
        let of = "what was seen";
        watch.save_structure(&fused, of);
        let mut kept = Vec::new();
        loop {
            let (_, parts) = watch.take_found();
            assert!(parts.len() < 2);
            if kept.len() == 1 && !parts.is_empty() {
                // The store did not answer.
                watch.give_back(parts);
                kept.extend(watch.take_found().1);
                continue;
            }
            if parts.is_empty() {
                break;
            }
            kept.extend(parts);
        }
        assert_eq!(kept.len(), 7);
        let again = Watch::default();
        again.begin("f".to_owned(), kept.clone(), None);
        assert_eq!(again.load_structure(of).unwrap().doubts, fused.doubts);
        assert!(again.load_structure(of).is_none() && again.pace().is_none());
        // It is no other images' structure.
        again.begin("f".to_owned(), kept.clone(), None);
        assert!(again.load_structure("what was seen again").is_none());
        for missing in 0..kept.len() {
            let mut parts = kept.clone();
            parts.remove(missing);
            let again = Watch::default();
            again.begin("f".to_owned(), parts, None);
            assert!(again.load_structure(of).is_none(), "without part {missing}");
        }
    }

    #[test]
    fn remaining_time_is_told_once_it_is_known() {
        let begun = Instant::now();
        let mut seen = Seen {
            now: Some((Stage::Detect, 4, 10)),
            begun: vec![(Stage::Read, begun), (Stage::Detect, begun)],
            images: 10,
            recalled: 2,
            structure_recalled: false,
            span: None,
        };
        let later = begun + Duration::from_secs(6);
        assert_eq!(seen.remaining_ms(None, later), None);
        let stage_ms = Stage::ALL.iter().map(|stage| (stage.as_str().to_owned(), 500)).collect();
        let last = Pace { images: 5, stage_ms };
        // Two images in 6 s leave 18 s for six; five later stages of 1 s each.
        assert_eq!(seen.remaining_ms(Some(&last), later), Some(18_000 + 5_000));
        seen.now = Some((Stage::Detect, 2, 10));
        assert_eq!(seen.remaining_ms(Some(&last), begun), Some(800 + 5_000));
        seen.now = Some((Stage::Assemble, 0, 1));
        assert_eq!(seen.remaining_ms(Some(&last), later), Some(0));
    }
}
