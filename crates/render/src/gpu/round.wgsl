// Copies a picture of 16-bit floats to one of 8 bits, which rounds it once.

@group(0) @binding(0) var wide: texture_2d<f32>;

@vertex
fn vs(@builtin(vertex_index) vertex: u32) -> @builtin(position) vec4f {
    // one triangle that covers the picture
    return vec4f(f32(vertex & 1u) * 4.0 - 1.0, f32(vertex >> 1u) * 4.0 - 1.0, 0.0, 1.0);
}

@fragment
fn fs(@builtin(position) place: vec4f) -> @location(0) vec4f {
    return textureLoad(wide, vec2i(place.xy), 0);
}
