// Provides btf_environment of local PCA: radiance under an environment in spherical harmonics.
// Expects what lib/light/harmonics.glsl expects, eigen_harmonics [cluster, view, order^2, packet], and lpca's texel maps.

#include "representations/lpca.glsl"
#include "lib/light/harmonics.glsl"

uniform sampler2DArray eigen_harmonics;

// Mueller, Meseth, Klein 2004, eq. 2: the product of the coefficients of the table and of the rotated light.
vec3 btf_environment(vec2 uv, vec3 w_view, mat3 to_world, float lod) {
    if (!directions_valid(w_view, w_view)) {
        return vec3(0.0);
    }
    vec3 light[HARMONICS];
    harmonic_rotated(to_world, light);
    Stencil texels = texel_stencil(uv, CLUSTER_DIM0, CLUSTER_DIM1);
    Stencil views = view_stencil(w_view);
    vec3 sum = vec3(0.0);
    for (int x = 0; x < 4; ++x) {
        if (texels.weight[x] == 0.0) {
            continue;
        }
        int texel = texels.index[x];
        float coefficient[PACKET_COLOURS];
        lpca_coefficients(texel, coefficient);
        int first = int(table_fetch(cluster, texel * CLUSTER_STRIDE).r) * EIGEN_HARMONICS_DIM1;
        for (int v = 0; v < 4; ++v) {
            if (views.weight[v] == 0.0) {
                continue;
            }
            vec3 seen = vec3(0.0);
            int at = (first + views.index[v]) * HARMONICS;
            for (int i = 0; i < HARMONICS; ++i) {
                seen += light[i] * packet_sum(eigen_harmonics, (at + i) * EIGEN_HARMONICS_STRIDE, coefficient);
            }
            sum += texels.weight[x] * views.weight[v] * seen;
        }
    }
    return sum;
}
