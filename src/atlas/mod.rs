//! The container: a scene as bytes (DESIGN, section 5; schema in `proto/tmpi.proto`).

use crate::generate::Bytes;
use crate::photo::Format;
use crate::tmpi::Scene;

/// Why a container could not be written or read.
#[derive(Debug, thiserror::Error)]
pub enum AtlasError {
    /// The bytes are no container, damaged, or exceed a bound; the text names what and where.
    #[error("not a readable TMPI container: {0}")]
    Broken(String),
    /// The container is of a newer major version.
    #[error("the container is of version {found}; this program reads up to version {known}")]
    Newer {
        /// Major version found.
        found: u16,
        /// Major version known.
        known: u16,
    },
    /// A picture codec failed while writing.
    #[error("encoding a picture: {0}")]
    Encode(String),
}

/// The photo as it is carried in a container.
pub struct Carried {
    /// Picture file.
    pub bytes: Vec<u8>,
    /// Its format.
    pub format: Format,
}

/// Media type of a container.
pub const MEDIA_TYPE: &str = "application/vnd.tmpi";

/// Writes a container; `carried` is the photo's file, `quality` (1 to 100) that of the hidden colours.
///
/// # Errors
/// [`AtlasError::Encode`].
pub fn encode(scene: &Scene, carried: &Carried, quality: u8) -> Result<(Vec<u8>, Bytes), AtlasError> {
    let _ = (scene, carried, quality);
    Err(AtlasError::Encode("not written yet".into()))
}

/// Reads a container; trusts nothing in it. The scene returned passes [`Scene::validate`].
///
/// # Errors
/// [`AtlasError::Broken`] or [`AtlasError::Newer`].
pub fn decode(bytes: &[u8]) -> Result<Scene, AtlasError> {
    let _ = bytes;
    Err(AtlasError::Broken("not read yet".into()))
}
