//! What is made of a photo: containers, views, exports.

use std::time::Duration;

use reqwest::header::{CONTENT_TYPE, ETAG, HeaderName, IF_NONE_MATCH};
use reqwest::{Method, StatusCode};
use tmpi_core::container::{self, ContainerError};
use tmpi_core::{Geometry, Photo, Rect, Scene};

use crate::client::Call;
use crate::{Client, Error};

/// An export may take the server ten minutes, and says nothing meanwhile.
const EXPORT: Duration = Duration::from_mins(10);

/// A part of a container.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Section {
    /// Cameras and where the others lie; always there.
    Index,
    /// The photo.
    Photo,
    /// Planes.
    Planes,
    /// Which plane each pixel is of.
    Labels,
    /// Coverage at edges.
    Alpha,
    /// What is hidden in the photo.
    Hidden,
}

impl Section {
    fn name(self) -> &'static str {
        container::SECTIONS[self as usize]
    }
}

/// Which container of a photo.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct AtlasQuery {
    /// 0 the photo's own size, 1 half of it, 2 a quarter, 3 an eighth.
    pub level: Option<u8>,
    /// In place of a level: the smallest whose longer side has at least so many pixels.
    pub fit: Option<u16>,
    /// Only the tiles over this rectangle, in pixels of the photo at its own size.
    pub region: Option<Rect>,
    /// Only these parts; all where there is none here.
    pub sections: Vec<Section>,
}

impl AtlasQuery {
    fn put(&self, mut call: Call) -> Call {
        if let Some(level) = self.level {
            call = call.parameter("level", level);
        }
        if let Some(fit) = self.fit {
            call = call.parameter("fit", fit);
        }
        if let Some(r) = self.region {
            call = call.parameter("region", format_args!("{},{},{},{}", r.x, r.y, r.w, r.h));
        }
        if !self.sections.is_empty() {
            let names: Vec<_> = self.sections.iter().map(|s| s.name()).collect();
            call = call.parameter("sections", names.join(","));
        }
        call
    }
}

/// A container, as the server sent it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Atlas {
    /// Its bytes: a `.tmpi` file.
    pub bytes: Vec<u8>,
    /// Strong entity tag of this level, region and choice of sections.
    pub etag: Option<String>,
}

impl Atlas {
    /// The scene, with all textures.
    ///
    /// # Errors
    /// It is damaged, of a later version, or lacks sections.
    pub fn scene(&self) -> Result<Scene, ContainerError> {
        container::decode(&self.bytes)
    }

    /// Photo and planes alone.
    ///
    /// # Errors
    /// As [`Atlas::scene`].
    pub fn read(&self) -> Result<(Photo, Geometry), ContainerError> {
        container::read(&self.bytes)
    }

    /// Where each section lies.
    ///
    /// # Errors
    /// The index is damaged.
    pub fn sections(&self) -> Result<Vec<container::SectionInfo>, ContainerError> {
        container::sections(&self.bytes)
    }
}

/// What a conditional request gives.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Fetched<T> {
    /// Another one than the caller has.
    New(T),
    /// The caller has it.
    Same,
}

/// Where the camera is: lengths in units of the nearest distance, angles in degrees.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Pose {
    /// To the right.
    pub tx: f64,
    /// Down.
    pub ty: f64,
    /// Forward.
    pub tz: f64,
    /// To the right.
    pub yaw: f64,
    /// Up.
    pub pitch: f64,
    /// Clockwise.
    pub roll: f64,
}

/// Format of a view.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Format {
    /// PNG.
    #[default]
    Png,
    /// JPEG.
    Jpeg,
    /// WebP; the one of animations where nothing is said.
    Webp,
    /// MP4, for animations; needs ffmpeg on the server.
    Mp4,
}

/// Several views in one picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stereo {
    /// Two side by side, the left eye's on the left.
    SideBySide,
    /// Two, for red and cyan glasses.
    Anaglyph,
    /// So many columns and rows, for light-field displays; at most 100 views.
    Quilt(u32, u32),
}

/// A part of a picture, in shares of its width and height.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Crop {
    /// Left.
    pub x: f64,
    /// Top.
    pub y: f64,
    /// Width.
    pub w: f64,
    /// Height.
    pub h: f64,
}

/// A camera that moves; needs ffmpeg on the server.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Motion {
    /// `orbit`, `swing`, `dolly`, `dolly-zoom` or `zoom`.
    pub path: String,
    /// Frames, 2 to 240, of which 30 are a second.
    pub frames: u32,
}

/// A view to draw; what is not given is the photo's.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct View {
    /// Where the camera is.
    pub pose: Pose,
    /// Width in pixels, 1 to 16384.
    pub w: Option<u32>,
    /// Height in pixels.
    pub h: Option<u32>,
    /// Horizontal field of view in degrees, 0.1 to 179.
    pub fov: Option<f64>,
    /// Only this part.
    pub crop: Option<Crop>,
    /// Format; PNG.
    pub format: Format,
    /// Several views in one picture.
    pub stereo: Option<Stereo>,
    /// From the first camera to the last, in units of the nearest distance.
    pub ipd: Option<f64>,
    /// Disparity that lies in the screen.
    pub focus: Option<f64>,
    /// An animation.
    pub motion: Option<Motion>,
}

impl View {
    fn put(&self, mut call: Call) -> Call {
        let Pose { tx, ty, tz, yaw, pitch, roll } = self.pose;
        for (name, value) in [("tx", tx), ("ty", ty), ("tz", tz), ("yaw", yaw), ("pitch", pitch), ("roll", roll)] {
            if value != 0.0 {
                call = call.parameter(name, value);
            }
        }
        let crop = self.crop.map(|c| format!("{},{},{},{}", c.x, c.y, c.w, c.h));
        let format = match (self.format, &self.motion) {
            (Format::Png, Some(_)) => None,
            (Format::Png, None) => Some("png"),
            (Format::Jpeg, _) => Some("jpeg"),
            (Format::Webp, _) => Some("webp"),
            (Format::Mp4, _) => Some("mp4"),
        };
        let (stereo, quilt) = match self.stereo {
            None => (None, None),
            Some(Stereo::SideBySide) => (Some("sbs"), None),
            Some(Stereo::Anaglyph) => (Some("anaglyph"), None),
            Some(Stereo::Quilt(columns, rows)) => (None, Some(format!("{columns}x{rows}"))),
        };
        let text = |v: Option<f64>| v.map(|v| v.to_string());
        let all = [
            ("w", self.w.map(|w| w.to_string())),
            ("h", self.h.map(|h| h.to_string())),
            ("fov", text(self.fov)),
            ("crop", crop),
            ("format", format.map(str::to_owned)),
            ("stereo", stereo.map(str::to_owned)),
            ("quilt", quilt),
            ("ipd", text(self.ipd)),
            ("focus", text(self.focus)),
            ("path", self.motion.as_ref().map(|m| m.path.clone())),
            ("frames", self.motion.as_ref().map(|m| m.frames.to_string())),
        ];
        all.into_iter().filter_map(|(name, value)| Some((name, value?))).fold(call, |call, (name, value)| call.parameter(name, value))
    }
}

/// A file to download.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Export {
    /// A page that opens from disk and moves.
    Html,
    /// A glTF 2.0 model that fits into the frame that viewers put around it.
    Glb,
    /// The same with far things far away.
    GlbMetric,
    /// An `OpenRaster` file of 3 to 8 layers.
    Ora,
    /// Photo, layers, disparity and planes.
    Zip,
}

/// A picture or a file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct File {
    /// Its bytes.
    pub bytes: Vec<u8>,
    /// Its media type.
    pub media_type: String,
    /// Its entity tag.
    pub etag: Option<String>,
}

impl Client {
    /// The container of a photo, or parts of it.
    ///
    /// # Errors
    /// [`Error::Refused`]: no such level, region or section (400), no such photo (404), not finished (409).
    pub async fn atlas(&self, id: &str, query: &AtlasQuery) -> Result<Atlas, Error> {
        match self.atlas_unless(id, query, None).await? {
            Fetched::New(atlas) => Ok(atlas),
            Fetched::Same => Err(Error::Answer("304 to a request without a condition".into())),
        }
    }

    /// The same, unless the caller has it already, by its entity tag.
    ///
    /// # Errors
    /// As [`Client::atlas`].
    pub async fn atlas_unless(&self, id: &str, query: &AtlasQuery, etag: Option<&str>) -> Result<Fetched<Atlas>, Error> {
        let mut call = query.put(self.photo(Method::GET, id, "/atlas")?);
        call.most = self.most_bytes();
        if let Some(etag) = etag {
            call = call.header(IF_NONE_MATCH, etag)?;
        }
        let answer = self.fetch(&call).await?;
        if answer.status == StatusCode::NOT_MODIFIED {
            return Ok(Fetched::Same);
        }
        Ok(Fetched::New(Atlas { etag: answer.header(&ETAG), bytes: answer.body }))
    }

    /// A view, drawn by the server.
    ///
    /// # Errors
    /// [`Error::Refused`]: a parameter is wrong (400), no such photo (404), not finished (409), no ffmpeg (501), too much waits (503).
    pub async fn view(&self, id: &str, view: &View) -> Result<File, Error> {
        self.file(view.put(self.photo(Method::GET, id, "/view")?)).await
    }

    /// The photo as a file to download.
    ///
    /// # Errors
    /// As [`Client::view`].
    pub async fn export(&self, id: &str, export: Export) -> Result<File, Error> {
        let (format, shape) = match export {
            Export::Html => ("html", None),
            Export::Glb => ("glb", None),
            Export::GlbMetric => ("glb", Some("metric")),
            Export::Ora => ("ora", None),
            Export::Zip => ("zip", None),
        };
        let mut call = self.photo(Method::GET, id, "/export")?.parameter("format", format);
        call.patience += EXPORT;
        self.file(shape.into_iter().fold(call, |call, shape| call.parameter("shape", shape))).await
    }

    /// JPEG of at most 320 pixels a side.
    ///
    /// # Errors
    /// [`Error::Refused`]: no such photo (404), not finished (409).
    pub async fn thumbnail(&self, id: &str) -> Result<File, Error> {
        self.file(self.photo(Method::GET, id, "/thumbnail")?).await
    }

    /// The disparity that the photo was made with: grey PNG of 16 bits, larger is nearer.
    ///
    /// # Errors
    /// [`Error::Refused`]: no such photo (404), not finished (409).
    pub async fn depth(&self, id: &str) -> Result<File, Error> {
        self.file(self.photo(Method::GET, id, "/depth")?).await
    }

    async fn file(&self, mut call: Call) -> Result<File, Error> {
        call.most = self.most_bytes();
        let answer = self.fetch(&call).await?;
        let header = |name: &HeaderName| answer.header(name);
        Ok(File { media_type: header(&CONTENT_TYPE).unwrap_or_default(), etag: header(&ETAG), bytes: answer.body })
    }
}
