// Provides the radiance of a shape that is a light and nothing else, on the side of its shading normal.
// Expects the tables of hosts/mesh.vert and the camera's rays, as hosts/mesh.frag does.

#include "lib/surface/triangle_table.glsl"

uniform sampler2DArray triangles;
uniform vec3 camera_origin;
uniform vec3 ray_corner;
uniform vec3 ray_right;
uniform vec3 ray_down;
uniform vec2 film_offset;
uniform float film_height;
uniform vec3 emission;

flat in int triangle;

out vec4 radiance;

void main() {
    vec2 film = vec2(gl_FragCoord.x, film_height - gl_FragCoord.y) + film_offset;
    vec3 direction = normalize(ray_corner + film.x * ray_right + film.y * ray_down);
    SurfacePoint point = scene_intersect(triangles, triangle, camera_origin, direction);
    radiance = vec4(dot(point.normal, direction) < 0.0 ? emission : vec3(0.0), 0.0);
}
