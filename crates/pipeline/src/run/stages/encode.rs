//! Encoding of the container.

use tmpi_core::container::{self, OptionalSections};
use tmpi_core::{Geometry, Scene, compose};

use super::Layered;
use crate::run::{Context, MakeError};

/// A scene and its container.
pub(crate) struct Encoded {
    /// The container.
    pub container: Vec<u8>,
    /// The scene in the container, with the photo as its readers see it.
    pub scene: Scene,
    /// Tiles, planes and labels of the scene.
    pub geometry: Geometry,
    /// What the container stores because it does not follow from photo, planes and labels.
    pub optional: OptionalSections,
}

/// Stage from layers to scene and container.
pub(crate) fn encode_scene(context: &mut Context, layered: Layered) -> Result<Encoded, MakeError> {
    let stage = context.begin("encode")?;
    let Layered { geometry, tiles, photo_file, photo, optional } = layered;
    let scene = compose(photo, &geometry, tiles);
    let (container, bytes) = container::encode(&geometry, &scene, &photo_file, optional)?;
    context.report.bytes = bytes.into();
    context.end(stage);
    Ok(Encoded { container, scene, geometry, optional })
}
