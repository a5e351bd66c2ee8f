//! The configuration file. Its values replace the defaults of the flags, so flags and environment variables take precedence
//! in every command.

use clap::builder::OsStr;
use clap::error::{ContextKind, ContextValue};
use clap::{Arg, ArgAction, Command};
use serde_yaml_ng::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::ffi::OsString;
use std::path::{Path, PathBuf};

/// The flag that names the file.
pub const FLAG: &str = "config";
/// The environment variable that names it.
pub const VARIABLE: &str = "HELIOMAP_CONFIG";
/// Largest file, bytes.
const MAX_BYTES: u64 = 1 << 20;
/// Settings with the names that they had in version 0.1, which are still accepted: old, new.
const RENAMED: [(&str, &str); 1] = [("max-megapixels", "max-image-megapixels")];

/// Why a configuration file cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    #[error("cannot read the configuration file {path}: {source}", path = path.display())]
    Unreadable { path: PathBuf, source: std::io::Error },
    #[error("the configuration file {path} is larger than 1 MiB; give one with `flag: value` lines", path = path.display())]
    TooLarge { path: PathBuf },
    #[error("the configuration file {path} is not YAML: {source}", path = path.display())]
    NoYaml { path: PathBuf, source: serde_yaml_ng::Error },
    #[error("the configuration file {path} must hold `flag: value` lines and nothing else", path = path.display())]
    NoMapping { path: PathBuf },
    #[error("the configuration file {path} sets `{key}`, which is not a setting{hint}", path = path.display())]
    Unknown { path: PathBuf, key: String, hint: String },
    #[error("the configuration file {path} sets `{key}` to a value that is not text, a number, true, false or a list of these",
        path = path.display())]
    Value { path: PathBuf, key: String },
}

/// The file that the command line or else the environment names.
pub fn named(arguments: impl IntoIterator<Item = OsString>) -> Option<PathBuf> {
    let mut arguments = arguments.into_iter().take_while(|argument| argument != "--");
    while let Some(argument) = arguments.next() {
        if argument == "--config" {
            return arguments.next().map(PathBuf::from);
        }
        if let Some(path) = argument.to_str().and_then(|argument| argument.strip_prefix("--config=")) {
            return Some(PathBuf::from(path));
        }
    }
    std::env::var_os(VARIABLE).filter(|path| !path.is_empty()).map(PathBuf::from)
}

/// Whether a flag may be set in the file: every one that has an environment variable, but for the one that names the file.
pub fn is_setting(arg: &Arg) -> bool {
    arg.get_env().is_some() && arg.get_long().is_some_and(|flag| flag != FLAG)
}

/// A command whose defaults are the values of a file.
///
/// # Errors
/// When the file cannot be read or has a key that is not a setting of any command.
pub fn with_file(command: Command, path: &Path) -> Result<Command, ConfigError> {
    let unreadable = |source| ConfigError::Unreadable { path: path.to_owned(), source };
    if std::fs::metadata(path).map_err(unreadable)?.len() > MAX_BYTES {
        return Err(ConfigError::TooLarge { path: path.to_owned() });
    }
    let text = std::fs::read_to_string(path).map_err(unreadable)?;
    with_text(command, &text, path)
}

fn with_text(command: Command, text: &str, path: &Path) -> Result<Command, ConfigError> {
    let document: Value =
        serde_yaml_ng::from_str(text).map_err(|source| ConfigError::NoYaml { path: path.to_owned(), source })?;
    let mapping = match document {
        Value::Null => return Ok(command),
        Value::Mapping(mapping) => mapping,
        _ => return Err(ConfigError::NoMapping { path: path.to_owned() }),
    };
    let known = settings(&command);
    let mut values: BTreeMap<String, Vec<&'static str>> = BTreeMap::new();
    for (key, value) in &mapping {
        let key = scalar(key).unwrap_or_default();
        let key = RENAMED.iter().find(|(old, _)| *old == key).map_or(key, |(_, new)| (*new).to_owned());
        if !known.contains(&key) {
            let hint = nearest(&known, &key);
            return Err(ConfigError::Unknown { path: path.to_owned(), key, hint });
        }
        let texts = match value {
            // As if the key were absent.
            Value::Null => continue,
            Value::Sequence(items) => items.iter().map(scalar).collect(),
            value => scalar(value).map(|text| vec![text]),
        };
        let texts = texts.ok_or_else(|| ConfigError::Value { path: path.to_owned(), key: key.clone() })?;
        // The command line is read once in the life of a process.
        values.insert(key, texts.into_iter().map(|text| &*text.leak()).collect());
    }
    Ok(with_defaults(command, &values))
}

/// A command whose defaults are the values of environment variables with their names of version 0.1.
pub fn with_renamed_variables(command: Command) -> Command {
    let variable = |old: &str| format!("HELIOMAP_{}", old.replace('-', "_").to_uppercase());
    let values = RENAMED.iter().filter_map(|(old, new)| {
        let value = std::env::var(variable(old)).ok().filter(|value| !value.is_empty())?;
        // The command line is read once in the life of a process.
        Some(((*new).to_owned(), vec![&*value.leak()]))
    });
    with_defaults(command, &values.collect())
}

/// A value as one would write it behind a flag.
fn scalar(value: &Value) -> Option<String> {
    match value {
        Value::String(text) => Some(text.clone()),
        Value::Bool(truth) => Some(truth.to_string()),
        Value::Number(number) => Some(number.to_string()),
        _ => None,
    }
}

/// The flags of a command and its subcommands that may be set in a file.
fn settings(command: &Command) -> BTreeSet<String> {
    let own = command.get_arguments().filter(|arg| is_setting(arg)).filter_map(|arg| arg.get_long());
    own.map(str::to_owned).chain(command.get_subcommands().flat_map(settings)).collect()
}

fn with_defaults(command: Command, values: &BTreeMap<String, Vec<&'static str>>) -> Command {
    command
        .mut_args(|arg| {
            let found = arg.get_long().and_then(|flag| values.get(flag)).filter(|_| is_setting(&arg));
            let Some(texts) = found else { return arg };
            // A secret in the file is shown by no `--help`.
            let hidden = arg.is_hide_env_values_set();
            arg.default_values(texts.iter().map(|text| OsStr::from(*text)).collect::<Vec<_>>())
                .hide_default_value(hidden)
        })
        .mut_subcommands(|subcommand| with_defaults(subcommand, values))
}

/// The setting whose name is most similar to a key, as part of a sentence; what clap suggests for a flag.
fn nearest(known: &BTreeSet<String>, key: &str) -> String {
    let flags = known.iter().map(|name| {
        let name: &'static str = name.clone().leak();
        Arg::new(name).long(name).action(ArgAction::SetTrue)
    });
    let wrong = Command::new("settings").args(flags).try_get_matches_from(["settings", &format!("--{key}")]);
    let suggested = wrong.err().and_then(|error| match error.get(ContextKind::SuggestedArg) {
        Some(ContextValue::String(flag)) => Some(flag.trim_start_matches('-').to_owned()),
        _ => None,
    });
    suggested
        .map_or_else(|| "; docs/CONFIGURATION.md lists them all".to_owned(), |name| format!("; did you mean `{name}`?"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::value_parser;

    fn command() -> Command {
        let listen = Arg::new("listen").long("listen").env("T_LISTEN").default_value("a");
        let size = Arg::new("max-size").long("max-size").env("T_SIZE").value_parser(value_parser!(u64));
        let origins = Arg::new("origin").long("origin").env("T_ORIGIN").value_delimiter(',').action(ArgAction::Append);
        let open = Arg::new("open").long("open").env("T_OPEN").action(ArgAction::SetTrue);
        let secret = Arg::new("database").long("database").env("T_DB").hide_env_values(true);
        let pixels = Arg::new("pixels").long("max-image-megapixels").env("T_MP").value_parser(value_parser!(f64));
        let once = Arg::new("once").long("once");
        Command::new("t").subcommand(Command::new("serve").args([listen, size, origins, open, secret, pixels, once]))
    }

    fn with(text: &str) -> Result<Command, ConfigError> {
        with_text(command(), text, Path::new("f.yaml"))
    }

    #[test]
    fn the_file_replaces_defaults_and_flags_take_precedence() {
        let text = "listen: b\nmax-size: 7\norigin: [x, y]\nopen: true\n";
        let read = |arguments: &[&str]| {
            let matches = with(text).unwrap().get_matches_from([&["t", "serve"], arguments].concat());
            matches.subcommand_matches("serve").unwrap().clone()
        };
        let matches = read(&[]);
        assert_eq!(matches.get_one::<String>("listen").unwrap(), "b");
        assert_eq!(matches.get_one::<u64>("max-size"), Some(&7));
        assert_eq!(matches.get_many::<String>("origin").unwrap().collect::<Vec<_>>(), ["x", "y"]);
        assert!(matches.get_flag("open"));
        let matches = read(&["--listen", "c", "--origin", "z"]);
        assert_eq!(matches.get_one::<String>("listen").unwrap(), "c");
        assert_eq!(matches.get_many::<String>("origin").unwrap().collect::<Vec<_>>(), ["z"]);
        assert!(with("").is_ok() && with("listen:\n").is_ok());
    }

    #[test]
    fn keys_of_version_0_1_are_accepted() {
        let matches = with("max-megapixels: 7.5").unwrap().get_matches_from(["t", "serve"]);
        assert_eq!(matches.subcommand_matches("serve").unwrap().get_one("pixels"), Some(&7.5));
    }

    #[test]
    fn mistakes_are_named() {
        let error = |text: &str| with(text).unwrap_err().to_string();
        assert!(error("max-sise: 7").ends_with("sets `max-sise`, which is not a setting; did you mean `max-size`?"));
        assert!(error("once: 7").contains("`once`, which is not a setting"));
        assert!(error("zzzz: 7").ends_with("docs/CONFIGURATION.md lists them all"));
        assert!(error("listen: {a: b}").contains("`listen` to a value that is not text"));
        assert!(error("- a").contains("`flag: value` lines"));
        assert!(error("a: [").contains("not YAML"));
        let wrong = with("max-size: many").unwrap().try_get_matches_from(["t", "serve"]).unwrap_err().to_string();
        assert!(wrong.contains("many") && wrong.contains("--max-size"), "{wrong}");
    }

    #[test]
    fn secrets_are_not_shown() {
        let mut command = with("database: postgres://me:pa55@host/x").unwrap();
        let help = command.find_subcommand_mut("serve").unwrap().render_help().to_string();
        assert!(!help.contains("pa55"), "{help}");
    }

    #[test]
    fn the_file_is_named_by_a_flag() {
        let named = |arguments: &[&str]| named(arguments.iter().map(OsString::from));
        assert_eq!(named(&["t", "serve", "--config", "a.yaml"]), Some(PathBuf::from("a.yaml")));
        assert_eq!(named(&["t", "--config=a.yaml", "serve"]), Some(PathBuf::from("a.yaml")));
        assert_eq!(named(&["t", "map", "--", "--config", "a.yaml"]), None);
    }
}
