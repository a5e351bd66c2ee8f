//! How far long work is: a bar on a terminal, a line per tenth elsewhere.

use super::output::notify;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use std::io::IsTerminal;
use std::sync::Mutex;

/// Progress on standard error.
pub struct Progress {
    bar: Option<ProgressBar>,
    last: Mutex<Option<(&'static str, usize)>>,
}

impl Progress {
    pub fn new() -> Self {
        let bar = std::io::stderr().is_terminal().then(|| {
            let bar = ProgressBar::with_draw_target(Some(1), ProgressDrawTarget::stderr());
            if let Ok(style) = ProgressStyle::with_template("{msg:<10} [{bar:40}] {pos}/{len} {elapsed}") {
                bar.set_style(style.progress_chars("=> "));
            }
            bar
        });
        Self { bar, last: Mutex::new(None) }
    }

    /// `done` of `total` in `stage`.
    pub fn show(&self, stage: &'static str, done: usize, total: usize) {
        if let Some(bar) = &self.bar {
            bar.set_message(stage);
            bar.set_length(total as u64);
            bar.set_position(done as u64);
            return;
        }
        let tenth = (done * 10).checked_div(total).unwrap_or(10);
        if let Ok(mut last) = self.last.lock()
            && *last != Some((stage, tenth))
        {
            *last = Some((stage, tenth));
            notify(format_args!("{stage}: {done} of {total}"));
        }
    }

    pub fn finish(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}
