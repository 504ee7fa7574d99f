//! The owner's settings for viewers: title, camera range and start, fixed disparity, preview view. Stored with the photo and changed by
//! JSON merge patches (RFC 7396).

use std::borrow::Cow;

use icu_normalizer::ComposingNormalizerBorrowed;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use super::problem::Problem;
use tmpi_core::ViewBox;
use tmpi_library::Photo;
use tmpi_render::{Path, looking_at};

/// Version of the settings that this program writes and reads.
pub const VERSION: u32 = 1;
/// Longest title, in characters.
pub const TITLE: usize = 200;
/// Names that programs give to photos without a name.
const NAMELESS: [&str; 6] = ["photo", "image", "picture", "blob", "file", "upload"];
/// Most bytes of a patch.
pub const PATCH_BYTES: usize = 16 << 10;
/// Allowed speeds, as multiples of the default.
pub const SPEED: [f64; 2] = [0.25, 4.0];
/// Default disparity that views turn about.
const PIVOT: f64 = 0.35;

/// A position in the view box, in units of its half extents.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Offset {
    /// Right.
    #[schema(minimum = -1.0, maximum = 1.0)]
    pub x: f64,
    /// Down.
    #[schema(minimum = -1.0, maximum = 1.0)]
    pub y: f64,
    /// Forward.
    #[schema(minimum = -1.0, maximum = 1.0)]
    pub z: f64,
}

/// Names of all idle motions.
pub fn idle_names() -> impl Iterator<Item = &'static str> {
    Path::NAMES.into_iter().chain(["none"])
}

/// Who may see a photo, with private access.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum Visibility {
    /// Only its owner.
    Private,
    /// Anyone with its address.
    Link,
}

/// Settings of a photo; missing ones are up to the viewer.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Settings {
    /// 1.
    #[schema(example = 1, required = false)]
    pub version: u32,
    /// Title of the photo, 1 to 200 characters.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(
        min_length = 1,
        max_length = 200,
        pattern = r"^[^\u0000-\u001f\u007f-\u009f]*[^\s\u0000-\u001f\u007f-\u009f][^\u0000-\u001f\u007f-\u009f]*$"
    )]
    pub title: Option<String>,
    /// Range of the camera, each 0 to 1 of the view box.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub motion: Option<Offset>,
    /// Disparity that stays in place while the camera moves, 0 (infinity) to 1 (the nearest thing).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 0, maximum = 1)]
    pub focus: Option<f64>,
    /// Start position of the camera, each −1 to 1 of the view box.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub start: Option<Offset>,
    /// Idle motion; `none` for no motion.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(example = "orbit")]
    pub idle: Option<String>,
    /// Speed of the idle motion, 0.25 to 4 times the default.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 0.25, maximum = 4.0)]
    pub speed: Option<f64>,
    /// Who may see the photo, with private access: `private` (default), only its owner, or `link`, anyone with its address.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub visibility: Option<Visibility>,
    /// Camera position of the preview view, each −1 to 1 of the view box.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub poster: Option<Offset>,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            version: VERSION,
            title: None,
            motion: None,
            focus: None,
            start: None,
            idle: None,
            speed: None,
            visibility: None,
            poster: None,
        }
    }
}

impl Settings {
    pub fn of(photo: &Photo) -> Self {
        serde_json::from_value(photo.settings.clone()).unwrap_or_else(|error| {
            tracing::error!(id = %photo.id, %error, "ignoring unreadable settings");
            Self::default()
        })
    }

    /// The settings as the library stores them.
    pub fn to_value(&self) -> Value {
        serde_json::to_value(self).unwrap_or_default()
    }

    /// These settings with the title and visibility that an upload of the same photo gives.
    pub fn overridden_by(&self, given: &Self) -> Self {
        let (title, visibility) = (given.title.clone().or_else(|| self.title.clone()), given.visibility.or(self.visibility));
        Self { title, visibility, ..self.clone() }
    }

    /// These settings with a merge patch: null removes a field, a missing one stays.
    pub fn patched(&self, patch: &[u8]) -> Result<Self, Problem> {
        let patch: Value = serde_json::from_slice(patch).map_err(|e| Problem::bad_request(format!("the body is not JSON: {e}")))?;
        let Value::Object(patch) = patch else { return Err(Problem::bad_request("the body must be a JSON object")) };
        let mut new = self.clone();
        for (name, value) in patch {
            new.set(&name, &value)?;
        }
        Ok(new)
    }

    /// Sets a field; null removes it.
    ///
    /// # Errors
    /// [`Problem`] 400 that names it: it is unknown, or its value is invalid.
    pub fn set(&mut self, name: &str, value: &Value) -> Result<(), Problem> {
        match name {
            "version" if value.as_u64() == Some(VERSION.into()) => {}
            "version" => return Err(Problem::parameter(name, format!("must be {VERSION}, not {value}"))),
            "title" => self.title = optional(value, |v| title(name, v))?,
            "motion" => self.motion = optional(value, |v| offset(name, v, self.motion, 1.0, 0.0))?,
            "focus" => self.focus = optional(value, |v| within(name, v, [0.0, 1.0]))?,
            "start" => self.start = optional(value, |v| offset(name, v, self.start, 0.0, -1.0))?,
            "idle" => self.idle = optional(value, |v| idle(name, v))?,
            "speed" => self.speed = optional(value, |v| within(name, v, SPEED))?,
            "visibility" => self.visibility = optional(value, |v| visibility(name, v))?,
            "poster" => self.poster = optional(value, |v| offset(name, v, self.poster, 0.0, -1.0))?,
            _ => {
                let detail = "there is no such setting; there are version, title, motion, focus, start, idle, speed, visibility, poster";
                return Err(Problem::parameter(name, detail));
            }
        }
        Ok(())
    }

    /// The camera of the preview view, as the start of a query; `None` if it is the photo's own.
    pub fn poster_pose(&self, view_box: &ViewBox) -> Option<String> {
        let at = self.poster?;
        let pose = looking_at(self.focus.unwrap_or(PIVOT), at.x * view_box.x, at.y * view_box.y, at.z * view_box.z);
        let number = |v: f64| v + 0.0;
        Some(format!(
            "tx={:.5}&ty={:.5}&tz={:.5}&yaw={:.3}&pitch={:.3}&",
            number(pose.tx),
            number(pose.ty),
            number(pose.tz),
            number(pose.yaw),
            number(pose.pitch)
        ))
    }
}

/// A title from a file name, without folders and extension; `None` if a program made up the name.
pub fn title_of_file(name: &str) -> Option<String> {
    // some browsers sent whole paths, with either kind of slash
    let name = name.rsplit(['/', '\\']).next().unwrap_or_default();
    let is_ending = |end: &str| (2..=5).contains(&end.len()) && end.bytes().all(|b| b.is_ascii_alphanumeric());
    let stem = name.rsplit_once('.').filter(|(_, end)| is_ending(end)).map_or(name, |(stem, _)| stem);
    let clean: String = composed(stem).chars().filter(|c| !c.is_control()).take(TITLE).collect();
    let clean = clean.trim();
    let nameless = clean.is_empty() || NAMELESS.iter().any(|n| clean.eq_ignore_ascii_case(n));
    (!nameless).then(|| clean.to_owned())
}

fn optional<T>(value: &Value, read: impl FnOnce(&Value) -> Result<T, Problem>) -> Result<Option<T>, Problem> {
    if value.is_null() { Ok(None) } else { read(value).map(Some) }
}

fn title(name: &str, value: &Value) -> Result<String, Problem> {
    let text = value.as_str().ok_or_else(|| Problem::parameter(name, format!("must be text, not {value}")))?;
    let text = composed(text.trim());
    let length = text.chars().count();
    if length == 0 || length > TITLE || text.chars().any(char::is_control) {
        return Err(Problem::parameter(name, format!("must have 1 to {TITLE} characters, none of them a control character")));
    }
    Ok(text.into_owned())
}

/// Text in Unicode form C, as people type it: macOS decomposes file names, and a search would not find them.
fn composed(text: &str) -> Cow<'_, str> {
    ComposingNormalizerBorrowed::new_nfc().normalize(text)
}

fn visibility(name: &str, value: &Value) -> Result<Visibility, Problem> {
    match value.as_str() {
        Some("private") => Ok(Visibility::Private),
        Some("link") => Ok(Visibility::Link),
        _ => Err(Problem::parameter(name, format!("must be one of private, link, not {value}"))),
    }
}

fn idle(name: &str, value: &Value) -> Result<String, Problem> {
    let wrong = || Problem::parameter(name, format!("must be one of {}, not {value}", idle_names().collect::<Vec<_>>().join(", ")));
    idle_names().find(|known| value == known).map(str::to_owned).ok_or_else(wrong)
}

fn within(name: &str, value: &Value, [least, most]: [f64; 2]) -> Result<f64, Problem> {
    let found = value.as_f64().filter(|v| (least..=most).contains(v));
    found.ok_or_else(|| Problem::parameter(name, format!("must be a number from {least} to {most}, not {value}")))
}

/// Axes from `least` to 1; a missing one keeps its value, or gets `usual`.
fn offset(name: &str, value: &Value, old: Option<Offset>, usual: f64, least: f64) -> Result<Offset, Problem> {
    let wrong = || Problem::parameter(name, format!("must be an object of x, y and z, not {value}"));
    let axes: &Map<String, Value> = value.as_object().ok_or_else(wrong)?;
    let mut new = old.unwrap_or(Offset { x: usual, y: usual, z: usual });
    for (axis, value) in axes {
        let field = format!("{name}.{axis}");
        let place = match axis.as_str() {
            "x" => &mut new.x,
            "y" => &mut new.y,
            "z" => &mut new.z,
            _ => return Err(Problem::parameter(field, "there is no such axis; there are x, y, z")),
        };
        *place = if value.is_null() { usual } else { within(&field, value, [least, 1.0])? };
    }
    Ok(new)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_patch_changes_what_it_names_and_null_removes() {
        let one = Settings::default().patched(br#"{"title": " A box ", "motion": {"x": 0.5}, "focus": 0.4, "start": {"y": -1}}"#).unwrap();
        assert_eq!(one.title.as_deref(), Some("A box"));
        assert_eq!(one.motion, Some(Offset { x: 0.5, y: 1.0, z: 1.0 }));
        assert_eq!((one.focus, one.start), (Some(0.4), Some(Offset { x: 0.0, y: -1.0, z: 0.0 })));
        let two = one.patched(br#"{"version": 1, "title": null, "motion": {"z": 0}}"#).unwrap();
        assert_eq!((two.title, two.motion, two.focus), (None, Some(Offset { x: 0.5, y: 1.0, z: 0.0 }), Some(0.4)));
        assert_eq!(serde_json::from_value::<Settings>(one.to_value()).unwrap(), one);
    }

    #[test]
    fn idle_motions_have_the_names_of_film_paths() {
        for name in Path::NAMES.into_iter().chain(["none"]) {
            let one = Settings::default().patched(format!(r#"{{"idle": "{name}", "speed": 4}}"#).as_bytes()).unwrap();
            assert_eq!((one.idle.as_deref(), one.speed), (Some(name), Some(4.0)));
            assert_eq!(serde_json::from_slice::<Settings>(&serde_json::to_vec(&one).unwrap()).unwrap(), one);
            assert_eq!(one.patched(br#"{"idle": null, "speed": null}"#).unwrap(), Settings::default());
        }
    }

    #[test]
    fn numbers_are_read_back_as_they_were_written() {
        let one = Settings::default().patched(br#"{"motion": {"x": 0.4, "y": 0}, "focus": 0.4444444444441444444}"#).unwrap();
        assert_eq!(serde_json::from_slice::<Settings>(&serde_json::to_vec(&one).unwrap()).unwrap(), one);
    }

    #[test]
    fn errors_name_their_field() {
        for (patch, field) in [
            (r#"{"titel": "x"}"#, Some("titel")),
            (r#"{"title": ""}"#, Some("title")),
            (r#"{"title": "a\u0007"}"#, Some("title")),
            (r#"{"title": 3}"#, Some("title")),
            (r#"{"motion": {"x": -0.1}}"#, Some("motion.x")),
            (r#"{"motion": {"w": 1}}"#, Some("motion.w")),
            (r#"{"motion": 1}"#, Some("motion")),
            (r#"{"focus": 1.01}"#, Some("focus")),
            (r#"{"focus": "near"}"#, Some("focus")),
            (r#"{"start": {"z": 1e999}}"#, None),
            (r#"{"start": {"z": 2}}"#, Some("start.z")),
            (r#"{"poster": {"y": -1.5}}"#, Some("poster.y")),
            (r#"{"idle": "spiral"}"#, Some("idle")),
            (r#"{"idle": 1}"#, Some("idle")),
            (r#"{"speed": 0.2}"#, Some("speed")),
            (r#"{"speed": 5}"#, Some("speed")),
            (r#"{"visibility": "all"}"#, Some("visibility")),
            (r#"{"version": 2}"#, Some("version")),
            ("[1]", None),
            ("{", None),
        ] {
            let p = Settings::default().patched(patch.as_bytes()).unwrap_err();
            assert_eq!((p.status, p.field.as_deref()), (400, field), "{patch}: {}", p.detail);
        }
        let long = format!(r#"{{"title": "{}"}}"#, "é".repeat(TITLE + 1));
        assert!(Settings::default().patched(long.as_bytes()).is_err());
        let fits = format!(r#"{{"title": "{}"}}"#, "é".repeat(TITLE));
        assert!(Settings::default().patched(fits.as_bytes()).is_ok());
    }

    #[test]
    fn a_file_name_becomes_the_title() {
        for (file, title) in [
            ("By the sea.jpg", Some("By the sea")),
            ("IMG_2041.HEIC", Some("IMG_2041")),
            ("C:\\fakepath\\Söhne.jpeg", Some("Söhne")),
            ("../../etc/a.b.png", Some("a.b")),
            ("v1.2 final", Some("v1.2 final")),
            ("a\u{0}b\n<script>.webp", Some("ab<script>")),
            ("image.jpg", None),
            ("Blob", None),
            (".jpg", None),
            (" \t.png", None),
            ("", None),
        ] {
            assert_eq!(title_of_file(file).as_deref(), title, "{file:?}");
        }
        let long = title_of_file(&"é".repeat(TITLE + 50)).unwrap();
        assert!(Settings::default().set("title", &long.into()).is_ok());
        assert_eq!(Settings::default().set("title", &"a\u{7}".into()).unwrap_err().field.as_deref(), Some("title"));
    }
}
