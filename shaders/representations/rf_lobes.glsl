// Provides btf_eval of reflectance fields as cosine lobes of the light.
// Expects lobes [row, column, view, 4 N_LOBES], colour [row, column, 4], LIGHT_EDGE and the direction tables.

#include "lib/lookup/directions.glsl"
#include "lib/lookup/hold.glsl"
#include "lib/lookup/parabolic.glsl"
#include "lib/numbers/powers.glsl"
#include "lib/lookup/texels.glsl"

uniform sampler2DArray lobes;
uniform sampler2DArray colour;

vec3 btf_eval(vec2 uv, vec3 w_light, vec3 w_view, float lod) {
    if (!directions_valid(w_light, w_view)) {
        return vec3(0.0);
    }
    Stencil texels = texel_stencil(uv, LOBES_DIM0, LOBES_DIM1);
    Stencil views = view_stencil(w_view);
    float fade;
    vec3 l = held(w_light, LIGHT_EDGE, fade);
    vec3 sum = vec3(0.0);
    for (int x = 0; x < 4; ++x) {
        if (texels.weight[x] == 0.0) {
            continue;
        }
        // Meseth, Mueller, Klein 2004, eq. 1: rho_d l_z + sum over j of peak_j (axis_j . l)^n_j; alpha holds rho_d.
        vec4 own = table_fetch(colour, texels.index[x] * COLOUR_STRIDE);
        float value = own.a * l.z;
        for (int v = 0; v < 4; ++v) {
            if (views.weight[v] == 0.0) {
                continue;
            }
            int at = (texels.index[x] * LOBES_DIM2 + views.index[v]) * LOBES_STRIDE;
            for (int j = 0; j < N_LOBES; ++j) {
                vec4 lobe = table_fetch(lobes, at + j);
                value += views.weight[v] * lobe.w * unit_lobe(parabolic_axis(lobe.xy), l, lobe.z);
            }
        }
        sum += texels.weight[x] * value * own.rgb;
    }
    return fade * sum;
}
