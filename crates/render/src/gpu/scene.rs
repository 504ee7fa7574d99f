//! Loads a scene into graphics memory: atlas pages and instances.

use bytemuck::{Pod, Zeroable};
use half::f16;
use wgpu::util::DeviceExt;

use super::device::{COLOUR, Device, WIDE};
use super::texture_atlas::{Packing, pack};
use crate::border::{Expander, Piece, border_colours, pieces};
use crate::scene_cache::{Content, back_to_front};
use crate::{OPAQUE, RenderError};
use tmpi_core::Scene;

/// An instance, as at the start of `tmpi.wgsl`.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
struct Instance {
    plane: [f32; 3],
    page: f32,
    centre: [f32; 2],
    rect: [f32; 4],
    atlas: [f32; 2],
}

/// Instances in drawing order.
#[derive(Debug)]
pub(super) struct Instances {
    pub buffer: wgpu::Buffer,
    pub count: u32,
}

/// A scene in graphics memory.
#[derive(Debug)]
pub(super) struct Loaded {
    pub bind_group: wgpu::BindGroup,
    /// Pieces with opaque texels, in layer order.
    pub opaque: Instances,
    /// Pieces with soft texels, back to front for a camera that looks forward.
    pub soft: Instances,
    /// Pieces with soft texels, back to front for a camera that looks backward.
    pub soft_backward: Instances,
    /// Whether the scene has stacks of soft texels that 8 bits per layer would spoil.
    pub wide: bool,
}

/// Maximum number of stacked soft texels that are blended in 8 bits, where each may round by half a level.
const STACK: u8 = 4;

/// Maximum number of soft texels over one pixel of the photo in one tile; stops counting above [`STACK`].
fn stacked(scene: &Scene) -> u8 {
    let (mut most, mut over, mut tile) = (0, Vec::new(), None);
    for layer in &scene.layers {
        let r = scene.grid.rect(layer.tile);
        if tile != Some(layer.tile) {
            tile = Some(layer.tile);
            over.clear();
            over.resize(r.area(), 0_u8);
        }
        let alphas = &scene.texels.alpha[layer.first_texel..][..layer.rect.area()];
        for (y, row) in alphas.chunks(layer.rect.w as usize).enumerate() {
            let at = (layer.rect.y - r.y) as usize * r.w as usize + y * r.w as usize + (layer.rect.x - r.x) as usize;
            for (n, &a) in over[at..].iter_mut().zip(row) {
                *n += u8::from(a > 0 && f32::from(a) / 255.0 < OPAQUE && *n <= STACK);
                most = most.max(*n);
            }
        }
        if most > STACK {
            break;
        }
    }
    most
}

/// The pieces to draw, and where their texels go.
#[derive(Debug)]
pub(super) struct Plan {
    /// The layers and their mirror images beyond the borders, in layer order; only pieces with visible content. `contents` describes each.
    pieces: Vec<Piece>,
    contents: Vec<Content>,
    packing: Packing,
    /// Whether texels are 16-bit floats: thin layers in stacks need more than 8 bits once they are premultiplied.
    wide: bool,
}

impl Plan {
    /// Plans what to load of `scene`, within the adapter's limits.
    pub fn new(scene: &Scene, limits: &wgpu::Limits) -> Result<Self, RenderError> {
        scene.validate()?;
        let all = pieces(scene).into_iter().map(|p| (p, Content::of(p.alphas(scene))));
        let (pieces, contents): (Vec<Piece>, Vec<Content>) = all.filter(|(_, c)| c.opaque || c.soft).unzip();
        let sizes: Vec<(u32, u32)> = pieces.iter().map(|p| (p.size[0], p.size[1])).collect();
        let packing = pack(&sizes, limits.max_texture_dimension_2d, limits.max_texture_array_layers)?;
        Ok(Self { pieces, contents, packing, wide: stacked(scene) > STACK })
    }

    /// Bytes of graphics memory that the plan takes.
    pub fn bytes(&self) -> usize {
        let p = &self.packing;
        let texel = if self.wide { 8 } else { 4 };
        p.width as usize * p.height as usize * p.pages as usize * texel + self.pieces.len() * 3 * size_of::<Instance>()
    }

    /// Uploads the scene.
    pub fn load(&self, scene: &Scene, device: &Device) -> Loaded {
        let texture = self.upload(scene, device);
        let of = |indices: &mut dyn Iterator<Item = usize>, wanted: fn(&Content) -> bool| {
            let all: Vec<Instance> = indices.filter(|&n| wanted(&self.contents[n])).map(|n| self.instance(n)).collect();
            Instances::new(device, &all)
        };
        Loaded {
            bind_group: device.bind_group(&texture),
            opaque: of(&mut (0..self.pieces.len()), |c| c.opaque),
            soft: of(&mut back_to_front(scene, &self.pieces, false).into_iter(), |c| c.soft),
            wide: self.wide,
            soft_backward: of(&mut back_to_front(scene, &self.pieces, true).into_iter(), |c| c.soft),
        }
    }

    fn instance(&self, n: usize) -> Instance {
        let (piece, position) = (&self.pieces[n], self.packing.positions[n]);
        let (p, centre) = (&piece.plane, piece.centre);
        let [[left, right], [upper, lower]] = piece.drawn;
        let corner = piece.corner.map(|v| v as f64);
        Instance {
            plane: [p.a as f32, p.b as f32, p.c as f32],
            page: position.page as f32,
            centre: [centre.0 as f32, centre.1 as f32],
            rect: [corner[0] + left, corner[1] + upper, right - left, lower - upper].map(|v| v as f32),
            atlas: [f64::from(position.x) + left, f64::from(position.y) + upper].map(|v| v as f32),
        }
    }

    fn upload(&self, scene: &Scene, device: &Device) -> wgpu::Texture {
        if self.wide {
            self.pages(scene, device, WIDE, |[r, g, b, a]| {
                let alpha = f32::from(a) / 255.0;
                let premultiplied = |v: u8| f16::from_f32(f32::from(v) / 255.0 * alpha).to_bits();
                [premultiplied(r), premultiplied(g), premultiplied(b), f16::from_f32(alpha).to_bits()]
            })
        } else {
            self.pages(scene, device, COLOUR, premultiplied)
        }
    }

    /// Creates pages of a format from texels that `texel` converts.
    fn pages<T: Pod>(&self, scene: &Scene, device: &Device, format: wgpu::TextureFormat, texel: impl Fn([u8; 4]) -> T) -> wgpu::Texture {
        let p = &self.packing;
        let usage = wgpu::TextureUsages::TEXTURE_BINDING | wgpu::TextureUsages::COPY_DST;
        let texture = device.texture("atlas", [p.width, p.height, p.pages], format, usage);
        let mut page = vec![T::zeroed(); p.width as usize * p.height as usize];
        let (colours, mut texels) = (border_colours(scene, &self.pieces), Vec::new());
        let mut expander = Expander::new(scene, colours.as_ref());
        for number in 0..p.pages {
            for (piece, position) in self.pieces.iter().zip(&p.positions).filter(|(_, position)| position.page == number) {
                texels.clear();
                expander.append(piece, &mut texels);
                let width = piece.size[0] as usize;
                for (y, row) in texels.chunks(width).enumerate() {
                    let start = (position.y as usize + y) * p.width as usize + position.x as usize;
                    for (to, from) in page[start..start + width].iter_mut().zip(row) {
                        *to = texel(*from);
                    }
                }
            }
            device.write_page(&texture, number, bytemuck::cast_slice(&page));
        }
        texture
    }
}

impl Instances {
    fn new(device: &Device, all: &[Instance]) -> Self {
        // an empty buffer cannot be bound
        let spare = [Instance::zeroed()];
        let contents = bytemuck::cast_slice(if all.is_empty() { &spare } else { all });
        let descriptor = wgpu::util::BufferInitDescriptor { label: Some("instances"), contents, usage: wgpu::BufferUsages::VERTEX };
        Self { buffer: device.handle.create_buffer_init(&descriptor), count: all.len() as u32 }
    }
}

fn premultiplied(t: [u8; 4]) -> [u8; 4] {
    let a = u32::from(t[3]);
    let c = |v: u8| ((u32::from(v) * a + 127) / 255) as u8;
    [c(t[0]), c(t[1]), c(t[2]), t[3]]
}
