//! Layers of all tiles: masks and colours, and their refinement by a network.

use rayon::prelude::*;

use tmpi_core::container::{EncodedPhoto, HiddenCodec, OptionalSections, PhotoFormat};
use tmpi_core::{Class, DisparityMap, Geometry, MATTE_BAND, Photo, TexturedLayer, Uncoloured};

use super::{Placed, Prepared};
use crate::layers::{self, refine};
use crate::planes::Placement;
use crate::run::{Context, LeftOut, MakeError, Report, Switch};

/// Whether Ψ runs with [`Switch::Auto`]. It does not: with the shipped weights, it gains 0.03 dB of the 0.37 dB that exact hidden colours
/// would gain (`tmpi-lab bench --only without`), and the container would have to store its colours.
const REFINEMENT_HELPS: bool = false;

/// Layers of a photo.
#[derive(Clone, Debug)]
pub struct Layered {
    /// Tiles, with background planes.
    pub geometry: Geometry,
    /// Layers of each tile.
    pub tiles: Vec<Vec<TexturedLayer>>,
    /// The photo's file for the container.
    pub photo_file: EncodedPhoto,
    /// The photo as readers of that file see it.
    pub photo: Photo,
    /// What the container must store because it does not follow from photo, planes and labels.
    pub optional: OptionalSections,
}

/// Stage from planes and labels to layers with hidden colours, and to the photo's file for the container.
///
/// # Errors
/// [`MakeError`] if the photo cannot be encoded, or if there is no time left.
pub fn make_layers(context: &mut Context, prepared: &mut Prepared, placed: Placed, delta: &DisparityMap) -> Result<Layered, MakeError> {
    let stage = context.begin("layers")?;
    let Placed { mut geometry, placement } = placed;
    // the container stores the alphas of Ψ, whereas readers derive mattes from the photo
    geometry.matte_band = if refined(context) { 0 } else { MATTE_BAND };
    // encoding the photo uses one core; beside all that does not depend on colours and uses all cores, it adds little wall time
    let uploaded = prepared.uploaded.take();
    let file = || ChosenFile::choose(uploaded, prepared.format, &prepared.photo, context.options.quality);
    let uncoloured = || {
        layers::add_backgrounds(&mut geometry, delta);
        Uncoloured::of(&geometry)
    };
    let (uncoloured, file) = rayon::join(uncoloured, file);
    let ChosenFile { file: photo_file, photo } = file?;
    // mattes depend on the colours, so the layers are those of readers only with the colours that readers see
    let tiles = uncoloured.texture(&photo, &geometry);
    count(&mut context.report, &geometry, &tiles, &placement);
    context.end(stage);
    Ok(Layered { geometry, tiles, photo_file, photo, optional: OptionalSections::default() })
}

/// Stage that refines alphas and hidden colours with the network Ψ, if the options ask for it.
///
/// # Errors
/// [`MakeError`] if the network fails, or if there is no time left.
pub fn refine_layers(context: &mut Context, mut layered: Layered) -> Result<Layered, MakeError> {
    let stage = context.begin("refine")?;
    context.report.left_out.tiles_not_refined = layered.tiles.len();
    if refined(context)
        && let Some(psi) = &context.models.psi
    {
        let refined = refine::run(psi.as_ref(), &layered.photo, &layered.geometry, &mut layered.tiles)?;
        context.report.left_out.tiles_not_refined = refined.skipped;
        let hidden = refined.colours.then_some(HiddenCodec::Jpeg(context.options.quality));
        layered.optional = OptionalSections { alpha: true, hidden };
    }
    context.end(stage);
    Ok(layered)
}

/// Whether Ψ refines the layers.
fn refined(context: &Context) -> bool {
    let refine = context.options.refine;
    (refine == Switch::On || (refine == Switch::Auto && REFINEMENT_HELPS)) && context.models.psi.is_some()
}

/// Counts planes and texels, and those left out: planes against the most per tile, texels against layers as large as their tiles.
fn count(report: &mut Report, geometry: &Geometry, tiles: &[Vec<TexturedLayer>], placement: &Placement) {
    report.tiles = tiles.len();
    report.planes = tiles.iter().map(Vec::len).sum();
    report.planes_per_tile = report.planes as f64 / report.tiles.max(1) as f64;
    let placed: usize = geometry.tiles.iter().map(|t| t.planes.len()).sum();
    let full: usize = tiles.iter().zip(0..).map(|(layers, t)| layers.len() * geometry.grid.rect(t).area()).sum();
    let kept: usize = tiles.par_iter().flatten_iter().map(|l| present(&l.shape.class)).sum();
    report.texels = kept;
    report.error.unsearched_tiles = geometry.tiles_beyond_reach();
    report.left_out = LeftOut {
        planes: (report.tiles * placement.most as usize).saturating_sub(placed),
        tiles_not_refined: 0,
        texels: full.saturating_sub(kept),
        bytes: full.saturating_sub(kept) * 4,
    };
}

/// Number of texels that are not empty.
fn present(class: &[u8]) -> usize {
    // in bytes, which vectorise best, as long as they hold the count
    let count = |part: &[u8]| part.iter().map(|class| u8::from(*class != Class::Empty as u8)).sum::<u8>();
    class.chunks(usize::from(u8::MAX)).map(|part| usize::from(count(part))).sum()
}

/// The photo's file for the container, and the photo as readers of that file see it.
struct ChosenFile {
    file: EncodedPhoto,
    photo: Photo,
}

impl ChosenFile {
    /// Chooses the uploaded file, which shows `photo` exactly, if it is no larger than a new one at `quality`.
    fn choose(uploaded: Option<Vec<u8>>, format: PhotoFormat, photo: &Photo, quality: u8) -> Result<Self, MakeError> {
        let Some(bytes) = uploaded else { return Self::decoded(EncodedPhoto::from_photo(photo, quality)?) };
        match EncodedPhoto::shorter_than(bytes.len(), photo, quality)? {
            Some(anew) => Self::decoded(anew),
            None => Ok(Self { file: EncodedPhoto { bytes, format }, photo: photo.clone() }),
        }
    }

    fn decoded(file: EncodedPhoto) -> Result<Self, MakeError> {
        Ok(Self { photo: file.decode()?, file })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_photo_is_what_readers_of_the_chosen_file_see() {
        let original = Photo::from_fn(70, 50, |x, y| [(x * 37 + y * 101) as u8, (x * y) as u8, (x * 5) as u8]);
        let uploaded = EncodedPhoto::from_photo(&original, 60).unwrap();
        let photo = uploaded.decode().unwrap();
        for (bytes, quality, keeps) in [(Some(&uploaded.bytes), 95, true), (Some(&uploaded.bytes), 20, false), (None, 95, false)] {
            let ChosenFile { file, photo: seen } = ChosenFile::choose(bytes.cloned(), PhotoFormat::Jpeg, &photo, quality).unwrap();
            assert_eq!((file.bytes == uploaded.bytes, &seen), (keeps, &file.decode().unwrap()), "quality {quality}");
        }
    }
}
