//! Exports scenes for use without tmpi: a page that opens from disk, a glTF model, layers for image editors, photo and depth side by side, an archive of the parts.

mod backdrop;
mod glb;
mod glb_writer;
mod html;
mod mesh;
mod ora;
mod rgbd;
mod script;
#[cfg(test)]
mod testing;
mod texture_atlas;
mod visible_surface;
mod zip;

pub use glb::{ModelOptions, ModelShape, ModelTextures, glb};
pub(crate) use html::escaped;
pub use html::html;
pub use ora::{ORA_BYTES, ora};
pub use rgbd::rgbd;
pub use zip::zip;

use tmpi_core::Scene;
use tmpi_core::container::{self, ContainerError};
use tmpi_pipeline::depth::DepthError;

/// Export formats.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum ExportFormat {
    /// A self-contained page with viewer and photo that opens from disk.
    #[default]
    Html,
    /// Binary glTF 2.0: textured polygons for any 3D program.
    Glb,
    /// `OpenRaster`: a few layers of the photo's size, for image editors.
    Ora,
    /// PNG of the photo and its depth map side by side (RGB-D), for light-field displays.
    Rgbd,
    /// ZIP archive of the photo, all layers as PNG, disparity and planes.
    Zip,
}

impl ExportFormat {
    /// All formats.
    pub const ALL: [Self; 5] = [Self::Html, Self::Glb, Self::Ora, Self::Rgbd, Self::Zip];

    /// The format of a file name extension: `html`, `glb`, `ora`, `png` or `zip`, in any case.
    pub fn from_extension(extension: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|format| format.ending().rsplit('.').next().is_some_and(|own| extension.eq_ignore_ascii_case(own)))
    }

    /// The format of a [`ExportFormat::name`], in any case.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|format| name.eq_ignore_ascii_case(format.name()))
    }

    /// Name in requests: `html`, `glb`, `ora`, `rgbd` or `zip`.
    pub fn name(self) -> &'static str {
        self.ending().split('.').next().unwrap_or_default()
    }

    /// Ending of a file's name; [`tmpi_pipeline::Stereo::of_name`] knows that of [`ExportFormat::Rgbd`].
    pub const fn ending(self) -> &'static str {
        match self {
            Self::Html => "html",
            Self::Glb => "glb",
            Self::Ora => "ora",
            Self::Rgbd => "rgbd.png",
            Self::Zip => "zip",
        }
    }

    /// Media type.
    pub const fn media_type(self) -> &'static str {
        match self {
            Self::Html => "text/html; charset=utf-8",
            Self::Glb => "model/gltf-binary",
            Self::Ora => "image/openraster",
            Self::Rgbd => "image/png",
            Self::Zip => "application/zip",
        }
    }
}

/// Why a scene could not be exported.
#[derive(Debug, thiserror::Error)]
pub enum ExportError {
    /// The container cannot be read.
    #[error(transparent)]
    Atlas(#[from] ContainerError),
    /// A picture cannot be written.
    #[error("cannot write a picture: {0}")]
    Picture(#[from] image::ImageError),
    /// A texture cannot be written.
    #[error("cannot write a texture: {0}")]
    WebP(String),
    /// The disparity cannot be written.
    #[error(transparent)]
    Disparity(#[from] DepthError),
    /// The archive cannot be written.
    #[error("cannot write the archive: {0}")]
    Archive(#[from] ::zip::result::ZipError),
    /// A part cannot be written to the archive.
    #[error("cannot write the archive: {0}")]
    Write(#[from] std::io::Error),
    /// A description cannot be written as JSON.
    #[error("cannot write JSON: {0}")]
    Json(#[from] serde_json::Error),
    /// The export was cancelled.
    #[error("the export was cancelled")]
    Cancelled,
    /// The result would exceed the format's size limit.
    #[error("the scene is too large for a {0} file")]
    TooLarge(&'static str),
}

/// Options for single formats.
#[derive(Clone, Copy, Debug, Default)]
pub struct ExportOptions<'a> {
    /// Title of the page (`html`).
    pub title: &'a str,
    /// Options of the model (`glb`).
    pub model: ModelOptions,
}

/// Exports `scene`, the decoded `container`, in `format`. Calls `cancelled` before each layer or texture page.
///
/// # Errors
/// [`ExportError`].
pub fn export(
    format: ExportFormat,
    container: &[u8],
    scene: &Scene,
    options: &ExportOptions<'_>,
    cancelled: &dyn Fn() -> bool,
) -> Result<Vec<u8>, ExportError> {
    match format {
        ExportFormat::Html => html(container, options.title),
        ExportFormat::Glb => glb(container, scene, options.model, cancelled),
        ExportFormat::Ora => ora(scene, cancelled),
        ExportFormat::Rgbd => rgbd(scene),
        ExportFormat::Zip => zip(container, scene, cancelled),
    }
}

/// The photo's file in a container.
struct PhotoFile<'a> {
    /// Byte range in the container.
    range: std::ops::Range<usize>,
    bytes: &'a [u8],
    media_type: &'static str,
    extension: &'static str,
}

fn photo_file(container: &[u8]) -> Result<PhotoFile<'_>, ExportError> {
    let sections = container::sections(container)?;
    let photo = sections.iter().find(|s| s.kind == "photo").ok_or_else(|| ContainerError::Broken("there is no photo section".into()))?;
    let range = photo.offset as usize..(photo.offset + photo.length) as usize;
    let bytes = container.get(range.clone()).ok_or_else(|| ContainerError::Broken("the photo is truncated".into()))?;
    let (media_type, extension) = match photo.codec {
        "png" => ("image/png", "png"),
        "webp" => ("image/webp", "webp"),
        _ => ("image/jpeg", "jpg"),
    };
    Ok(PhotoFile { range, bytes, media_type, extension })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn extensions_and_formats_match() {
        for format in ExportFormat::ALL {
            assert_eq!(ExportFormat::from_name(&format.name().to_uppercase()), Some(format));
        }
        let of = ["GLB", "png", "gltf", "rgbd"].map(ExportFormat::from_extension);
        assert_eq!(of, [Some(ExportFormat::Glb), Some(ExportFormat::Rgbd), None, None]);
    }
}
