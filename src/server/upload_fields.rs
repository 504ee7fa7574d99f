//! The text fields of an upload: options, class, title and visibility.

use std::collections::BTreeSet;

use super::photo_options;
use super::presets::{PRESET, Presets, refused};
use super::problem::Problem;
use super::viewer_settings::Settings;
use tmpi_library::Class;
use tmpi_pipeline::Options;

const TITLE: &str = "title";
const VISIBILITY: &str = "visibility";
const CLASS: &str = "class";

/// The text fields of an upload, each given at most once.
#[derive(Default)]
pub struct UploadFields {
    pub options: Options,
    given: BTreeSet<String>,
    /// How urgent it is to process the photo.
    pub class: Class,
    /// Title and visibility.
    pub settings: Settings,
    /// Name of the photo's file: the title by default; it may also name the stereo layout.
    pub file_name: Option<String>,
    /// Whether the caller may give options besides presets.
    free: bool,
}

impl UploadFields {
    /// Sets a field or parameter of a request, or all those of the preset that it names.
    ///
    /// # Errors
    /// As [`Self::set`], and 403 for an option where the caller may give only presets.
    pub fn take(&mut self, presets: &Presets, name: &str, value: &str) -> Result<(), Problem> {
        if name == PRESET {
            return presets.of_photo(value)?.iter().try_for_each(|(name, value)| self.set(name, value));
        }
        if self.free || !is_option(name) { self.set(name, value) } else { Err(refused(name)) }
    }

    /// Sets a field or parameter.
    ///
    /// # Errors
    /// 400 that names it if it is invalid, or given twice, in either spelling.
    pub fn set(&mut self, name: &str, value: &str) -> Result<(), Problem> {
        match name {
            TITLE | VISIBILITY => self.settings.set(name, &value.into())?,
            CLASS => self.class = class_of(value).ok_or_else(|| Problem::parameter(CLASS, "must be interactive or batch"))?,
            _ => _ = photo_options::set(&mut self.options, name, value)?,
        }
        if self.given.insert(name.replace('_', "-")) { Ok(()) } else { Err(Problem::parameter(name, "is given twice")) }
    }
}

fn is_option(name: &str) -> bool {
    photo_options::NAMES.contains(&name.replace('_', "-").as_str())
}

/// Parses a class: `interactive` or `batch`.
pub fn class_of(name: &str) -> Option<Class> {
    [Class::Interactive, Class::Batch].into_iter().find(|class| class.name() == name)
}

/// Refuses an unknown field before its value is read.
///
/// # Errors
/// 400 with `kinds` and the options.
pub fn check_name(name: &str, kinds: &str) -> Result<(), Problem> {
    if matches!(name, TITLE | VISIBILITY | CLASS | PRESET) || is_option(name) {
        return Ok(());
    }
    Err(Problem::parameter(name, format!("there is no such {kinds}, {}", photo_options::NAMES.join(", "))))
}

/// Reads the fields in a query; options besides presets need `free`.
///
/// # Errors
/// 400 that names the invalid one, 403 that names an option.
pub fn of_query(presets: &Presets, free: bool, query: &[(String, String)]) -> Result<UploadFields, Problem> {
    let mut fields = UploadFields { free, ..UploadFields::default() };
    for (name, value) in query {
        check_name(name, "option; there are preset, title, visibility, class")?;
        fields.take(presets, name, value)?;
    }
    Ok(fields)
}
