//! Exports a scene as binary glTF 2.0.
//!
//! The surfaces are drawn in the order of the renderers: first layers that show only the opaque photo, with the photo's file as texture;
//! then the opaque texels of all other layers (alpha mode MASK); then the layers with soft edges (BLEND), back to front. That order does
//! not depend on the camera.

use serde_json::json;

use super::backdrop::backdrop;
use super::glb_writer::File;
use super::mesh::{Mesh, Space, disparity};
use super::{ExportError, PhotoFile, photo_file, texture_atlas};
use tmpi_core::container::encode_jpeg;
use tmpi_core::{Class, Photo, Scene};
use tmpi_render::OPAQUE;

/// JPEG quality of a photo that must be re-encoded because core glTF does not support WebP.
const QUALITY: u8 = 95;
/// WebP quality of layers: a quarter smaller than at 90, without a visible difference.
const LAYER_QUALITY: f32 = 82.0;
/// JPEG quality of opaque textures other than the photo: the background of a relief, and pages of layers without holes.
const OPAQUE_QUALITY: u8 = 85;
/// Maximum side of a WebP picture.
const WEBP_SIDE: u32 = 16_383;

/// The coordinate space of a model.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, clap::ValueEnum)]
pub enum ModelShape {
    /// A relief whose depth is a quarter of the photo's longer side. It fits the frame that viewers put around a model.
    #[default]
    Relief,
    /// The photo's true proportions: far objects are far away, up to 100 times the nearest distance.
    Metric,
}

/// The texture format of a model.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, clap::ValueEnum)]
pub enum ModelTextures {
    /// JPEG for opaque textures, otherwise PNG: every glTF reader supports these.
    #[default]
    Plain,
    /// Layers as WebP, a fraction of PNG's size, for readers with `EXT_texture_webp`: three.js, model-viewer, Babylon.js, Blender 4.
    #[value(name = "webp")]
    WebP,
}

/// Options of a model.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct ModelOptions {
    /// Coordinate space.
    pub shape: ModelShape,
    /// Texture format.
    pub textures: ModelTextures,
}

/// Writes a glTF model of `scene`, the decoded `container`.
///
/// Axes: x right, y up, −z forward. Materials are unlit. Seen from the node `camera`, the model looks like the photo. In a relief, the unit
/// is its longer side and the origin its centre. In metric space, the unit is the distance to the photo's nearest surface, the origin is
/// the camera's position, and points beyond 100 units are moved to 100 units.
///
/// # Errors
/// [`ExportError::TooLarge`] above 4 GiB, and other [`ExportError`]s.
pub fn glb(container: &[u8], scene: &Scene, options: ModelOptions, cancelled: &dyn Fn() -> bool) -> Result<Vec<u8>, ExportError> {
    let photo = photo_file(container)?;
    let ModelOptions { shape, textures } = options;
    let space = match shape {
        ModelShape::Relief => Space::relief(&scene.intrinsics, scene.grid.width, scene.grid.height),
        ModelShape::Metric => Space::metric(&scene.intrinsics),
    };
    let mut file = File::default();
    if shape == ModelShape::Relief && !scene.layers.is_empty() {
        let (mesh, photo) = backdrop(scene, &space);
        let texture = file.texture("background", &("image/jpeg", jpeg(&photo, OPAQUE_QUALITY)?));
        let vertices = file.vertices(&mesh);
        file.surface("background", &vertices, &mesh.triangles, texture, &json!({}));
    }
    let (mut whole, mut layered) = (Vec::new(), Vec::new());
    for index in back_to_front(scene) {
        if cancelled() {
            return Err(ExportError::Cancelled);
        }
        match kind(scene, index) {
            Kind::Whole => whole.push(index),
            Kind::Empty => {}
            Kind::Layered { .. } => layered.push(index),
        }
    }
    if !whole.is_empty() {
        whole.sort_unstable();
        let (w, h) = (f64::from(scene.grid.width), f64::from(scene.grid.height));
        let mut mesh = Mesh::default();
        let parts: Vec<_> = whole.iter().map(|&l| mesh.add(scene, l, &space, |[x, y]| [x / w, y / h])).collect();
        let texture = file.texture("photo", &photo_texture(&photo, scene)?);
        let vertices = file.vertices(&mesh);
        file.surface("photo", &vertices, &mesh.pick(parts), texture, &json!({}));
    }
    for (n, page) in texture_atlas::pack(scene, &layered).iter().enumerate() {
        if cancelled() {
            return Err(ExportError::Cancelled);
        }
        let (w, h) = (f64::from(page.width), f64::from(page.height));
        let mut mesh = Mesh::default();
        let mut parts = Vec::new();
        for place in &page.placements {
            let rect = scene.layers[place.layer].rect;
            let shift = [f64::from(place.x) - f64::from(rect.x), f64::from(place.y) - f64::from(rect.y)];
            parts.push((place.layer, mesh.add(scene, place.layer, &space, |[x, y]| [(x + shift[0]) / w, (y + shift[1]) / h])));
        }
        let texture = file.texture(&format!("layers {n}"), &page_texture(scene, page, textures)?);
        let vertices = file.vertices(&mesh);
        let of = |wanted: fn(Kind) -> bool| -> Vec<_> {
            parts.iter().filter(|(l, _)| wanted(kind(scene, *l))).map(|(_, part)| part.clone()).collect()
        };
        let opaque = of(|k| matches!(k, Kind::Layered { opaque: true, .. }));
        let soft = of(|k| matches!(k, Kind::Layered { soft: true, .. }));
        let mask = json!({ "alphaMode": "MASK", "alphaCutoff": OPAQUE });
        for (name, parts, alpha) in [("opaque", opaque, mask), ("soft", soft, json!({ "alphaMode": "BLEND" }))] {
            if !parts.is_empty() {
                file.surface(&format!("{name} {n}"), &vertices, &mesh.pick(parts), texture, &alpha);
            }
        }
    }
    file.finish(scene, &space)
}

fn jpeg(photo: &Photo, quality: u8) -> Result<Vec<u8>, ExportError> {
    Ok(encode_jpeg(photo.width, photo.height, photo.rgb.as_flattened(), quality)?)
}

/// Encodes a page of layers (media type, bytes).
fn page_texture(scene: &Scene, page: &texture_atlas::Page, textures: ModelTextures) -> Result<(&'static str, Vec<u8>), ExportError> {
    let (w, h, rgba) = (page.width, page.height, texture_atlas::paint(scene, page));
    if textures == ModelTextures::Plain || w.max(h) > WEBP_SIDE {
        if rgba.iter().all(|texel| texel[3] == u8::MAX) {
            let rgb: Vec<[u8; 3]> = rgba.iter().map(|&[r, g, b, _]| [r, g, b]).collect();
            return Ok(("image/jpeg", encode_jpeg(w, h, rgb.as_flattened(), OPAQUE_QUALITY)?));
        }
        return Ok(("image/png", texture_atlas::png(w, h, &rgba)?));
    }
    // alpha is lossless
    let coded = webp::Encoder::from_rgba(rgba.as_flattened(), w, h).encode_simple(false, LAYER_QUALITY);
    Ok(("image/webp", coded.map_err(|e| ExportError::WebP(format!("{e:?}")))?.to_vec()))
}

/// The photo's file if glTF supports its format, otherwise the re-encoded photo.
fn photo_texture(photo: &PhotoFile<'_>, scene: &Scene) -> Result<(&'static str, Vec<u8>), ExportError> {
    match photo.media_type {
        "image/webp" => Ok(("image/jpeg", jpeg(&scene.photo, QUALITY)?)),
        media_type => Ok((media_type, photo.bytes.to_vec())),
    }
}

/// Kind of a layer by its texels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    /// Fully transparent.
    Empty,
    /// Only opaque texels of the photo.
    Whole,
    /// Has `opaque` texels, `soft` ones, or both.
    Layered { opaque: bool, soft: bool },
}

fn kind(scene: &Scene, index: usize) -> Kind {
    let l = &scene.layers[index];
    let texels = l.first_texel..l.first_texel + l.rect.area();
    let alpha = &scene.texels.alpha[texels.clone()];
    let is_opaque = |a: u8| f32::from(a) / 255.0 >= OPAQUE;
    let (least, most) = alpha.iter().fold((u8::MAX, 0), |(a, b), &t| (a.min(t), b.max(t)));
    match (least, most) {
        (_, 0) => Kind::Empty,
        (255, _) if scene.texels.class[texels].iter().all(|&c| c == Class::Photo as u8) => Kind::Whole,
        _ => Kind::Layered { opaque: is_opaque(most), soft: !is_opaque(least) },
    }
}

/// All layers by mean δ, then by index: the renderers' blending order.
fn back_to_front(scene: &Scene) -> Vec<usize> {
    let middle = |from: u32, length: u32| f64::from(from) + f64::from(length) / 2.0;
    let mean: Vec<f64> =
        scene.layers.iter().map(|l| disparity(scene, l).of([middle(l.rect.x, l.rect.w), middle(l.rect.y, l.rect.h)])).collect();
    let mut order: Vec<usize> = (0..mean.len()).collect();
    order.sort_by(|&a, &b| mean[a].total_cmp(&mean[b]).then(a.cmp(&b)));
    order
}

#[cfg(test)]
mod tests {
    use serde_json::Value;

    use super::super::testing;
    use super::*;

    /// The JSON and binary chunks of a file.
    fn read(file: &[u8]) -> (Value, &[u8]) {
        let word = |at: usize| u32::from_le_bytes(file[at..at + 4].try_into().unwrap()) as usize;
        assert_eq!((&file[..4], word(4), word(8)), (b"glTF".as_slice(), 2, file.len()));
        let (text, binary) = file[20..].split_at(word(12));
        (serde_json::from_slice(text).unwrap(), &binary[8..])
    }

    #[test]
    fn models_contain_all_layers_and_the_original_photo() {
        for shape in [ModelShape::Metric, ModelShape::Relief] {
            for textures in [ModelTextures::Plain, ModelTextures::WebP] {
                every_layer_is_in(ModelOptions { shape, textures });
            }
        }
    }

    fn every_layer_is_in(options: ModelOptions) {
        let (container, scene) = testing::sample();
        let file = glb(container, scene, options, &|| false).unwrap();
        let (root, binary) = read(&file);
        let ModelOptions { shape, textures } = options;
        let kinds: Vec<&str> = root["images"].as_array().unwrap().iter().map(|i| i["mimeType"].as_str().unwrap()).collect();
        let webp = textures == ModelTextures::WebP;
        assert_eq!(kinds.contains(&"image/webp"), webp, "{kinds:?}");
        assert_eq!(root["extensionsRequired"].as_array().is_some_and(|all| all.iter().any(|e| e == "EXT_texture_webp")), webp);
        let names: Vec<&str> = root["nodes"].as_array().unwrap().iter().map(|n| n["name"].as_str().unwrap()).collect();
        let relief = shape == ModelShape::Relief;
        assert_eq!(names[usize::from(relief)..], ["photo", "opaque 0", "soft 0", "camera", "3D photo"]);
        assert_eq!(names[0] == "background", relief);
        let view = |i: usize| {
            let v = &root["bufferViews"][i];
            let at = v["byteOffset"].as_u64().unwrap() as usize;
            &binary[at..at + v["byteLength"].as_u64().unwrap() as usize]
        };
        let photo = root["images"].as_array().unwrap().iter().find(|i| i["name"] == "photo").unwrap();
        assert_eq!(photo["mimeType"], "image/jpeg");
        assert!(view(photo["bufferView"].as_u64().unwrap() as usize) == photo_file(container).unwrap().bytes);
        // the triangles' areas from the photo's camera add up to those of the layers
        let mut seen = 0.0;
        for mesh in root["meshes"].as_array().unwrap().iter().filter(|m| m["name"] != "soft 0" && m["name"] != "background") {
            let primitive = &mesh["primitives"][0];
            let data =
                |accessor: &Value| view(root["accessors"][accessor.as_u64().unwrap() as usize]["bufferView"].as_u64().unwrap() as usize);
            let places: &[[f32; 3]] = bytemuck::cast_slice(data(&primitive["attributes"]["POSITION"]));
            let triangles: &[[u32; 3]] = bytemuck::cast_slice(data(&primitive["indices"]));
            let space = if relief { Space::relief(&scene.intrinsics, 150, 110) } else { Space::metric(&scene.intrinsics) };
            let k = &space.intrinsics;
            let pixel = |i: u32| {
                let [x, y, z] = places[i as usize].map(f64::from);
                [k.cx - k.fx * x / z, k.cy + k.fy * y / z]
            };
            for t in triangles {
                let [a, b, c] = t.map(pixel);
                seen += ((b[1] - a[1]) * (c[0] - a[0]) - (b[0] - a[0]) * (c[1] - a[1])) / 2.0;
            }
        }
        let drawn = |l: usize| scene.grid.drawn(scene.layers[l].tile, scene.layers[l].rect).map(|[from, to]| (to - from).max(0.0));
        let all: f64 = (0..scene.layers.len())
            .filter(|&l| matches!(kind(scene, l), Kind::Whole | Kind::Layered { opaque: true, .. }))
            .map(|l| drawn(l).iter().product::<f64>())
            .sum();
        assert!((seen - all).abs() < 1e-3 * all, "{seen} {all}");
    }

    #[test]
    fn the_camera_has_the_photos_field_of_view() {
        let (container, scene) = testing::sample();
        let file = glb(container, scene, ModelOptions { shape: ModelShape::Metric, ..ModelOptions::default() }, &|| false).unwrap();
        let camera = &read(&file).0["cameras"][0]["perspective"];
        let (yfov, aspect) = (camera["yfov"].as_f64().unwrap(), camera["aspectRatio"].as_f64().unwrap());
        let fov_x = 2.0 * ((yfov / 2.0).tan() * aspect).atan().to_degrees();
        assert!((fov_x - scene.intrinsics.fov_x(scene.grid.width)).abs() < 1e-9);
    }

    #[test]
    fn a_scene_without_layers_has_only_a_camera() {
        let (container, scene) = testing::sample();
        let mut scene = scene.clone();
        scene.layers.clear();
        let file = glb(container, &scene, ModelOptions::default(), &|| false).unwrap();
        let (root, _) = read(&file);
        assert!(root["meshes"].is_null() && root["cameras"][0].is_object());
    }
}
