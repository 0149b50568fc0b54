// Provides btf_eval of a latent texture and a small network.
// Expects latent [row, column, 4 hidden + 3], layer_1 [12, hidden], layer_2 [hidden, hidden], layer_3 [hidden, 3], colour_scale [1, 3], the edges.

#include "lib/lookup/directions.glsl"
#include "lib/lookup/halfway.glsl"
#include "lib/lookup/hold.glsl"
#include "lib/lookup/texels.glsl"
#include "lib/numbers/powers.glsl"

uniform sampler2DArray latent;
uniform sampler2DArray layer_1;
uniform sampler2DArray layer_2;
uniform sampler2DArray layer_3;
uniform sampler2DArray colour_scale;

// Units of a hidden layer in fours.
const int QUADS = LAYER_2_DIM0 / 4;

// Four numbers of the texels around a lookup, interpolated.
vec4 latent_at(Stencil texels, int i) {
    vec4 sum = vec4(0.0);
    for (int x = 0; x < 4; ++x) {
        if (texels.weight[x] != 0.0) {
            sum += texels.weight[x] * table_fetch(latent, texels.index[x] * LATENT_STRIDE + i);
        }
    }
    return sum;
}

vec4 rectified(vec4 x) {
    return max(x, 0.125 * x);
}

// Four rows of a matrix, summed with the weights x; i is the RGBA texel of the first.
vec4 four_rows(sampler2DArray layer, int i, int stride, vec4 x) {
    return x.x * table_fetch(layer, i) + x.y * table_fetch(layer, i + stride)
        + x.z * table_fetch(layer, i + 2 * stride) + x.w * table_fetch(layer, i + 3 * stride);
}

vec3 btf_eval(vec2 uv, vec3 w_light, vec3 w_view, float lod) {
    if (!directions_valid(w_light, w_view)) {
        return vec3(0.0);
    }
    float unused;
    vec3 l = held(w_light, LIGHT_EDGE, unused);
    vec3 v = held(w_view, VIEW_EDGE, unused);
    vec3 h = half_vector(l, v);
    vec3 d = difference_vector(l, h);
    vec4 code[3] = vec4[3](vec4(l, v.x), vec4(v.yz, h.xy), vec4(h.z, d));
    Stencil texels = texel_stencil(uv, LATENT_DIM0, LATENT_DIM1);
    vec4 first[QUADS];
    for (int k = 0; k < QUADS; ++k) {
        vec4 sum = vec4(0.0);
        for (int j = 0; j < 3; ++j) {
            sum += four_rows(layer_1, 4 * j * LAYER_1_STRIDE + k, LAYER_1_STRIDE, code[j]);
        }
        first[k] = rectified(latent_at(texels, k) * sum + latent_at(texels, QUADS + k));
    }
    vec3 y = latent_at(texels, 4 * QUADS).rgb;
    for (int k = 0; k < QUADS; ++k) {
        vec4 sum = vec4(0.0);
        for (int j = 0; j < QUADS; ++j) {
            sum += four_rows(layer_2, 4 * j * LAYER_2_STRIDE + k, LAYER_2_STRIDE, first[j]);
        }
        vec4 second = rectified(latent_at(texels, 2 * QUADS + k) * sum + latent_at(texels, 3 * QUADS + k));
        y += four_rows(layer_3, 4 * k, 1, second).rgb;
    }
    y = clamp(y, -20.0, 20.0);
    return table_fetch(colour_scale, 0).rgb * w_light.z * vec3(exp2_accurate(y.x), exp2_accurate(y.y), exp2_accurate(y.z));
}
