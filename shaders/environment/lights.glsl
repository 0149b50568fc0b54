// Provides btf_environment of any representation: radiance under the directional lights that stand for an environment.
// Expects what lib/light/environment_lights.glsl expects.

#include "lib/light/environment_lights.glsl"

// to_world takes local directions to world space.
vec3 btf_environment(vec2 uv, vec3 w_view, mat3 to_world, float lod) {
    return environment_lit(uv, w_view, to_world, lod);
}
