// Provides the projected vertices of a mesh, without vertex buffers: vertex v is corner v % 3 of triangle v / 3.
// Expects the triangle table of lib/triangle_table.glsl and world_to_clip, the jittered projection.

#include "lib/triangle_table.glsl"

uniform sampler2DArray triangles;
uniform mat4 world_to_clip;

flat out int triangle;

void main() {
    triangle = gl_VertexID / 3;
    vec3 position = table_fetch(triangles, triangle * SCENE_TRIANGLE_TEXELS + gl_VertexID % 3).xyz;
    gl_Position = world_to_clip * vec4(position, 1.0);
}
