// Provides btf_eval of the truncated singular value decomposition, B = sum over c of weights_c(x) basis_c(v, l).
// Expects basis [view, light, packet], weights [row, column, component], the tables of lib/directions.glsl.

#define PACKET_COLOURS WEIGHTS_DIM2

#include "lib/directions.glsl"
#include "lib/packets.glsl"
#include "lib/texels.glsl"

uniform sampler2DArray basis;
uniform sampler2DArray weights;

vec3 btf_eval(vec2 uv, vec3 w_light, vec3 w_view, float lod) {
    if (!directions_valid(w_light, w_view)) {
        return vec3(0.0);
    }
    // The basis does not depend on the texel, so that the weights may be blended first.
    Stencil texels = texel_stencil(uv, WEIGHTS_DIM0, WEIGHTS_DIM1);
    float coefficient[PACKET_COLOURS];
    for (int c = 0; c < PACKET_COLOURS; ++c) {
        coefficient[c] = 0.0;
    }
    for (int x = 0; x < 4; ++x) {
        if (texels.weight[x] == 0.0) {
            continue;
        }
        for (int c = 0; c < PACKET_COLOURS; ++c) {
            vec4 packet = table_fetch(weights, texels.index[x] * WEIGHTS_STRIDE + (c >> 2));
            coefficient[c] += texels.weight[x] * packet[c & 3];
        }
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
