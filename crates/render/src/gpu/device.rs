//! Adapter, device and pipelines, and the errors that they report.

use std::sync::{Arc, Mutex, PoisonError};

use crate::RenderError;

/// Format of views and atlases: the photo's own encoding, without conversion.
pub(super) const COLOUR: wgpu::TextureFormat = wgpu::TextureFormat::Rgba8Unorm;
/// Format of views and texels for stacks of soft layers: with 8 bits, each layer would round.
pub(super) const WIDE: wgpu::TextureFormat = wgpu::TextureFormat::Rgba16Float;
/// Reversed depth needs floating point to stay precise at infinity.
pub(super) const DEPTH: wgpu::TextureFormat = wgpu::TextureFormat::Depth32Float;
/// Size of the uniform at the start of `tmpi.wgsl`.
pub(super) const UNIFORM_BYTES: usize = 112;

/// An open device and everything that does not depend on the scene.
#[derive(Debug)]
pub(super) struct Device {
    pub handle: wgpu::Device,
    pub queue: wgpu::Queue,
    pub limits: wgpu::Limits,
    pub uniform: wgpu::Buffer,
    /// Pass 1 and pass 2 for a [`COLOUR`] target.
    pub plain: [wgpu::RenderPipeline; 2],
    /// Pass 1 and pass 2 for a [`WIDE`] target.
    pub wide: [wgpu::RenderPipeline; 2],
    /// Rounds a [`WIDE`] picture to [`COLOUR`].
    pub round: wgpu::RenderPipeline,
    layout: wgpu::BindGroupLayout,
    sampler: wgpu::Sampler,
    failure: Failure,
}

/// The first error since the last query.
#[derive(Clone, Debug, Default)]
struct Failure(Arc<Mutex<Option<String>>>);

impl Failure {
    fn note(&self, text: String) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(text);
    }

    fn take(&self) -> Option<String> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).take()
    }
}

fn adapter_error(what: &str, e: impl std::fmt::Display) -> RenderError {
    RenderError::Adapter(format!("{what}: {e}"))
}

/// The best adapter; a software adapter only if `software` is true and there is no other.
fn adapter(software: bool) -> Result<wgpu::Adapter, RenderError> {
    let descriptor =
        wgpu::InstanceDescriptor { backends: wgpu::Backends::PRIMARY, ..wgpu::InstanceDescriptor::new_without_display_handle() };
    let instance = wgpu::Instance::new(descriptor);
    let rank = |a: &wgpu::Adapter| match a.get_info().device_type {
        wgpu::DeviceType::DiscreteGpu => 0,
        wgpu::DeviceType::IntegratedGpu => 1,
        wgpu::DeviceType::VirtualGpu => 2,
        wgpu::DeviceType::Other => 3,
        wgpu::DeviceType::Cpu => 4,
    };
    let adapters = pollster::block_on(instance.enumerate_adapters(wgpu::Backends::PRIMARY));
    let best = adapters.into_iter().filter(|a| software || rank(a) < 4).min_by_key(rank);
    let wanted =
        if software { "no adapter found (Vulkan, Metal or DirectX 12)" } else { "no hardware adapter found (Vulkan, Metal or DirectX 12)" };
    best.ok_or_else(|| RenderError::Adapter(wanted.into()))
}

impl Device {
    /// Opens the best adapter.
    pub fn open(software: bool) -> Result<Self, RenderError> {
        let adapter = adapter(software)?;
        let info = adapter.get_info();
        tracing::info!(adapter = info.name, backend = %info.backend, kind = ?info.device_type, "graphics adapter");
        let limits = adapter.limits();
        let descriptor =
            wgpu::DeviceDescriptor { label: Some("tmpi"), required_limits: limits.clone(), ..wgpu::DeviceDescriptor::default() };
        let (device, queue) =
            pollster::block_on(adapter.request_device(&descriptor)).map_err(|e| adapter_error("opening the device", e))?;
        let failure = Failure::default();
        let (on_error, on_loss) = (failure.clone(), failure.clone());
        device.on_uncaptured_error(Arc::new(move |e: wgpu::Error| on_error.note(e.to_string())));
        device.set_device_lost_callback(move |reason, text| on_loss.note(format!("device lost ({reason:?}): {text}")));

        let layout = layout(&device);
        let uniform = device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("view"),
            size: UNIFORM_BYTES as u64,
            usage: wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        let sampler = device.create_sampler(&wgpu::SamplerDescriptor {
            mag_filter: wgpu::FilterMode::Linear,
            min_filter: wgpu::FilterMode::Linear,
            ..wgpu::SamplerDescriptor::default()
        });
        let module = device.create_shader_module(wgpu::ShaderModuleDescriptor {
            label: Some("tmpi.wgsl"),
            source: wgpu::ShaderSource::Wgsl(include_str!("../../../../static/draw/tmpi.wgsl").into()),
        });
        let [plain, wide] = [COLOUR, WIDE].map(|format| pipelines(&device, &module, &layout, format));
        let round = rounding(&device);
        let opened = Self { handle: device, queue, limits, uniform, plain, wide, round, layout, sampler, failure };
        opened.check()?;
        Ok(opened)
    }

    /// Returns an error if the device reported one since the last call.
    pub fn check(&self) -> Result<(), RenderError> {
        self.failure.take().map_or(Ok(()), |text| Err(RenderError::Adapter(text)))
    }

    /// Creates an empty texture of so many pages.
    pub fn texture(
        &self,
        label: &str,
        [width, height, pages]: [u32; 3],
        format: wgpu::TextureFormat,
        usage: wgpu::TextureUsages,
    ) -> wgpu::Texture {
        self.handle.create_texture(&wgpu::TextureDescriptor {
            label: Some(label),
            size: wgpu::Extent3d { width, height, depth_or_array_layers: pages },
            mip_level_count: 1,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D2,
            format,
            usage,
            view_formats: &[],
        })
    }

    /// Fills a page of an atlas with premultiplied texels.
    pub fn write_page(&self, atlas: &wgpu::Texture, page: u32, texels: &[u8]) {
        let to = wgpu::TexelCopyTextureInfo { origin: wgpu::Origin3d { x: 0, y: 0, z: page }, ..atlas.as_image_copy() };
        let (width, height) = (atlas.width(), atlas.height());
        let texel = if atlas.format() == WIDE { 8 } else { 4 };
        let layout = wgpu::TexelCopyBufferLayout { offset: 0, bytes_per_row: Some(width * texel), rows_per_image: Some(height) };
        self.queue.write_texture(to, texels, layout, wgpu::Extent3d { width, height, depth_or_array_layers: 1 });
    }

    /// Creates the bindings of a scene's atlas.
    pub fn bind_group(&self, atlas: &wgpu::Texture) -> wgpu::BindGroup {
        let view = atlas.create_view(&wgpu::TextureViewDescriptor {
            dimension: Some(wgpu::TextureViewDimension::D2Array),
            ..wgpu::TextureViewDescriptor::default()
        });
        let entry = |binding, resource| wgpu::BindGroupEntry { binding, resource };
        self.handle.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some("scene"),
            layout: &self.layout,
            entries: &[
                entry(0, self.uniform.as_entire_binding()),
                entry(1, wgpu::BindingResource::TextureView(&view)),
                entry(2, wgpu::BindingResource::Sampler(&self.sampler)),
            ],
        })
    }
}

fn layout(device: &wgpu::Device) -> wgpu::BindGroupLayout {
    let entry = |binding, visibility, ty| wgpu::BindGroupLayoutEntry { binding, visibility, ty, count: None };
    let uniform = wgpu::BindingType::Buffer { ty: wgpu::BufferBindingType::Uniform, has_dynamic_offset: false, min_binding_size: None };
    let texture = wgpu::BindingType::Texture {
        sample_type: wgpu::TextureSampleType::Float { filterable: true },
        view_dimension: wgpu::TextureViewDimension::D2Array,
        multisampled: false,
    };
    let sampler = wgpu::BindingType::Sampler(wgpu::SamplerBindingType::Filtering);
    device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
        label: Some("scene"),
        entries: &[
            entry(0, wgpu::ShaderStages::VERTEX, uniform),
            entry(1, wgpu::ShaderStages::FRAGMENT, texture),
            entry(2, wgpu::ShaderStages::FRAGMENT, sampler),
        ],
    })
}

/// Creates the pipelines of pass 1 and pass 2 for a target format.
fn pipelines(
    device: &wgpu::Device,
    module: &wgpu::ShaderModule,
    layout: &wgpu::BindGroupLayout,
    format: wgpu::TextureFormat,
) -> [wgpu::RenderPipeline; 2] {
    let layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
        label: Some("tmpi"),
        bind_group_layouts: &[Some(layout)],
        immediate_size: 0,
    });
    let attributes = wgpu::vertex_attr_array![0 => Float32x4, 1 => Float32x4, 2 => Float32x4];
    let instances = wgpu::VertexBufferLayout { array_stride: 48, step_mode: wgpu::VertexStepMode::Instance, attributes: &attributes };
    let of = |fragment, blend, write| {
        let depth = wgpu::DepthStencilState {
            format: DEPTH,
            depth_write_enabled: Some(write),
            depth_compare: Some(wgpu::CompareFunction::GreaterEqual),
            stencil: wgpu::StencilState::default(),
            bias: wgpu::DepthBiasState::default(),
        };
        let target = wgpu::ColorTargetState { format, blend, write_mask: wgpu::ColorWrites::ALL };
        pipeline(device, (module, fragment), Some(&layout), &[Some(instances.clone())], Some(depth), target)
    };
    [of("fs_opaque", None, true), of("fs_soft", Some(wgpu::BlendState::PREMULTIPLIED_ALPHA_BLENDING), false)]
}

/// Creates the pipeline that copies a picture of 16-bit floats to 8 bits, which rounds it once.
fn rounding(device: &wgpu::Device) -> wgpu::RenderPipeline {
    let module = device.create_shader_module(wgpu::ShaderModuleDescriptor {
        label: Some("copy.wgsl"),
        source: wgpu::ShaderSource::Wgsl(include_str!("../../../../static/draw/copy.wgsl").into()),
    });
    pipeline(device, (&module, "fs"), None, &[], None, COLOUR.into())
}

/// Creates the pipeline of a module's vertex shader `vs` and one of its fragment shaders.
fn pipeline(
    device: &wgpu::Device,
    (module, fragment): (&wgpu::ShaderModule, &str),
    layout: Option<&wgpu::PipelineLayout>,
    buffers: &[Option<wgpu::VertexBufferLayout<'_>>],
    depth_stencil: Option<wgpu::DepthStencilState>,
    target: wgpu::ColorTargetState,
) -> wgpu::RenderPipeline {
    let compilation_options = wgpu::PipelineCompilationOptions::default();
    device.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
        label: Some(fragment),
        layout,
        vertex: wgpu::VertexState { module, entry_point: Some("vs"), compilation_options: compilation_options.clone(), buffers },
        primitive: wgpu::PrimitiveState::default(),
        depth_stencil,
        multisample: wgpu::MultisampleState::default(),
        fragment: Some(wgpu::FragmentState { module, entry_point: Some(fragment), compilation_options, targets: &[Some(target)] }),
        multiview_mask: None,
        cache: None,
    })
}
