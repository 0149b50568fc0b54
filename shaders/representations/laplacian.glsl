// Provides btf_eval of a Laplacian pyramid: the mean and the levels from floor(lod) on; finer ones are not fetched.
// Expects basis [level, view, light, component], weights [texels of all levels, component], mean or phong.

// The nearest view is one already.
#if NEAREST_DIRECTIONS
#define NEAREST_VIEW
#endif

#include "lib/numbers/split_sum.glsl"
#include "lib/lookup/directions.glsl"
#include "lib/surface/footprint.glsl"
#include "lib/lookup/hold.glsl"
#include "lib/numbers/powers.glsl"
#include "lib/lookup/texels.glsl"

uniform sampler2DArray basis;
uniform sampler2DArray weights;
#ifdef PHONG_DIM0
uniform sampler2DArray phong;
#else
uniform sampler2DArray mean;
#endif

// Tables begin with the finest level that is kept; a lookup of a finer one gives no number.
#ifndef FIRST_LEVEL
#define FIRST_LEVEL 0
#endif
// By the preprocessor: naga knows no constants that choose.
#if FIRST_LEVEL < N_LEVELS
const int BASE_LEVEL = FIRST_LEVEL;
#else
const int BASE_LEVEL = N_LEVELS - 1;
#endif

const int LEVEL_ROW_TABLE[N_LEVELS] = LEVEL_ROWS;
const int LEVEL_COLUMN_TABLE[N_LEVELS] = LEVEL_COLUMNS;
const int LEVEL_FIRST_TABLE[N_LEVELS] = LEVEL_FIRST;

// Of the neighbours only the one with the largest weight, with the weight of all: the paper's nearest direction.
Stencil direction_choice(Stencil s) {
#if NEAREST_DIRECTIONS
    int best = 0;
    for (int i = 1; i < 4; ++i) {
        best = s.weight[i] > s.weight[best] ? i : best;
    }
    float total = s.weight.x + s.weight.y + s.weight.z + s.weight.w;
    return Stencil(ivec4(s.index[best], 0, 0, 0), vec4(total, 0.0, 0.0, 0.0));
#else
    return s;
#endif
}

// Sums of the products of components i to i + 3 by channel: those of Y come first, then those of Cb, then those of Cr.
vec3 channel_sum(int i, vec4 product) {
    vec3 sum = vec3(0.0);
    for (int c = 0; c < 4; ++c) {
        int component = i + c;
        sum += product[c] * vec3(component < N_Y, component >= N_Y && component < N_Y + N_CB, component >= N_Y + N_CB);
    }
    return sum;
}

SplitSum with_mean(SplitSum sum, vec3 w_light, vec3 w_view, Stencil views, Stencil lights) {
#ifdef PHONG_DIM0
    // Ma et al. 2005, eq. 5 and 6: k_a + k_d (n.l) + k_s (n.h)^alpha for Y, constants for Cb and Cr.
    float fade, unused_fade;
    vec3 light = held(w_light, LIGHT_EDGE, fade);
    vec3 halfway = normalize(light + held(w_view, VIEW_EDGE, unused_fade));
    vec4 k = table_fetch(phong, 0);
    vec2 colour = table_fetch(phong, 1).xy;
    return split_add(sum, fade * vec3(k.x + k.y * light.z + k.z * safe_power(halfway.z, k.w), colour));
#else
    for (int v = 0; v < 4; ++v) {
        for (int l = 0; l < 4; ++l) {
            float weight = views.weight[v] * lights.weight[l];
            if (weight != 0.0) {
                int pair = views.index[v] * MEAN_DIM1 + lights.index[l];
                sum = split_add(sum, weight * table_fetch(mean, pair).rgb);
            }
        }
    }
    return sum;
#endif
}

SplitSum with_level(SplitSum sum, int level, float share, vec2 uv, Stencil views, Stencil lights) {
    vec4 coefficient[BASIS_STRIDE];
    for (int i = 0; i < BASIS_STRIDE; ++i) {
        coefficient[i] = vec4(0.0);
    }
    // The basis of a level does not depend on the texel, so that the weights may be blended first: those of the
    // neighbouring texels, and of the lookups along the pixel's footprint.
    int probes = probe_count();
    for (int j = -probes; j <= probes; ++j) {
        Stencil texels = texel_stencil(uv + float(j) * footprint_step, LEVEL_ROW_TABLE[level], LEVEL_COLUMN_TABLE[level]);
        texels.weight *= probe_weight(j);
        for (int x = 0; x < 4; ++x) {
            if (texels.weight[x] != 0.0) {
                int at = (LEVEL_FIRST_TABLE[level] - LEVEL_FIRST_TABLE[BASE_LEVEL] + texels.index[x]) * BASIS_STRIDE;
                for (int i = 0; i < BASIS_STRIDE; ++i) {
                    coefficient[i] += texels.weight[x] * table_fetch(weights, at + i);
                }
            }
        }
    }
    for (int v = 0; v < 4; ++v) {
        for (int l = 0; l < 4; ++l) {
            float weight = share * views.weight[v] * lights.weight[l];
            if (weight != 0.0) {
                int at = (((level - BASE_LEVEL) * BASIS_DIM1 + views.index[v]) * BASIS_DIM2 + lights.index[l]) * BASIS_STRIDE;
                vec3 pair = vec3(0.0);
                for (int i = 0; i < BASIS_STRIDE; ++i) {
                    pair += channel_sum(4 * i, coefficient[i] * table_fetch(basis, at + i));
                }
                sum = split_add(sum, weight * pair);
            }
        }
    }
    return sum;
}

vec3 btf_eval(vec2 uv, vec3 w_light, vec3 w_view, float lod) {
    if (!directions_valid(w_light, w_view)) {
        return vec3(0.0);
    }
    // A lod that is no number fails the comparison.
    lod = lod > 0.0 ? min(lod, MAX_LOD) : 0.0;
#if FIRST_LEVEL > 0
    if (lod < float(FIRST_LEVEL)) {
        return vec3(uintBitsToFloat(0x7fc00000u));
    }
#endif
    Stencil views = direction_choice(view_stencil(w_view));
    Stencil lights = direction_choice(light_stencil(w_light));
    SplitSum sum = with_mean(SplitSum(vec3(0.0), vec3(0.0)), w_light, w_view, views, lights);
    // Ma et al. 2005, eq. 7: w_k = clamp(1 - lod + k, 0, 1).
    for (int level = int(lod); level < N_LEVELS; ++level) {
        float share = clamp(1.0 - lod + float(level), 0.0, 1.0);
        sum = with_level(sum, level, share, uv, views, lights);
    }
    vec3 ycc = sum.high + sum.rest;
    // ITU-R BT.709-6, item 3.3, solved for the primaries: K_r = 0.2126, K_b = 0.0722.
    float red = ycc.x + 1.5748 * ycc.z, blue = ycc.x + 1.8556 * ycc.y;
    return vec3(red, (ycc.x - 0.2126 * red - 0.0722 * blue) / 0.7152, blue);
}
