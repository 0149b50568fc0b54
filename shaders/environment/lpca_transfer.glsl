// Provides btf_environment of local PCA for one cluster of transfer matrices; hosts add the clusters' pictures up.
// Expects the samplers below, TRANSFER_*, lpca's texel maps, and the side, triangle and bin that the host sets.

#include "representations/lpca.glsl"
#include "lib/lookup/parabolic_maps.glsl"

uniform sampler2DArray transfer_products;  // [channel, side, matrix cluster, j, cluster, row, column, m] floats or codes
uniform sampler2DArray transfer_corners;   // [triangle, corner]: cluster, weights from j = 1 on
uniform sampler2DArray transfer_scales;    // of codes: (j = 0, m = 0), (0, > 0), (> 0, 0), (> 0, > 0)
uniform sampler2DArray transfer_clusters;  // place of each of the material's clusters among those that are present
uniform int transfer_components;           // 1 + matrix components in the table: fewer while the light moves
uniform int bin;                           // cluster that is drawn; -1: the other lights alone

int transfer_side;             // set by the host: 1 where the back of a two-sided surface is seen
int transfer_triangle;
vec3 transfer_barycentric;

// Sum over components of coefficients times floats that begin anywhere in a list of RGBA texels.
vec2 transfer_sum(int first, float coefficient[PACKET_COLOURS]) {
    vec4 texel = table_fetch(transfer_products, first >> 2);
    float mean = texel[first & 3], sum = 0.0;
#if TRANSFER_BITS == 8
    mean = mean * 255.0 - 127.0;
#endif
    for (int m = 1; m < PACKET_COLOURS; ++m) {
        int at = first + m;
        if ((at & 3) == 0) {
            texel = table_fetch(transfer_products, at >> 2);
        }
#if TRANSFER_BITS == 8
        sum += coefficient[m] * (texel[at & 3] * 255.0 - 127.0);
#else
        sum += coefficient[m] * texel[at & 3];
#endif
    }
    return vec2(coefficient[0] * mean, sum);
}

// Mueller, Meseth, Klein 2004, eq. 3, the terms of one cluster of matrices.
vec3 btf_environment(vec2 uv, vec3 w_view, mat3 to_world, float lod) {
    if (!directions_valid(w_view, w_view)) {
        return vec3(0.0);
    }
    // Corners of other clusters have weight zero here, and theirs in their own clusters' pictures.
    float alpha[TRANSFER_CORNERS_DIM1];
    for (int j = 0; j < TRANSFER_CORNERS_DIM1; ++j) {
        alpha[j] = 0.0;
    }
    for (int corner = 0; corner < 3; ++corner) {
        int at = (3 * transfer_triangle + corner) * TRANSFER_CORNERS_STRIDE;
        if (int(table_fetch(transfer_corners, at).r) == bin) {
            alpha[0] += transfer_barycentric[corner];
            for (int j = 1; j < transfer_components; ++j) {
                alpha[j] += transfer_barycentric[corner] * table_fetch(transfer_corners, at + (j >> 2))[j & 3];
            }
        }
    }
    Stencil texels = texel_stencil(uv, CLUSTER_DIM0, CLUSTER_DIM1);
    Stencil views = parabolic_stencil(w_view, TRANSFER_SIZE);
    ivec4 id = ivec4(-1);
    for (int x = 0; x < 4; ++x) {
        if (texels.weight[x] != 0.0) {
            // The products have the clusters that texels have, and no others.
            id[x] = int(table_fetch(transfer_clusters, int(table_fetch(cluster, texels.index[x] * CLUSTER_STRIDE).r)).r);
        }
    }
    const int maps = TRANSFER_MATERIALS * TRANSFER_SIZE * TRANSFER_SIZE * PACKET_COLOURS;
    int clusters = TRANSFER_SIDES * TRANSFER_CLUSTERS * transfer_components * maps;
#if TRANSFER_BITS == 8
    vec4 scales = table_fetch(transfer_scales, 0) * (1.0 / 127.0);
#else
    vec4 scales = vec4(1.0);
#endif
    vec3 sum = vec3(0.0);
    for (int x = 0; x < 4; ++x) {
        bool done = id[x] < 0;
        for (int y = 0; y < x; ++y) {
            done = done || id[y] == id[x];
        }
        if (done) {
            continue;
        }
        // Neighbours of one cluster share its products: their weights add up.
        float coefficient[PACKET_COLOURS];
        for (int m = 0; m < PACKET_COLOURS; ++m) {
            coefficient[m] = 0.0;
        }
        for (int y = x; y < 4; ++y) {
            if (id[y] == id[x]) {
                float own[PACKET_COLOURS];
                lpca_coefficients(texels.index[y], own);
                for (int m = 0; m < PACKET_COLOURS; ++m) {
                    coefficient[m] += texels.weight[y] * own[m];
                }
            }
        }
        for (int j = 0; j < transfer_components; ++j) {
            if (alpha[j] == 0.0) {
                continue;
            }
            vec2 scale = alpha[j] * (j == 0 ? scales.xy : scales.zw);
            int first = ((transfer_side * TRANSFER_CLUSTERS + bin) * transfer_components + j) * maps;
            for (int v = 0; v < 4; ++v) {
                int at = first + (id[x] * TRANSFER_SIZE * TRANSFER_SIZE + views.index[v]) * PACKET_COLOURS;
                for (int c = 0; c < 3; ++c) {
                    sum[c] += views.weight[v] * dot(scale, transfer_sum(at + c * clusters, coefficient));
                }
            }
        }
    }
    return sum;
}
