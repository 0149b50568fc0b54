// Provides black where a surface is: the pass that fills the depth buffer before others add up.
// Expects nothing, or with QUADRIC the shape and the place of the film.

#include "lib/surface/film.glsl"
#include "lib/surface/quadric.glsl"

out vec4 radiance;

void main() {
#ifdef QUADRIC
    vec3 at;
    float depth;
    if (!quadric_hit(film_coordinate(gl_FragCoord), at, depth)) {
        discard;
    }
    gl_FragDepth = quadric_depth(depth);
#endif
    radiance = vec4(0.0);
}
