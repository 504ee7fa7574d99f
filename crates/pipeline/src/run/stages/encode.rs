//! Encoding of the container.

use tmpi_core::container::{self, OptionalSections};
use tmpi_core::{Geometry, Scene, compose};

use super::Layered;
use crate::run::{Context, MakeError, Stage};

/// Stage from layers to scene and container.
#[derive(Debug, Default)]
pub struct Encode;

/// A scene and its container.
#[derive(Clone, Debug)]
pub struct Encoded {
    /// The container.
    pub container: Vec<u8>,
    /// The scene in the container, with the photo as its readers see it.
    pub scene: Scene,
    /// Tiles, planes and labels of the scene.
    pub geometry: Geometry,
    /// What the container stores because it does not follow from photo, planes and labels.
    pub optional: OptionalSections,
}

impl Stage for Encode {
    const NAME: &'static str = "encode";
    type Input<'a> = Layered;
    type Output = Encoded;

    fn run(&mut self, layered: Layered, context: &mut Context) -> Result<Encoded, MakeError> {
        let Layered { geometry, tiles, photo_file, photo, optional } = layered;
        let scene = compose(photo, &geometry, tiles);
        let (container, bytes) = container::encode(&geometry, &scene, &photo_file, optional)?;
        context.report.bytes = bytes.into();
        Ok(Encoded { container, scene, geometry, optional })
    }
}
