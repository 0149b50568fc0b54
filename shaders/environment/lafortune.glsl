// Provides btf_environment of Lafortune lobes per texel, times their factor of the view: radiance under a prefiltered environment.
// Expects what representations/lafortune.glsl and lib/light/environment.glsl expect.

#include "representations/lafortune.glsl"
#include "lib/light/lafortune_light.glsl"

// to_world takes local directions to world space.
vec3 btf_prefiltered(vec2 uv, vec3 w_view, mat3 to_world) {
    if (!directions_valid(w_view, w_view)) {
        return vec3(0.0);
    }
    Stencil texels = texel_stencil(uv, COLOUR_DIM0, COLOUR_DIM1);
    Stencil views = factor_views(w_view);
    float unused;
    vec3 view = held(w_view, VIEW_EDGE, unused);
    vec3 sum = vec3(0.0);
    for (int x = 0; x < 4; ++x) {
        if (texels.weight[x] == 0.0) {
            continue;
        }
        vec4 own = table_fetch(colour, texels.index[x] * COLOUR_STRIDE);
        float visible = view_factor(texels.index[x], views);
        sum += texels.weight[x] * visible * own.rgb * lafortune_light(texels.index[x], own.a, view, to_world);
    }
    return sum;
}

#include "lib/light/split_environment.glsl"
