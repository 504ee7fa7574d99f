//! Ways to send a scene.

use std::sync::Arc;

use image::ImageFormat;

use super::ZSTD_MOST;
use super::avif::{self, Pixels};
use super::layers::{Packing, texels, with_texels};
use crate::bench::BenchError;
use tmpi_core::container::{self, Carried, Carries, HiddenAs, encode_jpeg, encode_lossless};
use tmpi_core::{DisparityMap, Geometry, Scene};
use tmpi_pipeline::depth;

/// What is sent.
pub struct Source {
    pub geometry: Geometry,
    /// The scene before any coding: layers of the photo's pixels as they were uploaded.
    pub scene: Arc<Scene>,
    /// The uploaded file where the container carries it as it is.
    pub kept: Option<Carried>,
    /// Quality at which the photo is carried else.
    pub quality: u8,
    pub disparity: DisparityMap,
    /// All texels of the scene, and where they lie in one picture.
    texels: Vec<[u8; 4]>,
    packing: Packing,
}

impl Source {
    pub fn new(geometry: Geometry, scene: Arc<Scene>, kept: Option<Carried>, quality: u8, disparity: DisparityMap) -> Self {
        let (texels, packing) = (texels(&scene), Packing::new(&scene.layers));
        Self { geometry, scene, kept, quality, disparity, texels, packing }
    }

    fn carried(&self) -> Result<Carried, BenchError> {
        Ok(match &self.kept {
            Some(kept) => kept.clone(),
            None => Carried::from_photo(&self.scene.photo, self.quality)?,
        })
    }

    fn container(&self, hidden: Option<HiddenAs>) -> Result<Vec<u8>, BenchError> {
        Ok(container::encode(&self.geometry, &self.scene, &self.carried()?, Carries { alpha: false, hidden })?.0)
    }

    /// The container with labels in bands of so many rows of tiles, or in one stream.
    pub fn container_in(&self, rows: Option<u32>) -> Result<Vec<u8>, BenchError> {
        Ok(container::encode_in(rows, &self.geometry, &self.scene, &self.carried()?, Carries::default())?.0)
    }

    fn alpha(&self) -> Result<Vec<u8>, BenchError> {
        zstd::bulk::compress(&self.texels.iter().map(|t| t[3]).collect::<Vec<_>>(), ZSTD_MOST)
            .map_err(|e| BenchError::Picture(e.to_string()))
    }

    /// Colours of a picture with the scene's own alpha.
    fn joined(&self, colours: &[[u8; 3]], alpha: &[u8]) -> Arc<Scene> {
        let rgb = self.packing.unpack(&self.scene.layers, colours, self.texels.len());
        let rgba: Vec<[u8; 4]> = rgb.iter().zip(alpha).map(|(c, &a)| [c[0], c[1], c[2], a]).collect();
        with_texels(&self.scene, &rgba)
    }
}

/// A way to send a scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Way {
    /// The container as it is shipped.
    Ours,
    /// The container with hidden colours carried as JPEG.
    HiddenJpeg,
    /// The same without loss.
    HiddenPng,
    /// The same without loss.
    HiddenWebp,
    /// The same as AVIF.
    HiddenAvif,
    /// RGBA8 of all layers by zstd at this level.
    Zstd(i32),
    /// All layers in one picture.
    Png,
    /// The same.
    WebpLossless,
    /// Colours of all layers as JPEG, alpha by zstd.
    Jpeg,
    /// Lossy WebP with alpha without loss.
    Webp,
    /// Colours of all layers as AVIF, alpha as another without loss.
    Avif,
    /// Photo and 16-bit disparity, as viewers that bend one mesh take it: no layers, nothing behind anything.
    PhotoAndDepth,
}

impl Way {
    /// All of them, the container first; those of AVIF where it can be written.
    pub fn all(avif: bool) -> Vec<Self> {
        let mut all = vec![Self::Ours, Self::HiddenJpeg, Self::HiddenPng, Self::HiddenWebp, Self::HiddenAvif];
        all.extend([1, 3, 9, ZSTD_MOST].map(Self::Zstd));
        all.extend([Self::Png, Self::WebpLossless, Self::Jpeg, Self::Webp, Self::Avif, Self::PhotoAndDepth]);
        all.retain(|way| avif || !matches!(way, Self::HiddenAvif | Self::Avif));
        all
    }

    pub fn name(self) -> String {
        match self {
            Self::Ours => "tmpi".into(),
            Self::HiddenJpeg => "tmpi, hidden as JPEG".into(),
            Self::HiddenPng => "tmpi, hidden as PNG".into(),
            Self::HiddenWebp => "tmpi, hidden as WebP lossless".into(),
            Self::HiddenAvif => "tmpi, hidden as AVIF".into(),
            Self::Avif => "layers, AVIF + AVIF alpha".into(),
            Self::Zstd(level) => format!("layers, zstd -{level}"),
            Self::Png => "layers, PNG".into(),
            Self::WebpLossless => "layers, WebP lossless".into(),
            Self::Jpeg => "layers, JPEG + zstd alpha".into(),
            Self::Webp => "layers, WebP lossy + alpha".into(),
            Self::PhotoAndDepth => "photo + 16-bit depth PNG".into(),
        }
    }

    /// Ending of a file of it.
    pub fn extension(self) -> &'static str {
        match self {
            Self::Ours | Self::HiddenJpeg | Self::HiddenPng | Self::HiddenWebp => "tmpi",
            Self::Zstd(_) => "zst",
            Self::Png => "png",
            Self::WebpLossless | Self::Webp => "webp",
            Self::Jpeg | Self::HiddenAvif | Self::Avif | Self::PhotoAndDepth => "bin",
        }
    }

    /// True where a quality is to be chosen.
    pub fn lossy(self) -> bool {
        matches!(self, Self::HiddenJpeg | Self::HiddenAvif | Self::Jpeg | Self::Webp | Self::Avif)
    }

    /// The bytes, at `quality` 1 to 100 where one is to be chosen.
    pub fn encode(self, s: &Source, quality: u8) -> Result<Vec<u8>, BenchError> {
        let layers = &s.scene.layers;
        let (w, h) = (s.packing.width, s.packing.height);
        let lossless = |format| Ok(encode_lossless(format, w, h, s.packing.picture(layers, &s.texels).as_flattened())?);
        match self {
            Self::Ours => s.container(None),
            Self::HiddenJpeg => s.container(Some(HiddenAs::Jpeg(quality))),
            Self::HiddenPng => s.container(Some(HiddenAs::Png)),
            Self::HiddenWebp => s.container(Some(HiddenAs::Webp)),
            Self::HiddenAvif => hidden_as_avif(s, quality),
            Self::Avif => {
                let colours = avif::encode(s.packing.colours(&s.scene, &s.texels).as_flattened(), Pixels::Rgb, (w, h), quality)?;
                let alpha: Vec<u8> = s.packing.picture(layers, &s.texels).iter().map(|t| t[3]).collect();
                Ok(joined(&colours, &avif::encode(&alpha, Pixels::Grey, (w, h), quality)?))
            }
            Self::Zstd(level) => zstd::bulk::compress(s.texels.as_flattened(), level).map_err(|e| BenchError::Picture(e.to_string())),
            Self::Png => lossless(ImageFormat::Png),
            Self::WebpLossless => Ok(webp::lossless(&s.packing.picture(layers, &s.texels), w, h)),
            Self::Jpeg => {
                let colours = encode_jpeg(w, h, s.packing.colours(&s.scene, &s.texels).as_flattened(), quality)?;
                Ok(joined(&colours, &s.alpha()?))
            }
            Self::Webp => {
                let colours = s.packing.colours(&s.scene, &s.texels);
                let picture = s.packing.picture(layers, &s.texels);
                let joined: Vec<[u8; 4]> = colours.iter().zip(&picture).map(|(c, p)| [c[0], c[1], c[2], p[3]]).collect();
                Ok(webp::lossy(&joined, w, h, quality))
            }
            Self::PhotoAndDepth => {
                let photo = s.carried()?.bytes;
                let depth = depth::to_png(&s.disparity).map_err(|e| BenchError::Picture(e.to_string()))?;
                Ok([photo, depth].concat())
            }
        }
    }

    /// The scene of the bytes, none where they hold no layers. Where planes and rectangles are not in the bytes the source's are taken:
    /// they would add to the size of every way but ours.
    pub fn decode(self, s: &Source, bytes: &[u8]) -> Result<Option<Arc<Scene>>, BenchError> {
        let broken = |e: &dyn std::fmt::Display| BenchError::Picture(e.to_string());
        let picture = |format| -> Result<Vec<[u8; 4]>, BenchError> {
            let picture = image::load_from_memory_with_format(bytes, format).map_err(|e| broken(&e))?.into_rgba8();
            Ok(picture.as_raw().as_chunks().0.to_vec())
        };
        let scene = |picture: &[[u8; 4]]| with_texels(&s.scene, &s.packing.unpack(&s.scene.layers, picture, s.texels.len()));
        Ok(Some(match self {
            Self::Ours | Self::HiddenJpeg | Self::HiddenPng | Self::HiddenWebp => Arc::new(container::decode(bytes)?),
            Self::HiddenAvif => Arc::new(container::decode(&hidden_from_avif(bytes)?)?),
            Self::Avif => {
                let (colours, alpha) = parted(bytes)?;
                let size = (s.packing.width, s.packing.height);
                let colours = avif::decode(colours, Pixels::Rgb, size)?;
                let alpha = avif::decode(alpha, Pixels::Grey, size)?;
                let rgba: Vec<[u8; 4]> = colours.as_chunks().0.iter().zip(alpha).map(|(&[r, g, b], a)| [r, g, b, a]).collect();
                scene(&rgba)
            }
            Self::Zstd(_) => {
                let raw = zstd::bulk::decompress(bytes, s.texels.len() * 4).map_err(|e| broken(&e))?;
                with_texels(&s.scene, raw.as_chunks().0)
            }
            Self::Png => scene(&picture(ImageFormat::Png)?),
            Self::WebpLossless | Self::Webp => scene(&webp::decode(bytes)?),
            Self::Jpeg => {
                let (colours, alpha) = parted(bytes)?;
                let colours = image::load_from_memory_with_format(colours, ImageFormat::Jpeg).map_err(|e| broken(&e))?.into_rgb8();
                let alpha = zstd::bulk::decompress(alpha, s.texels.len()).map_err(|e| broken(&e))?;
                s.joined(colours.as_raw().as_chunks().0, &alpha)
            }
            Self::PhotoAndDepth => return Ok(None),
        }))
    }
}

/// Two files in one.
fn joined(first: &[u8], second: &[u8]) -> Vec<u8> {
    [&(first.len() as u32).to_le_bytes()[..], first, second].concat()
}

fn parted(bytes: &[u8]) -> Result<(&[u8], &[u8]), BenchError> {
    let parts = bytes.split_first_chunk().and_then(|(length, rest)| rest.split_at_checked(u32::from_le_bytes(*length) as usize));
    parts.ok_or_else(|| BenchError::Picture("cut off".into()))
}

/// The container without its picture of hidden colours, and that as AVIF. Readers know it as PNG: the times hold writing one and
/// reading it, some milliseconds.
fn hidden_as_avif(s: &Source, quality: u8) -> Result<Vec<u8>, BenchError> {
    let whole = s.container(Some(HiddenAs::Png))?;
    let sections = container::sections(&whole)?;
    let Some(hidden) = sections.iter().find(|s| s.kind == "hidden") else { return Ok(joined(&whole, &[])) };
    let png = &whole[hidden.offset as usize..(hidden.offset + hidden.length) as usize];
    let picture = image::load_from_memory_with_format(png, ImageFormat::Png).map_err(|e| BenchError::Picture(e.to_string()))?.into_rgb8();
    let (w, h) = picture.dimensions();
    let avif = avif::encode(picture.as_raw(), Pixels::Rgb, (w, h), quality)?;
    let size = [w.to_le_bytes(), h.to_le_bytes()].concat();
    Ok(joined(&container::select(&whole, &["photo", "planes", "labels"])?, &[size, avif].concat()))
}

fn hidden_from_avif(bytes: &[u8]) -> Result<Vec<u8>, BenchError> {
    let (container, picture) = parted(bytes)?;
    let Some((w, rest)) = picture.split_first_chunk() else { return Ok(container.to_vec()) };
    let (h, avif) = rest.split_first_chunk().ok_or_else(|| BenchError::Picture("cut off".into()))?;
    let (w, h) = (u32::from_le_bytes(*w), u32::from_le_bytes(*h));
    let rgb = avif::decode(avif, Pixels::Rgb, (w, h))?;
    let png = encode_lossless(ImageFormat::Png, w, h, &rgb)?;
    Ok(container::with_section(container, container::wire::Kind::Hidden, container::wire::Codec::Png, &png)?)
}

/// WebP by libwebp.
mod webp {
    use crate::bench::BenchError;

    pub fn lossless(rgba: &[[u8; 4]], w: u32, h: u32) -> Vec<u8> {
        webp::Encoder::from_rgba(rgba.as_flattened(), w, h).encode_lossless().to_vec()
    }

    pub fn lossy(rgba: &[[u8; 4]], w: u32, h: u32, quality: u8) -> Vec<u8> {
        webp::Encoder::from_rgba(rgba.as_flattened(), w, h).encode(f32::from(quality)).to_vec()
    }

    pub fn decode(bytes: &[u8]) -> Result<Vec<[u8; 4]>, BenchError> {
        let picture = webp::Decoder::new(bytes).decode().ok_or_else(|| BenchError::Picture("libwebp cannot read what it wrote".into()))?;
        Ok(if picture.is_alpha() {
            picture.as_chunks().0.to_vec()
        } else {
            picture.as_chunks().0.iter().map(|&[r, g, b]| [r, g, b, 255]).collect()
        })
    }
}
