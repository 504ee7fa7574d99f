//! Encodes containers.

use image::ImageFormat;
use prost::Message;

use super::schema::{Codec, Index, Kind, Section};
use super::select_sections::header;
use super::{
    ContainerError, EncodedPhoto, MAJOR, MINOR, bounds, columns, encode_jpeg, encode_lossless, hidden, label_bands, labels, planes,
};
use crate::{Geometry, Grid, MATTE_BAND, Scene};

/// zstd level; sections are small, so the highest ordinary level costs little time.
const LEVEL: i32 = 19;
/// Sections longer than this, in bytes, use a faster level: level 19 compresses about 3 MB/s.
const LARGE: usize = 2 << 20;
const LARGE_LEVEL: i32 = 9;

/// What a container carries in addition to photo, planes and labels, which determine everything else.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct OptionalSections {
    /// Soft alphas, if a network has refined them.
    pub alpha: bool,
    /// Hidden colours, if they differ from those of [`crate::Inpainter`].
    pub hidden: Option<HiddenCodec>,
}

/// Sizes of a container's sections in bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SectionBytes {
    /// The whole container.
    pub total: usize,
    /// Header, index and planes.
    pub index: usize,
    /// The photo.
    pub photo: usize,
    /// Labels and refined alphas.
    pub alpha: usize,
    /// Hidden colours.
    pub hidden: usize,
}

/// Codec for hidden colours.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HiddenCodec {
    /// JPEG with a quality from 1 to 100.
    Jpeg(u8),
    /// Lossless PNG.
    Png,
    /// Lossless WebP.
    Webp,
}

/// Encodes a container of `geometry`, with the parts of `scene` that `optional` selects. `photo_file` is the photo's file. Returns the
/// container and the sizes of its sections.
///
/// # Errors
/// [`ContainerError::Encode`] if a codec fails, or if a matted geometry is to carry alphas or hidden colours;
/// [`ContainerError::Bound`] if the geometry exceeds a limit of readers; [`ContainerError::Broken`] if the planes are inconsistent.
pub fn encode(
    geometry: &Geometry,
    scene: &Scene,
    photo_file: &EncodedPhoto,
    optional: OptionalSections,
) -> Result<(Vec<u8>, SectionBytes), ContainerError> {
    encode_in(label_bands::rows(&geometry.grid), geometry, scene, photo_file, optional)
}

/// Like [`encode`] with labels in bands of `rows` rows of tiles, or in a single stream for `None`.
///
/// # Errors
/// As in [`encode`].
pub fn encode_in(
    rows: Option<u32>,
    geometry: &Geometry,
    scene: &Scene,
    photo_file: &EncodedPhoto,
    optional: OptionalSections,
) -> Result<(Vec<u8>, SectionBytes), ContainerError> {
    bounds::geometry(geometry)?;
    if ![0, MATTE_BAND].contains(&geometry.matte_band) {
        return Err(ContainerError::Encode(format!("a container cannot have mattes {} pixels wide", geometry.matte_band)));
    }
    if geometry.matte_band > 0 && optional != OptionalSections::default() {
        return Err(ContainerError::Encode("a matted container must not carry alphas or hidden colours".into()));
    }
    let mut file = File::default();
    file.add(Kind::Photo, photo_file.format.codec(), photo_file.bytes.clone(), 0);
    let planes = columns::write(&geometry.tiles);
    let layout = planes::Layout::of(&geometry.grid, geometry.planes());
    let coded = planes::encode(&mut planes::Models::new(), layout, &planes)?;
    // zstd wins if planes repeat from tile to tile, as in drawings
    if packed(&planes)?.len() < coded.len() {
        file.add_packed(Kind::Planes, &planes)?;
    } else {
        file.add(Kind::Planes, Codec::Range, coded, planes.len() as u64);
    }
    let counts: Vec<u8> = geometry.tiles.iter().map(|t| t.planes.len() as u8).collect();
    let all: Vec<u8> = geometry.tiles.iter().flat_map(|t| &t.labels).copied().collect();
    file.add_labels(&geometry.grid, &counts, &all, rows);
    if optional.alpha {
        file.add_packed(Kind::Alpha, &refined_alpha(geometry, scene))?;
    }
    let (mut blocks, mut per_row) = (0, 0);
    if let Some(how) = optional.hidden {
        blocks = hidden::walk(&scene.layers, &scene.texels.class, |_, _, _| {});
        // an approximately square picture
        per_row = (blocks as f64).sqrt().ceil() as usize;
        if blocks > 0 {
            let (w, h, rgb) = hidden::paint(&scene.layers, &scene.texels.class, &scene.texels.hidden, blocks, per_row);
            let (codec, picture) = match how {
                HiddenCodec::Jpeg(quality) => (Codec::Jpeg, encode_jpeg(w, h, &rgb, quality)?),
                HiddenCodec::Png => (Codec::Png, encode_lossless(ImageFormat::Png, w, h, &rgb)?),
                HiddenCodec::Webp => (Codec::Webp, encode_lossless(ImageFormat::WebP, w, h, &rgb)?),
            };
            file.add(Kind::Hidden, codec, picture, 0);
        }
    }
    let (g, k, v) = (&scene.grid, &scene.intrinsics, &scene.view_box);
    let index = Index {
        width: g.width,
        height: g.height,
        tile_size: g.size,
        tile_stride: g.stride,
        fx: k.fx,
        fy: k.fy,
        cx: k.cx,
        cy: k.cy,
        view_x: v.x,
        view_y: v.y,
        view_z: v.z,
        planes: layout.planes as u32,
        hidden_blocks: blocks as u32,
        hidden_columns: per_row as u32,
        matted: geometry.matte_band > 0,
        sections: file.sections.clone(),
    };
    Ok(file.finish(&index))
}

/// For each soft texel, the difference (mod 256) between its alpha and the alpha derived from the geometry; empty if all are 0.
fn refined_alpha(geometry: &Geometry, scene: &Scene) -> Vec<u8> {
    let derived = geometry.masks().into_iter().flat_map(|s| s.layers).flat_map(|l| l.alpha);
    let soft =
        scene.texels.alpha.iter().zip(derived).filter(|(_, d)| (1..255).contains(d)).map(|(a, d)| a.wrapping_sub(d)).collect::<Vec<_>>();
    if soft.iter().all(|d| *d == 0) { Vec::new() } else { soft }
}

fn packed(raw: &[u8]) -> Result<Vec<u8>, ContainerError> {
    let level = if raw.len() > LARGE { LARGE_LEVEL } else { LEVEL };
    zstd::bulk::compress(raw, level).map_err(|e| ContainerError::Encode(e.to_string()))
}

#[derive(Default)]
struct File {
    sections: Vec<Section>,
    body: Vec<u8>,
}

impl File {
    fn add(&mut self, kind: Kind, codec: Codec, data: Vec<u8>, raw_length: u64) {
        self.sections.push(Section {
            kind: kind.into(),
            codec: codec.into(),
            offset: self.body.len() as u64,
            length: data.len() as u64,
            raw_length,
            bands: Vec::new(),
        });
        self.body.extend(data);
    }

    /// Adds the labels of all tiles in bands of `rows` rows of tiles, or in a single stream.
    fn add_labels(&mut self, grid: &Grid, counts: &[u8], all: &[u8], rows: Option<u32>) {
        let Some(rows) = rows else { return self.add(Kind::Labels, Codec::Range, labels::encode(grid, counts, all), 0) };
        let (data, bands) = label_bands::encode(grid, counts, all, rows);
        self.add(Kind::Labels, Codec::RangeBands, data, 0);
        if let Some(section) = self.sections.last_mut() {
            section.bands = bands;
        }
    }

    fn add_packed(&mut self, kind: Kind, raw: &[u8]) -> Result<(), ContainerError> {
        if raw.is_empty() {
            return Ok(());
        }
        self.add(kind, Codec::Zstd, packed(raw)?, raw.len() as u64);
        Ok(())
    }

    fn finish(self, index: &Index) -> (Vec<u8>, SectionBytes) {
        let index = index.encode_to_vec();
        let of = |kinds: &[Kind]| -> usize { self.sections.iter().filter(|s| kinds.contains(&s.kind())).map(|s| s.length as usize).sum() };
        let mut out = header(&[MAJOR.to_le_bytes(), MINOR.to_le_bytes()].concat(), &index);
        out.extend(&self.body);
        let bytes = SectionBytes {
            total: out.len(),
            index: 12 + index.len() + of(&[Kind::Planes]),
            photo: of(&[Kind::Photo]),
            alpha: of(&[Kind::Labels, Kind::Alpha]),
            hidden: of(&[Kind::Hidden]),
        };
        (out, bytes)
    }
}
