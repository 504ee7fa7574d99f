// Draws a tiled multiplane image for a camera. The server (wgpu) and the browser (WebGPU) share this file; it uses default features only.
// `crates/render/tests/shaders.rs` translates it for WebGL2.
//
// The geometry is linear in homogeneous coordinates, without division by depth. For a corner (x, y) of a layer's rectangle, in reference
// pixels (texel i covers [i, i+1]):
//     x̂ = ((x − cx)/fx, (y − cy)/fy, 1)      (u, v) = ((x, y) − tile centre) / half       δ = a + b·u + c·v
//     p = R x̂ + t δ                          pixel = K_t p / p_z                          target disparity δ_t = δ / p_z
// Clip position: (K_t p in NDC, times p_z; near·δ; p_z). Depth = near·δ_t is in [0, 1], 0 at infinity, larger is nearer:
// depth format depth32float, cleared to 0, compare `greater-equal` in both passes (so δ = 0 still draws on a cleared pixel).
// Points with p_z ≤ 0 are behind the camera and clipped by w; points nearer than `near` are clipped by z ≤ w.
// A plane may pass beyond infinity (δ < 0) inside its rectangle. The vertex stage splits the rectangle along δ = 0 and gives the
// part beyond it depth 0, so it is drawn behind everything, at the position of the linear formula; nothing is dropped.
//
// BUFFERS (little-endian f32, tightly packed)
//
// Uniform `View`, group 0 binding 0, 112 bytes, visible to the vertex stage:
//     0  R column 0: x y z, photo width   48  t: x y z, near                                 96  target width, target height (pixels)
//    16  R column 1: x y z, photo height  64  reference camera: fx fy cx cy (pixels)        104  half: half a tile, pixels
//    32  R column 2: x y z, page width    80  target camera: fx fy cx cy (pixels)           108  overlay: 0 none, 1 disparity, 2 tiles, 3 planes, 4 error
//     near: the distance at depth 1, in units of the photo's nearest distance; the server uses 1/1024. Sizes of photo and page are for the
//     border's means (below) and may be 0 without them.
//
// Instance, one vertex buffer, stepMode `instance`, arrayStride 48, three float32x4 attributes:
//     0  location 0: plane a b c, page (integer part: layer of the texture array; fraction: error of the tile for overlay 4, 0 to 1)
//    16  location 1: tile centre x y, rectangle x y       (reference pixels; the tile centre is the origin of u, v)
//    32  location 2: rectangle w h, atlas x y             (texels; upper left corner of the rectangle on its page; −x: its right side,
//                                                         from which columns run backward, and −y: its lower side. Such a rectangle lies
//                                                         beyond the photo's border: its alpha runs backward, its colours are the border's)
//     The rectangle is the part that is drawn: it starts and ends at the border of a texel, or at the centre of one if the layer
//     continues there (the outermost texels of a tile are sampled, but not drawn where the next tile has the same pixels).
//
// Group 0 binding 1: the atlas, texture_2d_array<f32>, rgba8unorm, PREMULTIPLIED, one mip level; view dimension `2d-array` even with
// one page. Rectangles need no gutter between them, because coordinates are clamped to the texels' centres.
// The last 28 rows of the first page are the border's means if any columns or rows run backward: those of the left, right, upper and lower
// border, for each of them the means over squares of 1, 2, … 64 pixels (`BorderColours::strips` in crates/core). A border of more pixels
// than the page has columns but one is reduced to them; its last texel repeats.
// Group 0 binding 2: sampler, magFilter and minFilter `linear`, clamp-to-edge.
//
// DRAWING: draw(VERTICES = 18, instances), primitive `triangle-list`, cullMode none. Colour is premultiplied, in the photo's own
// encoding: the target is rgba8unorm or bgra8unorm without -srgb, cleared to (0, 0, 0, 0).
//   pass 1  vs + fs_opaque, no blending, depth write on;  instances in layer order (a tie in depth goes to the later layer).
//   pass 2  vs + fs_soft, blend (one, one-minus-src-alpha, add) for colour and alpha, depth write OFF;  instances back to front by
//           (mean δ over the rectangle, layer order): mean δ = δ at the rectangle's centre. The order does not depend on the pose,
//           except that if R column 2 has z < 0 (the camera looks backward) it is by (−mean δ, layer order).
// Both passes may be one render pass with two pipelines. Pass 2 may omit layers without a soft edge.

struct View {
    r0: vec4f,
    r1: vec4f,
    r2: vec4f,
    t_near: vec4f,
    k_ref: vec4f,
    k_out: vec4f,
    size_half: vec4f,
}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var atlas: texture_2d_array<f32>;
@group(0) @binding(2) var linear_clamp: sampler;

// Sampled alpha from which a texel counts as opaque.
const OPAQUE: f32 = 0.99;
// Sizes of squares in the border's means, and rows for all four borders.
const SIZES: f32 = 7.0;
const BORDER_ROWS: f32 = 28.0;
// Pixels beyond the border per pixel of blur radius, the widest radius, and pixels over which an instance's own colours fade.
const PIXELS_PER_RADIUS: f32 = 2.0;
const MOST_RADIUS: f32 = 64.0;
const FADE: f32 = 2.0;

struct Instance {
    @location(0) plane_page: vec4f,
    @location(1) centre_origin: vec4f,
    @location(2) size_atlas: vec4f,
}

struct Varyings {
    @builtin(position) clip: vec4f,
    // Position on the page in texels.
    @location(0) texel: vec2f,
    // First and last texel centre of the rectangle on its page.
    @location(1) @interpolate(flat) bounds: vec4f,
    @location(2) @interpolate(flat) page: i32,
    // w = 0: no overlay; w > 0: mix in rgb by w; w < 0: grey level of depth · −w.
    @location(3) @interpolate(flat) overlay: vec4f,
    // Pixels beyond the right (x) and lower border (y), negative beyond the left and upper one, 0 for texels that do not run backward; then
    // the column in the means of the upper and lower border, and of the left and right one.
    @location(4) border: vec4f,
}

// A distinct colour for each v.
fn tint(v: vec3f) -> vec3f {
    let hue = fract(sin(dot(v, vec3f(12.9898, 78.233, 37.719))) * 43758.547);
    return 0.5 + 0.5 * cos(6.2831853 * (hue + vec3f(0.0, 0.33, 0.67)));
}

// From green over yellow to red.
fn heat(v: f32) -> vec3f {
    let low = mix(vec3f(0.1, 0.55, 0.35), vec3f(0.95, 0.8, 0.2), min(1.0, 2.0 * v));
    return mix(low, vec3f(0.85, 0.1, 0.1), max(0.0, 2.0 * v - 1.0));
}

fn overlay_of(i: Instance) -> vec4f {
    let kind = view.size_half.w;
    if (kind == 1.0) {
        return vec4f(0.0, 0.0, 0.0, -1.0 / view.t_near.w);
    }
    if (kind == 2.0) {
        return vec4f(tint(vec3f(i.centre_origin.xy / view.size_half.z, 1.0)), 0.5);
    }
    if (kind == 3.0) {
        return vec4f(tint(i.plane_page.xyz), 0.5);
    }
    if (kind == 4.0) {
        return vec4f(heat(fract(i.plane_page.w)), 0.65);
    }
    return vec4f(0.0);
}

fn delta_at(s: vec2f, i: Instance) -> f32 {
    let uv = (s * i.size_atlas.xy + i.centre_origin.zw - i.centre_origin.xy) / view.size_half.z;
    return i.plane_page.x + i.plane_page.y * uv.x + i.plane_page.z * uv.y;
}

// `border` of the reference pixel `at`; all of an instance lies on the same side of each border.
fn border_of(at: vec2f, i: Instance) -> vec4f {
    let photo = vec2f(view.r0.w, view.r1.w);
    let outside = select(at - photo, at, i.centre_origin.zw < vec2f(0.0));
    let beyond = select(vec2f(0.0), outside, i.size_atlas.zw < vec2f(0.0));
    let columns = min(photo, vec2f(view.r2.w - 1.0));
    return vec4f(beyond, clamp(at, vec2f(0.0), photo) * columns / max(photo, vec2f(1.0)));
}

// Vertices 0 to 8: the triangle fan of the part with δ ≥ 0; 9 to 17: that of the part beyond infinity. A line splits a rectangle into parts
// of at most five corners, so three triangles each; unused triangles are degenerate.
fn corner_of(vertex: u32, i: Instance) -> Varyings {
    let beyond = vertex >= 9u;
    var corner = array<vec2f, 4>(vec2f(0.0, 0.0), vec2f(1.0, 0.0), vec2f(1.0, 1.0), vec2f(0.0, 1.0));
    var place: array<vec2f, 6>;
    var delta: array<f32, 6>;
    var n = 0u;
    for (var k = 0u; k < 4u; k++) {
        let a = corner[k];
        let b = corner[(k + 1u) % 4u];
        let da = delta_at(a, i);
        let db = delta_at(b, i);
        if ((da < 0.0) == beyond) {
            place[n] = a;
            delta[n] = da;
            n++;
        }
        if ((da < 0.0) != (db < 0.0)) {
            place[n] = a + (b - a) * (da / (da - db));
            delta[n] = 0.0;
            n++;
        }
    }
    let triangle = (vertex % 9u) / 3u;
    var pick = 0u;
    if (triangle + 2u < n && vertex % 3u > 0u) {
        pick = triangle + vertex % 3u;
    }
    var out: Varyings;
    let rect = i.size_atlas.xy;
    let first = abs(i.size_atlas.zw);
    let run = select(rect, -rect, i.size_atlas.zw < vec2f(0.0));
    out.texel = place[pick] * run + first;
    out.bounds = vec4f(floor(min(first, first + run)) + 0.5, ceil(max(first, first + run)) - 0.5);
    out.page = i32(i.plane_page.w);
    out.overlay = overlay_of(i);
    let at = place[pick] * rect + i.centre_origin.zw;
    out.border = border_of(at, i);
    if (n < 3u) {
        out.clip = vec4f(0.0, 0.0, 0.0, 1.0);
        return out;
    }
    let x = (at - view.k_ref.zw) / view.k_ref.xy;
    let d = delta[pick];
    let p = view.r0.xyz * x.x + view.r1.xyz * x.y + view.r2.xyz + view.t_near.xyz * d;
    let pixel = view.k_out.xy * p.xy + view.k_out.zw * p.z;
    let ndc = 2.0 * pixel / view.size_half.xy - p.z;
    out.clip = vec4f(ndc.x, -ndc.y, view.t_near.w * select(d, 0.0, beyond), p.z);
    return out;
}

@vertex
fn vs(@builtin(vertex_index) vertex: u32, i: Instance) -> Varyings {
    return corner_of(vertex, i);
}

// For WebGL, whose clip space starts at z = −w, so that depth 0 is at infinity there, too.
@vertex
fn vs_webgl(@builtin(vertex_index) vertex: u32, i: Instance) -> Varyings {
    var out = corner_of(vertex, i);
    out.clip.z = 2.0 * out.clip.z - out.clip.w;
    return out;
}

fn colour(v: Varyings) -> vec4f {
    let size = vec2f(textureDimensions(atlas));
    let own = textureSampleLevel(atlas, linear_clamp, clamp(v.texel, v.bounds.xy, v.bounds.zw) / size, v.page, 0.0);
    let beyond = abs(v.border.xy);
    let far = max(beyond.x, beyond.y);
    if (far == 0.0) {
        return own;
    }
    // the colours at the border, as crates/core continues those of photos
    let radius = min(1.0 + far / PIXELS_PER_RADIUS, MOST_RADIUS);
    let side = select(vec2f(0.0, 2.0), vec2f(1.0, 3.0), v.border.xy > vec2f(0.0));
    let row = size.y - BORDER_ROWS + SIZES * side + log2(radius) + 0.5;
    let beside = textureSampleLevel(atlas, linear_clamp, vec2f(v.border.w, row.x) / size, 0, 0.0).rgb;
    let above = textureSampleLevel(atlas, linear_clamp, vec2f(v.border.z, row.y) / size, 0, 0.0).rgb;
    let continued = mix(beside, above, beyond.y / (beyond.x + beyond.y));
    return vec4f(mix(own.rgb, own.a * continued, min(1.0, far / FADE)), own.a);
}

// Premultiplied colour under the overlay; near is bright.
fn overlaid(c: vec4f, v: Varyings) -> vec4f {
    if (v.overlay.w < 0.0) {
        return vec4f(vec3f(c.a * min(1.0, v.clip.z * -v.overlay.w)), c.a);
    }
    return vec4f(mix(c.rgb, v.overlay.rgb * c.a, v.overlay.w), c.a);
}

// Opaque texels, with alpha 1.
@fragment
fn fs_opaque(v: Varyings) -> @location(0) vec4f {
    let c = colour(v);
    if (c.a < OPAQUE) {
        discard;
    }
    return overlaid(vec4f(c.rgb / c.a, 1.0), v);
}

// All others, premultiplied.
@fragment
fn fs_soft(v: Varyings) -> @location(0) vec4f {
    let c = colour(v);
    if (c.a >= OPAQUE || c.a <= 0.0) {
        discard;
    }
    return overlaid(c, v);
}
