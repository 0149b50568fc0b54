// Provides btf_eval of Lafortune lobes per texel, times a view-dependent factor where there is a map of it.
// Expects the maps of lib/numbers/lafortune.glsl, LIGHT_EDGE, VIEW_EDGE, the direction tables; factor [row, column, view].

#include "lib/lookup/directions.glsl"
#include "lib/lookup/hold.glsl"
#include "lib/numbers/lafortune.glsl"
#include "lib/lookup/texels.glsl"

#ifdef FACTOR_DIM2
uniform sampler2DArray factor;
#endif

// Views between which the factor is interpolated.
Stencil factor_views(vec3 w_view) {
#ifdef FACTOR_DIM2
    return view_stencil(w_view);
#else
    return Stencil(ivec4(0), vec4(0.0));
#endif
}

// Daubert et al. 2001: the factor stands for self-occlusion.
float view_factor(int texel, Stencil views) {
#ifdef FACTOR_DIM2
    float sum = 0.0;
    for (int v = 0; v < 4; ++v) {
        int at = texel * FACTOR_STRIDE + (views.index[v] >> 2);
        sum += views.weight[v] * table_fetch(factor, at)[views.index[v] & 3];
    }
    return sum;
#else
    return 1.0;
#endif
}

vec3 btf_eval(vec2 uv, vec3 w_light, vec3 w_view, float lod) {
    if (!directions_valid(w_light, w_view)) {
        return vec3(0.0);
    }
    Stencil texels = texel_stencil(uv, COLOUR_DIM0, COLOUR_DIM1);
    Stencil views = factor_views(w_view);
    float fade, unused;
    vec3 l = held(w_light, LIGHT_EDGE, fade);
    vec3 product = l * held(w_view, VIEW_EDGE, unused);
    vec3 sum = vec3(0.0);
    for (int x = 0; x < 4; ++x) {
        if (texels.weight[x] == 0.0) {
            continue;
        }
        float visible = view_factor(texels.index[x], views);
        vec4 own = table_fetch(colour, texels.index[x] * COLOUR_STRIDE);
        sum += texels.weight[x] * visible * lafortune_value(texels.index[x], own.a, product) * own.rgb;
    }
    return fade * l.z * sum;
}
