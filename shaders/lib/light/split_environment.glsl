// Provides btf_environment: filtered light of what is broad, and directional lights for what is small and bright.
// Expects btf_prefiltered(uv, w_view, to_world) of the method and what lib/light/environment_lights.glsl expects.

#include "lib/light/environment_lights.glsl"

// to_world takes local directions to world space.
vec3 btf_environment(vec2 uv, vec3 w_view, mat3 to_world, float lod) {
    vec3 sum = environment_lit(uv, w_view, to_world, lod);
    // Passes add up: the first one has the filtered part.
    return environment_first == 0 ? sum + btf_prefiltered(uv, w_view, to_world) : sum;
}
