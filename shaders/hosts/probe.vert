// Provides one value of B for each vertex, through transform feedback, and whether the lookup is malformed.
// Expects a representation; attributes uv, w_light, w_view (local frame, unit length) and lod; with DRAWN_VIEWS draw.

#include "lib/lookup/malformed.glsl"
#include "representation"

in vec2 uv;
in vec3 w_light;
in vec3 w_view;
in float lod;
#ifdef DRAWN_VIEWS
in float draw;
#endif

out vec3 value;
out vec2 unusable;

void main() {
#ifdef DRAWN_VIEWS
    view_draw = draw;
#endif
    value = btf_eval(uv, w_light, w_view, lod);
    unusable = malformed(uv, w_light, w_view);
    gl_Position = vec4(0.0, 0.0, 0.0, 1.0);
}
