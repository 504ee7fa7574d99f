//! Presets: named options of views, films and photos, from the server's settings.

use std::collections::BTreeMap;
use std::str::FromStr;

use axum::http::StatusCode;

use super::limits::Limits;
use super::problem::Problem;
use super::routes::ViewQuery;
use super::upload_fields::{check_name, of_query};

/// The parameter that names a preset.
pub const PRESET: &str = "preset";

type Parameters = Vec<(String, String)>;

/// A preset as given: `NAME=OPTIONS`, with options as in a query.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Preset {
    name: String,
    options: Parameters,
}

impl FromStr for Preset {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let is_name = |name: &str| !name.is_empty() && name.bytes().all(|b| b.is_ascii_alphanumeric() || b"-_".contains(&b));
        let named = text.split_once('=').filter(|(name, options)| is_name(name) && !options.is_empty());
        let (name, options) =
            named.ok_or("NAME=OPTIONS is expected, such as card=w=640&format=webp; a name has letters, digits, - and _")?;
        Ok(Self { name: name.to_owned(), options: form_urlencoded::parse(options.as_bytes()).into_owned().collect() })
    }
}

/// The presets of a server.
#[derive(Clone, Debug, Default)]
pub struct Presets {
    views: BTreeMap<String, Parameters>,
    photos: BTreeMap<String, Parameters>,
    only: bool,
}

impl Presets {
    /// Checks presets. With `only`, callers without the rights of an administrator may give no other options.
    ///
    /// # Errors
    /// Names the preset whose options are neither those of a view nor those of a photo, or whose name is given twice.
    pub fn new(presets: &[Preset], only: bool, limits: &Limits) -> Result<Self, String> {
        let mut all = Self { only, ..Self::default() };
        for Preset { name, options } in presets {
            let is_of_photo = options.iter().any(|(option, _)| check_name(option, "").is_ok());
            let checked = if is_of_photo {
                of_query(&Self::default(), true, options).map(drop)
            } else {
                ViewQuery::of_film(options.clone(), limits).map(drop)
            };
            checked.map_err(|problem| format!("the preset {name}: {}", problem.detail))?;
            let kind = if is_of_photo { &mut all.photos } else { &mut all.views };
            if kind.insert(name.clone(), options.clone()).is_some() {
                return Err(format!("the preset {name} is given twice"));
            }
        }
        Ok(all)
    }

    /// Whether other options are for callers with the rights of an administrator.
    pub const fn are_exclusive(&self) -> bool {
        self.only
    }

    /// The name of each preset, and what its options are of: `view`, `film` or `photo`.
    pub fn names(&self) -> impl Iterator<Item = (&str, &'static str)> {
        let kind = |options: &Parameters| if options.iter().any(|(option, _)| option == "path") { "film" } else { "view" };
        let views = self.views.iter().map(move |(name, options)| (name.as_str(), kind(options)));
        views.chain(self.photos.keys().map(|name| (name.as_str(), "photo")))
    }

    /// Replaces a preset among the parameters of a view or film by its options; other options need `free`.
    ///
    /// # Errors
    /// 400 if the preset is unknown or given twice, 403 that names another option.
    pub fn expand(&self, pairs: Parameters, free: bool) -> Result<Parameters, Problem> {
        let (named, mut rest): (Parameters, Parameters) = pairs.into_iter().partition(|(name, _)| name == PRESET);
        if let Some((option, _)) = rest.iter().find(|(name, _)| !free && name != "v") {
            return Err(refused(option));
        }
        match named.as_slice() {
            [] => {}
            [(_, name)] => rest.extend_from_slice(find(&self.views, name)?),
            _ => return Err(Problem::parameter(PRESET, "is given twice")),
        }
        Ok(rest)
    }

    /// The options of a preset for photos.
    ///
    /// # Errors
    /// 400 if it is unknown.
    pub fn of_photo(&self, name: &str) -> Result<&[(String, String)], Problem> {
        find(&self.photos, name)
    }
}

/// Only presets are allowed, and this is an option.
pub fn refused(option: &str) -> Problem {
    Problem::new(StatusCode::FORBIDDEN, "presets-only", "this server takes no options but its presets (--presets-only)").field(option)
}

/// The options of a preset.
fn find<'a>(presets: &'a BTreeMap<String, Parameters>, name: &str) -> Result<&'a [(String, String)], Problem> {
    presets.get(name).map(Vec::as_slice).ok_or_else(|| {
        let known = if presets.is_empty() { "none".to_owned() } else { presets.keys().cloned().collect::<Vec<_>>().join(", ") };
        Problem::parameter(PRESET, format!("there is no such preset here; there are {known}"))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wrong_presets_are_named() {
        let read = |all: &[&str]| {
            let all: Vec<Preset> = all.iter().map(|text| text.parse()).collect::<Result<_, _>>()?;
            Presets::new(&all, false, &Limits::default())
        };
        assert!(read(&["card=w=640&h=400&format=webp", "loop=path=orbit&frames=30", "card=planes=8&max_size=900&title=A%20b"]).is_ok());
        for (all, words) in [
            (&["card"][..], "NAME=OPTIONS"),
            (&["card="], "NAME=OPTIONS"),
            (&["=w=640"], "NAME=OPTIONS"),
            (&["a card=w=640"], "NAME=OPTIONS"),
            (&["card=w=0"], "the preset card: w: "),
            (&["card=w=8&w=8"], "the preset card: w: "),
            (&["card=width=8"], "the preset card: width: "),
            (&["card=v=8"], "the preset card: v: "),
            (&["card=preset=card"], "the preset card: preset: "),
            (&["small=planes=many"], "the preset small: planes: "),
            (&["small=max-size=8&max_size=8"], "the preset small: max_size: "),
            (&["small=planes=8&w=3"], "the preset small: w: "),
            (&["card=w=8", "card=w=9"], "the preset card is given twice"),
        ] {
            let told = read(all).unwrap_err();
            assert!(told.contains(words), "{all:?}: {told}");
        }
    }
}
