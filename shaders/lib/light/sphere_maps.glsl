// Provides sphere_lookup: bilinear lookups in maps over the sphere, pairs of parabolic maps.
// Expects a table [2 maps, size, size, channels <= 4], as btfref/rendering/environment_light/prefilter.py makes it.

#include "lib/lookup/parabolic_maps.glsl"

// The second map of a pair holds the lower hemisphere, mirrored. The unit disc fills all but half a texel of the square
// at its sides, so that a lookup at the rim finds texels on both sides of it.
vec3 sphere_lookup(sampler2DArray maps, int map, int size, vec3 w) {
    float scale = length(w) + abs(w.z);
    vec2 st = scale > 0.0 ? w.xy * (float(size - 1) / (float(size) * scale)) : vec2(0.0);
    Stencil s = parabolic_stencil(vec3(2.0 * st, 1.0 - dot(st, st)), size);
    return parabolic_lookup(maps, 2 * map + (w.z < 0.0 ? 1 : 0), size, s, 1);
}
