//! Exports the parts of a scene as a ZIP archive: photo, layers as pictures, planes, disparity.

use std::io::{Cursor, Write};

use ::zip::write::SimpleFileOptions;
use ::zip::{CompressionMethod, ZipWriter};
use serde_json::json;

use super::visible_surface::visible_disparity;
use super::{ExportError, photo_file, texture_atlas};
use tmpi_core::Scene;
use tmpi_pipeline::depth::to_png;

const README: &str = include_str!("README.txt");
/// Version of the archive's layout.
const VERSION: u32 = 1;

/// Writes an archive of `scene`, the decoded `container`. Its `README.txt` describes the contents.
///
/// # Errors
/// [`ExportError`].
pub fn zip(container: &[u8], scene: &Scene, cancelled: &dyn Fn() -> bool) -> Result<Vec<u8>, ExportError> {
    let photo = photo_file(container)?;
    let photo_name = format!("photo.{}", photo.extension);
    let mut archive = ZipWriter::new(Cursor::new(Vec::new()));
    let text = SimpleFileOptions::default().compression_method(CompressionMethod::Deflated);
    // pictures are already compressed
    let picture = SimpleFileOptions::default().compression_method(CompressionMethod::Stored);
    let mut add = |name: &str, options, bytes: &[u8]| -> Result<(), ExportError> {
        archive.start_file(name, options)?;
        archive.write_all(bytes)?;
        Ok(())
    };
    add("README.txt", text, README.replace("{photo}", &photo_name).as_bytes())?;
    add("planes.json", text, &serde_json::to_vec_pretty(&planes(scene, &photo_name))?)?;
    add(&photo_name, picture, photo.bytes)?;
    add("disparity.png", picture, &to_png(&visible_disparity(scene))?)?;
    let mut texels = Vec::new();
    for (index, name) in names(scene).iter().enumerate() {
        if cancelled() {
            return Err(ExportError::Cancelled);
        }
        let rect = scene.layers[index].rect;
        texels.clear();
        scene.expand_layer(index, &mut texels);
        add(name, picture, &texture_atlas::png(rect.w, rect.h, &texels)?)?;
    }
    Ok(archive.finish()?.into_inner())
}

/// File names of the layers' pictures: index of the tile, index of the layer in the tile from the back.
fn names(scene: &Scene) -> Vec<String> {
    let digits = scene.grid.tiles().to_string().len().max(4);
    let (mut tile, mut number) = (None, 0);
    let name = |l: &tmpi_core::Layer| {
        number = if tile == Some(l.tile) { number + 1 } else { 0 };
        tile = Some(l.tile);
        format!("layers/{:0digits$}-{number}.png", l.tile)
    };
    scene.layers.iter().map(name).collect()
}

fn planes(scene: &Scene, photo_name: &str) -> serde_json::Value {
    let (g, k, v) = (&scene.grid, &scene.intrinsics, &scene.view_box);
    let tiles: Vec<_> = (0..g.tiles()).map(|t| json!({ "rect": g.rect(t), "centre": [g.centre(t).0, g.centre(t).1] })).collect();
    let layers: Vec<_> = scene
        .layers
        .iter()
        .zip(names(scene))
        .map(|(l, file)| json!({ "file": file, "tile": l.tile, "plane": l.plane, "rect": l.rect }))
        .collect();
    json!({
        "version": VERSION,
        "photo": { "file": photo_name, "width": g.width, "height": g.height },
        "intrinsics": k,
        "view_box": v,
        "tile": { "size": g.size, "stride": g.stride, "half": g.half(), "columns": g.columns(), "rows": g.rows() },
        "tiles": tiles,
        "layers": layers,
    })
}

#[cfg(test)]
mod tests {
    use std::io::Read;

    use super::super::testing;
    use super::*;

    #[test]
    fn the_archive_contains_the_scene() {
        let (container, scene) = testing::sample();
        let bytes = zip(container, scene, &|| false).unwrap();
        let mut archive = ::zip::ZipArchive::new(Cursor::new(bytes)).unwrap();
        let mut file = |name: &str| {
            let mut out = Vec::new();
            archive.by_name(name).unwrap_or_else(|e| panic!("{name}: {e}")).read_to_end(&mut out).unwrap();
            out
        };
        let about: serde_json::Value = serde_json::from_slice(&file("planes.json")).unwrap();
        assert_eq!(file("photo.jpg"), photo_file(container).unwrap().bytes);
        assert!(String::from_utf8(file("README.txt")).unwrap().contains("photo.jpg"));
        let layers = about["layers"].as_array().unwrap();
        assert_eq!(layers.len(), scene.layers.len());
        for (i, l) in layers.iter().enumerate() {
            let picture = image::load_from_memory(&file(l["file"].as_str().unwrap())).unwrap().to_rgba8();
            let mut want = Vec::new();
            scene.expand_layer(i, &mut want);
            assert_eq!((picture.width(), picture.height()), (scene.layers[i].rect.w, scene.layers[i].rect.h));
            assert!(picture.as_raw().as_slice() == want.as_flattened(), "layer {i}");
            let plane: tmpi_core::Plane = serde_json::from_value(l["plane"].clone()).unwrap();
            assert_eq!(plane, scene.layers[i].plane);
        }
        let image::DynamicImage::ImageLuma16(map) = image::load_from_memory(&file("disparity.png")).unwrap() else { panic!("16-bit grey") };
        let at = |x, y| f64::from(map.get_pixel(x, y).0[0]) / 65_535.0;
        assert!((at(70, 60) - 0.9).abs() < 0.01 && (at(20, 100) - 70.0 / 120.0).abs() < 0.02 && at(20, 5) < 0.02, "box, ground, sky");
    }
}
