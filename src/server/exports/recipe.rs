//! The recipe of an export file: its format and parameters.

use super::query::ExportQuery;
use crate::export::{ExportFormat, ModelOptions, ORA_BYTES};
use crate::server::finished_photo::FinishedPhoto;
use crate::server::limits::Limits;
use crate::server::photo_options::value_name;
use crate::server::problem::Problem;
use crate::server::routes::{Pairs, ViewQuery};
use tmpi_render::{AnimationFormat, Arrangement, Path, StereoLayout};

/// Memory of a process that writes a file, in bytes, without the photo. This and the other figures are above those measured on 12
/// megapixels.
const PROCESS: u64 = 48 << 20;
/// Memory of textures and pictures besides the scene, in bytes a pixel.
const PICTURES: u64 = 20;
/// Memory of the renderer's scene and the frame of a film, besides the scene, in bytes a pixel.
const DRAWN: u64 = 14;
const FRAME: u64 = 16;
/// Memory of a page in multiples of the container: as bytes and as text.
const PAGE: u64 = 4;
/// Most bytes of scene work in the server's process: about a megapixel, which takes tenths of a second.
const CHEAP: u64 = 16 << 20;

/// How to make a file.
#[derive(Clone, Debug, PartialEq)]
pub enum Recipe {
    /// The photo in another format.
    File { format: ExportFormat, model: ModelOptions },
    /// A film along a path of the camera, with frames of this size.
    Film(Box<ViewQuery>, (u32, u32)),
}

impl Recipe {
    /// Reads the parameters of an export or, with `path`, of a view, for a photo of `size` pixels.
    ///
    /// # Errors
    /// 400 that names the first parameter that is unknown, given twice, wrong or over the limits.
    pub fn read(pairs: Vec<(String, String)>, size: (u32, u32), limits: &Limits) -> Result<Self, Problem> {
        if pairs.iter().any(|(name, _)| name == "path") {
            let query = ViewQuery::of_film(pairs, limits)?;
            let size = query.size(size, limits)?;
            return Ok(Self::Film(Box::new(query), size));
        }
        if let Some((_, film)) = pairs.iter().find(|(name, value)| name == "format" && AnimationFormat::from_extension(value).is_some()) {
            return Err(Problem::parameter("path", format!("is required for {film}: one of {}", Path::NAMES.join(", "))));
        }
        let query = ExportQuery::of(Pairs::of(pairs, &["format", "shape", "textures"])?)?;
        Ok(Self::File { format: query.format, model: query.model() })
    }

    /// Parses the text of [`Recipe::text`].
    pub fn parse(text: &str, limits: &Limits) -> Result<Self, Problem> {
        Self::read(form_urlencoded::parse(text.as_bytes()).into_owned().collect(), (1, 1), limits)
    }

    /// All parameters in canonical form.
    pub fn pairs(&self) -> Vec<(&'static str, String)> {
        match self {
            Self::File { format: ExportFormat::Glb, model: ModelOptions { shape, textures } } => {
                vec![("format", "glb".to_owned()), ("shape", value_name(shape)), ("textures", value_name(textures))]
            }
            Self::File { format, .. } => vec![("format", format.name().to_owned())],
            Self::Film(query, size) => film_pairs(query, *size),
        }
    }

    /// The canonical text, which names the file among those of one version of a photo.
    pub fn text(&self) -> String {
        self.pairs().iter().map(|(name, value)| format!("{name}={value}")).collect::<Vec<_>>().join("&")
    }

    /// Media type and extension of the file for a [`Recipe::text`], whatever the current limits are.
    pub fn kind(text: &str) -> Option<(&'static str, &'static str)> {
        let format = text.split('&').find_map(|part| part.strip_prefix("format="))?;
        let file = ExportFormat::from_name(format).map(|format| (format.media_type(), format.ending()));
        file.or_else(|| AnimationFormat::from_extension(format).map(|format| (format.media_type(), format.extension())))
    }

    /// Memory that the work takes besides the scene, in bytes.
    fn own(&self, done: &FinishedPhoto) -> u64 {
        let pixels = u64::from(done.width) * u64::from(done.height);
        match self {
            Self::File { format: ExportFormat::Html, .. } => PAGE * done.atlas_bytes,
            Self::File { format: ExportFormat::Ora, .. } => ORA_BYTES * pixels,
            Self::File { .. } => PICTURES * pixels,
            Self::Film(_, (width, height)) => DRAWN * pixels + FRAME * u64::from(*width) * u64::from(*height),
        }
    }

    /// Memory of a process that writes the file, in bytes.
    pub fn memory(&self, done: &FinishedPhoto) -> u64 {
        let scene = if matches!(self, Self::File { format: ExportFormat::Html, .. }) { 0 } else { done.scene_bytes() };
        PROCESS + scene + self.own(done)
    }

    /// Memory for a slot of work that writes the file, in bytes.
    pub fn slot_bytes(&self, done: &FinishedPhoto) -> u64 {
        let pixels = u64::from(done.width) * u64::from(done.height);
        done.scene_bytes() + if matches!(self, Self::File { format: ExportFormat::Ora, .. }) { ORA_BYTES * pixels } else { 0 }
    }

    /// Whether the server writes it in its own process, while the client waits: pages, which contain the container unchanged, and other
    /// files of small photos, but no films.
    pub fn is_cheap(&self, done: &FinishedPhoto) -> bool {
        match self {
            Self::File { format: ExportFormat::Html, .. } => true,
            Self::File { .. } => done.scene_bytes() <= CHEAP,
            Self::Film(..) => false,
        }
    }
}

fn film_pairs(query: &ViewQuery, (width, height): (u32, u32)) -> Vec<(&'static str, String)> {
    let q = query;
    let number = |v: Option<f64>| v.map(|v| v.to_string());
    // the default pose is the photo's
    let pose = |v: Option<f64>| number(v.filter(|v| *v != 0.0));
    let stereo = q.stereo.map(StereoLayout::name);
    let quilt = q.quilt.and_then(|quilt| match quilt {
        Arrangement::Quilt { columns, rows } => Some(format!("{columns}x{rows}")),
        Arrangement::Stereo(_) => None,
    });
    let crop = q.crop.map(|c| format!("{},{},{},{}", c.corner[0], c.corner[1], c.size[0], c.size[1]));
    let all = [
        ("path", q.film.map(|film| value_name(&film.path))),
        ("format", q.film.map(|film| film.format.extension().to_owned())),
        ("frames", q.film.map(|film| film.frames.to_string())),
        ("w", Some(width.to_string())),
        ("h", Some(height.to_string())),
        ("tx", pose(q.tx)),
        ("ty", pose(q.ty)),
        ("tz", pose(q.tz)),
        ("yaw", pose(q.yaw)),
        ("pitch", pose(q.pitch)),
        ("roll", pose(q.roll)),
        ("fov", number(q.fov)),
        ("crop", crop),
        ("stereo", stereo),
        ("quilt", quilt),
        ("ipd", number(q.ipd)),
        ("focus", number(q.focus)),
    ];
    all.into_iter().filter_map(|(name, value)| Some((name, value?))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<Recipe, Problem> {
        Recipe::read(form_urlencoded::parse(text.as_bytes()).into_owned().collect(), (80, 60), &Limits::default())
    }

    #[test]
    fn equal_recipes_have_one_text_which_reads_back() {
        for (asked, text) in [
            ("format=GLB", "format=glb&shape=relief&textures=plain"),
            ("textures=webp&shape=metric&format=glb", "format=glb&shape=metric&textures=webp"),
            ("format=zip", "format=zip"),
            ("path=orbit", "path=orbit&format=webp&frames=60&w=80&h=60"),
            ("frames=9&path=dolly-zoom&w=40&format=mp4&tx=0", "path=dolly-zoom&format=mp4&frames=9&w=40&h=30"),
            (
                "path=swing&w=20&h=10&tx=0.0300001&quilt=3x2&fov=60&focus=0.5&crop=0.25,0,0.5,1",
                "path=swing&format=webp&frames=60&w=20&h=10&tx=0.03&fov=60&crop=0.25,0,0.5,1&quilt=3x2&focus=0.5",
            ),
            (
                "path=zoom&w=8&stereo=anaglyph&ipd=0.05&yaw=-1.5",
                "path=zoom&format=webp&frames=60&w=8&h=6&yaw=-1.5&stereo=anaglyph&ipd=0.05",
            ),
        ] {
            let recipe = read(asked).unwrap();
            assert_eq!(recipe.text(), text);
            assert_eq!(Recipe::parse(text, &Limits::default()).unwrap().text(), text);
        }
    }

    #[test]
    fn a_stored_recipe_is_readable_under_any_limits() {
        let tight = Limits { view_side: 8, ..Limits::default() };
        for (asked, kind) in [
            ("format=html", ("text/html; charset=utf-8", "html")),
            ("shape=metric&format=glb", ("model/gltf-binary", "glb")),
            ("format=ora", ("image/openraster", "ora")),
            ("format=rgbd", ("image/png", "rgbd.png")),
            ("format=zip", ("application/zip", "zip")),
            ("path=orbit", ("image/webp", "webp")),
            ("path=orbit&format=mp4", ("video/mp4", "mp4")),
        ] {
            let text = read(asked).unwrap().text();
            assert_eq!(Recipe::kind(&text), Some(kind), "{text}");
            assert_eq!(Recipe::parse(&text, &tight).is_err(), text.starts_with("path"), "{text}");
        }
        assert_eq!(Recipe::kind("path=orbit"), None);
    }

    #[test]
    fn wrong_parameters_are_named() {
        for (asked, field) in [
            ("format=gif", "format"),
            ("format=png", "format"),
            ("format=mp4", "path"),
            ("format=webp", "path"),
            ("format=zip&w=3", "w"),
            ("path=orbit&v=1", "v"),
            ("path=orbit&format=zip", "format"),
            ("path=orbit&frames=241", "frames"),
            ("path=orbit&frames=240&w=2000&h=2000", "w"),
            ("path=orbit&quilt=10x10", "frames"),
            ("format=zip&shape=metric", "shape"),
            ("format=glb&format=glb", "format"),
        ] {
            let p = read(asked).unwrap_err();
            assert_eq!((p.status, p.field.as_deref()), (400, Some(field)), "{asked}: {}", p.detail);
        }
    }

    #[test]
    fn cheap_exports_are_small_and_memory_covers_measured_peaks() {
        let done = |width, height| FinishedPhoto { at_ms: 1, width, height, atlas_bytes: 400_000, atlas_hash: String::new() };
        let (small, large) = (done(1000, 1000), done(4000, 3000));
        for (asked, cheap) in [("format=html", [true, true]), ("format=glb", [true, false]), ("path=orbit", [false, false])] {
            let recipe = read(asked).unwrap();
            assert_eq!([recipe.is_cheap(&small), recipe.is_cheap(&large)], cheap, "{asked}");
        }
        // measured peaks at 12 megapixels: 323, 262, 400 and 309 MiB
        for (asked, peak) in [("format=glb", 323), ("format=zip", 262), ("format=ora", 400), ("path=orbit", 309)] {
            let memory = read(asked).unwrap().memory(&large) >> 20;
            assert!((peak..peak * 2).contains(&memory), "{asked}: {memory}");
        }
    }
}
