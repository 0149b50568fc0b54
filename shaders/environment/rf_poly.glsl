// Provides btf_environment of reflectance fields as polynomials: radiance under an environment, by its moments.
// Expects what representations/rf_poly.glsl expects, and environment_moments [18, size, size, 3].

#include "representations/rf_poly.glsl"
#include "lib/light/sphere_maps.glsl"

uniform sampler2DArray environment_moments;

// to_world takes local directions to world space.
vec3 btf_prefiltered(vec2 uv, vec3 w_view, mat3 to_world) {
    if (!directions_valid(w_view, w_view)) {
        return vec3(0.0);
    }
    vec3 s = to_world[0], t = to_world[1], n = to_world[2];
    // Moments x^2, y^2, z^2, xy, xz, yz, x, y, z in world space; those of the local frame are their contractions.
    vec3 m[9];
    for (int i = 0; i < 9; ++i) {
        m[i] = sphere_lookup(environment_moments, i, ENVIRONMENT_MOMENTS_DIM1, n);
    }
    vec3 xx = s.x * s.x * m[0] + s.y * s.y * m[1] + s.z * s.z * m[2]
        + 2.0 * (s.x * s.y * m[3] + s.x * s.z * m[4] + s.y * s.z * m[5]);
    vec3 yy = t.x * t.x * m[0] + t.y * t.y * m[1] + t.z * t.z * m[2]
        + 2.0 * (t.x * t.y * m[3] + t.x * t.z * m[4] + t.y * t.z * m[5]);
    vec3 zz = n.x * n.x * m[0] + n.y * n.y * m[1] + n.z * n.z * m[2]
        + 2.0 * (n.x * n.y * m[3] + n.x * n.z * m[4] + n.y * n.z * m[5]);
    vec3 xy = s.x * t.x * m[0] + s.y * t.y * m[1] + s.z * t.z * m[2] + (s.x * t.y + s.y * t.x) * m[3]
        + (s.x * t.z + s.z * t.x) * m[4] + (s.y * t.z + s.z * t.y) * m[5];
    vec3 x1 = s.x * m[6] + s.y * m[7] + s.z * m[8];
    vec3 y1 = t.x * m[6] + t.y * m[7] + t.z * m[8];
    Stencil texels = texel_stencil(uv, POLYNOMIAL_DIM0, POLYNOMIAL_DIM1);
    Stencil views = view_stencil(w_view);
    vec3 sum = vec3(0.0);
    for (int x = 0; x < 4; ++x) {
        if (texels.weight[x] == 0.0) {
            continue;
        }
        vec4 first = vec4(0.0), second = vec4(0.0);
        for (int v = 0; v < 4; ++v) {
            if (views.weight[v] == 0.0) {
                continue;
            }
            int at = (texels.index[x] * POLYNOMIAL_DIM2 + views.index[v]) * POLYNOMIAL_STRIDE;
            first += views.weight[v] * table_fetch(polynomial, at);
            second += views.weight[v] * table_fetch(polynomial, at + 1);
        }
        vec3 value = first.x * xx + first.y * yy + first.z * xy + first.w * x1 + second.x * y1 + second.y * zz;
        sum += texels.weight[x] * value * table_fetch(chroma, texels.index[x] * CHROMA_STRIDE).rgb;
    }
    return sum;
}

#include "lib/light/split_environment.glsl"
