// Provides what each pixel sees: the number of the triangle plus 1, and the mesh.
// Expects hosts/mesh.vert, or with QUADRIC the shape and the place of the film.

#include "lib/surface/film.glsl"
#include "lib/surface/quadric.glsl"

uniform int mesh;

#ifndef QUADRIC
flat in int triangle;
#endif

out vec2 seen;

void main() {
#ifdef QUADRIC
    int triangle = 0;
    vec3 at;
    float depth;
    if (!quadric_hit(film_coordinate(gl_FragCoord), at, depth)) {
        discard;
    }
    gl_FragDepth = quadric_depth(depth);
#endif
    seen = vec2(float(triangle + 1), float(mesh));
}
