// Provides btf_eval of one apparent BRDF times a colour a texel.
// Expects brdf [view, light, 3], tint [row, column, 3], the tables of lib/lookup/directions.glsl.

#include "lib/lookup/directions.glsl"
#include "lib/lookup/texels.glsl"

uniform sampler2DArray brdf;
uniform sampler2DArray tint;

vec3 btf_eval(vec2 uv, vec3 w_light, vec3 w_view, float lod) {
    if (!directions_valid(w_light, w_view)) {
        return vec3(0.0);
    }
    Stencil texels = texel_stencil(uv, TINT_DIM0, TINT_DIM1);
    Stencil views = view_stencil(w_view);
    Stencil lights = light_stencil(w_light);
    vec3 colour = vec3(0.0), sum = vec3(0.0);
    for (int x = 0; x < 4; ++x) {
        colour += texels.weight[x] * table_fetch(tint, texels.index[x] * TINT_STRIDE).rgb;
    }
    for (int v = 0; v < 4; ++v) {
        for (int l = 0; l < 4; ++l) {
            int pair = views.index[v] * BRDF_DIM1 + lights.index[l];
            sum += views.weight[v] * lights.weight[l] * table_fetch(brdf, pair * BRDF_STRIDE).rgb;
        }
    }
    return colour * sum;
}
