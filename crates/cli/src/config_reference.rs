//! `isodream config`: what a configuration resolves to, and what each setting means.

use std::fmt::Write;

use clap::Subcommand;
use isodream_core::Config;
use schemars::schema_for;
use serde_json::Value;

use crate::config_args::ConfigArgs;
use crate::output::print;

/// What is told of configurations.
#[derive(Debug, Subcommand)]
pub(crate) enum ConfigCommand {
    /// The resolved configuration, as a run directory keeps it
    Show(ConfigArgs),
    /// Every setting with its default and its meaning, as Markdown (docs/configuration.md)
    Reference,
}

/// Runs the command.
pub(crate) fn run(command: &ConfigCommand) -> anyhow::Result<()> {
    match command {
        ConfigCommand::Show(args) => print(args.load()?.to_toml().trim_end()),
        ConfigCommand::Reference => print(reference().trim_end()),
    }
}

const HEAD: &str = "\
# Configuration

Every setting, with its default, which is the paper's driving setup. Made by `isodream config reference` from the
comments of `crates/core/src/config/`.

Settings: defaults < `--preset` < `--config file.toml` < `--set a.b=v`. `isodream config show --preset quick` prints what
comes of it.
";

/// All settings as Markdown, in the order in which a configuration is written.
fn reference() -> String {
    let schema = schema_for!(Config).to_value();
    let mut text = HEAD.to_owned();
    let mut section = &schema;
    text += &table(section);
    for line in Config::default().to_toml().lines() {
        if let Some(name) = line
            .strip_prefix('[')
            .and_then(|line| line.strip_suffix(']'))
        {
            section = descend(&schema, name);
            let _ = write!(text, "\n## `[{name}]`\n\n{}\n", description(section));
            text += &table(section);
        } else if let Some((key, value)) = line.split_once(" = ") {
            let property = &section["properties"][key];
            let meaning = format!(
                "{} {}",
                description(property),
                choices(resolve(&schema, property))
            );
            let _ = writeln!(text, "| `{key}` | `{value}` | {} |", meaning.trim_end());
        }
    }
    text
}

/// The head of a section's table; none where it holds other sections alone.
fn table(section: &Value) -> String {
    let properties = section["properties"].as_object();
    let is_plain =
        |property: &Value| property.get("$ref").is_none() || !description(property).is_empty();
    match properties.is_some_and(|properties| properties.values().any(is_plain)) {
        true => "\n| setting | default | meaning |\n|---|---|---|\n".to_owned(),
        false => String::new(),
    }
}

/// The schema of a section by its path, for example `replay.tables.train`.
fn descend<'a>(schema: &'a Value, path: &str) -> &'a Value {
    path.split('.').fold(schema, |section, name| {
        let property = match section["properties"].get(name) {
            Some(property) => property,
            // A name that users choose.
            None => &section["additionalProperties"],
        };
        resolve(schema, property)
    })
}

/// What a reference stands for.
fn resolve<'a>(schema: &'a Value, property: &'a Value) -> &'a Value {
    let name = property["$ref"]
        .as_str()
        .and_then(|path| path.strip_prefix("#/$defs/"));
    name.map_or(property, |name| &schema["$defs"][name])
}

/// A comment, on one line.
fn description(schema: &Value) -> String {
    let text = schema["description"].as_str().unwrap_or_default();
    text.split_whitespace()
        .collect::<Vec<_>>()
        .join(" ")
        .replace('|', "\\|")
}

/// The values of an enumeration with their comments.
fn choices(schema: &Value) -> String {
    let of = schema["oneOf"].as_array().into_iter().flatten();
    let words: Vec<String> = of
        .filter_map(|choice| {
            let value = choice["const"].as_str()?;
            Some(format!("`\"{value}\"`: {}", description(choice)))
        })
        .collect();
    words.join(" ")
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    #[test]
    fn every_setting_has_a_meaning_and_the_document_is_fresh() {
        let text = reference();
        for line in text.lines().filter(|line| line.starts_with("| `")) {
            let meaning = line.rsplit(" | ").next().unwrap().trim_end_matches(" |");
            assert!(meaning.len() > 5, "no meaning: {line}");
        }
        assert!(
            text.contains(
                "| `kl_balance` | `0.8` | Share of the KL that trains the prior (DreamerV2). |"
            ),
            "{text}"
        );
        assert!(
            text.contains("`\"concatenation\"`: All of them beside"),
            "{text}"
        );
        let document = include_str!("../../../docs/configuration.md");
        assert!(
            document.trim_end() == text.trim_end(),
            "docs/configuration.md is old; make it again: isodream config reference > docs/configuration.md"
        );
    }
}
