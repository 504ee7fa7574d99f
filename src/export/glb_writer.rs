//! Writes binary glTF files.

use serde_json::{Value, json};

use super::ExportError;
use super::mesh::{Mesh, Space};
use tmpi_core::Scene;

/// Near plane of the file's camera.
const NEAR: f64 = 0.05;
const WEBP: &str = "EXT_texture_webp";

// constants of glTF for accessors, buffer views and samplers
const FLOAT: u32 = 5126;
const UNSIGNED_INT: u32 = 5125;
const VERTICES: u32 = 34_962;
const INDICES: u32 = 34_963;
const LINEAR: u32 = 9729;
const CLAMP: u32 = 33_071;

/// Accessors of a mesh's vertices.
pub(super) struct Vertices {
    position: usize,
    coordinates: usize,
}

#[derive(Default)]
pub(super) struct File {
    binary: Vec<u8>,
    views: Vec<Value>,
    accessors: Vec<Value>,
    images: Vec<Value>,
    materials: Vec<Value>,
    meshes: Vec<Value>,
    nodes: Vec<Value>,
    textures: Vec<Value>,
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

    pub fn vertices(&mut self, Mesh { positions, coordinates, .. }: &Mesh) -> Vertices {
        let bound = |pick: fn(f32, f32) -> f32| -> Vec<f32> {
            (0..3).map(|axis| positions.iter().map(|p| p[axis]).reduce(pick).unwrap_or_default()).collect()
        };
        let (least, most) = (bound(f32::min), bound(f32::max));
        let count = positions.len();
        let view = self.view(bytemuck::cast_slice(positions), Some(VERTICES));
        let position = json!({ "bufferView": view, "componentType": FLOAT, "count": count, "type": "VEC3", "min": least, "max": most });
        let position = push(&mut self.accessors, position);
        let view = self.view(bytemuck::cast_slice(coordinates), Some(VERTICES));
        let coordinates = json!({ "bufferView": view, "componentType": FLOAT, "count": count, "type": "VEC2" });
        Vertices { position, coordinates: push(&mut self.accessors, coordinates) }
    }

    /// Adds a texture from a picture (media type, bytes).
    pub fn texture(&mut self, name: &str, picture: &(&'static str, Vec<u8>)) -> usize {
        let view = self.view(&picture.1, None);
        let image = push(&mut self.images, json!({ "name": name, "bufferView": view, "mimeType": picture.0 }));
        let source = json!({ "source": image });
        let mut texture = if picture.0 == "image/webp" { json!({ "extensions": { WEBP: source } }) } else { source };
        texture["sampler"] = 0.into();
        push(&mut self.textures, texture)
    }

    /// Adds triangles with a material of their own; `alpha` is its alpha mode.
    pub fn surface(&mut self, name: &str, vertices: &Vertices, triangles: &[[u32; 3]], texture: usize, alpha: &Value) {
        let mut material = json!({
            "name": name,
            "doubleSided": true,
            "pbrMetallicRoughness": { "baseColorTexture": { "index": texture }, "metallicFactor": 0, "roughnessFactor": 1 },
            "extensions": { "KHR_materials_unlit": {} },
        });
        for (key, value) in alpha.as_object().into_iter().flatten() {
            material[key] = value.clone();
        }
        let material = push(&mut self.materials, material);
        let view = self.view(bytemuck::cast_slice(triangles), Some(INDICES));
        let count = triangles.len() * 3;
        let indices = json!({ "bufferView": view, "componentType": UNSIGNED_INT, "count": count, "type": "SCALAR" });
        let indices = push(&mut self.accessors, indices);
        let attributes = json!({ "POSITION": vertices.position, "TEXCOORD_0": vertices.coordinates });
        let primitive = json!({ "attributes": attributes, "indices": indices, "material": material });
        let mesh = push(&mut self.meshes, json!({ "name": name, "primitives": [primitive] }));
        push(&mut self.nodes, json!({ "name": name, "mesh": mesh }));
    }

    pub fn finish(mut self, scene: &Scene, space: &Space) -> Result<Vec<u8>, ExportError> {
        let (k, v, g) = (&space.intrinsics, &scene.view_box, &scene.grid);
        let (w, h) = (f64::from(g.width), f64::from(g.height));
        let camera = json!({
            "name": "camera",
            "type": "perspective",
            "perspective": {
                "yfov": 2.0 * (h / 2.0 / k.fy).atan(),
                "aspectRatio": (w / k.fx) / (h / k.fy),
                "znear": NEAR,
                "zfar": 2.0 / space.least,
            },
        });
        let mut parts: Vec<usize> = (0..self.nodes.len()).collect();
        parts.push(push(&mut self.nodes, json!({ "name": "camera", "camera": 0 })));
        let mut photo = json!({ "name": "3D photo", "children": parts });
        if let Some(middle) = space.middle {
            photo["translation"] = json!([0.0, 0.0, middle]);
        }
        let photo = push(&mut self.nodes, photo);
        let unit =
            if space.middle.is_some() { "longer side of the photo" } else { "distance from the camera to the photo's nearest surface" };
        let extras = json!({
            "unit": unit,
            "farthest": 1.0 / space.least,
            // disparity in the file is gain · photo's disparity + offset
            "disparity": { "gain": space.gain, "offset": space.offset },
            "view_box": [v.x, v.y, v.z],
            "photo": { "width": g.width, "height": g.height },
            "intrinsics": scene.intrinsics,
            "tiles": g.tiles(),
            "planes": scene.layers.len(),
        });
        let mut used = vec!["KHR_materials_unlit"];
        if self.textures.iter().any(|t| t["extensions"].is_object()) {
            used.push(WEBP);
        }
        self.binary.resize(self.binary.len().next_multiple_of(4), 0);
        let mut root = json!({
            "asset": { "version": "2.0", "generator": concat!("tmpi ", env!("CARGO_PKG_VERSION")) },
            "extensionsUsed": used,
            "scene": 0,
            "scenes": [{ "name": "3D photo", "nodes": [photo], "extras": extras }],
            "nodes": self.nodes,
            "cameras": [camera],
            "meshes": self.meshes,
            "materials": self.materials,
            "textures": self.textures,
            "images": self.images,
            "samplers": [{ "magFilter": LINEAR, "minFilter": LINEAR, "wrapS": CLAMP, "wrapT": CLAMP }],
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{ "byteLength": self.binary.len() }],
        });
        if used.contains(&WEBP) {
            root["extensionsRequired"] = json!([WEBP]);
        }
        // glTF forbids empty arrays; a scene without visible layers has only a camera
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
        for word in [2, total] {
            out.extend_from_slice(&word.to_le_bytes());
        }
        for (kind, chunk) in [(b"JSON", &text), (b"BIN\0", &self.binary)] {
            out.extend_from_slice(&(chunk.len() as u32).to_le_bytes());
            out.extend_from_slice(kind);
            out.extend_from_slice(chunk);
        }
        Ok(out)
    }
}

fn push(all: &mut Vec<Value>, value: Value) -> usize {
    all.push(value);
    all.len() - 1
}
