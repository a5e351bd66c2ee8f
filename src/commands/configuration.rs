//! `heliomap configuration`: docs/CONFIGURATION.md, generated from the command line.

use super::output::print;
use clap::{Arg, ArgAction, Command};
use heliomap::config::file::FLAG;
use std::collections::BTreeMap;
use std::fmt::Write;

const INTRODUCTION: &str = "\
# Configuration

A setting can be a flag, an environment variable, or a line of a file. A flag takes precedence over the environment, the
environment over the file, the file over the default. `heliomap COMMAND --help` shows the flags of a command.

The file is YAML with one line `flag: value` for each setting, the flag without its dashes. Flags without a value take `true` or
`false`, flags that may be repeated take a list. `--config FILE` or `HELIOMAP_CONFIG` names the file. One file serves all commands:
each uses the settings that it has. A key that no command has is refused. Make a file with a password readable by the service only
(`chmod 600`).

Durations have a unit: `30s`, `10m`, `24h`, `400d`. Sizes too, in powers of 1024: `256M`, `8G`, `2T`. Bare numbers are bytes, and for
durations the unit that version 0.1 used: seconds; days for `--keep-audit` and `--expires-after`; hours for `keys rotate --grace`.

```yaml
listen: 0.0.0.0:8080
data-dir: /var/lib/heliomap
log-format: json
max-image-size: 128M
cors-origin: [https://dashboard.example.org]
```

`make configuration` generates this page from the command line, and a test compares the two.

";

/// Flags without an environment variable, which belong to a single run.
const RUNS: &str = "
## Flags of single runs

These belong to one run of a command and have no environment variable.

";

/// Prints the page.
pub fn run(command: &Command) -> anyhow::Result<()> {
    print(document(command))
}

/// A flag as the page shows it, without the commands that take it.
#[derive(PartialEq, Eq, PartialOrd, Ord)]
struct Row {
    flag: String,
    environment: Option<String>,
    default: String,
    meaning: String,
}

/// The page.
pub fn document(command: &Command) -> String {
    let mut rows: BTreeMap<Row, Vec<String>> = BTreeMap::new();
    collect(command, "", &mut rows);
    let mut text = INTRODUCTION.to_owned();
    text.push_str("| flag | environment | file | default | commands | meaning |\n|---|---|---|---|---|---|\n");
    let listed = |commands: &[String]| match commands {
        [all] if all.is_empty() => "all".to_owned(),
        commands => commands.join(", "),
    };
    for (row, commands) in &rows {
        if let Some(variable) = &row.environment {
            let file = row.flag.trim_start_matches('-').split(' ').next().unwrap_or_default();
            let file = if file == FLAG { String::new() } else { format!("`{file}`") };
            let commands = listed(commands);
            // Writing to a string does not fail.
            let _ = writeln!(
                text,
                "| `{}` | `{variable}` | {file} | {} | {commands} | {} |",
                row.flag, row.default, row.meaning
            );
        }
    }
    text.push_str(RUNS);
    text.push_str("| flag | default | commands | meaning |\n|---|---|---|---|\n");
    for (row, commands) in rows.iter().filter(|(row, _)| row.environment.is_none()) {
        let _ = writeln!(text, "| `{}` | {} | {} | {} |", row.flag, row.default, listed(commands), row.meaning);
    }
    text
}

/// The flags of a command and of its subcommands, each with the commands that take it.
fn collect(command: &Command, path: &str, rows: &mut BTreeMap<Row, Vec<String>>) {
    for arg in command.get_arguments().filter(|arg| !arg.is_hide_set()) {
        if let Some(row) = row(arg) {
            rows.entry(row).or_default().push(path.to_owned());
        }
    }
    for subcommand in command.get_subcommands().filter(|subcommand| !subcommand.is_hide_set()) {
        collect(subcommand, format!("{path} {}", subcommand.get_name()).trim(), rows);
    }
}

fn row(arg: &Arg) -> Option<Row> {
    let flag = arg.get_long()?;
    let takes_value = !matches!(arg.get_action(), ArgAction::SetTrue | ArgAction::Help | ArgAction::Version);
    let value = arg.get_value_names().filter(|_| takes_value).and_then(|names| names.first());
    let defaults: Vec<_> = arg.get_default_values().iter().map(|value| value.to_string_lossy()).collect();
    let help = arg.get_long_help().or(arg.get_help()).map(ToString::to_string).unwrap_or_default();
    let choices: Vec<String> = match takes_value {
        true => arg.get_possible_values().iter().map(|value| format!("`{}`", value.get_name())).collect(),
        false => Vec::new(),
    };
    let mut meaning = help.split_whitespace().collect::<Vec<_>>().join(" ").replace('|', "\\|");
    if !choices.is_empty() {
        let end = if meaning.ends_with('.') { "" } else { "." };
        meaning.push_str(&format!("{end} One of {}.", choices.join(", ")));
    }
    Some(Row {
        flag: value.map_or_else(|| format!("--{flag}"), |value| format!("--{flag} {value}")),
        environment: arg.get_env().map(|variable| variable.to_string_lossy().into_owned()),
        default: match (takes_value, defaults.as_slice()) {
            (false, _) => "`false`".to_owned(),
            (true, []) => "none".to_owned(),
            (true, defaults) => format!("`{}`", defaults.join(",")),
        },
        meaning,
    })
}
