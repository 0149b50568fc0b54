// Provides btf_eval: a Lambertian surface of one colour or a bitmap, as Mitsuba's diffuse.
// Expects reflectance [rows, columns, 4], WRAP_MODE (0 repeats, 1 mirrors, 2 clamps) and FILTER_BILINEAR.

#include "lib/lookup/table.glsl"

uniform sampler2DArray reflectance;

const float DIFFUSE_INVERSE_PI = 0.318309886183790672;

int diffuse_wrapped(int at, int size) {
    if (WRAP_MODE == 2) {
        return clamp(at, 0, size - 1);
    }
    // Division of integers rounds towards zero.
    int turn = (at < 0 ? at + 1 : at) / size - (at < 0 ? 1 : 0);
    int inside = at - turn * size;
    return WRAP_MODE == 1 && (turn & 1) == 1 ? size - 1 - inside : inside;
}

vec3 diffuse_texel(ivec2 at) {
    int column = diffuse_wrapped(at.x, REFLECTANCE_DIM1), row = diffuse_wrapped(at.y, REFLECTANCE_DIM0);
    return table_fetch(reflectance, row * REFLECTANCE_DIM1 + column).rgb;
}

// As Dr.Jit's textures: texel centres at (i + 1/2) / n.
vec3 diffuse_reflectance(vec2 uv) {
    vec2 position = uv * vec2(float(REFLECTANCE_DIM1), float(REFLECTANCE_DIM0));
#if FILTER_BILINEAR
    position -= 0.5;
    vec2 low = floor(position), share = position - low;
    ivec2 at = ivec2(low);
    vec3 near = mix(diffuse_texel(at), diffuse_texel(at + ivec2(1, 0)), share.x);
    vec3 far = mix(diffuse_texel(at + ivec2(0, 1)), diffuse_texel(at + ivec2(1, 1)), share.x);
    return mix(near, far, share.y);
#else
    return diffuse_texel(ivec2(floor(position)));
#endif
}

vec3 btf_eval(vec2 uv, vec3 w_light, vec3 w_view, float lod) {
    if (!(w_light.z > 0.0 && w_view.z > 0.0)) {
        return vec3(0.0);
    }
    return diffuse_reflectance(uv) * (DIFFUSE_INVERSE_PI * w_light.z);
}
