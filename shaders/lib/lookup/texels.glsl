// Provides texel_stencil (texels that a lookup blends: flat indices row * columns + column, weights) and texel_corner.
// Expects FILTER_BILINEAR (1: the four neighbours, 0: the texel that holds uv).

#include "lib/lookup/stencil.glsl"

// Integer and fractional part of fraction(u) * n - shift.
// The product is taken in two halves: 4096 = 2^12, so that for n <= 4096 the first product is exact in 24 bits and
// the fraction keeps its accuracy in the last column as in the first.
vec2 texel_position(float u, float n, float shift) {
    // Not finite counts as 0; the largest float bounds it.
    u = abs(u) <= 3.4e38 ? u : 0.0;
    u -= floor(u);
    float high = floor(u * 4096.0) * (1.0 / 4096.0);
    float position = high * n - shift;
    float whole = floor(position);
    float fraction = (position - whole) + (u - high) * n;
    float carry = floor(fraction);
    return vec2(whole + carry, fraction - carry);
}

// Texel centres are at (i + 1/2)/n: column and row of the last centre before uv, and the way from there to the next.
void texel_corner(vec2 uv, int rows, int columns, out vec2 corner, out vec2 way) {
    vec2 x = texel_position(uv.x, float(columns), 0.5);
    vec2 y = texel_position(uv.y, float(rows), 0.5);
    corner = vec2(x.x, y.x);
    way = vec2(x.y, y.y);
}

// The texture repeats.
Stencil texel_stencil(vec2 uv, int rows, int columns) {
#if FILTER_BILINEAR
    vec2 corner, f;
    texel_corner(uv, rows, columns, corner, f);
    int c0 = int(corner.x), r0 = int(corner.y);
    c0 = c0 < 0 ? c0 + columns : min(c0, columns - 1);
    r0 = r0 < 0 ? r0 + rows : min(r0, rows - 1);
    int c1 = c0 + 1 == columns ? 0 : c0 + 1;
    int r1 = r0 + 1 == rows ? 0 : r0 + 1;
    return Stencil(
        ivec4(r0 * columns + c0, r0 * columns + c1, r1 * columns + c0, r1 * columns + c1),
        vec4((1.0 - f.x) * (1.0 - f.y), f.x * (1.0 - f.y), (1.0 - f.x) * f.y, f.x * f.y));
#else
    // A coordinate just below an integer may round up to it.
    int c = min(int(texel_position(uv.x, float(columns), 0.0).x), columns - 1);
    int r = min(int(texel_position(uv.y, float(rows), 0.0).x), rows - 1);
    return Stencil(ivec4(r * columns + c, 0, 0, 0), vec4(1.0, 0.0, 0.0, 0.0));
#endif
}
