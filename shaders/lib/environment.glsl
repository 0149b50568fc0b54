// Provides environment_lobe, environment_irradiance: a prefiltered environment, as btfref/render/prefilter.py makes it.
// Expects environment_maps [2 slices, size, size, 3] and horizon_shares [slices, heights, 1].

#include "lib/powers.glsl"
#include "lib/sphere_maps.glsl"

uniform sampler2DArray environment_maps;
uniform sampler2DArray horizon_shares;

const float ENVIRONMENT_PI = 3.14159265358979;

// Share of a lobe above the horizon; height is that of its axis.
float horizon_share(int slice, float height) {
    const int last = HORIZON_SHARES_DIM1 - 1;
    float position = clamp((height + 1.0) * (0.5 * float(last)), 0.0, float(last));
    int low = min(int(position), last - 1);
    int at = slice * HORIZON_SHARES_DIM1 + low;
    return mix(table_fetch(horizon_shares, at).r, table_fetch(horizon_shares, at + 1).r, position - float(low));
}

// Integral of max(axis . l, 0)^exponent L(l) over the hemisphere (Meseth, Mueller, Klein 2004, section 5.2): linear in
// the logarithm of the exponent between the slices, which are at 2^(i/2).
vec3 environment_lobe(vec3 axis, float height, float exponent) {
    const int slices = ENVIRONMENT_MAPS_DIM0 / 2;
    float n = max(exponent, 1.0);
    float position = clamp(2.0 * log2_accurate(n), 0.0, float(slices - 1));
    int low = min(int(position), slices - 2);
    float f = position - float(low);
    vec3 mean = mix(sphere_lookup(environment_maps, low, ENVIRONMENT_MAPS_DIM1, axis),
                    sphere_lookup(environment_maps, low + 1, ENVIRONMENT_MAPS_DIM1, axis), f);
    float share = mix(horizon_share(low, height), horizon_share(low + 1, height), f);
    return (2.0 * ENVIRONMENT_PI / (n + 1.0) * share) * mean;
}

// Irradiance of a surface: the first slice is the cosine.
vec3 environment_irradiance(vec3 normal) {
    return ENVIRONMENT_PI * sphere_lookup(environment_maps, 0, ENVIRONMENT_MAPS_DIM1, normal);
}
