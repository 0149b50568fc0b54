// Provides the projected vertices of what casts shadows, as a light sees it, without vertex buffers.
// Expects the table of lib/light/shadows.glsl and the view of one tile: clip coordinates x, y and w, and in z the depth.

#include "lib/lookup/table.glsl"

uniform sampler2DArray occluders;
uniform mat4 view;

flat out int triangle;
out float depth;

void main() {
    triangle = gl_VertexID / 3;
    vec4 clip = view * vec4(table_fetch(occluders, 4 * triangle + gl_VertexID % 3).xyz, 1.0);
    // Nothing is cut off at a near or far plane: what is near to a lamp casts shadows, too.
    gl_Position = vec4(clip.xy, 0.0, clip.w);
    depth = clip.z;
}
