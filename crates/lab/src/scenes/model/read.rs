//! Reads meshes from binary glTF files.

use std::collections::HashMap;
use std::io::Cursor;
use std::sync::Arc;

use gltf::accessor::DataType;
use gltf::image::Source;
use gltf::material::AlphaMode;
use gltf::{Accessor, Document, Node, Primitive};
use image::{ImageReader, Limits};

use super::mesh::{Material, Mesh, Vertex};
use super::{FARTHEST, MAX_TEXELS, MAX_TRIANGLES, ModelError, Up};
use crate::scenes::math::{V3, v3};
use crate::scenes::photo_texture::Levels;
use tmpi_core::Photo;

/// Maximum nesting depth of nodes.
const MAX_DEPTH: u32 = 64;
/// Maximum side of a texture in pixels.
const MAX_SIDE: u32 = 8192;

/// A 4 × 4 matrix in column-major order, as in glTF.
type Matrix = [[f64; 4]; 4];

/// Reads all meshes of the file's scene; x right, y down, z ahead.
pub fn parts(bytes: &[u8], up: Up) -> Result<Vec<Mesh>, ModelError> {
    let file = gltf::Gltf::from_slice(bytes)?;
    let blob = file.blob.as_deref().ok_or(ModelError::Missing("the binary chunk"))?;
    let mut reader = Reader { blob, materials: HashMap::new(), textures: HashMap::new(), triangles: 0, texels: 0, parts: Vec::new() };
    let turned = match up {
        Up::Y => [[1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 0.0, 0.0, 1.0]],
        Up::Z => [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]],
    };
    let document: &Document = &file.document;
    let scene = document.default_scene().or_else(|| document.scenes().next()).ok_or(ModelError::Nothing)?;
    for node in scene.nodes() {
        reader.node(&node, &turned, MAX_DEPTH)?;
    }
    Ok(reader.parts)
}

struct Reader<'a> {
    blob: &'a [u8],
    /// Materials by index, with and without a texture.
    materials: HashMap<(Option<usize>, bool), Material>,
    textures: HashMap<usize, Texture>,
    triangles: usize,
    texels: u64,
    parts: Vec<Mesh>,
}

#[derive(Clone)]
struct Texture {
    levels: Arc<Levels>,
    width: usize,
    height: usize,
    alpha: Arc<[u8]>,
}

impl Reader<'_> {
    fn node(&mut self, node: &Node, above: &Matrix, deep: u32) -> Result<(), ModelError> {
        let matrix = product(above, &node.transform().matrix().map(|c| c.map(f64::from)));
        for primitive in node.mesh().iter().flat_map(gltf::Mesh::primitives) {
            self.primitive(&primitive, &matrix)?;
        }
        let deep = deep.checked_sub(1).ok_or(ModelError::TooMuch { what: "nested nodes", most: MAX_DEPTH.into() })?;
        node.children().try_for_each(|child| self.node(&child, &matrix, deep))
    }

    fn primitive(&mut self, primitive: &Primitive, matrix: &Matrix) -> Result<(), ModelError> {
        if primitive.mode() != gltf::mesh::Mode::Triangles {
            return Ok(());
        }
        let blob = self.blob;
        let read = primitive.reader(|buffer| matches!(buffer.source(), gltf::buffer::Source::Bin).then_some(blob));
        let colour = primitive.material().pbr_metallic_roughness();
        let set = colour.base_color_texture().map_or(0, |t| t.tex_coord());
        let positions = primitive.get(&gltf::Semantic::Positions).filter(|a| is_plain(a, &[DataType::F32]));
        let corners = primitive.indices().or_else(|| positions.clone()).map_or(0, |a| a.count());
        self.triangles += corners / 3;
        if self.triangles > MAX_TRIANGLES {
            return Err(ModelError::TooMuch { what: "triangles", most: MAX_TRIANGLES as u64 });
        }
        let positions = positions.and_then(|_| read.read_positions()).ok_or(ModelError::Missing("the position data"))?;
        let positions: Vec<V3> = positions.map(|p| applied(matrix, p, 1.0)).collect();
        let has = |semantic, types: &[DataType]| primitive.get(&semantic).filter(|a| is_plain(a, types));
        let normals: Option<Vec<V3>> = has(gltf::Semantic::Normals, &[DataType::F32])
            .and_then(|_| read.read_normals())
            .map(|n| n.map(|n| applied(matrix, n, 0.0).unit()).collect());
        let uv: Option<Vec<[f64; 2]>> = has(gltf::Semantic::TexCoords(set), &[DataType::F32, DataType::U8, DataType::U16])
            .and_then(|_| read.read_tex_coords(set))
            .map(|uv| uv.into_f32().map(|uv| uv.map(f64::from)).collect());
        let order: Vec<u32> = match primitive.indices() {
            None => (0..positions.len() as u32).collect(),
            Some(a) if is_plain(&a, &[DataType::U8, DataType::U16, DataType::U32]) => {
                read.read_indices().ok_or(ModelError::Missing("the index data"))?.into_u32().collect()
            }
            Some(_) => return Err(ModelError::Missing("the index data")),
        };
        let corner = |i: u32| {
            let i = i as usize;
            let at = *positions.get(i).ok_or(ModelError::Missing("a vertex"))?;
            let normal = normals.as_ref().and_then(|n| n.get(i)).copied().unwrap_or_default();
            let uv = uv.as_ref().and_then(|uv| uv.get(i)).copied().unwrap_or_default();
            let is_valid = at.array().iter().all(|v| v.abs() <= FARTHEST) && normal.array().into_iter().chain(uv).all(f64::is_finite);
            if is_valid { Ok(Vertex { at, normal, uv }) } else { Err(ModelError::Far) }
        };
        let triangles =
            order.chunks_exact(3).map(|t| Ok([corner(t[0])?, corner(t[1])?, corner(t[2])?])).collect::<Result<Vec<_>, ModelError>>()?;
        let material = self.material(&primitive.material(), uv.is_some())?;
        self.parts.extend(Mesh::new(triangles.into_iter(), material));
        Ok(())
    }

    fn material(&mut self, material: &gltf::Material, has_uv: bool) -> Result<Material, ModelError> {
        if let Some(known) = self.materials.get(&(material.index(), has_uv)) {
            return Ok(known.clone());
        }
        let surface = material.pbr_metallic_roughness();
        let [r, g, b, _] = surface.base_color_factor().map(f64::from);
        let texture = surface.base_color_texture().filter(|_| has_uv).map(|t| self.texture(&t.texture().source())).transpose()?;
        let least = match material.alpha_mode() {
            AlphaMode::Opaque => None,
            AlphaMode::Mask => Some((material.alpha_cutoff().unwrap_or(0.5).clamp(0.0, 1.0) * 255.0).ceil() as u8),
            // treat texels of at least half opacity as opaque
            AlphaMode::Blend => Some(128),
        };
        let cut = texture.as_ref().zip(least).map(|(t, least)| (t.width, t.height, Arc::clone(&t.alpha), least));
        let new = Material { colour: v3(r, g, b), texture: texture.map(|t| t.levels), cut };
        self.materials.insert((material.index(), has_uv), new.clone());
        Ok(new)
    }

    fn texture(&mut self, image: &gltf::Image) -> Result<Texture, ModelError> {
        if let Some(known) = self.textures.get(&image.index()) {
            return Ok(known.clone());
        }
        let missing = ModelError::Missing("a texture");
        let Source::View { view, .. } = image.source() else { return Err(missing) };
        let bytes = self.blob.get(view.offset()..view.offset().saturating_add(view.length())).ok_or(missing)?;
        let mut reader = ImageReader::new(Cursor::new(bytes)).with_guessed_format().map_err(image::ImageError::IoError)?;
        let mut limits = Limits::default();
        (limits.max_image_width, limits.max_image_height) = (Some(MAX_SIDE), Some(MAX_SIDE));
        reader.limits(limits);
        let pixels = reader.decode()?.to_rgba8();
        let (width, height) = pixels.dimensions();
        self.texels += u64::from(width) * u64::from(height);
        if self.texels > MAX_TEXELS {
            return Err(ModelError::TooMuch { what: "texture pixels", most: MAX_TEXELS });
        }
        let photo = Photo { width, height, rgb: pixels.pixels().map(|p| [p[0], p[1], p[2]]).collect() };
        let alpha = pixels.pixels().map(|p| p[3]).collect();
        let new = Texture { levels: Arc::new(Levels::new(&photo)), width: width as usize, height: height as usize, alpha };
        self.textures.insert(image.index(), new.clone());
        Ok(new)
    }
}

/// Whether an accessor's values can be read directly.
fn is_plain(a: &Accessor, types: &[DataType]) -> bool {
    let packed = a.view().is_some_and(|v| v.stride().is_none_or(|s| s >= a.size()));
    packed && a.sparse().is_none() && a.count() > 0 && types.contains(&a.data_type())
}

fn product(a: &Matrix, b: &Matrix) -> Matrix {
    std::array::from_fn(|j| std::array::from_fn(|i| (0..4).map(|k| a[k][i] * b[j][k]).sum()))
}

/// Transforms a point (`w` 1) or a direction (`w` 0). Normals are correct only for uniform scales.
fn applied(m: &Matrix, p: [f32; 3], w: f64) -> V3 {
    let at = |i: usize| (0..3).map(|k| m[k][i] * f64::from(p[k])).sum::<f64>() + m[3][i] * w;
    v3(at(0), at(1), at(2))
}
