// Provides environment_lobe, environment_irradiance: a prefiltered environment, as btfref/rendering/environment_light/prefilter.py makes it.
// Expects environment_maps [2 slices, size, size, 3] and clipped_lobes [rows, heights, 4].

#include "lib/numbers/powers.glsl"
#include "lib/light/sphere_maps.glsl"

uniform sampler2DArray environment_maps;
uniform sampler2DArray clipped_lobes;

const float ENVIRONMENT_PI = 3.14159265358979;

// What stands for a lobe that the horizon cuts, two others beside its centroid: what is left of its integral, the centroid's
// height, the position of their exponent, the sine of the angle between them and the centroid.
vec4 clipped_lobe(int slice, float height) {
    const int last = CLIPPED_LOBES_DIM1 - 1;
    float position = clamp((height + 1.0) * (0.5 * float(last)), 0.0, float(last));
    int low = min(int(position), last - 1);
    int at = slice * CLIPPED_LOBES_DIM1 + low;
    return mix(table_fetch(clipped_lobes, at), table_fetch(clipped_lobes, at + 1), position - float(low));
}

// The mean that a lobe about an axis sees, between two slices of the maps.
vec3 environment_mean(vec3 axis, int low, float f) {
    return mix(sphere_lookup(environment_maps, low, ENVIRONMENT_MAPS_DIM1, axis),
               sphere_lookup(environment_maps, low + 1, ENVIRONMENT_MAPS_DIM1, axis), f);
}

// Integral of max(axis . l, 0)^exponent L(l) over the hemisphere (Meseth, Mueller, Klein 2004, section 5.2), the axis in
// the frame that to_world takes to world space. Linear in the logarithm of the exponent between slices and rows, which are
// at 2^(i/2).
vec3 environment_lobe(vec3 axis, mat3 to_world, float exponent) {
    const int slices = ENVIRONMENT_MAPS_DIM0 / 2;
    float n = max(exponent, 1.0);
    float position = clamp(2.0 * log2_accurate(n), 0.0, float(CLIPPED_LOBES_DIM0 - 1));
    int low = min(int(position), CLIPPED_LOBES_DIM0 - 2);
    vec4 lobe = mix(clipped_lobe(low, axis.z), clipped_lobe(low + 1, axis.z), position - float(low));
    position = clamp(lobe.z, 0.0, float(slices - 1));
    low = min(int(position), slices - 2);
    float f = position - float(low);
    vec2 outwards = axis.xy / max(length(axis.xy), POWER_FLOOR);
    vec3 centre = vec3(outwards * sqrt(max(1.0 - lobe.y * lobe.y, 0.0)), lobe.y);
    vec3 mean;
    if (lobe.w > 0.0) {
        centre *= sqrt(max(1.0 - lobe.w * lobe.w, 0.0));
        vec3 aside = lobe.w * vec3(-outwards.y, outwards.x, 0.0);
        mean = 0.5 * (environment_mean(to_world * (centre + aside), low, f) + environment_mean(to_world * (centre - aside), low, f));
    } else {
        mean = environment_mean(to_world * centre, low, f);
    }
    return (2.0 * ENVIRONMENT_PI / (n + 1.0) * lobe.x) * mean;
}

// Irradiance of a surface: the first slice is the cosine.
vec3 environment_irradiance(vec3 normal) {
    return ENVIRONMENT_PI * sphere_lookup(environment_maps, 0, ENVIRONMENT_MAPS_DIM1, normal);
}
