//! Stored details of a finished photo.

use tmpi_library::{Part, Photo, PhotoState};

/// Memory of a decoded scene in bytes a pixel, measured on photographs and rounded up.
const SCENE_BYTES: u64 = 13;

#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FinishedPhoto {
    /// When, milliseconds since 1970 by the database's clock.
    pub at_ms: u64,
    /// Width of the scene in pixels.
    pub width: u32,
    /// Height of the scene in pixels.
    pub height: u32,
    /// Size of the container.
    pub atlas_bytes: u64,
    /// SHA-256 of the container in hex.
    pub atlas_hash: String,
}

impl FinishedPhoto {
    /// The details for the library.
    pub fn details(width: u32, height: u32) -> serde_json::Value {
        serde_json::json!({ "width": width, "height": height })
    }

    /// Memory for work on the scene, in bytes.
    pub fn scene_bytes(&self) -> u64 {
        SCENE_BYTES * u64::from(self.width) * u64::from(self.height) + self.atlas_bytes
    }

    /// Details of a photo; `None` if it is not finished.
    pub fn of(photo: &Photo) -> Option<Self> {
        let (details, container) = (photo.details.as_ref()?, photo.blobs.get(&Part::Container)?);
        let side = |name: &str| details.get(name)?.as_u64()?.try_into().ok();
        (photo.state == PhotoState::Done).then_some(())?;
        Some(Self {
            at_ms: photo.finished_at?.max(0) as u64,
            width: side("width")?,
            height: side("height")?,
            atlas_bytes: container.bytes,
            atlas_hash: container.digest.as_str().to_owned(),
        })
    }
}
