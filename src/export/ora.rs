//! Exports a scene as a stack of full-size layers for image editors: `OpenRaster`, which Krita, GIMP, `MyPaint` and others read.

use std::io::{Cursor, Write};

use ::zip::write::SimpleFileOptions;
use ::zip::{CompressionMethod, ZipWriter};
use image::codecs::png::PngEncoder;
use image::{ExtendedColorType, ImageEncoder};

use super::visible_surface::{inpainted, visible_disparity};
use super::{ExportError, texture_atlas};
use tmpi_core::{Photo, Scene};
use tmpi_pipeline::depth::to_png;
use tmpi_pipeline::photo::{reduced_size, resize};
use tmpi_pipeline::planes::ClusterTable;

/// Range of the number of bands of disparity, unless the photo has fewer distances.
const BANDS: std::ops::RangeInclusive<usize> = 3..=8;
/// RMS deviation of δ from its band's mean above which another band is added.
const SPREAD: f64 = 0.06;

/// Alpha of a layer one and two pixels beyond its edge over farther layers. Its colour there is the photo's, so unmoved layers show the
/// photo.
const EDGE_ALPHA: [u8; 2] = [170, 85];
/// How far a layer continues behind nearer ones, as a fraction of the longer side; it fades over the second half.
const OVERLAP: f64 = 0.06;
/// Memory for writing beside the scene, in bytes per pixel: 25 for maps and the current layer, and up to 3 per layer for the archive.
pub const ORA_BYTES: u64 = 48;
/// Maximum side of the preview, set by the format.
const THUMBNAIL: u32 = 256;

/// Writes `scene` as an `OpenRaster` archive with 3 to 8 layers of the photo's size, or fewer if it has fewer distances. Each layer shows
/// one band of disparity.
///
/// The farthest layer covers the whole picture; the others continue a little behind nearer ones. Together they show the photo, within one
/// level of 255. The depth map is a hidden layer, and `depth.png` with 16 bits.
///
/// # Errors
/// [`ExportError`].
pub fn ora(scene: &Scene, cancelled: &dyn Fn() -> bool) -> Result<Vec<u8>, ExportError> {
    let (photo, map) = (&scene.photo, visible_disparity(scene));
    let (width, height) = (photo.width, photo.height);
    let bounds = bounds(&map.delta);
    let band: Vec<u8> = map.delta.iter().map(|d| bounds.iter().filter(|&b| d >= b).count() as u8).collect();
    let mut archive = ZipWriter::new(Cursor::new(Vec::new()));
    // pictures are already compressed, and the format requires an uncompressed `mimetype` at the start
    let stored = SimpleFileOptions::default().compression_method(CompressionMethod::Stored);
    let mut add = |name: &str, bytes: &[u8]| -> Result<(), ExportError> {
        archive.start_file(name, stored)?;
        archive.write_all(bytes)?;
        Ok(())
    };
    add("mimetype", b"image/openraster")?;
    let mut layers = Vec::new();
    for index in 0..=bounds.len() {
        if cancelled() {
            return Err(ExportError::Cancelled);
        }
        let file = format!("data/layer{index}.png");
        let limit = bounds.get(index).copied().unwrap_or(f32::INFINITY);
        add(&file, &texture_atlas::png(width, height, &layer(photo, &map.delta, &band, index as u8, limit))?)?;
        let word = if index == 0 {
            ", farthest"
        } else if index == bounds.len() {
            ", nearest"
        } else {
            ""
        };
        layers.push(element(&format!("Layer {}{word}", index + 1), &file, true));
    }
    let grey: Vec<u8> = map.delta.iter().map(|d| (d * 255.0).round() as u8).collect();
    add("data/depth.png", &png(&grey, width, height, ExtendedColorType::L8)?)?;
    layers.push(element("Depth map, near is white", "data/depth.png", false));
    // the top layer comes first
    let stack: String = layers.iter().rev().map(String::as_str).collect();
    let head = format!("<image version=\"0.0.3\" w=\"{width}\" h=\"{height}\" xres=\"72\" yres=\"72\">");
    add("stack.xml", format!("<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n{head}\n<stack>\n{stack}</stack>\n</image>\n").as_bytes())?;
    add("depth.png", &to_png(&map)?)?;
    add("mergedimage.png", &png(photo.rgb.as_flattened(), width, height, ExtendedColorType::Rgb8)?)?;
    let (w, h) = reduced_size((width, height), Some(THUMBNAIL));
    add("Thumbnails/thumbnail.png", &png(resize(photo, w, h).rgb.as_flattened(), w, h, ExtendedColorType::Rgb8)?)?;
    Ok(archive.finish()?.into_inner())
}

/// Bounds between bands of disparity, ascending: one fewer than bands. Uses the fewest bands that keep to [`SPREAD`].
fn bounds(delta: &[f32]) -> Vec<f32> {
    let table = ClusterTable::new(delta, &vec![1.0; delta.len()], *BANDS.end());
    let count = (*BANDS.start()..=*BANDS.end()).find(|n| table.deviation(*n) <= SPREAD).unwrap_or(*BANDS.end());
    table.centres(count).windows(2).map(|pair| ((pair[0] + pair[1]) / 2.0) as f32).collect()
}

fn element(name: &str, file: &str, shown: bool) -> String {
    let visibility = if shown { "visible" } else { "hidden" };
    let place = "x=\"0\" y=\"0\" opacity=\"1.0\" composite-op=\"svg:src-over\"";
    format!("<layer name=\"{name}\" src=\"{file}\" visibility=\"{visibility}\" {place}/>\n")
}

/// Picture of band `own`, whose δ is below `limit`, with straight alpha.
fn layer(photo: &Photo, delta: &[f32], band: &[u8], own: u8, limit: f32) -> Vec<[u8; 4]> {
    let reach = (OVERLAP * f64::from(photo.width.max(photo.height))).round().max(4.0) as u16;
    let away = distances(photo.width as usize, band, own, reach);
    let alpha: Vec<u8> = (band.iter().zip(&away))
        .map(|(b, &d)| match (b.cmp(&own), d) {
            (std::cmp::Ordering::Equal, _) => u8::MAX,
            (std::cmp::Ordering::Less, d) => d.checked_sub(1).and_then(|d| EDGE_ALPHA.get(usize::from(d)).copied()).unwrap_or(0),
            (std::cmp::Ordering::Greater, _) if own == 0 => u8::MAX,
            (std::cmp::Ordering::Greater, d) => {
                (f64::from(reach - d) / (f64::from(reach) / 2.0) * f64::from(u8::MAX)).min(f64::from(u8::MAX)) as u8
            }
        })
        .collect();
    let hidden = |i: usize| band[i] > own && alpha[i] > 0;
    let inpainted = if (0..band.len()).any(hidden) { &inpainted(photo, delta, limit, hidden) } else { photo };
    inpainted.rgb.iter().zip(alpha).map(|(&[r, g, b], a)| if a > 0 { [r, g, b, a] } else { [0; 4] }).collect()
}

/// Distance of each pixel from band `own`, in horizontal and vertical steps, at most `most`.
fn distances(width: usize, band: &[u8], own: u8, most: u16) -> Vec<u16> {
    let mut away: Vec<u16> = band.iter().map(|&b| if b == own { 0 } else { most }).collect();
    let nearer = |away: &mut [u16], i: usize, other: usize| away[i] = away[i].min(away[other] + 1);
    for i in 0..away.len() {
        if i % width > 0 {
            nearer(&mut away, i, i - 1);
        }
        if i >= width {
            nearer(&mut away, i, i - width);
        }
    }
    for i in (0..away.len()).rev() {
        if i % width + 1 < width {
            nearer(&mut away, i, i + 1);
        }
        if i + width < away.len() {
            nearer(&mut away, i, i + width);
        }
    }
    away
}

pub(super) fn png(samples: &[u8], width: u32, height: u32, colour: ExtendedColorType) -> Result<Vec<u8>, ExportError> {
    let mut out = Vec::new();
    PngEncoder::new(&mut out).write_image(samples, width, height, colour)?;
    Ok(out)
}

#[cfg(test)]
mod tests {
    use std::io::Read;

    use super::super::testing;
    use super::*;

    /// Names and contents of an archive's files, in order.
    fn files(bytes: &[u8]) -> Vec<(String, Vec<u8>)> {
        let mut archive = ::zip::ZipArchive::new(Cursor::new(bytes)).unwrap();
        let count = archive.len();
        let read = |i| {
            let mut file = archive.by_index(i).unwrap();
            let mut out = Vec::new();
            file.read_to_end(&mut out).unwrap();
            (file.name().unwrap().into_owned(), out)
        };
        (0..count).map(read).collect()
    }

    #[test]
    fn the_stacked_layers_show_the_photo() {
        let scene = &testing::sample().1;
        let bytes = ora(scene, &|| false).unwrap();
        let files = files(&bytes);
        assert_eq!((files[0].0.as_str(), files[0].1.as_slice()), ("mimetype", b"image/openraster".as_slice()));
        assert_eq!(&bytes[30..54], b"mimetypeimage/openraster", "the format fixes this offset");
        let file = |name: &str| &files.iter().find(|f| f.0 == name).unwrap_or_else(|| panic!("{name}")).1;
        let stack = String::from_utf8(file("stack.xml").clone()).unwrap();
        let shown: Vec<&str> = stack.lines().filter(|l| l.contains("visibility=\"visible\"")).collect();
        assert!(BANDS.contains(&shown.len()), "{stack}");
        assert!(shown[0].contains("nearest") && shown[shown.len() - 1].contains("farthest"), "{stack}");
        let mut over = vec![[0f64; 3]; scene.photo.rgb.len()];
        for (i, line) in shown.iter().rev().enumerate() {
            let name = line.split("src=\"").nth(1).unwrap().split('"').next().unwrap();
            let picture = image::load_from_memory(file(name)).unwrap().to_rgba8();
            assert_eq!(picture.dimensions(), (scene.photo.width, scene.photo.height), "whole pictures");
            assert!(i > 0 || picture.pixels().all(|p| p.0[3] == 255), "the farthest has no hole");
            assert!(picture.pixels().any(|p| p.0[3] == 255), "{name} shows something");
            for (to, from) in over.iter_mut().zip(picture.pixels()) {
                let a = f64::from(from.0[3]) / 255.0;
                *to = std::array::from_fn(|c| (f64::from(from.0[c]) * a + to[c] * (1.0 - a)).round());
            }
        }
        for (got, want) in over.iter().zip(&scene.photo.rgb) {
            assert!(got.iter().zip(want).all(|(g, w)| (g - f64::from(*w)).abs() <= 1.0), "{got:?} {want:?}");
        }
        // the box is the nearest object; without it, the ground is visible
        let nearest = image::load_from_memory(file(&format!("data/layer{}.png", shown.len() - 1))).unwrap().to_rgba8();
        assert_eq!(nearest.get_pixel(70, 60).0[3], 255);
        assert_eq!((nearest.get_pixel(20, 60).0[3], nearest.get_pixel(70, 10).0[3]), (0, 0));
        let farthest = image::load_from_memory(file("data/layer0.png")).unwrap().to_rgba8();
        assert!(farthest.get_pixel(70, 60).0[0] < 180, "the box is gone: {:?}", farthest.get_pixel(70, 60));
        for name in ["depth.png", "mergedimage.png", "Thumbnails/thumbnail.png", "data/depth.png"] {
            assert!(image::load_from_memory(file(name)).is_ok(), "{name}");
        }
        assert!(matches!(ora(scene, &|| true), Err(ExportError::Cancelled)));
    }

    #[test]
    fn separate_distances_get_separate_bands_and_a_slope_equal_ones() {
        let of = |at: &[f32]| bounds(&(0..4000).map(|i| at[i % at.len()] + (i % 7) as f32 * 1e-3).collect::<Vec<_>>());
        let got = of(&[0.0, 0.5, 1.0]);
        assert!(got.len() == 2 && (got[0] - 0.25).abs() < 0.02 && (got[1] - 0.75).abs() < 0.02, "{got:?}");
        assert_eq!(of(&[0.05, 0.3, 0.5, 0.7, 0.95]).len(), 4);
        assert!(bounds(&[0.4; 100]).is_empty() && bounds(&[]).is_empty());
        let slope: Vec<f32> = (0..10_000).map(|i| i as f32 / 1e4).collect();
        let got = bounds(&slope);
        // the fewest that keep to the spread, which is 1 / (√12 · bands) on a slope
        assert_eq!(got.len(), 4);
        assert!(got.iter().enumerate().all(|(i, b)| (b - (i + 1) as f32 / 5.0).abs() < 0.01), "{got:?}");
        let steep: Vec<f32> = slope.iter().map(|d| d * 50.0).collect();
        assert_eq!(bounds(&steep).len() + 1, *BANDS.end());
    }

    #[test]
    fn a_flat_photo_is_one_layer() {
        let photo = Photo { width: 4, height: 3, rgb: vec![[9, 8, 7]; 12] };
        assert_eq!(layer(&photo, &[0.5; 12], &[0; 12], 0, f32::INFINITY), vec![[9, 8, 7, 255]; 12]);
    }

    #[test]
    fn distances_count_steps_up_to_the_limit() {
        assert_eq!(distances(4, &[1, 0, 0, 0, 0, 0, 0, 0], 1, 3), [0, 1, 2, 3, 1, 2, 3, 3]);
        assert_eq!(distances(2, &[0; 4], 1, 5), [5; 4]);
    }
}
