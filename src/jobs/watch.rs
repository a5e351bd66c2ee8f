//! What the mapping thread and the worker exchange while a job runs: progress, checkpoints, the order to stop.

use super::publisher::TaskPublisher;
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

/// Prefix of the names of checkpoints of the fused structure, before the number of the part. No image is called so.
const STRUCTURE: &str = "fused structure/";
/// Size of one such part, bytes.
const PART_BYTES: usize = 8 << 20;
/// Checkpoints are stored in batches of about this many bytes, so that heartbeats go on in between.
const BATCH_BYTES: usize = PART_BYTES;

/// Why a running job must stop.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stop {
    /// Someone cancelled it.
    Cancelled = 1,
    /// The worker shuts down.
    Shutdown = 2,
    /// Its lease was lost: another worker has the job, or it was deleted.
    Lost = 3,
}

/// Duration of each stage of a mapping of so many images.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Pace {
    pub images: u64,
    pub stage_ms: BTreeMap<String, u64>,
}

impl Pace {
    /// Expected duration of a stage for so many images.
    fn expected_ms(&self, stage: Stage, images: u64) -> Option<u64> {
        Some(self.stage_ms.get(stage.as_str())? * images / self.images.max(1))
    }
}

/// Progress of a mapping.
#[derive(Debug, Default)]
struct Timeline {
    now: Option<(Stage, usize, usize)>,
    /// When each stage began, in order.
    begun: Vec<(Stage, Instant)>,
    images: u64,
    /// How many images came from checkpoints, which takes no time.
    restored: u64,
    /// Whether the fused structure did, too.
    structure_restored: bool,
    /// The span of the running stage, which ends when it is dropped.
    span: Option<Span>,
}

/// Checkpoints of a job: those of earlier attempts, and new ones to be stored.
#[derive(Debug, Default)]
struct Checkpoints {
    fingerprint: String,
    known: HashMap<String, Found>,
    /// The parts of the structure that an earlier attempt fused, in order.
    structure: Parts,
    fresh: VecDeque<Checkpoint>,
    last: Option<Pace>,
}

/// Bytes in parts, one after the other; parts that were read are dropped.
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

/// Progress, checkpoints and stop flag of one job.
pub struct Watch {
    timeline: Mutex<Timeline>,
    checkpoints: Mutex<Checkpoints>,
    stop: AtomicU8,
    /// The job's span, parent of those of its stages.
    span: Span,
    publisher: OnceLock<TaskPublisher>,
}

fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(|poisoned| poisoned.into_inner())
}

impl Default for Watch {
    /// For a job whose span is the current one.
    fn default() -> Self {
        Self {
            timeline: Mutex::default(),
            checkpoints: Mutex::default(),
            stop: AtomicU8::new(0),
            span: Span::current(),
            publisher: OnceLock::new(),
        }
    }
}

impl Watch {
    /// Ends the span of the stage that ran last.
    pub fn end(&self) {
        locked(&self.timeline).span = None;
    }

    /// Orders the mapping to stop. The first reason stays, but a lost lease overrides all others.
    pub fn stop(&self, reason: Stop) {
        if reason == Stop::Lost {
            self.stop.store(reason as u8, Ordering::Release);
        } else {
            let _ = self.stop.compare_exchange(0, reason as u8, Ordering::AcqRel, Ordering::Acquire);
        }
    }

    /// The reason to stop, where there is one.
    pub fn stopped(&self) -> Option<Stop> {
        match self.stop.load(Ordering::Acquire) {
            1 => Some(Stop::Cancelled),
            2 => Some(Stop::Shutdown),
            3 => Some(Stop::Lost),
            _ => None,
        }
    }

    /// Sets the checkpoints of earlier attempts under this fingerprint, and the durations of the last job's stages.
    pub fn begin(&self, fingerprint: String, known: Vec<Checkpoint>, last: Option<Pace>) {
        let (mut parts, images): (Vec<_>, Vec<_>) =
            known.into_iter().partition(|kept| kept.name.starts_with(STRUCTURE));
        let known = images
            .into_iter()
            // An image whose checkpoint cannot be read is processed again.
            .filter_map(|kept| Some((kept.name, ciborium::from_reader(kept.document.as_slice()).ok()?)))
            .collect();
        parts.sort_by(|one, other| one.name.cmp(&other.name));
        let structure = Parts(parts.into_iter().map(|part| Cursor::new(part.document)).collect());
        *locked(&self.checkpoints) = Checkpoints { fingerprint, known, structure, fresh: VecDeque::new(), last };
    }

    /// Publishes the job's images from now on.
    pub fn publish_by(&self, publisher: TaskPublisher) {
        let _ = self.publisher.set(publisher);
    }

    /// The next batch of new checkpoints, and their fingerprint.
    pub fn take_checkpoints(&self) -> (String, Vec<Checkpoint>) {
        let mut checkpoints = locked(&self.checkpoints);
        let mut bytes = 0;
        let parts = checkpoints.fresh.iter().take_while(|found| {
            let begins_in_time = bytes < BATCH_BYTES;
            bytes += found.document.len();
            begins_in_time
        });
        let count = parts.count();
        (checkpoints.fingerprint.clone(), checkpoints.fresh.drain(..count).collect())
    }

    /// Takes back checkpoints that could not be stored, in front of newer ones, which may depend on them.
    pub fn return_checkpoints(&self, found: Vec<Checkpoint>) {
        let mut checkpoints = locked(&self.checkpoints);
        for checkpoint in found.into_iter().rev() {
            checkpoints.fresh.push_front(checkpoint);
        }
    }

    /// Progress of the mapping.
    pub fn progress(&self) -> Option<Progress> {
        let last = locked(&self.checkpoints).last.clone();
        let timeline = locked(&self.timeline);
        timeline.now.map(|(stage, done, total)| Progress {
            stage: stage.as_str().to_owned(),
            done: done as u64,
            total: total as u64,
            remaining_ms: timeline.remaining_ms(last.as_ref(), Instant::now()),
        })
    }

    /// Durations of the stages; `None` where some images came from checkpoints.
    pub fn pace(&self) -> Option<Pace> {
        let timeline = locked(&self.timeline);
        // A plant needs two images: with one, boxes were read instead of detected.
        if timeline.restored > 0 || timeline.structure_restored || timeline.images < 2 {
            return None;
        }
        let ends = timeline.begun.iter().skip(1).map(|(_, begun)| *begun).chain([Instant::now()]);
        let took = timeline.begun.iter().zip(ends).map(|((stage, begun), end)| {
            (stage.as_str().to_owned(), end.saturating_duration_since(*begun).as_millis() as u64)
        });
        Some(Pace { images: timeline.images, stage_ms: took.collect() })
    }
}

impl Timeline {
    /// Milliseconds until the end: the rest of this stage by its own pace or else the last job's, the later stages by the
    /// last job's. `None` while a part of it is not known.
    fn remaining_ms(&self, last: Option<&Pace>, now: Instant) -> Option<u64> {
        let (stage, done, total) = self.now?;
        let (_, begun) = self.begun.last()?;
        let spent_ms = now.saturating_duration_since(*begun).as_millis() as u64;
        let (done, total) = (done as u64, total as u64);
        let rest_ms = match stage {
            Stage::Detect if done > self.restored => spent_ms * total.saturating_sub(done) / (done - self.restored),
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
        let mut timeline = locked(&self.timeline);
        // Threads report out of order: never step back.
        if timeline.now.is_none_or(|(before, done_before, _)| (before, done_before) <= (stage, done)) {
            timeline.now = Some((stage, done, total));
        }
        if timeline.begun.last().is_none_or(|(last, _)| *last < stage) {
            timeline.begun.push((stage, Instant::now()));
            tracing::debug!(stage = stage.as_str(), "stage begins");
            let name = format!("stage {}", stage.as_str());
            // The previous span ends first.
            timeline.span = None;
            timeline.span = Some(tracing::info_span!(parent: &self.span, "stage", otel.name = name));
        }
        if stage == Stage::Detect {
            timeline.images = total as u64;
        }
    }

    fn cancelled(&self) -> bool {
        self.stopped().is_some()
    }

    fn load_checkpoint(&self, image: &str) -> Option<Found> {
        let found = locked(&self.checkpoints).known.remove(image)?;
        locked(&self.timeline).restored += 1;
        Some(found)
    }

    fn offer(&self, images: &[ImageRequest]) {
        if self.publisher.get().is_some_and(|publisher| !publisher.offer(images)) {
            self.stop(Stop::Lost);
        }
    }

    fn next(&self, left: &[usize]) -> NextImage {
        self.publisher.get().map_or(NextImage::Search(left[0]), |publisher| publisher.next(left))
    }

    fn save_checkpoint(&self, found: &Found) {
        let mut document = Vec::new();
        if ciborium::into_writer(found, &mut document).is_ok() {
            let name = found.detections.image.clone();
            locked(&self.checkpoints).fresh.push_back(Checkpoint { name, document });
        }
    }

    fn load_structure(&self, of: &str) -> Option<Fused> {
        let parts = std::mem::take(&mut locked(&self.checkpoints).structure);
        // A structure with missing parts is fused again.
        let (was_of, fused): (String, Fused) = ciborium::from_reader(parts).ok()?;
        if was_of != of {
            return None;
        }
        locked(&self.timeline).structure_restored = true;
        Some(fused)
    }

    fn save_structure(&self, fused: &Fused, of: &str) {
        let mut document = Vec::new();
        if ciborium::into_writer(&(of, fused), &mut document).is_ok() {
            let parts = document.chunks(PART_BYTES).enumerate();
            let parts = parts
                .map(|(part, bytes)| Checkpoint { name: format!("{STRUCTURE}{part:09}"), document: bytes.to_vec() });
            locked(&self.checkpoints).fresh.extend(parts);
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
    fn a_lost_lease_overrides_other_reasons_to_stop() {
        let watch = Watch::default();
        watch.stop(Stop::Cancelled);
        watch.stop(Stop::Shutdown);
        assert_eq!(watch.stopped(), Some(Stop::Cancelled));
        watch.stop(Stop::Lost);
        assert_eq!(watch.stopped(), Some(Stop::Lost));
    }

    #[test]
    fn checkpoints_are_exact() {
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
        let (_, kept) = watch.take_checkpoints();
        assert!(watch.take_checkpoints().1.is_empty());
        let again = Watch::default();
        again.begin("f".to_owned(), kept, None);
        let recalled = again.load_checkpoint("a.jpg").unwrap();
        // Debug output of a float has all its digits.
        assert_eq!(format!("{recalled:?}"), format!("{found:?}"));
        assert!(again.load_checkpoint("a.jpg").is_none() && again.load_checkpoint("b.jpg").is_none());
    }

    #[test]
    fn a_structure_is_restored_whole_or_not_at_all() {
        let bench = |rows| heliomap_mapping::fusion::Doubt {
            code: "bench_conflict".into(),
            message: "x".repeat(PART_BYTES / 2),
            images: vec![format!("{rows}.jpg")],
            benches: vec![rows],
            places_m: vec![Vector2::new(0.1 + 0.2, 1.0 / 3.0)],
            sightings: vec![(1, 2)],
        };
        let fused = Fused { doubts: (0..12).map(bench).collect(), ..Fused::default() };
        let watch = Watch::default();
        let of = "what was seen";
        watch.save_structure(&fused, of);
        let mut kept = Vec::new();
        loop {
            let (_, parts) = watch.take_checkpoints();
            assert!(parts.len() < 2);
            if kept.len() == 1 && !parts.is_empty() {
                // The store did not answer.
                watch.return_checkpoints(parts);
                kept.extend(watch.take_checkpoints().1);
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
    fn remaining_time_is_given_once_it_is_known() {
        let begun = Instant::now();
        let mut timeline = Timeline {
            now: Some((Stage::Detect, 4, 10)),
            begun: vec![(Stage::Read, begun), (Stage::Detect, begun)],
            images: 10,
            restored: 2,
            structure_restored: false,
            span: None,
        };
        let later = begun + Duration::from_secs(6);
        assert_eq!(timeline.remaining_ms(None, later), None);
        let stage_ms = Stage::ALL.iter().map(|stage| (stage.as_str().to_owned(), 500)).collect();
        let last = Pace { images: 5, stage_ms };
        // Two images in 6 s leave 18 s for six; five later stages of 1 s each.
        assert_eq!(timeline.remaining_ms(Some(&last), later), Some(18_000 + 5_000));
        timeline.now = Some((Stage::Detect, 2, 10));
        assert_eq!(timeline.remaining_ms(Some(&last), begun), Some(800 + 5_000));
        timeline.now = Some((Stage::Assemble, 0, 1));
        assert_eq!(timeline.remaining_ms(Some(&last), later), Some(0));
    }
}
