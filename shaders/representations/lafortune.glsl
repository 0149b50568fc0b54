// Provides btf_eval of Lafortune lobes per texel.
// Expects the maps of lib/numbers/lafortune.glsl, LIGHT_EDGE, VIEW_EDGE and the direction tables.

#include "lib/lookup/directions.glsl"
#include "lib/lookup/hold.glsl"
#include "lib/numbers/lafortune.glsl"
#include "lib/lookup/texels.glsl"

vec3 btf_eval(vec2 uv, vec3 w_light, vec3 w_view, float lod) {
    if (!directions_valid(w_light, w_view)) {
        return vec3(0.0);
    }
    Stencil texels = texel_stencil(uv, COLOUR_DIM0, COLOUR_DIM1);
    float fade, unused;
    vec3 l = held(w_light, LIGHT_EDGE, fade);
    vec3 product = l * held(w_view, VIEW_EDGE, unused);
    vec3 sum = vec3(0.0);
    for (int x = 0; x < 4; ++x) {
        if (texels.weight[x] == 0.0) {
            continue;
        }
        vec4 own = table_fetch(colour, texels.index[x] * COLOUR_STRIDE);
        sum += texels.weight[x] * lafortune_value(texels.index[x], own.a, product) * own.rgb;
    }
    return fade * l.z * sum;
}
