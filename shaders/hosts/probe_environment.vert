// Provides the radiance under an environment for each vertex, through transform feedback: what agreement tests compare.
// Expects a representation and an environment shader; attributes uv, w_view (local frame) and the local axes in world space.

#include "representation"
#include "environment"

in vec2 uv;
in vec3 w_view;
in vec3 axis_x;
in vec3 axis_y;
in vec3 axis_z;

out vec3 value;

void main() {
    value = btf_environment(uv, w_view, mat3(axis_x, axis_y, axis_z), 0.0);
    gl_Position = vec4(0.0, 0.0, 0.0, 1.0);
}
