// Provides environment_lit: radiance under the directional lights that stand for an environment, or for a part of it.
// Expects the representation's btf_eval and environment_lights [light, 2, 4]: direction towards it, irradiance.

#include "lib/lookup/table.glsl"

uniform sampler2DArray environment_lights;
uniform int environment_first;  // light of this pass, and the one after its last
uniform int environment_end;

// to_world takes local directions to world space.
vec3 environment_lit(vec2 uv, vec3 w_view, mat3 to_world, float lod) {
    vec3 sum = vec3(0.0);
    for (int i = environment_first; i < environment_end; ++i) {
        // A row vector times the matrix: the transpose takes the world's directions to local ones.
        vec3 w_light = table_fetch(environment_lights, 2 * i).xyz * to_world;
        if (w_light.z > 0.0) {
            sum += table_fetch(environment_lights, 2 * i + 1).rgb * btf_eval(uv, w_light, w_view, lod);
        }
    }
    return sum;
}
