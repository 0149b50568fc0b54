// Provides btf_eval of factored BTFs: products of parabolic maps of the light, half, view and difference directions.
// Expects factor_p, _q, _r (and _d) [prototype, n, n, 3], index [row, column, channel], scale_map [row, column, term, 3].

// Suykens et al. 2003, eq. 3: B = (sum over k of S_k P_k(l) R_k(v)) * (sum over j of T_j Q_j(h) D_j(d)). The index holds a
// prototype for each term of P, then of Q, R and D; with one term each these are the paper's r, g and b.

#include "lib/lookup/directions.glsl"
#include "lib/lookup/halfway.glsl"
#include "lib/lookup/parabolic_maps.glsl"
#include "lib/lookup/texels.glsl"

uniform sampler2DArray factor_p;
uniform sampler2DArray factor_q;
uniform sampler2DArray factor_r;
#ifdef FACTOR_D_DIM0
uniform sampler2DArray factor_d;
#endif
#ifdef HALF_SCALE_DIM0
uniform sampler2DArray half_scale;
#endif
uniform sampler2DArray scale_map;
uniform sampler2DArray scale_peak;
uniform usampler2DArray index;

int prototype(int texel, int channel) {
    return int(table_fetch(index, texel * INDEX_STRIDE + (channel >> 2))[channel & 3]);
}

vec3 btf_eval(vec2 uv, vec3 w_light, vec3 w_view, float lod) {
    if (!directions_valid(w_light, w_view)) {
        return vec3(0.0);
    }
    vec3 h = half_vector(w_light, w_view);
    Stencil at_light = parabolic_stencil(w_light, FACTOR_P_DIM1);
    Stencil at_half = parabolic_stencil(h, FACTOR_Q_DIM1);
    Stencil at_view = parabolic_stencil(w_view, FACTOR_R_DIM1);
#ifdef FACTOR_D_DIM0
    Stencil at_difference = parabolic_stencil(difference_vector(w_light, h), FACTOR_D_DIM1);
#endif
    Stencil texels = texel_stencil(uv, INDEX_DIM0, INDEX_DIM1);
    vec3 sum = vec3(0.0);
    for (int x = 0; x < 4; ++x) {
        // Indices are never interpolated: each neighbour is evaluated with its own maps, then blended.
        if (texels.weight[x] == 0.0) {
            continue;
        }
        int texel = texels.index[x];
        vec3 in_out = vec3(0.0);
        for (int k = 0; k < N_TERMS; ++k) {
            vec3 amount = raised(table_fetch(scale_map, texel * N_TERMS + k), SCALE_POWER);
            amount *= table_fetch(scale_peak, k).rgb;
            vec3 p = parabolic_lookup(factor_p, prototype(texel, k), FACTOR_P_DIM1, at_light, MAP_POWER);
            vec3 r = parabolic_lookup(
                factor_r, prototype(texel, N_TERMS + N_HALF_TERMS + k), FACTOR_R_DIM1, at_view, MAP_POWER);
            in_out += amount * p * r;
        }
        vec3 half_sum = vec3(0.0);
        for (int j = 0; j < N_HALF_TERMS; ++j) {
            vec3 q = parabolic_lookup(factor_q, prototype(texel, N_TERMS + j), FACTOR_Q_DIM1, at_half, MAP_POWER);
#ifdef FACTOR_D_DIM0
            q *= parabolic_lookup(
                factor_d, prototype(texel, 2 * N_TERMS + N_HALF_TERMS + j), FACTOR_D_DIM1, at_difference, MAP_POWER);
#endif
#ifdef HALF_SCALE_DIM0
            q *= raised(table_fetch(half_scale, texel * N_HALF_TERMS + j), MAP_POWER);
#endif
            half_sum += q;
        }
        sum += texels.weight[x] * in_out * half_sum;
    }
    // P holds its last ring; B falls to zero at the horizon. 1e-6: lights at the horizon itself have nothing beyond them.
    return LIGHT_COS_LAST > 1e-6 ? sum * min(w_light.z / LIGHT_COS_LAST, 1.0) : sum;
}
