// Provides btf_eval of local PCA: mean of the texel's cluster plus its weighted eigen-BRDFs.
// Expects basis [cluster, view, light, packet], weights [row, column, component], cluster [row, column, 1].

// Mueller, Meseth, Klein 2004: B_x = mean_k(x) + sum over i of weight_i E_(i,k(x)); entry 0 of a packet is the mean.
#define PACKET_COLOURS (1 + WEIGHTS_DIM2)

#include "lib/lookup/directions.glsl"
#include "lib/lookup/packets.glsl"
#include "lib/lookup/texels.glsl"

uniform sampler2DArray basis;
uniform sampler2DArray weights;
uniform usampler2DArray cluster;

// Weight of the cluster's mean, and of its eigen-BRDFs in a texel.
void lpca_coefficients(int texel, out float coefficient[PACKET_COLOURS]) {
    coefficient[0] = 1.0;
    for (int c = 1; c < PACKET_COLOURS; ++c) {
        coefficient[c] = table_fetch(weights, texel * WEIGHTS_STRIDE + ((c - 1) >> 2))[(c - 1) & 3];
    }
}

vec3 btf_eval(vec2 uv, vec3 w_light, vec3 w_view, float lod) {
    if (!directions_valid(w_light, w_view)) {
        return vec3(0.0);
    }
    Stencil texels = texel_stencil(uv, CLUSTER_DIM0, CLUSTER_DIM1);
    Stencil views = view_stencil(w_view);
    Stencil lights = light_stencil(w_light);
    vec3 sum = vec3(0.0);
    for (int x = 0; x < 4; ++x) {
        // Indices are never interpolated: each neighbour is evaluated with its own cluster, then blended.
        if (texels.weight[x] == 0.0) {
            continue;
        }
        int texel = texels.index[x];
        float coefficient[PACKET_COLOURS];
        lpca_coefficients(texel, coefficient);
        int first = int(table_fetch(cluster, texel * CLUSTER_STRIDE).r) * BASIS_DIM1;
        vec3 texel_sum = vec3(0.0);
        for (int v = 0; v < 4; ++v) {
            for (int l = 0; l < 4; ++l) {
                float weight = views.weight[v] * lights.weight[l];
                if (weight != 0.0) {
                    int pair = (first + views.index[v]) * BASIS_DIM2 + lights.index[l];
                    texel_sum += weight * packet_sum(basis, pair * BASIS_STRIDE, coefficient);
                }
            }
        }
        sum += texels.weight[x] * texel_sum;
    }
    return sum;
}
