//! Draws one view: uniform, two passes, read-back.

use std::sync::mpsc;
use std::time::Duration;

use super::device::{COLOUR, DEPTH, Device, UNIFORM_BYTES, WIDE};
use super::scene::Loaded;
use crate::{NEAR, RenderError, View};
use tmpi_core::{Camera, Scene};

/// Vertices per instance, as in `tmpi.wgsl`.
const VERTICES: u32 = 18;

/// Time limit of a view: a driver that takes longer hangs.
const TIMEOUT: Duration = Duration::from_secs(20);

/// Picture, depth and read-back buffer of one size.
#[derive(Debug)]
pub(super) struct Target {
    colour: wgpu::Texture,
    /// Receives stacks of soft layers before they are rounded.
    wide: Option<Wide>,
    depth: wgpu::Texture,
    buffer: wgpu::Buffer,
    bytes_per_row: u32,
}

/// A picture of 16-bit floats.
#[derive(Debug)]
struct Wide {
    texture: wgpu::Texture,
    bind_group: wgpu::BindGroup,
}

impl Wide {
    fn new(device: &Device, texture: wgpu::Texture) -> Self {
        let view = texture.create_view(&wgpu::TextureViewDescriptor::default());
        let bind_group = device.handle.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some("wide"),
            layout: &device.round.get_bind_group_layout(0),
            entries: &[wgpu::BindGroupEntry { binding: 0, resource: wgpu::BindingResource::TextureView(&view) }],
        });
        Self { texture, bind_group }
    }

    /// Rounds the picture to `colour`.
    fn round(&self, encoder: &mut wgpu::CommandEncoder, device: &Device, colour: &wgpu::Texture) {
        let view = colour.create_view(&wgpu::TextureViewDescriptor::default());
        let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            label: Some("round"),
            color_attachments: &[Some(cleared(&view))],
            ..wgpu::RenderPassDescriptor::default()
        });
        pass.set_pipeline(&device.round);
        pass.set_bind_group(0, &self.bind_group, &[]);
        pass.draw(0..3, 0..1);
    }
}

/// An attachment that is transparent before the pass.
fn cleared(view: &wgpu::TextureView) -> wgpu::RenderPassColorAttachment<'_> {
    let ops = wgpu::Operations { load: wgpu::LoadOp::Clear(wgpu::Color::TRANSPARENT), store: wgpu::StoreOp::Store };
    wgpu::RenderPassColorAttachment { view, depth_slice: None, resolve_target: None, ops }
}

impl Target {
    /// Creates a target of the camera's size; `wide` adds the picture for stacks of soft layers. Returns an error if the adapter cannot
    /// hold the target.
    pub fn new(device: &Device, camera: &Camera, wide: bool) -> Result<Self, RenderError> {
        let (width, height) = (camera.width, camera.height);
        // copies need a row pitch that is a multiple of 256 bytes
        let bytes_per_row = (width * 4).next_multiple_of(wgpu::COPY_BYTES_PER_ROW_ALIGNMENT);
        let size = u64::from(bytes_per_row) * u64::from(height);
        let side = device.limits.max_texture_dimension_2d;
        if width > side || height > side || size > device.limits.max_buffer_size {
            return Err(RenderError::TooLarge(format!("a view of {width}×{height}; the adapter draws at most {side} a side")));
        }
        let texture = |label, format, usage| device.texture(label, [width, height, 1], format, usage);
        let attachment = wgpu::TextureUsages::RENDER_ATTACHMENT;
        let buffer = device.handle.create_buffer(&wgpu::BufferDescriptor {
            label: Some("read-back"),
            size,
            usage: wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::MAP_READ,
            mapped_at_creation: false,
        });
        Ok(Self {
            colour: texture("colour", COLOUR, attachment | wgpu::TextureUsages::COPY_SRC),
            wide: wide.then(|| Wide::new(device, texture("wide colour", WIDE, attachment | wgpu::TextureUsages::TEXTURE_BINDING))),
            depth: texture("depth", DEPTH, attachment),
            buffer,
            bytes_per_row,
        })
    }

    /// Whether the target has the camera's size, and is wide exactly if `wide` is true.
    pub fn fits(&self, camera: &Camera, wide: bool) -> bool {
        (self.colour.width(), self.colour.height(), self.wide.is_some()) == (camera.width, camera.height, wide)
    }

    /// Draws a loaded scene and reads the view back.
    pub fn draw(&self, device: &Device, scene: &Scene, loaded: &Loaded, camera: &Camera) -> Result<View, RenderError> {
        device.queue.write_buffer(&device.uniform, 0, &uniform(scene, camera));
        let mut encoder = device.handle.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        self.passes(&mut encoder, device, loaded, camera);
        encoder.copy_texture_to_buffer(
            self.colour.as_image_copy(),
            wgpu::TexelCopyBufferInfo {
                buffer: &self.buffer,
                layout: wgpu::TexelCopyBufferLayout { offset: 0, bytes_per_row: Some(self.bytes_per_row), rows_per_image: None },
            },
            self.colour.size(),
        );
        device.queue.submit([encoder.finish()]);
        self.read(device)
    }

    fn passes(&self, encoder: &mut wgpu::CommandEncoder, device: &Device, loaded: &Loaded, camera: &Camera) {
        let drawn = self.wide.as_ref().map_or(&self.colour, |w| &w.texture);
        let pipelines = if self.wide.is_some() { &device.wide } else { &device.plain };
        let colour = drawn.create_view(&wgpu::TextureViewDescriptor::default());
        let depth = self.depth.create_view(&wgpu::TextureViewDescriptor::default());
        let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            label: Some("tmpi"),
            color_attachments: &[Some(cleared(&colour))],
            depth_stencil_attachment: Some(wgpu::RenderPassDepthStencilAttachment {
                view: &depth,
                depth_ops: Some(wgpu::Operations { load: wgpu::LoadOp::Clear(0.0), store: wgpu::StoreOp::Discard }),
                stencil_ops: None,
            }),
            ..wgpu::RenderPassDescriptor::default()
        });
        pass.set_bind_group(0, &loaded.bind_group, &[]);
        // for a camera that looks against the reference camera's direction, the order of layers along a ray is reversed
        let soft = if camera.pose.extrinsics().0[2][2] < 0.0 { &loaded.soft_backward } else { &loaded.soft };
        for (pipeline, instances) in pipelines.iter().zip([&loaded.opaque, soft]) {
            if instances.count > 0 {
                pass.set_pipeline(pipeline);
                pass.set_vertex_buffer(0, instances.buffer.slice(..));
                pass.draw(0..VERTICES, 0..instances.count);
            }
        }
        drop(pass);
        if let Some(wide) = &self.wide {
            wide.round(encoder, device, &self.colour);
        }
    }

    fn read(&self, device: &Device) -> Result<View, RenderError> {
        let (sender, receiver) = mpsc::sync_channel(1);
        self.buffer.map_async(wgpu::MapMode::Read, .., move |result| {
            // the receiver is gone only if the wait below has failed
            let _ = sender.send(result);
        });
        let failed = |what: &str, e: &dyn std::fmt::Display| RenderError::Adapter(format!("{what}: {e}"));
        let wait = wgpu::PollType::Wait { submission_index: None, timeout: Some(TIMEOUT) };
        let polled = device.handle.poll(wait);
        device.check()?;
        polled.map_err(|e| failed("waiting for the view", &e))?;
        receiver.try_recv().map_err(|e| failed("reading the view back", &e))?.map_err(|e| failed("reading the view back", &e))?;
        let (width, height) = (self.colour.width(), self.colour.height());
        let mut rgba = Vec::with_capacity(width as usize * height as usize);
        {
            let range = self.buffer.get_mapped_range(..).map_err(|e| failed("reading the view back", &e))?;
            for row in range.chunks_exact(self.bytes_per_row as usize) {
                rgba.extend_from_slice(row[..width as usize * 4].as_chunks::<4>().0);
            }
        }
        self.buffer.unmap();
        Ok(View { width, height, rgba })
    }
}

/// The uniform at the start of `tmpi.wgsl`.
fn uniform(scene: &Scene, camera: &Camera) -> [u8; UNIFORM_BYTES] {
    let (r, t) = camera.pose.extrinsics();
    let column = |j: usize| [r[0][j], r[1][j], r[2][j], 0.0];
    let (k, out) = (&scene.intrinsics, &camera.intrinsics);
    let rows = [
        column(0),
        column(1),
        column(2),
        [t[0], t[1], t[2], NEAR],
        [k.fx, k.fy, k.cx, k.cy],
        [out.fx, out.fy, out.cx, out.cy],
        [f64::from(camera.width), f64::from(camera.height), scene.grid.half(), 0.0],
    ];
    let mut bytes = [0; UNIFORM_BYTES];
    for (to, v) in bytes.as_chunks_mut::<4>().0.iter_mut().zip(rows.iter().flatten()) {
        *to = (*v as f32).to_ne_bytes();
    }
    bytes
}
