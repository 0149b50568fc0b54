// Provides what is at a pixel, one vector of it at a time: texture coordinate and level of detail, local frame, place.
// Expects hosts/mesh.vert, the camera's rays and the texture transform, as hosts/mesh.frag does.

#include "lib/surface/film.glsl"
#include "lib/surface/frame.glsl"
#include "lib/surface/lod.glsl"
#include "lib/surface/triangle_table.glsl"

const int POINT_UV = 0, POINT_PLACE = 4;  // between them the rows of the local frame

uniform sampler2DArray triangles;
uniform vec3 camera_origin;
uniform vec3 ray_corner;
uniform vec3 ray_right;
uniform vec3 ray_down;
uniform vec3 uv_row0;
uniform vec3 uv_row1;
uniform vec3 uv_turn;
uniform int wanted;

flat in int triangle;

out vec4 found;

void main() {
    vec2 film = film_coordinate(gl_FragCoord);
    vec3 direction = normalize(ray_corner + film.x * ray_right + film.y * ray_down);
    SurfacePoint point = scene_intersect(triangles, triangle, camera_origin, direction);
    if (wanted == POINT_UV) {
        vec3 uv1 = vec3(point.uv, 1.0);
        float lod = lod_of(point, uv_row0, uv_row1, -direction, distance(point.position, camera_origin));
        found = vec4(dot(uv_row0, uv1), dot(uv_row1, uv1), lod, 1.0);
    } else if (wanted == POINT_PLACE) {
        found = vec4(point.position, 1.0);
    } else {
        mat3 to_local = frame_turned(shading_frame(point.normal, point.dp_du, point.side), uv_turn);
        int row = wanted - 1;
        found = vec4(to_local[0][row], to_local[1][row], to_local[2][row], 1.0);
    }
}
