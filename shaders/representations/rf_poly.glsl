// Provides btf_eval of reflectance fields as biquadratic polynomials of the light.
// Expects polynomial [row, column, view, 6], chroma [row, column, 3], LIGHT_EDGE and the direction tables.

#include "lib/lookup/directions.glsl"
#include "lib/lookup/hold.glsl"
#include "lib/lookup/texels.glsl"

uniform sampler2DArray polynomial;
uniform sampler2DArray chroma;

vec3 btf_eval(vec2 uv, vec3 w_light, vec3 w_view, float lod) {
    if (!directions_valid(w_light, w_view)) {
        return vec3(0.0);
    }
    Stencil texels = texel_stencil(uv, POLYNOMIAL_DIM0, POLYNOMIAL_DIM1);
    Stencil views = view_stencil(w_view);
    float fade;
    vec3 l = held(w_light, LIGHT_EDGE, fade);
    // Malzbender, Gelb, Wolters 2001, eq. 2, with a5 z^2 in place of a5: a0 x^2 + a1 y^2 + a2 x y + a3 x + a4 y + a5 z^2.
    vec4 squares = vec4(l.x * l.x, l.y * l.y, l.x * l.y, l.x);
    vec3 sum = vec3(0.0);
    for (int x = 0; x < 4; ++x) {
        if (texels.weight[x] == 0.0) {
            continue;
        }
        float value = 0.0;
        for (int v = 0; v < 4; ++v) {
            if (views.weight[v] == 0.0) {
                continue;
            }
            int at = (texels.index[x] * POLYNOMIAL_DIM2 + views.index[v]) * POLYNOMIAL_STRIDE;
            vec2 rest = table_fetch(polynomial, at + 1).xy;
            value += views.weight[v] * (dot(table_fetch(polynomial, at), squares) + rest.x * l.y + rest.y * (l.z * l.z));
        }
        sum += texels.weight[x] * value * table_fetch(chroma, texels.index[x] * CHROMA_STRIDE).rgb;
    }
    return fade * sum;
}
