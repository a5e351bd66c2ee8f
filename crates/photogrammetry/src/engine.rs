//! The process that reconstructs: a request in, lines of progress and a result out. Its contract stands in
//! `engine/engine.py`.

use crate::photos::Survey;
use crate::{Observer, Options, ReconstructError};
use serde::{Deserialize, Serialize};
use std::collections::VecDeque;
use std::io::{BufRead, BufReader, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::thread;
use std::time::Duration;

const SCRIPT: &str = include_str!("../engine/engine.py");
/// How often cancelling is looked for.
const LOOK_EVERY: Duration = Duration::from_millis(200);
/// So often is looked whether a process that has closed its output has ended.
const ENDING_LOOKS: usize = 10;
/// Longest line that the engine may write: a result of ten million points.
const MAX_LINE_BYTES: u64 = 1 << 30;
/// So many lines of what the engine writes to standard error are shown where it fails.
const LAST_LINES: usize = 5;

/// A step of the reconstruction.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Stage {
    /// Features of each photo.
    Features,
    /// Matches of each pair of photos.
    Matches,
    /// Placing photo by photo.
    Mapping,
}

impl Stage {
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Features => "features",
            Self::Matches => "matches",
            Self::Mapping => "mapping",
        }
    }
}

#[derive(Serialize)]
pub(crate) struct Request {
    work: PathBuf,
    threads: usize,
    seed: u64,
    cameras: Vec<RequestCamera>,
    images: Vec<RequestImage>,
}

#[derive(Serialize)]
struct RequestCamera {
    width: u32,
    height: u32,
    focal_px: f64,
    other_focal_px: Option<f64>,
}

#[derive(Serialize)]
struct RequestImage {
    path: PathBuf,
    camera: usize,
    enu_m: Option<[f64; 3]>,
}

impl Request {
    pub(crate) fn of(survey: &Survey, work: &Path, options: &Options) -> Self {
        let cameras = survey.cameras.iter().map(|camera| {
            let [width, height] = camera.size_px;
            RequestCamera { width, height, focal_px: camera.focal_px, other_focal_px: camera.other_focal_px }
        });
        let images = survey.photos.iter().map(|photo| {
            let enu_m = photo.gnss_enu_m.map(Into::into);
            RequestImage { path: photo.path.clone(), camera: photo.camera, enu_m }
        });
        Self {
            work: work.to_owned(),
            threads: options.threads.max(1),
            seed: options.seed,
            cameras: cameras.collect(),
            images: images.collect(),
        }
    }
}

#[derive(Deserialize)]
#[serde(rename_all = "snake_case")]
enum Line {
    Result(Outcome),
    Error {
        code: String,
        message: String,
    },
    #[serde(untagged)]
    Progress {
        stage: Stage,
        done: usize,
        total: usize,
    },
}

/// What the engine made.
#[derive(Debug, Deserialize)]
pub(crate) struct Outcome {
    /// In the order of the survey's cameras; `None` where no photo of one was placed.
    pub(crate) cameras: Vec<Option<OutcomeCamera>>,
    /// The one with the most shots first.
    pub(crate) components: Vec<OutcomeComponent>,
}

#[derive(Debug, Clone, Copy, Deserialize)]
pub(crate) struct OutcomeCamera {
    pub(crate) focal_px: f64,
    pub(crate) k1: f64,
    pub(crate) k2: f64,
}

#[derive(Debug, Deserialize)]
pub(crate) struct OutcomeComponent {
    pub(crate) aligned: bool,
    pub(crate) points: Vec<[f64; 3]>,
    pub(crate) reprojection_px: f64,
    pub(crate) shots: Vec<OutcomeShot>,
}

#[derive(Debug, Deserialize)]
pub(crate) struct OutcomeShot {
    pub(crate) image: usize,
    pub(crate) rotation: [[f64; 3]; 3],
    pub(crate) translation: [f64; 3],
    pub(crate) points: usize,
    pub(crate) reprojection_px: Option<f64>,
}

/// Runs the engine to its end. Its process does not outlive this call.
pub(crate) fn run(python: &Path, request: &Request, observer: &dyn Observer) -> Result<Outcome, ReconstructError> {
    let not_started = |source| ReconstructError::NotStarted { python: python.to_owned(), source };
    let mut command = Command::new(python);
    // -I: neither the current folder nor the user's packages take part.
    command.args(["-I", "-c", SCRIPT]).stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut process = Process(command.spawn().map_err(not_started)?);
    let (Some(stdin), Some(stdout), Some(stderr)) =
        (process.0.stdin.take(), process.0.stdout.take(), process.0.stderr.take())
    else {
        return Err(process.crashed("it has no standard streams".to_owned()));
    };
    let mut text = serde_json::to_vec(request).unwrap_or_default();
    text.push(b'\n');
    // Kept open until the end: the engine ends where its input does, also when this process is killed.
    let writer = thread::spawn(move || {
        let mut stdin = stdin;
        // An engine that ends before it has read everything says why in what it writes.
        let _ = stdin.write_all(&text);
        stdin
    });
    let last_words = thread::spawn(move || last_lines(BufReader::new(stderr)));
    let (sender, lines) = channel();
    let reader = thread::spawn(move || {
        let mut stdout = BufReader::new(stdout);
        loop {
            let mut line = Vec::new();
            match stdout.by_ref().take(MAX_LINE_BYTES).read_until(b'\n', &mut line) {
                Ok(1..) if sender.send(line).is_ok() => {}
                _ => break,
            }
        }
    });
    let outcome = follow(&lines, observer);
    if matches!(outcome, Ok(None)) {
        process.let_end();
    }
    // A result is whole; what the process does after it is of no interest.
    process.kill();
    let _ = (writer.join(), reader.join());
    let words = last_words.join().unwrap_or_default();
    match outcome {
        Ok(Some(outcome)) => Ok(outcome),
        Ok(None) => Err(process.crashed(words)),
        Err(error) => Err(error),
    }
}

/// Reads lines until a result or the end, `None`.
fn follow(lines: &Receiver<Vec<u8>>, observer: &dyn Observer) -> Result<Option<Outcome>, ReconstructError> {
    loop {
        if observer.is_cancelled() {
            return Err(ReconstructError::Cancelled);
        }
        match lines.recv_timeout(LOOK_EVERY) {
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => return Ok(None),
            // Libraries may print lines of their own.
            Ok(line) => match serde_json::from_slice(&line) {
                Ok(Line::Progress { stage, done, total }) => observer.progress(stage, done, total),
                Ok(Line::Result(outcome)) => return Ok(Some(outcome)),
                Ok(Line::Error { code, message }) => return Err(ReconstructError::Refused { code, message }),
                Err(_) => {}
            },
        }
    }
}

fn last_lines(stderr: impl BufRead) -> String {
    let mut last: VecDeque<String> = VecDeque::new();
    for line in stderr.split(b'\n').map_while(Result::ok) {
        if last.len() == LAST_LINES {
            last.pop_front();
        }
        last.push_back(String::from_utf8_lossy(&line).chars().take(500).collect());
    }
    Vec::from(last).join("; ")
}

/// A process that ends when it goes out of scope.
struct Process(Child);

impl Process {
    fn kill(&mut self) {
        // It may have ended by itself.
        let _ = self.0.kill();
    }

    /// Gives a process that has closed its output the time to say with which status it ends.
    fn let_end(&mut self) {
        for _ in 0..ENDING_LOOKS {
            if !matches!(self.0.try_wait(), Ok(None)) {
                return;
            }
            thread::sleep(LOOK_EVERY);
        }
    }

    /// The error for a process that gave no result.
    fn crashed(mut self, last_words: String) -> ReconstructError {
        self.kill();
        let status = self.0.wait().map_or_else(|error| error.to_string(), |status| status.to_string());
        ReconstructError::Crashed { status, last_words }
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        self.kill();
        let _ = self.0.wait();
    }
}
