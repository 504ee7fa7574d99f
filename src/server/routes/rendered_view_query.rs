//! Query parameters of a view.

use axum::http::Uri;

use super::query::{Pairs, decode};
use crate::server::limits::Limits;
use crate::server::problem::Problem;
use tmpi_core::{Camera, Intrinsics, Pose, Scene};
use tmpi_render::{AnimationFormat, Arrangement, EYE_DISTANCE, MotionRange, Path, PictureFormat, Rig, StereoLayout};

/// Allowed fields of view in degrees.
const FOV: std::ops::RangeInclusive<f64> = 0.1..=179.0;
/// Allowed distances of the first camera from the last.
const BASELINE: std::ops::RangeInclusive<f64> = 1e-4..=10.0;
/// Allowed disparities of the screen plane.
const FOCUS: std::ops::RangeInclusive<f64> = 0.0..=2.0;
/// Lengths of a pose are rounded to this, in units of the nearest distance, and angles to [`ANGLE_STEP`]: too little to move a pixel, so
/// poses that look the same share a cache entry.
const LENGTH_STEP: f64 = 1e-5;
/// Degrees.
const ANGLE_STEP: f64 = 1e-3;

/// Parameters of a view, without its version.
const NAMES: [&str; 17] =
    ["tx", "ty", "tz", "yaw", "pitch", "roll", "w", "h", "fov", "crop", "format", "stereo", "quilt", "ipd", "focus", "path", "frames"];
/// Allowed numbers of frames of an animation.
const FRAMES: std::ops::RangeInclusive<u32> = 2..=240;
/// Default number of frames: two seconds.
const USUAL_FRAMES: u32 = 60;
/// Number of frames that may each have as many pixels as a single view.
const FILM: u64 = 8;
/// Longest side of a WebP animation in pixels.
const WEBP_SIDE: u32 = 16_383;
/// Default longer side of an animation.
const USUAL_SIDE: u32 = 640;

/// A camera that moves.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FilmOptions {
    pub path: Path,
    pub frames: u32,
    pub format: AnimationFormat,
}

/// A part of a picture, in fractions of its width and height.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Crop {
    /// Left and upper border.
    pub corner: [f64; 2],
    /// Width and height, above 0.
    pub size: [f64; 2],
}

/// Smallest side of a crop as a fraction: about a pixel of the largest photo.
const MIN_CROP: f64 = 1e-4;

impl std::str::FromStr for Crop {
    type Err = &'static str;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        const WRONG: &str = "must be x,y,w,h, all from 0 to 1 and within the picture, w and h at least 0.0001";
        let numbers: Vec<f64> = text.split(',').map(|v| v.trim().parse().map_err(|_| WRONG)).collect::<Result<_, _>>()?;
        let &[x, y, w, h] = numbers.as_slice() else { return Err(WRONG) };
        // rounding may make it slightly too wide
        let within = |from: f64, length: f64| from >= 0.0 && length >= MIN_CROP && from + length <= 1.0 + MIN_CROP;
        if within(x, w) && within(y, h) { Ok(Self { corner: [x, y], size: [w, h] }) } else { Err(WRONG) }
    }
}

/// Camera and format of a view.
#[derive(Clone, Debug, Default, PartialEq, utoipa::IntoParams)]
#[into_params(parameter_in = Query)]
pub struct ViewQuery {
    /// Camera to the right, in units of the nearest distance; lengths are rounded to 0.00001.
    pub tx: Option<f64>,
    /// Camera down.
    pub ty: Option<f64>,
    /// Camera forward.
    pub tz: Option<f64>,
    /// Degrees to the right; angles are rounded to 0.001.
    pub yaw: Option<f64>,
    /// Degrees up.
    pub pitch: Option<f64>,
    /// Degrees clockwise.
    pub roll: Option<f64>,
    /// Width in pixels of each view. Without it: from `h` and the photo's aspect ratio; the photo's width if `h` is missing, too.
    #[param(minimum = 1, maximum = 16384)]
    pub w: Option<u32>,
    /// Height in pixels.
    #[param(minimum = 1, maximum = 16384)]
    pub h: Option<u32>,
    /// Horizontal field of view in degrees; that of the photo if it is not given.
    #[param(minimum = 0.1, maximum = 179.0)]
    pub fov: Option<f64>,
    /// `x,y,w,h`: only this part of the picture, in fractions of its width and height. `fov` still means the whole picture, while `w` and
    /// `h` mean the part.
    #[param(value_type = Option<String>, example = "0.25,0.25,0.5,0.5")]
    pub crop: Option<Crop>,
    /// `png`, `jpeg` or `webp`, or with `stereo=sbs` `mpo`; by `Accept` if it is not given. With `path`: `webp` (default) or `mp4`.
    #[param(value_type = Option<String>)]
    pub format: Option<PictureFormat>,
    /// The views of two eyes in one picture: `sbs` side by side, `half-sbs` at half the width, `crossed` for crossed eyes, `top-bottom`,
    /// `half-top-bottom`, `anaglyph` for red and cyan glasses, `anaglyph-grey`, `anaglyph-green-magenta` or `anaglyph-amber-blue`.
    #[param(value_type = Option<String>)]
    pub stereo: Option<StereoLayout>,
    /// `COLUMNSxROWS` views from left to right, starting at the lower left, for light-field displays; at most 100.
    #[param(value_type = Option<String>)]
    pub quilt: Option<Arrangement>,
    /// Distance of the first camera from the last, in units of the nearest distance. Default: 1/30 for stereo, the width of the view box
    /// but at most 0.06 for a quilt.
    #[param(minimum = 0.0001, maximum = 10.0)]
    pub ipd: Option<f64>,
    /// Disparity of the screen plane; nearer things appear in front of it. Default: that of the middle of the area.
    #[param(minimum = 0.0, maximum = 2.0)]
    pub focus: Option<f64>,
    /// `orbit`, `swing`, `dolly`, `dolly-zoom` or `zoom` (into the nearest thing): an animation along this path of the camera, 30 frames a
    /// second, with at most 640 pixels a side if you give no size. Needs ffmpeg on the server.
    #[param(value_type = Option<String>, rename = "path")]
    pub film: Option<FilmOptions>,
    /// Frames of an animation, 60 if it is not given.
    #[param(minimum = 2, maximum = 240)]
    pub frames: Option<u32>,
    /// Version as in the photo's `links`: browsers then cache the view for a year.
    #[param(rename = "v")]
    pub version: Option<String>,
}

impl ViewQuery {
    /// Reads the query.
    ///
    /// # Errors
    /// 400 that names the first parameter that is unknown, given twice, not finite or out of range.
    pub fn read(uri: &Uri, limits: &Limits) -> Result<Self, Problem> {
        Self::of_pairs(decode(uri)?, limits)
    }

    /// Like [`Self::read`], for parameters that are decoded already.
    ///
    /// # Errors
    /// As [`Self::read`].
    pub fn of_pairs(pairs: Vec<(String, String)>, limits: &Limits) -> Result<Self, Problem> {
        Self::of(Pairs::of(pairs, &[&NAMES[..], &["v"]].concat())?, limits)
    }

    /// Like [`Self::read`], for the parameters of a film, which has no version.
    pub fn of_film(pairs: Vec<(String, String)>, limits: &Limits) -> Result<Self, Problem> {
        Self::of(Pairs::of(pairs, &NAMES)?, limits)
    }

    fn of(mut given: Pairs, limits: &Limits) -> Result<Self, Problem> {
        let on_grid = |name: &str, step: f64| {
            let finite = |text: &str| text.parse().ok().filter(|v: &f64| v.is_finite());
            given.parse(name, "a finite number", finite).map(|number| number.map(|v| rounded(v, step)))
        };
        let [tx, ty, tz] = [on_grid("tx", LENGTH_STEP)?, on_grid("ty", LENGTH_STEP)?, on_grid("tz", LENGTH_STEP)?];
        let [yaw, pitch, roll] = [on_grid("yaw", ANGLE_STEP)?, on_grid("pitch", ANGLE_STEP)?, on_grid("roll", ANGLE_STEP)?];
        let (fov, ipd, focus) = (given.number("fov", &FOV)?, given.number("ipd", &BASELINE)?, given.number("focus", &FOCUS)?);
        let crop = given.typed("crop")?;
        let sides = 1..=limits.view_side;
        let (w, h) = (given.number("w", &sides)?, given.number("h", &sides)?);
        let path = given.choice("path")?;
        if path.is_none() && given.get("frames").is_some() {
            return Err(Problem::parameter("frames", "requires path"));
        }
        let frames = given.number("frames", &FRAMES)?;
        let film = path.map(|path| {
            let format = given.parse("format", "webp or mp4 with path", AnimationFormat::from_extension)?;
            let format = format.unwrap_or(AnimationFormat::WebP);
            Ok::<_, Problem>(FilmOptions { path, frames: frames.unwrap_or(USUAL_FRAMES), format })
        });
        let film = film.transpose()?;
        let still = || given.parse("format", "png, jpeg, webp or mpo", PictureFormat::from_extension);
        let format = if film.is_some() { None } else { still()? };
        let stereo = given.choice("stereo")?;
        let quilt = given.get("quilt").map(Arrangement::quilt).transpose().map_err(|e| Problem::parameter("quilt", e))?;
        if stereo.is_some() && quilt.is_some() {
            return Err(Problem::parameter("quilt", "cannot be combined with stereo"));
        }
        for (name, value) in [("ipd", ipd), ("focus", focus)] {
            if value.is_some() && stereo.is_none() && quilt.is_none() {
                return Err(Problem::parameter(name, "requires stereo or quilt"));
            }
        }
        if format == Some(PictureFormat::Mpo) && stereo != Some(StereoLayout::SideBySide) {
            return Err(Problem::parameter("format", "mpo requires stereo=sbs"));
        }
        let version = given.take("v");
        Ok(Self { tx, ty, tz, yaw, pitch, roll, w, h, fov, crop, format, stereo, quilt, ipd, focus, film, frames, version })
    }

    /// Size of each view of a photo of `photo` pixels. Without a size in the query, views of large photos are reduced to the limits.
    ///
    /// # Errors
    /// 400 if all views together are over the limits.
    pub fn size(&self, photo: (u32, u32), limits: &Limits) -> Result<(u32, u32), Problem> {
        let (columns, rows) = self.arrangement().map_or((1, 1), Arrangement::grid);
        self.renders_within(Limits::RENDERS)?;
        let (most_wide, most_high) = (limits.view_side / columns, limits.view_side / rows);
        let frames = self.film.map_or(1, |m| u64::from(m.frames));
        let most = limits.view_pixels / (u64::from(columns) * u64::from(rows)) * FILM / frames.max(FILM);
        let [cw, ch] = self.crop.map_or([1.0; 2], |c| c.size);
        let (pw, ph) = (f64::from(photo.0) * cw, f64::from(photo.1) * ch);
        let side = |v: f64| (v.round() as u32).clamp(1, limits.view_side);
        let (w, h) = match (self.w, self.h) {
            (Some(w), Some(h)) => (w, h),
            (Some(w), None) => (w, side(f64::from(w) * ph / pw)),
            (None, Some(h)) => (side(f64::from(h) * pw / ph), h),
            (None, None) => {
                let side = if self.film.is_some() { USUAL_SIDE } else { limits.view_side };
                let (most_wide, most_high) = (most_wide.min(side), most_high.min(side));
                let scale = (most as f64 / (pw * ph)).sqrt().min(f64::from(most_wide) / pw).min(f64::from(most_high) / ph).min(1.0);
                // rounded down, so that the product stays within the limit
                return Ok((((pw * scale) as u32).max(1), ((ph * scale) as u32).max(1)));
            }
        };
        let webp = self.film.is_some_and(|m| m.format == AnimationFormat::WebP);
        if webp && (w > WEBP_SIDE / columns || h > WEBP_SIDE / rows) {
            let field = if self.w.is_some() { "w" } else { "h" };
            return Err(Problem::parameter(field, format!("WebP animations have at most {WEBP_SIDE} pixels a side; format=mp4 has more")));
        }
        if w > most_wide || h > most_high || u64::from(w) * u64::from(h) > most {
            let field = if self.w.is_some() { "w" } else { "h" };
            let views = if (columns, rows) == (1, 1) { String::new() } else { format!("{columns}×{rows} views of ") };
            let limit = format!("{} pixels, {} a side", limits.view_pixels, limits.view_side);
            return Err(Problem::parameter(field, format!("{views}{w}×{h} is over the limit of {limit}")));
        }
        Ok((w, h))
    }

    /// Limits the number of pictures: each has a cost, however small it is.
    fn renders_within(&self, most: u32) -> Result<(), Problem> {
        let views = self.arrangement().map_or(1, Arrangement::views);
        let frames = self.film.map_or(1, |m| m.frames);
        if views * frames > most {
            let field = if self.film.is_some() { "frames" } else { "quilt" };
            return Err(Problem::parameter(field, format!("{frames} frames of {views} views are over the limit of {most} pictures")));
        }
        Ok(())
    }

    fn arrangement(&self) -> Option<Arrangement> {
        self.quilt.or(self.stereo.map(Arrangement::Stereo))
    }

    /// The cameras of stereo pictures and quilts.
    pub fn rig(&self, scene: &Scene) -> Option<Rig> {
        let arrangement = self.arrangement()?;
        let usual = if self.quilt.is_some() { (2.0 * scene.view_box.x).min(MotionRange::TRAVEL) } else { EYE_DISTANCE };
        Some(Rig { arrangement, baseline: self.ipd.unwrap_or(usual), focus: self.focus.unwrap_or_else(|| MotionRange::of(scene).pivot) })
    }

    /// The query without size, format and version: equal for equal cameras.
    pub fn canonical(&self) -> Self {
        Self { w: None, h: None, format: None, version: None, ..self.clone() }
    }

    pub fn camera(&self, scene: &Scene, (width, height): (u32, u32)) -> Camera {
        let of = |v: Option<f64>| v.unwrap_or(0.0);
        let pose =
            Pose { tx: of(self.tx), ty: of(self.ty), tz: of(self.tz), yaw: of(self.yaw), pitch: of(self.pitch), roll: of(self.roll) };
        let photo = (scene.grid.width, scene.grid.height);
        let intrinsics = match (self.fov, &self.crop) {
            (Some(fov), None) => Intrinsics::from_fov_x(width, height, fov),
            (None, None) => scene.intrinsics.resized(photo, (width, height)),
            (fov, Some(crop)) => {
                let whole = fov.map_or(scene.intrinsics, |fov| Intrinsics::from_fov_x(photo.0, photo.1, fov));
                part(&whole, photo, crop, (width, height))
            }
        };
        Camera { pose, intrinsics, width, height }
    }
}

/// Intrinsics of a picture of `size` that shows the part `crop` of a picture of `photo` pixels.
fn part(k: &Intrinsics, photo: (u32, u32), crop: &Crop, size: (u32, u32)) -> Intrinsics {
    let scale = f64::from(size.0) / (crop.size[0] * f64::from(photo.0));
    let centre = |c: f64, axis: usize, photo: u32, size: u32| {
        (c - (crop.corner[axis] + crop.size[axis] / 2.0) * f64::from(photo)) * scale + f64::from(size) / 2.0
    };
    Intrinsics { fx: k.fx * scale, fy: k.fy * scale, cx: centre(k.cx, 0, photo.0, size.0), cy: centre(k.cy, 1, photo.1, size.1) }
}

/// `v` rounded to multiples of `step`; unchanged if it is so large that rounding the result again could change it.
fn rounded(v: f64, step: f64) -> f64 {
    // by the reciprocal, so that decimal steps stay short
    let steps = (1.0 / step).round();
    let whole = (v * steps).round();
    if whole.abs() < (1_u64 << 50) as f64 { whole / steps } else { v }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(query: &str) -> Result<ViewQuery, Problem> {
        ViewQuery::read(&format!("/view?{query}").parse().unwrap(), &Limits::default())
    }

    #[test]
    fn a_crop_is_a_part_of_the_whole_picture() {
        let crop: Crop = "0.25,0.5,0.5,0.25".parse().unwrap();
        let k = Intrinsics { fx: 300.0, fy: 310.0, cx: 190.0, cy: 110.0 };
        let own = part(&k, (400, 200), &crop, (400, 100));
        // twice as large, with the part's corner at the picture's corner
        assert!((own.fx - 600.0).abs() < 1e-9 && (own.fy - 620.0).abs() < 1e-9, "{own:?}");
        assert!((own.cx - (190.0 - 100.0) * 2.0).abs() < 1e-9 && (own.cy - (110.0 - 100.0) * 2.0).abs() < 1e-9, "{own:?}");
        let all: Crop = "0,0,1,1".parse().unwrap();
        assert_eq!(part(&k, (400, 200), &all, (400, 200)), k);
    }

    #[test]
    fn wrong_parameters_are_named() {
        for (query, field) in [
            ("tx=NaN", "tx"),
            ("ty=inf", "ty"),
            ("tz=-Infinity", "tz"),
            ("yaw=left", "yaw"),
            ("pitch=", "pitch"),
            ("roll=1e999", "roll"),
            ("w=0", "w"),
            ("w=16385", "w"),
            ("h=-1", "h"),
            ("h=1.5", "h"),
            ("fov=0.09", "fov"),
            ("fov=179.1", "fov"),
            ("fov=NaN", "fov"),
            ("crop=0,0,1", "crop"),
            ("crop=0,0,1,0", "crop"),
            ("crop=0.6,0,0.5,1", "crop"),
            ("crop=-0.1,0,0.5,1", "crop"),
            ("crop=0,0,NaN,1", "crop"),
            ("format=gif", "format"),
            ("format=mpo", "format"),
            ("format=mpo&stereo=crossed", "format"),
            ("yew=3", "yew"),
            ("stereo=both", "stereo"),
            ("quilt=11x10", "quilt"),
            ("quilt=8x6&stereo=sbs", "quilt"),
            ("ipd=0.1", "ipd"),
            ("stereo=sbs&ipd=0", "ipd"),
            ("stereo=sbs&ipd=10.1", "ipd"),
            ("stereo=sbs&focus=2.1", "focus"),
            ("tx=1&tx=2", "tx"),
            ("path=spiral", "path"),
            ("path=orbit&format=png", "format"),
            ("format=mp4", "format"),
            ("frames=10", "frames"),
            ("path=orbit&frames=1", "frames"),
            ("path=orbit&frames=241", "frames"),
        ] {
            let p = read(query).unwrap_err();
            assert_eq!((p.status, p.field.as_deref()), (400, Some(field)), "{query}: {}", p.detail);
        }
    }

    #[test]
    fn poses_that_look_the_same_are_the_same() {
        assert_eq!(read("tx=0.0300001&yaw=1.0004").unwrap(), read("tx=0.03&yaw=1").unwrap());
        assert_ne!(read("tx=0.03001").unwrap(), read("tx=0.03").unwrap());
        assert_eq!(read("tx=1e305").unwrap().tx, Some(1e305), "too far away to be rounded");
    }

    #[test]
    fn pictures_are_counted_however_small() {
        let limits = Limits::default();
        let size = |query: &str| read(query).unwrap().size((60, 30), &limits);
        assert!(size("quilt=10x10&w=4&h=4").is_ok() && size("path=orbit&frames=240&stereo=sbs&w=4&h=4").is_ok());
        let p = size("quilt=10x10&path=orbit&frames=240&w=4&h=4").unwrap_err();
        assert_eq!((p.status, p.field.as_deref()), (400, Some("frames")));
        assert!(size("quilt=10x10&path=orbit&frames=4&w=4&h=4").is_ok());
        assert_eq!(size("quilt=10x10&path=orbit&frames=5&w=4&h=4").unwrap_err().status, 400);
    }

    #[test]
    fn sizes_over_the_webp_limit_are_refused() {
        let size = |query: &str| read(query).unwrap().size((60, 30), &Limits::default());
        assert_eq!(size("path=orbit&frames=8&w=16384&h=1").unwrap_err().field.as_deref(), Some("w"));
        assert!(size("path=orbit&frames=8&w=16383&h=1").is_ok() && size("path=orbit&frames=8&w=16384&h=1&format=mp4").is_ok());
    }

    #[test]
    fn sizes_at_the_limit_and_one_over() {
        let limits = Limits { view_pixels: 1000, view_side: 100, ..Limits::default() };
        let size = |w, h| ViewQuery { w, h, ..ViewQuery::default() }.size((60, 30), &limits);
        assert_eq!(size(Some(100), Some(10)).unwrap(), (100, 10));
        assert_eq!(size(Some(91), Some(11)).unwrap_err().field.as_deref(), Some("w"));
        assert_eq!(size(Some(40), None).unwrap(), (40, 20));
        assert_eq!(size(None, Some(10)).unwrap(), (20, 10));
        let quilt = |w, h| ViewQuery { w, h, quilt: Some(Arrangement::Quilt { columns: 5, rows: 2 }), ..ViewQuery::default() };
        assert_eq!(quilt(Some(20), Some(5)).size((60, 30), &limits).unwrap(), (20, 5));
        for (w, h) in [(21, 4), (20, 6)] {
            assert_eq!(quilt(Some(w), Some(h)).size((60, 30), &limits).unwrap_err().field.as_deref(), Some("w"));
        }
        let (w, h) = quilt(None, None).size((60, 30), &limits).unwrap();
        assert!(w * h <= 100 && w <= 20 && w * h > 80, "{w}×{h}");
        let (w, h) = size(None, None).unwrap();
        assert!(w * h <= 1000 && w * h > 800, "{w}×{h}");
        assert!(ViewQuery::read(&"/view?w=101".parse().unwrap(), &limits).is_err());
        assert!(ViewQuery::read(&"/view?w=100".parse().unwrap(), &limits).is_ok());
    }
}
