// Provides raised, parabolic_stencil and parabolic_lookup: bilinear lookups in stacks of parabolic maps of the hemisphere.
// Expects a table [slice, row, column, channels <= 4]; conventions are those of btfref/numerics/sphere/parabolic.py.

#include "lib/lookup/stencil.glsl"
#include "lib/lookup/table.glsl"

// Parabolic map of the upper hemisphere (Heidrich and Seidel 1998): (s, t) = (x, y) / (1 + z) for unit vectors, here for
// vectors of any length. Texel centres of an n x n map are at (i + 1/2) * 2/n - 1, as a texture of (s + 1)/2 has them.
Stencil parabolic_stencil(vec3 w, int n) {
    float scale = length(w) + w.z;
    vec2 st = scale > 0.0 ? w.xy / scale : vec2(0.0);
    float size = float(n);
    // For n a power of two the product is exact, and so is what is left of it without the whole part.
    vec2 x = st * (0.5 * size);
    float offset = 0.5 * size - 0.5;
    vec2 low = clamp(floor(x + offset), 0.0, size - 1.0);
    vec2 f = clamp(x - (low - offset), 0.0, 1.0);
    ivec2 i = ivec2(low);
    ivec2 j = min(i + 1, n - 1);
    return Stencil(
        ivec4(i.y * n + i.x, i.y * n + j.x, j.y * n + i.x, j.y * n + j.x),
        vec4((1.0 - f.x) * (1.0 - f.y), f.x * (1.0 - f.y), (1.0 - f.x) * f.y, f.x * f.y));
}

// What a stored number stands for; the power is 1 or 4. The fourth power spreads 8-bit codes over the dark values.
vec3 raised(vec4 stored, int power) {
    vec3 square = stored.rgb * stored.rgb;
    return power == 4 ? square * square : stored.rgb;
}

// The slice is a whole number and its texels are fetched one by one, so that no neighbouring slice leaks in.
vec3 parabolic_lookup(sampler2DArray maps, int slice, int n, Stencil s, int power) {
    int first = slice * n * n;
    vec3 sum = s.weight.x * raised(table_fetch(maps, first + s.index.x), power);
    sum += s.weight.y * raised(table_fetch(maps, first + s.index.y), power);
    sum += s.weight.z * raised(table_fetch(maps, first + s.index.z), power);
    return sum + s.weight.w * raised(table_fetch(maps, first + s.index.w), power);
}
