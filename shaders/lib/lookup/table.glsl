// Provides table_fetch: reads RGBA texel i of a linear list that is folded into a 2D array texture.
// Expects a texture of up to 4096 texels a row and 4096 rows a layer (full where more follow), written by btfref.rendering.gl.device.

// Texels fetched so far, where COUNT_FETCHES is defined to report them.
#ifdef COUNT_FETCHES
int fetches = 0;
#define COUNTED ++fetches;
#else
#define COUNTED
#endif

// 4096 = 2^12: every OpenGL 3.3 and WebGL 2 device of interest has textures of that size (ES 3.0 asks for 2048 only,
// but no WebGL 2 device below 4096 is known), and x, y and layer are bit fields of i.
vec4 table_fetch(sampler2DArray table, int i) {
    COUNTED
    return texelFetch(table, ivec3(i & 4095, (i >> 12) & 4095, i >> 24), 0);
}

// The same of what belongs to no representation, lights and shapes: it is not counted.
vec4 table_read(sampler2DArray table, int i) {
    return texelFetch(table, ivec3(i & 4095, (i >> 12) & 4095, i >> 24), 0);
}

uvec4 table_fetch(usampler2DArray table, int i) {
    COUNTED
    return texelFetch(table, ivec3(i & 4095, (i >> 12) & 4095, i >> 24), 0);
}
