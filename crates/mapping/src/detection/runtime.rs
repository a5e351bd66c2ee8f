//! ONNX Runtime: found, loaded once, and asked to open models that are checked before they are trusted.

use super::DetectionError;
use ort::environment::Environment;
use ort::ep;
use ort::session::Session;
use ort::session::builder::GraphOptimizationLevel;
use ort::value::{TensorElementType, TensorRef};
use std::ffi::OsString;
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::sync::{Condvar, Mutex, PoisonError};

/// The largest model file that is read.
pub const MAX_MODEL_BYTES: u64 = 512 << 20;

/// What runs the models: ONNX Runtime's own CPU kernels, or CUDA where the library was built with it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ExecutionProvider {
    #[default]
    Cpu,
    Cuda,
}

impl ExecutionProvider {
    /// All of them.
    const ALL: [Self; 2] = [Self::Cpu, Self::Cuda];

    /// The name as people write it.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Cpu => "CPU",
            Self::Cuda => "CUDA",
        }
    }

    /// What is registered before a session opens; nothing for the CPU, which ONNX Runtime always has.
    fn dispatch(self) -> Option<ep::ExecutionProviderDispatch> {
        match self {
            Self::Cpu => None,
            Self::Cuda => Some(ep::CUDA::default().build()),
        }
    }
}

impl std::str::FromStr for ExecutionProvider {
    type Err = String;

    /// By name, in any case.
    fn from_str(text: &str) -> Result<Self, String> {
        Self::ALL.into_iter().find(|provider| provider.as_str().eq_ignore_ascii_case(text)).ok_or_else(|| {
            let names: Vec<String> = Self::ALL.iter().map(|provider| provider.as_str().to_ascii_lowercase()).collect();
            format!("one of {} is expected", names.join(", "))
        })
    }
}

impl std::fmt::Display for ExecutionProvider {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.as_str())
    }
}

/// How models are run.
#[derive(Debug, Clone, Copy, Default)]
pub struct RuntimeSettings {
    /// Threads; 0 is one per core.
    pub threads: usize,
    pub provider: ExecutionProvider,
}

impl RuntimeSettings {
    /// On the CPU with so many threads.
    pub fn with_threads(threads: usize) -> Self {
        Self { threads, ..Self::default() }
    }

    pub(super) fn thread_count(self) -> usize {
        if self.threads == 0 { std::thread::available_parallelism().map_or(1, usize::from) } else { self.threads }
    }

    /// For people: "CPU with 2 threads".
    pub fn describe(self) -> String {
        format!("ONNX Runtime on {} with {} threads", self.provider.as_str(), self.thread_count())
    }
}

static ENVIRONMENT: Mutex<Option<Environment>> = Mutex::new(None);

/// The process's ONNX Runtime; loaded at the first call. A failure is not remembered: the library may be installed
/// while the process runs.
fn environment() -> Result<Environment, DetectionError> {
    let mut slot = ENVIRONMENT.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(environment) = slot.as_ref() {
        return Ok(environment.clone());
    }
    let named = std::env::var_os("ORT_DYLIB_PATH").filter(|path| !path.is_empty());
    let is_named = named.is_some();
    let library = find_library(named, std::env::current_dir().ok(), std::env::current_exe().ok())?;
    let unusable = |what: String| DetectionError::RuntimeUnusable { library: library.display().to_string(), what };
    let environment = ort::init_from(&library)
        .map_err(|error| match error {
            ort::LoadDynamicError::Dlopen { .. } if !is_named && is_bare(&library) => DetectionError::RuntimeMissing,
            error => unusable(error.to_string()),
        })?
        .with_name("heliomap")
        .with_telemetry(false)
        .build()
        .map_err(|error| unusable(error.to_string()))?;
    environment.set_log_level(ort::logging::LogLevel::Fatal);
    Ok(slot.insert(environment).clone())
}

/// The name under which the system's loader knows the library.
fn system_name() -> String {
    format!("{}onnxruntime{}", std::env::consts::DLL_PREFIX, std::env::consts::DLL_SUFFIX)
}

/// Whether a path is a name without a folder, which is for the system's loader to find.
fn is_bare(path: &Path) -> bool {
    path.components().count() == 1
}

/// Where the library is: what `named` says, else `.ort/` in the working directory, beside the executable or in one of
/// its parents, else the system's own.
fn find_library(
    named: Option<OsString>,
    working_directory: Option<PathBuf>,
    executable: Option<PathBuf>,
) -> Result<PathBuf, DetectionError> {
    if let Some(named) = named.map(PathBuf::from) {
        return if is_bare(&named) || named.is_file() {
            Ok(named)
        } else {
            Err(DetectionError::RuntimeUnusable {
                library: named.display().to_string(),
                what: "no such file (ORT_DYLIB_PATH names it)".to_owned(),
            })
        };
    }
    let beside_executable = executable.iter().flat_map(|path| path.ancestors().skip(1));
    let found = working_directory
        .as_deref()
        .into_iter()
        .chain(beside_executable)
        .map(|folder| folder.join(".ort").join(system_name()))
        .find(|path| path.is_file());
    Ok(found.unwrap_or_else(|| PathBuf::from(system_name())))
}

/// The most sessions of one model: each keeps memory for a tile.
const MAX_SESSIONS: usize = 4;

/// Sessions of one model. Tiles run side by side, each on few threads, rather than one after the other on all: threads that
/// share one tile wait for each other, the more so on a busy machine.
pub(super) struct Sessions {
    idle: Mutex<Vec<Session>>,
    returned: Condvar,
    count: usize,
}

impl Sessions {
    /// How many calls of [`Self::with`] run at once.
    pub fn count(&self) -> usize {
        self.count
    }

    /// Lends a session to `f`, after waiting for one where all are in use. `f` must not wait for work that itself needs a
    /// session.
    pub fn with<T>(&self, f: impl FnOnce(&mut Session) -> T) -> T {
        /// Gives the session back, also when `f` panics.
        struct Lent<'a>(&'a Sessions, Option<Session>);
        impl Drop for Lent<'_> {
            fn drop(&mut self) {
                if let Some(session) = self.1.take() {
                    self.0.idle.lock().unwrap_or_else(PoisonError::into_inner).push(session);
                    self.0.returned.notify_one();
                }
            }
        }
        let mut idle = self.idle.lock().unwrap_or_else(PoisonError::into_inner);
        let session = loop {
            match idle.pop() {
                Some(session) => break session,
                None => idle = self.returned.wait(idle).unwrap_or_else(PoisonError::into_inner),
            }
        };
        drop(idle);
        let mut lent = Lent(self, Some(session));
        f(lent.1.as_mut().expect("taken in drop only"))
    }
}

/// An outlet of a model: its name, and its shape where it is a float32 tensor (negative where any size is taken).
pub(super) struct Outlet {
    pub name: String,
    pub shape: Option<Vec<i64>>,
}

/// A model that takes photos, as far as its file tells: which kind it is, its outputs say.
pub(super) struct ImageModel {
    /// Name of the file.
    pub name: String,
    pub sessions: Sessions,
    pub settings: RuntimeSettings,
    pub input: String,
    /// Height and width that the input is bound to, where it is.
    pub fixed_size: [Option<u32>; 2],
    pub outputs: Vec<Outlet>,
    /// The outputs in words.
    pub outputs_text: String,
    /// Metadata by key.
    pub metadata: std::collections::BTreeMap<String, String>,
    /// SHA-256 of the file, hexadecimal.
    pub digest: String,
}

impl ImageModel {
    /// The error that this model does not fit.
    pub fn unfit(&self, what: impl Into<String>) -> DetectionError {
        DetectionError::UnfitModel { name: self.name.clone(), what: what.into() }
    }

    /// Metadata of ours.
    pub fn ours(&self, key: &str) -> Option<&str> {
        self.metadata.get(&format!("heliomap.{key}")).map(|value| value.trim())
    }

    /// A positive number of our metadata.
    pub fn number(&self, key: &str, text: &str) -> Result<f64, DetectionError> {
        text.trim().parse().ok().filter(|value: &f64| value.is_finite() && *value > 0.0).ok_or_else(|| {
            self.unfit(format!("its metadata `heliomap.{key}` is `{text}`; a positive number is needed"))
        })
    }

    /// Tells this model and what runs it from every other that may give other numbers.
    pub fn identity(&self) -> String {
        format!("{} on {}, {}", self.digest, self.settings.provider.as_str(), ort::info())
    }

    /// The version that the metadata tells, else the beginning of the file's digest.
    pub fn version(&self) -> String {
        self.ours("version").map_or_else(|| self.digest[..12].to_owned(), str::to_owned)
    }
}

/// Reads a model file and opens it: a model of one float32 input `[N, 3, H, W]`.
///
/// # Errors
/// No runtime, or none with the execution provider that is asked for; a file that cannot be read, is too large, is no ONNX
/// model or one with other inputs.
pub(super) fn open_model(path: &Path, settings: RuntimeSettings) -> Result<ImageModel, DetectionError> {
    let name = path.file_name().map_or_else(|| path.display().to_string(), |name| name.to_string_lossy().into_owned());
    let bytes = read_bounded(path)?;
    let no_model = |what: String| DetectionError::NotAModel { name: name.clone(), what };
    if bytes.is_empty() {
        return Err(no_model("the file is empty".to_owned()));
    }
    let threads = settings.thread_count();
    // An accelerator runs one tile after the other; sessions beside each other would only take its memory.
    let count = if settings.provider == ExecutionProvider::Cpu { threads.min(MAX_SESSIONS) } else { 1 };
    let sessions: Vec<Session> = (0..count)
        .map(|_| open_session(&bytes, threads / count, settings.provider, &name))
        .collect::<Result<_, _>>()?;
    let session = &sessions[0];
    let unfit = |what: String| DetectionError::UnfitModel { name: name.clone(), what };
    let shape_of = |outlet: &ort::value::Outlet| -> Option<Vec<i64>> {
        let dtype = outlet.dtype();
        (dtype.tensor_type() == Some(TensorElementType::Float32))
            .then(|| dtype.tensor_shape().map(|shape| shape.iter().copied().collect()))
            .flatten()
    };
    let describe = |outlets: &[ort::value::Outlet]| -> String {
        let texts: Vec<String> = outlets.iter().map(|o| format!("{}: {}", o.name(), o.dtype())).collect();
        if texts.is_empty() { "none".to_owned() } else { texts.join(", ") }
    };
    let [input] = session.inputs() else {
        return Err(unfit(format!(
            "it has the inputs {}; one is needed, float32 [N, 3, H, W]",
            describe(session.inputs())
        )));
    };
    let fits = |dim: i64, wanted: i64| dim == wanted || dim < 0;
    let input_shape = shape_of(input)
        .filter(|shape| shape.len() == 4 && fits(shape[0], 1) && fits(shape[1], 3))
        .ok_or_else(|| unfit(format!("its input is {}; float32 [N, 3, H, W] is needed", describe(session.inputs()))))?;
    let mut fixed_size = [None; 2];
    for (fixed, dim) in fixed_size.iter_mut().zip(&input_shape[2..]) {
        *fixed = match *dim {
            dim if dim < 0 => None,
            dim @ 64..=4096 => Some(dim as u32),
            dim => return Err(unfit(format!("its input is bound to {dim} pixels; 64 to 4096, or any, are needed"))),
        };
    }
    let metadata = {
        let held = session.metadata().map_err(|error| no_model(error.to_string()))?;
        let keys = held.custom_keys().map_err(|error| no_model(error.to_string()))?;
        keys.iter().filter_map(|key| Some((key.clone(), held.custom(key)?))).collect()
    };
    let outputs = session.outputs();
    Ok(ImageModel {
        settings,
        input: input.name().to_owned(),
        outputs_text: describe(outputs),
        outputs: outputs.iter().map(|o| Outlet { name: o.name().to_owned(), shape: shape_of(o) }).collect(),
        fixed_size,
        metadata,
        digest: hexadecimal(&<sha2::Sha256 as sha2::Digest>::digest(&bytes)),
        sessions: Sessions { idle: Mutex::new(sessions), returned: Condvar::new(), count },
        name,
    })
}

/// Runs a session on one picture: planes of red, green and blue.
pub(super) fn run<'s>(
    session: &'s mut Session,
    input: &str,
    pixels: &[f32],
    height: usize,
    width: usize,
) -> Result<ort::session::SessionOutputs<'s>, DetectionError> {
    let failed = |error: ort::Error| DetectionError::Inference { what: error.message().to_owned() };
    let tensor = TensorRef::from_array_view(([1, 3, height, width], pixels)).map_err(failed)?;
    session.run(ort::inputs![input => tensor]).map_err(failed)
}

/// The shape and the values of an output.
pub(super) fn extract<'o>(
    outputs: &'o ort::session::SessionOutputs<'_>,
    name: &str,
) -> Result<(Vec<usize>, &'o [f32]), DetectionError> {
    let failed = |what: String| DetectionError::Inference { what };
    let value = outputs.get(name).ok_or_else(|| failed(format!("it gave no output `{name}`")))?;
    let (shape, values) = value.try_extract_tensor::<f32>().map_err(|error| failed(error.message().to_owned()))?;
    Ok((shape.iter().map(|dim| usize::try_from(*dim).unwrap_or(0)).collect(), values))
}

fn hexadecimal(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

fn read_bounded(path: &Path) -> Result<Vec<u8>, DetectionError> {
    let name = || path.display().to_string();
    let unreadable = |source| DetectionError::ModelUnreadable { name: name(), source };
    let file = File::open(path).map_err(unreadable)?;
    let size = file.metadata().map_err(unreadable)?;
    if size.is_dir() {
        return Err(DetectionError::NotAModel { name: name(), what: "it is a folder".to_owned() });
    }
    let mut bytes = Vec::new();
    file.take(MAX_MODEL_BYTES + 1).read_to_end(&mut bytes).map_err(unreadable)?;
    if bytes.len() as u64 > MAX_MODEL_BYTES {
        return Err(DetectionError::ModelTooLarge { name: name(), limit: MAX_MODEL_BYTES });
    }
    Ok(bytes)
}

fn open_session(
    bytes: &[u8],
    threads: usize,
    provider: ExecutionProvider,
    name: &str,
) -> Result<Session, DetectionError> {
    let environment = environment()?;
    let no_model = |what: &str| DetectionError::NotAModel { name: name.to_owned(), what: first_line(what) };
    let options = || -> ort::Result<_> {
        Ok(Session::builder(&environment)?
            .with_optimization_level(GraphOptimizationLevel::All)?
            .with_intra_threads(threads)?
            // Threads that spin while they wait take the cores from decoding and post-processing.
            .with_intra_op_spinning(false)?)
    };
    let mut builder = options().map_err(|error| DetectionError::Inference { what: error.message().to_owned() })?;
    if let Some(dispatch) = provider.dispatch() {
        dispatch.register(&mut builder).map_err(|error| DetectionError::ProviderMissing {
            provider: provider.as_str(),
            what: first_line(error.message()),
        })?;
    }
    builder.commit_from_memory(bytes).map_err(|error| no_model(error.message()))
}

/// The first line of a message, of bounded length.
fn first_line(text: &str) -> String {
    text.lines().next().unwrap_or("").chars().take(300).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_named_library_comes_first_and_must_exist() {
        let folder = tempfile::tempdir().unwrap();
        let library = folder.path().join("lib.so");
        std::fs::write(&library, b"").unwrap();
        let found = find_library(Some(library.clone().into()), None, None).unwrap();
        assert_eq!(found, library);
        let missing = find_library(Some(folder.path().join("other.so").into()), None, None);
        assert!(matches!(missing, Err(DetectionError::RuntimeUnusable { .. })));
    }

    #[test]
    fn the_library_is_looked_for_in_the_working_directory_and_above_the_executable() {
        let folder = tempfile::tempdir().unwrap();
        let library = folder.path().join(".ort").join(system_name());
        std::fs::create_dir(folder.path().join(".ort")).unwrap();
        std::fs::write(&library, b"").unwrap();
        let executable = folder.path().join("target/debug/heliomap");
        assert_eq!(find_library(None, None, Some(executable.clone())).unwrap(), library);
        assert_eq!(find_library(None, Some(folder.path().to_owned()), None).unwrap(), library);
        let elsewhere = tempfile::tempdir().unwrap();
        let found = find_library(None, Some(elsewhere.path().to_owned()), None).unwrap();
        assert_eq!(found, PathBuf::from(system_name()));
    }
}
