//! A scene in forms that need no program of ours: a page that opens from disk, a glTF model, layers for editors of pictures, an archive
//! of the parts.

mod backdrop;
mod bands;
mod glb;
mod gltf;
mod html;
mod mesh;
mod ora;
mod pages;
mod script;
mod surface;
#[cfg(test)]
mod testing;
mod zip;

pub use glb::{ModelOptions, ModelShape, ModelTextures, glb};
pub use html::html;
pub use ora::{ORA_BYTES, ora};
pub use script::ScriptError;
pub use zip::zip;

use tmpi_core::Scene;
use tmpi_core::container::{self, ContainerError};
use tmpi_pipeline::depth::DepthError;

/// Export formats.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum ExportFormat {
    /// One page that carries viewer and photo in itself and opens from disk.
    #[default]
    Html,
    /// glTF 2.0, binary: textured polygons for any 3D program.
    Glb,
    /// `OpenRaster`: a few layers of the photo's size, for editors of pictures.
    Ora,
    /// Archive of the photo, all layers as PNG, disparity, planes.
    Zip,
}

impl ExportFormat {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::Html, Self::Glb, Self::Ora, Self::Zip];

    /// The format that a file name ending stands for: `html`, `glb`, `ora` or `zip`, in any case.
    #[must_use]
    pub fn from_extension(extension: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|format| extension.eq_ignore_ascii_case(format.extension()))
    }

    /// File name ending.
    #[must_use]
    pub const fn extension(self) -> &'static str {
        match self {
            Self::Html => "html",
            Self::Glb => "glb",
            Self::Ora => "ora",
            Self::Zip => "zip",
        }
    }

    /// Media type.
    #[must_use]
    pub const fn media_type(self) -> &'static str {
        match self {
            Self::Html => "text/html; charset=utf-8",
            Self::Glb => "model/gltf-binary",
            Self::Ora => "image/openraster",
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
    /// The viewer's scripts cannot be put into one page.
    #[error("the viewer's scripts: {0}")]
    Script(#[from] ScriptError),
    /// A picture cannot be written.
    #[error("writing a picture: {0}")]
    Picture(#[from] image::ImageError),
    /// A texture cannot be written.
    #[error("writing a texture: {0}")]
    WebP(String),
    /// The disparity cannot be written.
    #[error(transparent)]
    Disparity(#[from] DepthError),
    /// The archive cannot be written.
    #[error("writing an archive: {0}")]
    Archive(#[from] ::zip::result::ZipError),
    /// A part cannot be written to the archive.
    #[error("writing an archive: {0}")]
    Write(#[from] std::io::Error),
    /// A description cannot be written as JSON.
    #[error("writing JSON: {0}")]
    Json(#[from] serde_json::Error),
    /// The export was cancelled.
    #[error("the export was cancelled")]
    Cancelled,
    /// The result would be larger than its format can hold.
    #[error("the scene is too large for a {0} file")]
    TooLarge(&'static str),
}

/// Options of some formats.
#[derive(Clone, Copy, Debug, Default)]
pub struct ExportOptions<'a> {
    /// Title of a page.
    pub title: &'a str,
    /// Options of a model.
    pub model: ModelOptions,
}

/// Writes `scene`, which is what `container` decodes to, in `format`. `cancelled` is asked before each layer or page of them.
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
        ExportFormat::Zip => zip(container, scene, cancelled),
    }
}

/// The photo's file as a container carries it.
struct PhotoFile<'a> {
    /// Place in the container.
    range: std::ops::Range<usize>,
    bytes: &'a [u8],
    /// `jpeg`, `png` or `webp`.
    codec: &'static str,
}

impl PhotoFile<'_> {
    fn media_type(&self) -> &'static str {
        match self.codec {
            "png" => "image/png",
            "webp" => "image/webp",
            _ => "image/jpeg",
        }
    }

    fn extension(&self) -> &'static str {
        match self.codec {
            "png" => "png",
            "webp" => "webp",
            _ => "jpg",
        }
    }
}

fn photo_file(container: &[u8]) -> Result<PhotoFile<'_>, ExportError> {
    let sections = container::sections(container)?;
    let photo = sections.iter().find(|s| s.kind == "photo").ok_or_else(|| ContainerError::Broken("there is no photo section".into()))?;
    let range = photo.offset as usize..(photo.offset + photo.length) as usize;
    let bytes = container.get(range.clone()).ok_or_else(|| ContainerError::Broken("the photo is cut off".into()))?;
    Ok(PhotoFile { range, bytes, codec: photo.codec })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn endings_and_formats_are_one_to_one() {
        for format in ExportFormat::ALL {
            assert_eq!(ExportFormat::from_extension(&format.extension().to_uppercase()), Some(format));
        }
        assert_eq!(ExportFormat::from_extension("gltf"), None);
    }

    #[test]
    fn a_broken_container_is_an_error() {
        assert!(matches!(html(b"TMPI", "x"), Err(ExportError::Atlas(_))));
    }
}
