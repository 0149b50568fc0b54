// Provides btf_environment of reflectance fields as cosine lobes: radiance under a prefiltered environment.
// Expects what representations/rf_lobes.glsl and lib/light/environment.glsl expect.

#include "representations/rf_lobes.glsl"
#include "lib/light/environment.glsl"

// to_world takes local directions to world space.
vec3 btf_prefiltered(vec2 uv, vec3 w_view, mat3 to_world) {
    if (!directions_valid(w_view, w_view)) {
        return vec3(0.0);
    }
    Stencil texels = texel_stencil(uv, LOBES_DIM0, LOBES_DIM1);
    Stencil views = view_stencil(w_view);
    vec3 irradiance = environment_irradiance(to_world[2]);
    vec3 sum = vec3(0.0);
    for (int x = 0; x < 4; ++x) {
        if (texels.weight[x] == 0.0) {
            continue;
        }
        vec4 own = table_fetch(colour, texels.index[x] * COLOUR_STRIDE);
        vec3 value = own.a * irradiance;
        for (int v = 0; v < 4; ++v) {
            if (views.weight[v] == 0.0) {
                continue;
            }
            int at = (texels.index[x] * LOBES_DIM2 + views.index[v]) * LOBES_STRIDE;
            for (int j = 0; j < N_LOBES; ++j) {
                vec4 lobe = table_fetch(lobes, at + j);
                vec3 axis = parabolic_axis(lobe.xy);
                // The data hold the light's cosine, and so do the lobes: the paper's (n . t) is not needed.
                value += views.weight[v] * lobe.w * environment_lobe(axis, to_world, lobe.z);
            }
        }
        sum += texels.weight[x] * own.rgb * value;
    }
    return sum;
}

#include "lib/light/split_environment.glsl"
