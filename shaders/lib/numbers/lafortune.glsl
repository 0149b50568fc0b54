// Provides lafortune_value: generalized cosine lobes of a texel, without its chroma.
// Expects lobes [row, column, 4 N_LOBES], peaks [row, column, N_LOBES], colour [row, column, 4].

#include "lib/numbers/powers.glsl"
#include "lib/lookup/table.glsl"

uniform sampler2DArray lobes;
uniform sampler2DArray peaks;
uniform sampler2DArray colour;

// Lafortune et al. 1997, eq. 8: rho_d + sum over j of peak_j (C_j . (l v))^n_j, the product taken by component.
float lafortune_value(int texel, float diffuse, vec3 product) {
    float value = diffuse;
    for (int j = 0; j < N_LOBES; ++j) {
        vec4 lobe = table_fetch(lobes, texel * LOBES_STRIDE + j);
        float peak = table_fetch(peaks, texel * PEAKS_STRIDE + (j >> 2))[j & 3];
        value += peak * safe_power(dot(lobe.xyz, product), lobe.w);
    }
    return value;
}
