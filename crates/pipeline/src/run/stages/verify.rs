//! Compares what a container shows with what it was made from.

use std::ops::Range;

use tmpi_core::container::{self, OptionalSections};
use tmpi_core::{Intrinsics, Layer, Photo, Rect, Scene, Texels};
use tmpi_render::difference::{psnr, psnr_of};
use tmpi_render::draw_reference_view;

use super::Encoded;
use crate::run::{Context, MakeError, PruneError, prune_error};

/// Most pixels of a photo that is drawn as a whole; with more, it would take too long compared to making.
const MOST_WHOLE: usize = 1 << 17;
/// Of a larger photo, one of this many rows of tiles is drawn.
const ROW_STEP: u32 = 12;

/// Stage that measures the errors of the container's photo, of the reference view that a reader draws, and of pruning.
pub(crate) fn verify_container(context: &mut Context, photo: &Photo, made: &Encoded) -> Result<(), MakeError> {
    let stage = context.begin("verify")?;
    let all = context.options.verify_prune;
    let (reader, pruned) = rayon::join(|| reader_errors(photo, made), || pruned(made, all));
    let (reader, error) = (reader?, &mut context.report.error);
    (error.codec_psnr, error.identity_psnr, error.identity_tiles) = (reader.codec_psnr, reader.identity_psnr, reader.tiles);
    error.hidden_psnr = reader.hidden_psnr;
    error.prune = pruned?;
    context.end(stage);
    Ok(())
}

fn pruned(made: &Encoded, all: bool) -> Result<Option<PruneError>, MakeError> {
    Ok(if all { Some(prune_error::verify(&made.geometry)?) } else { prune_error::sample(&made.geometry)? })
}

/// Errors of what a reader of the container draws.
struct ReaderErrors {
    codec_psnr: f64,
    identity_psnr: f64,
    /// Number of tiles in the drawn part of the reference view.
    tiles: usize,
    hidden_psnr: Option<f64>,
}

/// `photo` is the photo before it was encoded.
fn reader_errors(photo: &Photo, made: &Encoded) -> Result<ReaderErrors, MakeError> {
    let codec_psnr = psnr(made.scene.photo.rgb.as_flattened(), photo.rgb.as_flattened());
    // readers derive the layers that the scene has; only refined ones are stored, and their colours are compressed
    let read = if made.optional == OptionalSections::default() { None } else { Some(container::decode(&made.container)?) };
    let hidden = |read: &Scene| psnr(read.texels.hidden.as_flattened(), made.scene.texels.hidden.as_flattened());
    let hidden_psnr = read.as_ref().filter(|_| made.optional.hidden.is_some()).map(hidden);
    let (identity_psnr, tiles) = identity(photo, read.as_ref().unwrap_or(&made.scene))?;
    Ok(ReaderErrors { codec_psnr, identity_psnr, tiles, hidden_psnr })
}

/// PSNR of the reference view against the photo, over all tiles of a small photo, else over some rows of them; and their number.
fn identity(photo: &Photo, scene: &Scene) -> Result<(f64, usize), MakeError> {
    let (grid, mut difference, mut tiles) = (scene.grid, Difference::default(), 0);
    if photo.rgb.len() <= MOST_WHOLE {
        difference.add(photo.rgb.as_flattened(), scene, 0..photo.height)?;
        return Ok((difference.psnr(), grid.tiles() as usize));
    }
    let width = photo.width as usize;
    for block in (0..grid.rows()).step_by(ROW_STEP as usize) {
        let row = block.midpoint((block + ROW_STEP).min(grid.rows()) - 1);
        let (rect, part) = alone(scene, row);
        // rows of pixels that no other tiles overlap
        let from = if row == 0 { 0 } else { (row - 1) * grid.stride + grid.size };
        let to = if row + 1 == grid.rows() { photo.height } else { (row + 1) * grid.stride };
        let own = from.min(to)..to;
        let want = &photo.rgb[own.start as usize * width..own.end as usize * width];
        difference.add(want.as_flattened(), &part, own.start - rect.y..own.end - rect.y)?;
        tiles += grid.columns() as usize;
    }
    Ok((difference.psnr(), tiles))
}

/// A row of tiles as a scene of its own, and its rectangle in the photo.
fn alone(scene: &Scene, row: u32) -> (Rect, Scene) {
    let Scene { grid, intrinsics: k, view_box, photo, layers, texels } = scene;
    let (rect, own) = grid.part(0..grid.columns(), row..row + 1);
    // layers are sorted by tile
    let first = |row: u32| layers.partition_point(|l| l.tile < row * grid.columns());
    let (from, to) = (first(row), first(row + 1));
    let starts = |i: usize| layers.get(i).map_or((texels.class.len(), texels.hidden.len()), |l| (l.first_texel, l.first_hidden));
    let ((texel, hidden), (texel_end, hidden_end)) = (starts(from), starts(to));
    let moved = |l: &Layer| Layer {
        tile: l.tile - row * grid.columns(),
        rect: Rect { y: l.rect.y - rect.y, ..l.rect },
        first_texel: l.first_texel - texel,
        first_hidden: l.first_hidden - hidden,
        ..*l
    };
    let pixels = rect.y as usize * rect.w as usize;
    let part = Scene {
        grid: own,
        intrinsics: Intrinsics { cy: k.cy - f64::from(rect.y), ..*k },
        view_box: *view_box,
        photo: Photo { width: rect.w, height: rect.h, rgb: photo.rgb[pixels..pixels + rect.area()].to_vec() },
        layers: layers[from..to].iter().map(moved).collect(),
        texels: Texels {
            class: texels.class[texel..texel_end].to_vec(),
            alpha: texels.alpha[texel..texel_end].to_vec(),
            hidden: texels.hidden[hidden..hidden_end].to_vec(),
        },
    };
    (rect, part)
}

/// Accumulated squared differences of colours.
#[derive(Default)]
struct Difference {
    squares: f64,
    values: usize,
}

impl Difference {
    /// Adds `rows` of the reference view of `scene`, compared with the colours `want`.
    fn add(&mut self, want: &[u8], scene: &Scene, rows: Range<u32>) -> Result<(), MakeError> {
        let view = draw_reference_view(scene)?;
        let width = view.width as usize;
        let shown = view.rgba[rows.start as usize * width..rows.end as usize * width].iter().flat_map(|p| [p[0], p[1], p[2]]);
        self.squares += shown.zip(want).map(|(a, b)| f64::from(a.abs_diff(*b)).powi(2)).sum::<f64>();
        self.values += want.len();
        Ok(())
    }

    fn psnr(&self) -> f64 {
        psnr_of(self.squares / self.values.max(1) as f64)
    }
}
