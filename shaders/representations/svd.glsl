// Provides btf_eval of the truncated singular value decomposition, B = sum over c of weights_c(x) basis_c(v, l).
// Expects basis [view, light, packet], weights [row, column, component], the tables of lib/lookup/directions.glsl.

#define PACKET_COLOURS WEIGHTS_DIM2

#include "lib/lookup/directions.glsl"
#include "lib/lookup/packets.glsl"
#include "lib/lookup/texels.glsl"

uniform sampler2DArray basis;
uniform sampler2DArray weights;

// The upper 12 bits of x and what they leave. Bits are masked, because compilers cancel the terms of Veltkamp's
// splitting, and GLSL 3.30 has no "precise".
vec2 split(float x) {
    float high = intBitsToFloat(floatBitsToInt(x) & ~0xfff);
    return vec2(high, x - high);
}

// Blended weight of component c, in two parts.
vec2 blended_weight(Stencil texels, int c) {
    vec4 stored = vec4(0.0);
    for (int x = 0; x < 4; ++x) {
        if (texels.weight[x] != 0.0) {
            stored[x] = table_fetch(weights, texels.index[x] * WEIGHTS_STRIDE + (c >> 2))[c & 3];
        }
    }
    // Terms share 12 bits of the filter's weights, so that each product with a half is exact.
    vec2 a = split(texels.weight.x), b = split(texels.weight.y);
    vec2 d = split(texels.weight.z), e = split(texels.weight.w);
    vec4 terms = vec4(a.x, b.x, d.x, e.x) * stored;
    float high = split((terms.x + terms.y) + (terms.z + terms.w)).x;
    float rest = (((terms.x - high) + terms.y) + terms.z) + terms.w;
    return vec2(high, rest + dot(vec4(a.y, b.y, d.y, e.y), stored));
}

vec3 btf_eval(vec2 uv, vec3 w_light, vec3 w_view, float lod) {
    if (!directions_valid(w_light, w_view)) {
        return vec3(0.0);
    }
    // The basis does not depend on the texel, so that the weights may be blended first.
    Stencil texels = texel_stencil(uv, WEIGHTS_DIM0, WEIGHTS_DIM1);
    vec2 coefficient[PACKET_COLOURS];
    for (int c = 0; c < PACKET_COLOURS; ++c) {
        coefficient[c] = blended_weight(texels, c);
    }
    Stencil views = view_stencil(w_view);
    Stencil lights = light_stencil(w_light);
    vec3 sum = vec3(0.0);
    for (int v = 0; v < 4; ++v) {
        for (int l = 0; l < 4; ++l) {
            float weight = views.weight[v] * lights.weight[l];
            if (weight != 0.0) {
                int pair = views.index[v] * BASIS_DIM1 + lights.index[l];
                sum += weight * packet_sum(basis, pair * BASIS_STRIDE, coefficient);
            }
        }
    }
    return sum;
}
