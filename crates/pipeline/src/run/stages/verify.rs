//! Compares what a container shows with what it was made from.

use std::ops::Range;

use tmpi_core::container::{self, OptionalSections, PhotoRows, TileLayers};
use tmpi_core::{Intrinsics, Layer, Photo, Rect, Scene};
use tmpi_render::difference::{psnr, psnr_of};
use tmpi_render::draw_reference_view;

use super::Encoded;
use crate::run::{Context, MakeError, PruneError, Stage, prune_error};

/// One of this many rows of tiles is drawn from the container: to draw all of them would take half as long as making.
const ROW_STEP: u32 = 12;

/// Stage that measures the errors of the container's photo, of the reference view that a reader draws, and of pruning.
#[derive(Debug, Default)]
pub struct Verify;

impl Stage for Verify {
    const NAME: &'static str = "verify";
    type Input<'a> = (&'a Photo, &'a Encoded);
    type Output = ();

    fn run(&mut self, (photo, made): (&Photo, &Encoded), context: &mut Context) -> Result<(), MakeError> {
        let all = context.options.verify_prune;
        let (reader, pruned) = rayon::join(|| reader_errors(photo, made), || pruned(made, all));
        let (reader, error) = (reader?, &mut context.report.error);
        (error.codec_psnr, error.identity_psnr, error.identity_tiles) = (reader.codec_psnr, reader.identity_psnr, reader.tiles);
        error.hidden_psnr = reader.hidden_psnr;
        error.prune = pruned?;
        Ok(())
    }
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
    if made.optional != OptionalSections::default() {
        // refined layers are stored for all tiles together, so no single row can be decoded
        let read = container::decode(&made.container)?;
        let hidden = || psnr(read.texels.hidden.as_flattened(), made.scene.texels.hidden.as_flattened());
        let mut difference = Difference::default();
        difference.add(photo.rgb.as_flattened(), &read, 0..photo.height)?;
        return Ok(ReaderErrors {
            codec_psnr,
            identity_psnr: difference.psnr(),
            tiles: made.geometry.tiles.len(),
            hidden_psnr: made.optional.hidden.map(|_| hidden()),
        });
    }
    let Photo { width, height, rgb } = made.scene.photo.clone();
    let rows = PhotoRows { width, height, top: 0, rgb };
    let (grid, mut difference, mut tiles) = (made.geometry.grid, Difference::default(), 0);
    for block in (0..grid.rows()).step_by(ROW_STEP as usize) {
        let row = block.midpoint((block + ROW_STEP).min(grid.rows()) - 1);
        let part = container::decode_rows(&made.container, &(row..row + 1), &rows, None)?;
        let (rect, scene) = alone(made, row, part, &rows);
        // rows of pixels that no other tiles overlap
        let from = if row == 0 { 0 } else { (row - 1) * grid.stride + grid.size };
        let to = if row + 1 == grid.rows() { height } else { (row + 1) * grid.stride };
        let own = from.min(to)..to;
        let want = &photo.rgb[own.start as usize * width as usize..own.end as usize * width as usize];
        difference.add(want.as_flattened(), &scene, own.start - rect.y..own.end - rect.y)?;
        tiles += grid.columns() as usize;
    }
    Ok(ReaderErrors { codec_psnr, identity_psnr: difference.psnr(), tiles, hidden_psnr: None })
}

/// A row of tiles as a scene of its own, and its rectangle in the photo.
fn alone(made: &Encoded, row: u32, part: TileLayers, photo: &PhotoRows) -> (Rect, Scene) {
    let grid = &made.geometry.grid;
    let (rect, own) = grid.part(0..grid.columns(), row..row + 1);
    let (k, width) = (made.geometry.intrinsics, rect.w as usize);
    let rgb = photo.rgb[rect.y as usize * width..(rect.y + rect.h) as usize * width].to_vec();
    let moved = |l: Layer| Layer { tile: l.tile - row * grid.columns(), rect: Rect { y: l.rect.y - rect.y, ..l.rect }, ..l };
    let scene = Scene {
        grid: own,
        intrinsics: Intrinsics { cy: k.cy - f64::from(rect.y), ..k },
        view_box: made.geometry.view_box,
        photo: Photo { width: rect.w, height: rect.h, rgb },
        layers: part.layers.into_iter().map(moved).collect(),
        texels: part.texels,
    };
    (rect, scene)
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
