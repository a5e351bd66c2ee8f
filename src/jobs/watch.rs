//! What the mapping thread and the worker tell each other while a job runs.

use crate::pipeline::{Observer, Stage};
use crate::store::Progress;
use std::sync::Mutex;
use std::sync::atomic::{AtomicU8, Ordering};

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

/// One job's progress and stop sign.
#[derive(Debug, Default)]
pub struct Watch {
    progress: Mutex<Option<(Stage, usize, usize)>>,
    stop: AtomicU8,
}

impl Watch {
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

    /// How far the mapping has come.
    pub fn progress(&self) -> Option<Progress> {
        let progress = *self.progress.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        progress.map(|(stage, done, total)| Progress {
            stage: stage.as_str().to_owned(),
            done: done as u64,
            total: total as u64,
        })
    }
}

impl Observer for Watch {
    fn progress(&self, stage: Stage, done: usize, total: usize) {
        let mut progress = self.progress.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        // Threads report out of order: never step back.
        if progress.is_none_or(|(before, done_before, _)| (before, done_before) <= (stage, done)) {
            *progress = Some((stage, done, total));
        }
    }

    fn cancelled(&self) -> bool {
        self.stopped().is_some()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
}
