// Provides hashed, a number in [0, 1) of four words, and drawn: one neighbour of a stencil instead of all.
// Expects nothing.

#include "lib/lookup/stencil.glsl"

// Jarzynski and Olano 2020, pcg4d: whole numbers alone, as btfref/numerics/draws.py.
float hashed(uvec4 v) {
    v = v * 1664525u + 1013904223u;
    for (int i = 0; i < 2; ++i) {
        v.x += v.y * v.w;
        v.y += v.z * v.x;
        v.z += v.x * v.y;
        v.w += v.y * v.z;
        if (i == 0) {
            v ^= v >> 16u;
        }
    }
    // 24 bits are what a float holds.
    return float(v.x >> 8u) * (1.0 / 16777216.0);
}

// Of weights that sum to 1: a neighbour is drawn where the weight of those before it is at most the number, and one
// without weight never is. The mean over uniform numbers is the sum over the stencil.
Stencil drawn(Stencil s, float number) {
    int index = s.index.x;
    float before = s.weight.x;
    for (int i = 1; i < 4; ++i) {
        if (number >= before && s.weight[i] > 0.0) {
            index = s.index[i];
        }
        before += s.weight[i];
    }
    return Stencil(ivec4(index, 0, 0, 0), vec4(1.0, 0.0, 0.0, 0.0));
}
