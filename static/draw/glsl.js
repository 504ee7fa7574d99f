// Made of the WGSL files beside this one by `TMPI_BLESS=shaders cargo test --test shaders`: change those.

/** `vs_webgl` of tmpi.wgsl. */
export const SCENE_VERTEX = `#version 300 es

precision highp float;
precision highp int;

struct View {
    vec4 r0_;
    vec4 r1_;
    vec4 r2_;
    vec4 t_near;
    vec4 k_ref;
    vec4 k_out;
    vec4 size_half;
};
struct Instance {
    vec4 plane_page;
    vec4 centre_origin;
    vec4 size_atlas;
};
struct Varyings {
    vec4 clip;
    vec2 texel;
    vec4 bounds;
    int page;
    vec4 overlay;
    vec4 border;
};
const float OPAQUE = 0.99;
const float SIZES = 7.0;
const float BORDER_ROWS = 28.0;
const float PIXELS_PER_RADIUS = 2.0;
const float MOST_RADIUS = 64.0;
const float FADE = 2.0;

layout(std140) uniform View_block_0Vertex { View _group_0_binding_0_vs; };

layout(location = 0) in vec4 _p2vs_location0;
layout(location = 1) in vec4 _p2vs_location1;
layout(location = 2) in vec4 _p2vs_location2;
smooth out vec2 _vs2fs_location0;
flat out vec4 _vs2fs_location1;
flat out int _vs2fs_location2;
flat out vec4 _vs2fs_location3;
smooth out vec4 _vs2fs_location4;

vec3 tint(vec3 v_2) {
    float hue = fract((sin(dot(v_2, vec3(12.9898, 78.233, 37.719))) * 43758.547));
    return (vec3(0.5) + (0.5 * cos((6.2831855 * (vec3(hue) + vec3(0.0, 0.33, 0.67))))));
}

vec3 heat(float v_3) {
    vec3 low = mix(vec3(0.1, 0.55, 0.35), vec3(0.95, 0.8, 0.2), min(1.0, (2.0 * v_3)));
    return mix(low, vec3(0.85, 0.1, 0.1), max(0.0, ((2.0 * v_3) - 1.0)));
}

vec4 overlay_of(Instance i_2) {
    float kind = _group_0_binding_0_vs.size_half.w;
    if ((kind == 1.0)) {
        float _e10 = _group_0_binding_0_vs.t_near.w;
        return vec4(0.0, 0.0, 0.0, (-1.0 / _e10));
    }
    if ((kind == 2.0)) {
        float _e24 = _group_0_binding_0_vs.size_half.z;
        vec3 _e29 = tint(vec3((i_2.centre_origin.xy / vec2(_e24)), 1.0));
        return vec4(_e29, 0.5);
    }
    if ((kind == 3.0)) {
        vec3 _e36 = tint(i_2.plane_page.xyz);
        return vec4(_e36, 0.5);
    }
    if ((kind == 4.0)) {
        vec3 _e44 = heat(fract(i_2.plane_page.w));
        return vec4(_e44, 0.65);
    }
    return vec4(0.0);
}

float delta_at(vec2 s, Instance i_3) {
    float _e14 = _group_0_binding_0_vs.size_half.z;
    vec2 uv = ((((s * i_3.size_atlas.xy) + i_3.centre_origin.zw) - i_3.centre_origin.xy) / vec2(_e14));
    return ((i_3.plane_page.x + (i_3.plane_page.y * uv.x)) + (i_3.plane_page.z * uv.y));
}

vec4 border_of(vec2 at, Instance i_4) {
    float _e5 = _group_0_binding_0_vs.r0_.w;
    float _e9 = _group_0_binding_0_vs.r1_.w;
    vec2 photo = vec2(_e5, _e9);
    vec2 outside = mix((at - photo), at, lessThan(i_4.centre_origin.zw, vec2(0.0)));
    vec2 beyond = mix(vec2(0.0), outside, lessThan(i_4.size_atlas.zw, vec2(0.0)));
    float _e29 = _group_0_binding_0_vs.r2_.w;
    vec2 columns = min(photo, vec2((_e29 - 1.0)));
    return vec4(beyond, ((clamp(at, vec2(0.0), photo) * columns) / max(photo, vec2(1.0))));
}

Varyings corner_of(uint vertex_2, Instance i_5) {
    vec2 corner[4] = vec2[4](vec2(0.0, 0.0), vec2(1.0, 0.0), vec2(1.0, 1.0), vec2(0.0, 1.0));
    vec2 place[6] = vec2[6](vec2(0.0), vec2(0.0), vec2(0.0), vec2(0.0), vec2(0.0), vec2(0.0));
    float delta[6] = float[6](0.0, 0.0, 0.0, 0.0, 0.0, 0.0);
    uint n = 0u;
    uint k = 0u;
    uint pick = 0u;
    bool local_1 = false;
    Varyings out_1 = Varyings(vec4(0.0), vec2(0.0), vec4(0.0), 0, vec4(0.0), vec4(0.0));
    bool beyond_1 = (vertex_2 >= 9u);
    bool loop_init = true;
    while(true) {
        if (!loop_init) {
            uint _e68 = k;
            k = (_e68 + 1u);
        }
        loop_init = false;
        uint _e24 = k;
        if ((_e24 < 4u)) {
        } else {
            break;
        }
        {
            uint _e27 = k;
            vec2 a = corner[_e27];
            uint _e30 = k;
            vec2 b = corner[((_e30 + 1u) % 4u)];
            float _e37 = delta_at(a, i_5);
            float _e38 = delta_at(b, i_5);
            if (((_e37 < 0.0) == beyond_1)) {
                uint _e42 = n;
                place[_e42] = a;
                uint _e44 = n;
                delta[_e44] = _e37;
                uint _e47 = n;
                n = (_e47 + 1u);
            }
            if (((_e37 < 0.0) != (_e38 < 0.0))) {
                uint _e54 = n;
                place[_e54] = (a + ((b - a) * (_e37 / (_e37 - _e38))));
                uint _e61 = n;
                delta[_e61] = 0.0;
                uint _e65 = n;
                n = (_e65 + 1u);
            }
        }
    }
    uint triangle = ((vertex_2 % 9u) / 3u);
    uint _e78 = n;
    if (((triangle + 2u) < _e78)) {
        local_1 = ((vertex_2 % 3u) > 0u);
    } else {
        local_1 = false;
    }
    bool _e87 = local_1;
    if (_e87) {
        pick = (triangle + (vertex_2 % 3u));
    }
    vec2 rect = i_5.size_atlas.xy;
    vec2 first = abs(i_5.size_atlas.zw);
    vec2 run = mix(rect, -(rect), lessThan(i_5.size_atlas.zw, vec2(0.0)));
    uint _e105 = pick;
    vec2 _e107 = place[_e105];
    out_1.texel = ((_e107 * run) + first);
    out_1.bounds = vec4((floor(min(first, (first + run))) + vec2(0.5)), (ceil(max(first, (first + run))) - vec2(0.5)));
    out_1.page = int(i_5.plane_page.w);
    vec4 _e129 = overlay_of(i_5);
    out_1.overlay = _e129;
    uint _e130 = pick;
    vec2 _e132 = place[_e130];
    vec2 at_1 = ((_e132 * rect) + i_5.centre_origin.zw);
    vec4 _e138 = border_of(at_1, i_5);
    out_1.border = _e138;
    uint _e139 = n;
    if ((_e139 < 3u)) {
        out_1.clip = vec4(0.0, 0.0, 0.0, 1.0);
        Varyings _e148 = out_1;
        return _e148;
    }
    vec4 _e151 = _group_0_binding_0_vs.k_ref;
    vec4 _e156 = _group_0_binding_0_vs.k_ref;
    vec2 x = ((at_1 - _e151.zw) / _e156.xy);
    uint _e159 = pick;
    float d = delta[_e159];
    vec4 _e164 = _group_0_binding_0_vs.r0_;
    vec4 _e170 = _group_0_binding_0_vs.r1_;
    vec4 _e177 = _group_0_binding_0_vs.r2_;
    vec4 _e182 = _group_0_binding_0_vs.t_near;
    vec3 p = ((((_e164.xyz * x.x) + (_e170.xyz * x.y)) + _e177.xyz) + (_e182.xyz * d));
    vec4 _e188 = _group_0_binding_0_vs.k_out;
    vec4 _e194 = _group_0_binding_0_vs.k_out;
    vec2 pixel = ((_e188.xy * p.xy) + (_e194.zw * p.z));
    vec4 _e203 = _group_0_binding_0_vs.size_half;
    vec2 ndc = (((2.0 * pixel) / _e203.xy) - vec2(p.z));
    float _e216 = _group_0_binding_0_vs.t_near.w;
    out_1.clip = vec4(ndc.x, -(ndc.y), (_e216 * (beyond_1 ? 0.0 : d)), p.z);
    Varyings _e222 = out_1;
    return _e222;
}

vec4 overlaid(vec4 c, Varyings v_5) {
    if ((v_5.overlay.w < 0.0)) {
        return vec4(vec3((c.w * min(1.0, (v_5.clip.z * -(v_5.overlay.w))))), c.w);
    }
    return vec4(mix(c.xyz, (v_5.overlay.xyz * c.w), v_5.overlay.w), c.w);
}

void main() {
    uint vertex_1 = uint(gl_VertexID);
    Instance i_1 = Instance(_p2vs_location0, _p2vs_location1, _p2vs_location2);
    Varyings out_ = Varyings(vec4(0.0), vec2(0.0), vec4(0.0), 0, vec4(0.0), vec4(0.0));
    Varyings _e2 = corner_of(vertex_1, i_1);
    out_ = _e2;
    float _e8 = out_.clip.z;
    float _e13 = out_.clip.w;
    out_.clip.z = ((2.0 * _e8) - _e13);
    Varyings _e15 = out_;
    gl_Position = _e15.clip;
    _vs2fs_location0 = _e15.texel;
    _vs2fs_location1 = _e15.bounds;
    _vs2fs_location2 = _e15.page;
    _vs2fs_location3 = _e15.overlay;
    _vs2fs_location4 = _e15.border;
    return;
}
`;

/** `fs_opaque` of tmpi.wgsl. */
export const OPAQUE_FRAGMENT = `#version 300 es

precision highp float;
precision highp int;

struct View {
    vec4 r0_;
    vec4 r1_;
    vec4 r2_;
    vec4 t_near;
    vec4 k_ref;
    vec4 k_out;
    vec4 size_half;
};
struct Instance {
    vec4 plane_page;
    vec4 centre_origin;
    vec4 size_atlas;
};
struct Varyings {
    vec4 clip;
    vec2 texel;
    vec4 bounds;
    int page;
    vec4 overlay;
    vec4 border;
};
const float OPAQUE = 0.99;
const float SIZES = 7.0;
const float BORDER_ROWS = 28.0;
const float PIXELS_PER_RADIUS = 2.0;
const float MOST_RADIUS = 64.0;
const float FADE = 2.0;

uniform highp sampler2DArray _group_0_binding_1_fs;

smooth in vec2 _vs2fs_location0;
flat in vec4 _vs2fs_location1;
flat in int _vs2fs_location2;
flat in vec4 _vs2fs_location3;
smooth in vec4 _vs2fs_location4;
layout(location = 0) out vec4 _fs2p_location0;

vec3 tint(vec3 v_2) {
    float hue = fract((sin(dot(v_2, vec3(12.9898, 78.233, 37.719))) * 43758.547));
    return (vec3(0.5) + (0.5 * cos((6.2831855 * (vec3(hue) + vec3(0.0, 0.33, 0.67))))));
}

vec3 heat(float v_3) {
    vec3 low = mix(vec3(0.1, 0.55, 0.35), vec3(0.95, 0.8, 0.2), min(1.0, (2.0 * v_3)));
    return mix(low, vec3(0.85, 0.1, 0.1), max(0.0, ((2.0 * v_3) - 1.0)));
}

vec4 colour(Varyings v_4) {
    vec2 size = vec2(uvec2(textureSize(_group_0_binding_1_fs, 0).xy));
    vec4 own = textureLod(_group_0_binding_1_fs, vec3((clamp(v_4.texel, v_4.bounds.xy, v_4.bounds.zw) / size), v_4.page), 0.0);
    vec2 beyond = abs(v_4.border.xy);
    float far = max(beyond.x, beyond.y);
    if ((far == 0.0)) {
        return own;
    }
    float radius = min((1.0 + (far / PIXELS_PER_RADIUS)), MOST_RADIUS);
    vec2 side = mix(vec2(0.0, 2.0), vec2(1.0, 3.0), greaterThan(v_4.border.xy, vec2(0.0)));
    vec2 row = (((vec2((size.y - BORDER_ROWS)) + (SIZES * side)) + vec2(log2(radius))) + vec2(0.5));
    vec4 _e64 = textureLod(_group_0_binding_1_fs, vec3((vec2(v_4.border.w, row.x) / size), 0), 0.0);
    vec3 beside = _e64.xyz;
    vec4 _e75 = textureLod(_group_0_binding_1_fs, vec3((vec2(v_4.border.z, row.y) / size), 0), 0.0);
    vec3 above = _e75.xyz;
    vec3 continued = mix(beside, above, (beyond.y / (beyond.x + beyond.y)));
    return vec4(mix(own.xyz, (own.w * continued), min(1.0, (far / FADE))), own.w);
}

vec4 overlaid(vec4 c, Varyings v_5) {
    if ((v_5.overlay.w < 0.0)) {
        return vec4(vec3((c.w * min(1.0, (v_5.clip.z * -(v_5.overlay.w))))), c.w);
    }
    return vec4(mix(c.xyz, (v_5.overlay.xyz * c.w), v_5.overlay.w), c.w);
}

void main() {
    Varyings v = Varyings(gl_FragCoord, _vs2fs_location0, _vs2fs_location1, _vs2fs_location2, _vs2fs_location3, _vs2fs_location4);
    vec4 _e1 = colour(v);
    if ((_e1.w < OPAQUE)) {
        discard;
    }
    vec4 _e11 = overlaid(vec4((_e1.xyz / vec3(_e1.w)), 1.0), v);
    _fs2p_location0 = _e11;
    return;
}
`;

/** `fs_soft` of tmpi.wgsl. */
export const SOFT_FRAGMENT = `#version 300 es

precision highp float;
precision highp int;

struct View {
    vec4 r0_;
    vec4 r1_;
    vec4 r2_;
    vec4 t_near;
    vec4 k_ref;
    vec4 k_out;
    vec4 size_half;
};
struct Instance {
    vec4 plane_page;
    vec4 centre_origin;
    vec4 size_atlas;
};
struct Varyings {
    vec4 clip;
    vec2 texel;
    vec4 bounds;
    int page;
    vec4 overlay;
    vec4 border;
};
const float OPAQUE = 0.99;
const float SIZES = 7.0;
const float BORDER_ROWS = 28.0;
const float PIXELS_PER_RADIUS = 2.0;
const float MOST_RADIUS = 64.0;
const float FADE = 2.0;

uniform highp sampler2DArray _group_0_binding_1_fs;

smooth in vec2 _vs2fs_location0;
flat in vec4 _vs2fs_location1;
flat in int _vs2fs_location2;
flat in vec4 _vs2fs_location3;
smooth in vec4 _vs2fs_location4;
layout(location = 0) out vec4 _fs2p_location0;

vec3 tint(vec3 v_2) {
    float hue = fract((sin(dot(v_2, vec3(12.9898, 78.233, 37.719))) * 43758.547));
    return (vec3(0.5) + (0.5 * cos((6.2831855 * (vec3(hue) + vec3(0.0, 0.33, 0.67))))));
}

vec3 heat(float v_3) {
    vec3 low = mix(vec3(0.1, 0.55, 0.35), vec3(0.95, 0.8, 0.2), min(1.0, (2.0 * v_3)));
    return mix(low, vec3(0.85, 0.1, 0.1), max(0.0, ((2.0 * v_3) - 1.0)));
}

vec4 colour(Varyings v_4) {
    vec2 size = vec2(uvec2(textureSize(_group_0_binding_1_fs, 0).xy));
    vec4 own = textureLod(_group_0_binding_1_fs, vec3((clamp(v_4.texel, v_4.bounds.xy, v_4.bounds.zw) / size), v_4.page), 0.0);
    vec2 beyond = abs(v_4.border.xy);
    float far = max(beyond.x, beyond.y);
    if ((far == 0.0)) {
        return own;
    }
    float radius = min((1.0 + (far / PIXELS_PER_RADIUS)), MOST_RADIUS);
    vec2 side = mix(vec2(0.0, 2.0), vec2(1.0, 3.0), greaterThan(v_4.border.xy, vec2(0.0)));
    vec2 row = (((vec2((size.y - BORDER_ROWS)) + (SIZES * side)) + vec2(log2(radius))) + vec2(0.5));
    vec4 _e64 = textureLod(_group_0_binding_1_fs, vec3((vec2(v_4.border.w, row.x) / size), 0), 0.0);
    vec3 beside = _e64.xyz;
    vec4 _e75 = textureLod(_group_0_binding_1_fs, vec3((vec2(v_4.border.z, row.y) / size), 0), 0.0);
    vec3 above = _e75.xyz;
    vec3 continued = mix(beside, above, (beyond.y / (beyond.x + beyond.y)));
    return vec4(mix(own.xyz, (own.w * continued), min(1.0, (far / FADE))), own.w);
}

vec4 overlaid(vec4 c, Varyings v_5) {
    if ((v_5.overlay.w < 0.0)) {
        return vec4(vec3((c.w * min(1.0, (v_5.clip.z * -(v_5.overlay.w))))), c.w);
    }
    return vec4(mix(c.xyz, (v_5.overlay.xyz * c.w), v_5.overlay.w), c.w);
}

void main() {
    Varyings v_1 = Varyings(gl_FragCoord, _vs2fs_location0, _vs2fs_location1, _vs2fs_location2, _vs2fs_location3, _vs2fs_location4);
    bool local = false;
    vec4 _e1 = colour(v_1);
    if (!((_e1.w >= OPAQUE))) {
        local = (_e1.w <= 0.0);
    } else {
        local = true;
    }
    bool _e12 = local;
    if (_e12) {
        discard;
    }
    vec4 _e13 = overlaid(_e1, v_1);
    _fs2p_location0 = _e13;
    return;
}
`;

/** `vs` of copy.wgsl. */
export const COPY_VERTEX = `#version 300 es

precision highp float;
precision highp int;


void main() {
    uint vertex = uint(gl_VertexID);
    gl_Position = vec4(((float((vertex & 1u)) * 4.0) - 1.0), ((float((vertex >> 1u)) * 4.0) - 1.0), 0.0, 1.0);
    return;
}
`;

/** `fs` of copy.wgsl. */
export const COPY_FRAGMENT = `#version 300 es

precision highp float;
precision highp int;

uniform highp sampler2D _group_0_binding_0_fs;

layout(location = 0) out vec4 _fs2p_location0;

void main() {
    vec4 at = gl_FragCoord;
    vec4 _e5 = texelFetch(_group_0_binding_0_fs, ivec2(at.xy), 0);
    _fs2p_location0 = _e5;
    return;
}
`;
