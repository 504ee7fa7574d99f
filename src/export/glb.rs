//! A scene as glTF 2.0, binary form.
//!
//! Three kinds of surface, drawn in the order that the renderers draw in: tiles that are the photo and nothing else take the
//! photo's file as their texture; of all other layers first the opaque texels (alpha mode MASK), then everything once more with
//! the soft edges (BLEND) back to front, an order that does not depend on the camera.

use std::collections::HashMap;

use serde_json::{Value, json};

use super::mesh::{Corner, Disparity, FAR, polygons};
use super::{ExportError, PhotoFile, pages, photo_file};
use tmpi_core::container::encode_jpeg;
use tmpi_core::{Class, Layer, Scene};
use tmpi_render::OPAQUE;

/// Nearest distance that the camera of the file sees.
const NEAR: f64 = 0.05;
/// Quality of a photo that must be encoded anew because glTF knows no WebP.
const QUALITY: u8 = 95;

// glTF's numbers for what its accessors, buffers and samplers hold
const FLOAT: u32 = 5126;
const UNSIGNED_INT: u32 = 5125;
const VERTICES: u32 = 34_962;
const INDICES: u32 = 34_963;
const LINEAR: u32 = 9729;
const CLAMP: u32 = 33_071;

/// Writes a glTF model of `scene`, which is what `container` decodes to.
///
/// Axes: x right, y up, −z forward; the unit is the distance to the photo's nearest thing; the camera `camera` is where the photo
/// was taken. What is farther than 100 units is put there. Materials are unlit.
///
/// # Errors
/// [`ExportError::TooLarge`] above 4 GiB.
pub fn glb(container: &[u8], scene: &Scene, cancelled: &dyn Fn() -> bool) -> Result<Vec<u8>, ExportError> {
    let photo = photo_file(container)?;
    let mut file = File::default();
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
        let parts: Vec<_> = whole.iter().map(|&l| mesh.add(scene, l, |[x, y]| [x / w, y / h])).collect();
        let texture = file.texture("photo", &photo_texture(&photo, scene)?);
        let material = file.material("photo", texture, &json!({}));
        let vertices = file.vertices(&mesh);
        file.surface("photo", &vertices, &mesh.pick(parts), material);
    }
    for (n, page) in pages::pack(scene, &layered).iter().enumerate() {
        if cancelled() {
            return Err(ExportError::Cancelled);
        }
        let (w, h) = (f64::from(page.width), f64::from(page.height));
        let mut mesh = Mesh::default();
        let mut parts = Vec::new();
        for place in &page.places {
            let rect = scene.layers[place.layer].rect;
            let shift = [f64::from(place.x) - f64::from(rect.x), f64::from(place.y) - f64::from(rect.y)];
            parts.push((place.layer, mesh.add(scene, place.layer, |[x, y]| [(x + shift[0]) / w, (y + shift[1]) / h])));
        }
        let texture = file.texture(&format!("layers {n}"), &("image/png", pages::paint(scene, page)?));
        let vertices = file.vertices(&mesh);
        let of = |wanted: fn(Kind) -> bool| parts.iter().filter(move |(l, _)| wanted(kind(scene, *l))).map(|(_, part)| part.clone());
        let opaque: Vec<_> = of(|k| matches!(k, Kind::Layered { opaque: true, .. })).collect();
        let soft: Vec<_> = of(|k| matches!(k, Kind::Layered { soft: true, .. })).collect();
        if !opaque.is_empty() {
            let material = file.material(&format!("opaque {n}"), texture, &json!({ "alphaMode": "MASK", "alphaCutoff": OPAQUE }));
            file.surface(&format!("opaque {n}"), &vertices, &mesh.pick(opaque), material);
        }
        if !soft.is_empty() {
            let material = file.material(&format!("soft {n}"), texture, &json!({ "alphaMode": "BLEND" }));
            file.surface(&format!("soft {n}"), &vertices, &mesh.pick(soft), material);
        }
    }
    file.finish(scene)
}

/// The photo's file where glTF can hold it, else the photo encoded anew.
fn photo_texture(photo: &PhotoFile<'_>, scene: &Scene) -> Result<(&'static str, Vec<u8>), ExportError> {
    if photo.codec != "webp" {
        return Ok((photo.media_type(), photo.bytes.to_vec()));
    }
    let (w, h) = (scene.photo.width, scene.photo.height);
    Ok(("image/jpeg", encode_jpeg(w, h, scene.photo.rgb.as_flattened(), QUALITY)?))
}

/// What a layer's texels are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    /// Nothing.
    Empty,
    /// The photo, all of it opaque.
    Whole,
    /// Both may be true: samples between texels are soft where their alphas differ.
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

fn disparity(scene: &Scene, layer: &Layer) -> Disparity {
    let (centre, half, p) = (scene.grid.centre(layer.tile), scene.grid.half(), layer.plane);
    Disparity { origin: [centre.0, centre.1], at: p.a, slope: [p.b / half, p.c / half] }
}

/// All layers by mean δ, then by index, as the renderers blend them.
fn back_to_front(scene: &Scene) -> Vec<usize> {
    let middle = |from: u32, length: u32| f64::from(from) + f64::from(length) / 2.0;
    let mean: Vec<f64> =
        scene.layers.iter().map(|l| disparity(scene, l).of([middle(l.rect.x, l.rect.w), middle(l.rect.y, l.rect.h)])).collect();
    let mut order: Vec<usize> = (0..mean.len()).collect();
    order.sort_by(|&a, &b| mean[a].total_cmp(&mean[b]).then(a.cmp(&b)));
    order
}

/// Vertices of many layers.
#[derive(Default)]
struct Mesh {
    positions: Vec<[f32; 3]>,
    coordinates: Vec<[f32; 2]>,
    triangles: Vec<[u32; 3]>,
}

impl Mesh {
    /// Adds a layer; gives its triangles. `texture` takes pixels of the photo to texture coordinates.
    fn add(&mut self, scene: &Scene, index: usize, texture: impl Fn([f64; 2]) -> [f64; 2]) -> std::ops::Range<usize> {
        let layer = &scene.layers[index];
        let start = self.triangles.len();
        // strips side by side have their corners in common
        let mut known = HashMap::new();
        let [[left, right], [upper, lower]] = scene.grid.drawn(layer.tile, layer.rect);
        if left >= right || upper >= lower {
            return start..start;
        }
        let (x, y) = (f64::from(layer.rect.x), f64::from(layer.rect.y));
        for polygon in polygons([x + left, y + upper], [x + right, y + lower], &disparity(scene, layer), &scene.intrinsics) {
            let mut vertex = |corner: &Corner| {
                *known.entry(corner.position.map(f32::to_bits)).or_insert_with(|| {
                    self.positions.push(corner.position);
                    self.coordinates.push(texture(corner.pixel).map(|v| v as f32));
                    self.positions.len() as u32 - 1
                })
            };
            let corners: Vec<u32> = polygon.iter().map(&mut vertex).collect();
            self.triangles.extend(corners[1..].windows(2).map(|pair| [corners[0], pair[0], pair[1]]));
        }
        start..self.triangles.len()
    }

    /// The triangles of these parts.
    fn pick(&self, parts: Vec<std::ops::Range<usize>>) -> Vec<[u32; 3]> {
        parts.into_iter().flat_map(|part| &self.triangles[part]).copied().collect()
    }
}

/// Accessors of a mesh's vertices.
struct Vertices {
    position: usize,
    coordinates: usize,
}

/// A file under construction.
#[derive(Default)]
struct File {
    binary: Vec<u8>,
    views: Vec<Value>,
    accessors: Vec<Value>,
    images: Vec<Value>,
    materials: Vec<Value>,
    meshes: Vec<Value>,
    nodes: Vec<Value>,
}

impl File {
    fn view(&mut self, bytes: &[u8], target: Option<u32>) -> usize {
        self.binary.resize(self.binary.len().next_multiple_of(4), 0);
        let mut view = json!({ "buffer": 0, "byteOffset": self.binary.len(), "byteLength": bytes.len() });
        if let Some(target) = target {
            view["target"] = target.into();
        }
        self.binary.extend_from_slice(bytes);
        push(&mut self.views, view)
    }

    fn vertices(&mut self, mesh: &Mesh) -> Vertices {
        let bound = |pick: fn(f32, f32) -> f32| -> Vec<f32> {
            (0..3).map(|axis| mesh.positions.iter().map(|p| p[axis]).reduce(pick).unwrap_or_default()).collect()
        };
        let (least, most) = (bound(f32::min), bound(f32::max));
        let count = mesh.positions.len();
        let view = self.view(bytemuck::cast_slice(&mesh.positions), Some(VERTICES));
        let position = json!({ "bufferView": view, "componentType": FLOAT, "count": count, "type": "VEC3", "min": least, "max": most });
        let position = push(&mut self.accessors, position);
        let view = self.view(bytemuck::cast_slice(&mesh.coordinates), Some(VERTICES));
        let coordinates = json!({ "bufferView": view, "componentType": FLOAT, "count": count, "type": "VEC2" });
        Vertices { position, coordinates: push(&mut self.accessors, coordinates) }
    }

    /// A texture of a picture (media type, bytes).
    fn texture(&mut self, name: &str, picture: &(&'static str, Vec<u8>)) -> usize {
        let view = self.view(&picture.1, None);
        // textures and images go in pairs
        push(&mut self.images, json!({ "name": name, "bufferView": view, "mimeType": picture.0 }))
    }

    fn material(&mut self, name: &str, texture: usize, alpha: &Value) -> usize {
        let mut material = json!({
            "name": name,
            "doubleSided": true,
            "pbrMetallicRoughness": { "baseColorTexture": { "index": texture }, "metallicFactor": 0, "roughnessFactor": 1 },
            "extensions": { "KHR_materials_unlit": {} },
        });
        for (key, value) in alpha.as_object().into_iter().flatten() {
            material[key] = value.clone();
        }
        push(&mut self.materials, material)
    }

    fn surface(&mut self, name: &str, vertices: &Vertices, triangles: &[[u32; 3]], material: usize) {
        let view = self.view(bytemuck::cast_slice(triangles), Some(INDICES));
        let count = triangles.len() * 3;
        let indices = json!({ "bufferView": view, "componentType": UNSIGNED_INT, "count": count, "type": "SCALAR" });
        let indices = push(&mut self.accessors, indices);
        let attributes = json!({ "POSITION": vertices.position, "TEXCOORD_0": vertices.coordinates });
        let primitive = json!({ "attributes": attributes, "indices": indices, "material": material });
        let mesh = push(&mut self.meshes, json!({ "name": name, "primitives": [primitive] }));
        push(&mut self.nodes, json!({ "name": name, "mesh": mesh }));
    }

    fn finish(mut self, scene: &Scene) -> Result<Vec<u8>, ExportError> {
        let (k, v, g) = (&scene.intrinsics, &scene.view_box, &scene.grid);
        let (w, h) = (f64::from(g.width), f64::from(g.height));
        let camera = json!({
            "name": "camera",
            "type": "perspective",
            "perspective": {
                "yfov": 2.0 * (h / 2.0 / k.fy).atan(),
                "aspectRatio": (w / k.fx) / (h / k.fy),
                "znear": NEAR,
                "zfar": 2.0 * FAR,
            },
        });
        let surfaces: Vec<usize> = (0..self.nodes.len()).collect();
        let photo = push(&mut self.nodes, json!({ "name": "3D photo", "children": surfaces }));
        let eye = push(&mut self.nodes, json!({ "name": "camera", "camera": 0 }));
        let extras = json!({
            "unit": "distance from the camera to the photo's nearest thing",
            "farthest": FAR,
            "view_box": [v.x, v.y, v.z],
            "photo": { "width": g.width, "height": g.height },
            "intrinsics": k,
            "tiles": g.tiles(),
            "planes": scene.layers.len(),
        });
        let textures: Vec<Value> = (0..self.images.len()).map(|i| json!({ "source": i, "sampler": 0 })).collect();
        self.binary.resize(self.binary.len().next_multiple_of(4), 0);
        let mut root = json!({
            "asset": { "version": "2.0", "generator": concat!("tmpi ", env!("CARGO_PKG_VERSION")) },
            "extensionsUsed": ["KHR_materials_unlit"],
            "scene": 0,
            "scenes": [{ "name": "3D photo", "nodes": [photo, eye], "extras": extras }],
            "nodes": self.nodes,
            "cameras": [camera],
            "meshes": self.meshes,
            "materials": self.materials,
            "textures": textures,
            "images": self.images,
            "samplers": [{ "magFilter": LINEAR, "minFilter": LINEAR, "wrapS": CLAMP, "wrapT": CLAMP }],
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{ "byteLength": self.binary.len() }],
        });
        // glTF forbids empty lists: a scene of which nothing can be seen has a camera alone
        if self.images.is_empty() {
            for key in ["meshes", "materials", "textures", "images", "samplers", "accessors", "bufferViews", "buffers", "extensionsUsed"] {
                root.as_object_mut().map(|all| all.remove(key));
            }
        }
        let mut text = serde_json::to_vec(&root)?;
        text.resize(text.len().next_multiple_of(4), b' ');
        let length = 12 + 8 + text.len() + 8 + self.binary.len();
        let total = u32::try_from(length).map_err(|_| ExportError::TooLarge("glb"))?;
        let mut out = Vec::with_capacity(length);
        out.extend_from_slice(b"glTF");
        for word in [2, total, text.len() as u32, u32::from_le_bytes(*b"JSON")] {
            out.extend_from_slice(&word.to_le_bytes());
        }
        out.extend_from_slice(&text);
        for word in [self.binary.len() as u32, u32::from_le_bytes(*b"BIN\0")] {
            out.extend_from_slice(&word.to_le_bytes());
        }
        out.extend_from_slice(&self.binary);
        Ok(out)
    }
}

fn push(all: &mut Vec<Value>, value: Value) -> usize {
    all.push(value);
    all.len() - 1
}

#[cfg(test)]
mod tests {
    use super::super::testing;
    use super::*;

    /// The JSON of a file, and its binary part.
    fn read(file: &[u8]) -> (Value, &[u8]) {
        let word = |at: usize| u32::from_le_bytes(file[at..at + 4].try_into().unwrap()) as usize;
        assert_eq!((&file[..4], word(4), word(8)), (b"glTF".as_slice(), 2, file.len()));
        let (text, binary) = file[20..].split_at(word(12));
        (serde_json::from_slice(text).unwrap(), &binary[8..])
    }

    #[test]
    fn every_layer_is_there_and_the_photo_is_its_own_file() {
        let (container, scene) = testing::made();
        let file = glb(container, scene, &|| false).unwrap();
        let (root, binary) = read(&file);
        let names: Vec<&str> = root["nodes"].as_array().unwrap().iter().map(|n| n["name"].as_str().unwrap()).collect();
        assert_eq!(names, ["photo", "opaque 0", "soft 0", "3D photo", "camera"]);
        let view = |i: usize| {
            let v = &root["bufferViews"][i];
            let at = v["byteOffset"].as_u64().unwrap() as usize;
            &binary[at..at + v["byteLength"].as_u64().unwrap() as usize]
        };
        let photo = &root["images"][0];
        assert_eq!(photo["mimeType"], "image/jpeg");
        assert!(view(photo["bufferView"].as_u64().unwrap() as usize) == photo_file(container).unwrap().bytes);
        // areas of the triangles as the photo's camera sees them add up to those of the layers
        let mut seen = 0.0;
        for mesh in root["meshes"].as_array().unwrap().iter().filter(|m| m["name"] != "soft 0") {
            let primitive = &mesh["primitives"][0];
            let data =
                |accessor: &Value| view(root["accessors"][accessor.as_u64().unwrap() as usize]["bufferView"].as_u64().unwrap() as usize);
            let places: &[[f32; 3]] = bytemuck::cast_slice(data(&primitive["attributes"]["POSITION"]));
            let triangles: &[[u32; 3]] = bytemuck::cast_slice(data(&primitive["indices"]));
            let k = &scene.intrinsics;
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
    fn the_camera_sees_what_the_photo_shows() {
        let (container, scene) = testing::made();
        let file = glb(container, scene, &|| false).unwrap();
        let camera = &read(&file).0["cameras"][0]["perspective"];
        let (yfov, aspect) = (camera["yfov"].as_f64().unwrap(), camera["aspectRatio"].as_f64().unwrap());
        let fov_x = 2.0 * ((yfov / 2.0).tan() * aspect).atan().to_degrees();
        assert!((fov_x - scene.intrinsics.fov_x(scene.grid.width)).abs() < 1e-9);
    }

    #[test]
    fn a_scene_of_which_nothing_is_seen_has_a_camera() {
        let (container, scene) = testing::made();
        let mut scene = scene.clone();
        scene.layers.clear();
        let file = glb(container, &scene, &|| false).unwrap();
        let (root, _) = read(&file);
        assert!(root["meshes"].is_null() && root["cameras"][0].is_object());
    }
}
