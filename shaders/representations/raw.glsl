// Provides btf_eval of the tabulated BTF.
// Expects values [row, column, view, light, 4] and the direction tables of lib/lookup/directions.glsl.

#include "lib/lookup/directions.glsl"
#include "lib/lookup/table.glsl"
#include "lib/lookup/texels.glsl"

uniform sampler2DArray values;

vec3 btf_eval(vec2 uv, vec3 w_light, vec3 w_view, float lod) {
    if (!directions_valid(w_light, w_view)) {
        return vec3(0.0);
    }
    Stencil texels = texel_stencil(uv, VALUES_DIM0, VALUES_DIM1);
    Stencil views = view_stencil(w_view);
    Stencil lights = light_stencil(w_light);
    vec3 sum = vec3(0.0);
    for (int x = 0; x < 4; ++x) {
        if (texels.weight[x] == 0.0) {
            continue;
        }
        for (int v = 0; v < 4; ++v) {
            if (views.weight[v] == 0.0) {
                continue;
            }
            int row = (texels.index[x] * VALUES_DIM2 + views.index[v]) * VALUES_DIM3;
            vec3 light_sum = vec3(0.0);
            for (int l = 0; l < 4; ++l) {
                if (lights.weight[l] != 0.0) {
                    light_sum += lights.weight[l] * table_fetch(values, (row + lights.index[l]) * VALUES_STRIDE).rgb;
                }
            }
            sum += texels.weight[x] * views.weight[v] * light_sum;
        }
    }
    return sum;
}
