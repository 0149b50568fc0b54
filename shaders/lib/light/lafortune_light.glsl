// Provides lafortune_light: Lafortune lobes of a texel under a prefiltered environment, without its chroma.
// Expects what lib/numbers/lafortune.glsl and lib/light/environment.glsl expect.

#include "lib/light/environment.glsl"
#include "lib/numbers/lafortune.glsl"

// For a view, a lobe is (t . l)^n times the light's cosine with t = C v by component. The cosine is part of the share.
vec3 lafortune_light(int texel, float diffuse, vec3 view, mat3 to_world) {
    vec3 value = diffuse * environment_irradiance(to_world[2]);
    for (int j = 0; j < N_LOBES; ++j) {
        vec4 lobe = table_fetch(lobes, texel * LOBES_STRIDE + j);
        float peak = table_fetch(peaks, texel * PEAKS_STRIDE + (j >> 2))[j & 3];
        vec3 t = lobe.xyz * view;
        float size = length(t);
        vec3 axis = t / max(size, POWER_FLOOR);
        value += peak * safe_power(size, lobe.w) * environment_lobe(axis, to_world, lobe.w);
    }
    return value;
}
