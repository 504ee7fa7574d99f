//! Settings of `tmpi serve` without a flag of their own: the fields of [`Limits`], by their JSON schema.
//!
//! You set one by a key in a table of the file, as `uploads` of `[rates]`, by the variable `TMPI_SERVE_RATES_UPLOADS`, or by
//! `--set rates.uploads=30`.

use std::sync::LazyLock;

use clap::Command;
use schemars::generate::SchemaSettings;
use serde_json::{Map, Value, json};

use crate::server::Limits;

/// The table of ungrouped fields.
const PLAIN: &str = "limits";

#[derive(Debug)]
pub(super) struct Setting {
    pub table: String,
    pub key: String,
    schema: Value,
}

#[derive(Clone, Debug)]
pub(super) struct Assignment {
    pub setting: &'static Setting,
    value: Value,
}

/// The schema of [`Limits`], with subschemas inlined.
fn schema() -> Value {
    let settings = SchemaSettings::draft2020_12().with(|s| s.inline_subschemas = true);
    settings.into_generator().into_root_schema_for::<Limits>().to_value()
}

/// Tables of the file by name, each as the schema of an object.
fn tables() -> Vec<(String, Value)> {
    let mut whole = schema();
    let fields = whole["properties"].as_object_mut().map(std::mem::take).unwrap_or_default();
    let (groups, plain): (Vec<_>, Vec<_>) = fields.into_iter().partition(|(_, field)| field["properties"].is_object());
    whole["properties"] = Value::Object(plain.into_iter().collect());
    std::iter::once((PLAIN.to_owned(), whole)).chain(groups).collect()
}

pub(super) fn all() -> &'static [Setting] {
    static ALL: LazyLock<Vec<Setting>> = LazyLock::new(|| {
        let of = |(table, schema): (String, Value)| {
            let fields = schema["properties"].as_object().cloned().unwrap_or_default();
            fields.into_iter().map(move |(key, schema)| Setting { table: table.clone(), key, schema })
        };
        tables().into_iter().flat_map(of).collect()
    });
    &ALL
}

pub(super) fn of_key(table: &str, key: &str) -> Option<&'static Setting> {
    all().iter().find(|setting| setting.table == table && setting.key == key)
}

/// The setting of a variable whose name begins with `prefix`.
pub(super) fn of_variable(prefix: &str, name: &str) -> Option<&'static Setting> {
    let name = name.strip_prefix(prefix)?;
    all().iter().find(|setting| setting.name().replace(['.', '-'], "_").to_uppercase() == name)
}

impl Setting {
    /// `TABLE.KEY`.
    pub fn name(&self) -> String {
        format!("{}.{}", self.table, self.key)
    }

    /// Its value in `limits`, in its unit.
    pub fn value<'a>(&self, limits: &'a Value) -> &'a Value {
        let table = if self.table == PLAIN { limits } else { &limits[&self.table] };
        &table[&self.key]
    }

    pub fn parse(&'static self, text: &str) -> Result<Assignment, String> {
        let bound = |name: &str| self.schema[name].as_f64();
        let is_whole = self.schema["type"] != "number";
        let number = serde_json::from_str::<Value>(text).ok().filter(|value| if is_whole { value.is_u64() } else { value.is_number() });
        let (least, most) = (bound("minimum").unwrap_or(0.0), bound("maximum").unwrap_or(f64::from(u32::MAX)));
        let within = number.filter(|value| value.as_f64().is_some_and(|n| (least..=most).contains(&n)));
        let kind = if is_whole { "whole number" } else { "number" };
        within
            .map(|value| Assignment { setting: self, value })
            .ok_or_else(|| format!("{} must be a {kind} from {least} to {most}, not {text}", self.name()))
    }
}

/// Reads `TABLE.KEY=VALUE`.
pub(super) fn assignment(text: &str) -> Result<Assignment, String> {
    let named = text.split_once('=').and_then(|(name, value)| Some((name.trim().split_once('.')?, value.trim())));
    let ((table, key), value) = named.ok_or("TABLE.KEY=VALUE is expected, as rates.uploads=30")?;
    of_key(table, key).ok_or_else(|| format!("{table}.{key} is no setting; `tmpi config` lists them"))?.parse(value)
}

pub(super) fn applied(usual: &Limits, said: &[Assignment]) -> serde_json::Result<Limits> {
    let mut all = serde_json::to_value(usual)?;
    for Assignment { setting, value } in said {
        let table = if setting.table == PLAIN { &mut all } else { &mut all[&setting.table] };
        table[&setting.key] = value.clone();
    }
    serde_json::from_value(all)
}

/// The schema of the file: the flags of `serve` and the tables.
pub(super) fn file_schema(flags: &Command, is_flag: impl Fn(&clap::Arg) -> bool) -> Value {
    let mut properties = Map::new();
    for flag in flags.get_arguments().filter(|flag| is_flag(flag)) {
        let (name, help) = (flag.get_long().unwrap_or_default(), flag.get_help().map(ToString::to_string).unwrap_or_default());
        properties.insert(name.to_owned(), json!({ "description": help, "type": ["string", "number", "boolean", "array"] }));
    }
    for (name, mut table) in tables() {
        if let Some(table) = table.as_object_mut() {
            table.retain(|word, _| !["$schema", "title", "default"].contains(&word.as_str()));
        }
        properties.insert(name, table);
    }
    json!({
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "tmpi.toml",
        "type": "object",
        "properties": properties,
        "additionalProperties": false,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_setting_changes_only_its_own_field_and_reads_back() {
        let usual = serde_json::to_value(Limits::default()).unwrap();
        assert!(all().len() > 30);
        for setting in all() {
            // one more than the default, or one less if that is the maximum
            let old = setting.value(&usual).as_f64().unwrap();
            let [more, less] = [1.0, -1.0].map(|by| setting.parse(&(old + by).to_string()));
            let said = more.or(less).unwrap();
            let changed = serde_json::to_value(applied(&Limits::default(), std::slice::from_ref(&said)).unwrap()).unwrap();
            for other in all() {
                let is_same = other.value(&changed) == other.value(&usual);
                assert_eq!(is_same, other.name() != setting.name(), "{} changes {}", setting.name(), other.name());
            }
            assert_eq!(setting.value(&changed).as_f64(), said.value.as_f64());
            assert!(setting.schema["description"].is_string() && setting.schema["default"].is_number(), "{setting:?}");
            assert_eq!(
                of_variable("X_", &format!("X_{}", setting.name().replace(['.', '-'], "_").to_uppercase())).unwrap().name(),
                setting.name()
            );
        }
        assert_eq!(applied(&Limits::default(), &[]).unwrap(), Limits::default(), "nothing is lost on the way");
    }

    #[test]
    fn errors_name_values_out_of_range() {
        for (text, words) in [
            ("limits.pixels=51", ["limits.pixels", "1 to 50"]),
            ("limits.body=0", ["limits.body", "1 to 4096"]),
            ("limits.queue=many", ["limits.queue", "whole number"]),
            ("limits.queue=1.5", ["limits.queue", "whole number"]),
            ("limits.queue=-1", ["limits.queue", "0 to"]),
            ("live.budget-ms=NaN", ["live.budget-ms", "number"]),
            ("live.rooms=65", ["live.rooms", "0 to 64"]),
            ("rates.uploads=4294967296", ["rates.uploads", "4294967295"]),
            ("limits.quue=3", ["limits.quue", "tmpi config"]),
            ("queue=3", ["TABLE.KEY=VALUE", ""]),
        ] {
            let said = assignment(text).unwrap_err();
            assert!(words.iter().all(|word| said.contains(word)), "{text}: {said}");
        }
    }
}
