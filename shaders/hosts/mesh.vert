// Provides the projected vertices of a mesh, without vertex buffers: vertex v is corner v % 3 of triangle v / 3.
// Expects the triangle table of lib/surface/triangle_table.glsl and world_to_clip, the jittered projection; the bins' triangles if any.

#include "lib/surface/triangle_table.glsl"

uniform sampler2DArray triangles;
uniform mat4 world_to_clip;

flat out int triangle;

// Passes over the same triangles must agree on their depth.
invariant gl_Position;

#ifdef HAS_BINS
uniform sampler2DArray bin_triangles;
uniform int bin_first;
#endif

void main() {
    triangle = gl_VertexID / 3;
#ifdef HAS_BINS
    triangle = int(table_fetch(bin_triangles, bin_first + triangle).r);
#endif
    vec3 position = table_fetch(triangles, triangle * SCENE_TRIANGLE_TEXELS + gl_VertexID % 3).xyz;
    gl_Position = world_to_clip * vec4(position, 1.0);
}
