// Provides the radiance towards the camera under the scene's lights, with cast shadows if any, and an environment.
// Expects a representation, the tables of hosts/mesh.vert, the camera's rays, the lights and the material.

#include "lib/surface/film.glsl"
#include "lib/surface/frame.glsl"
#include "lib/light/lights.glsl"
#include "lib/light/shadows.glsl"
#include "lib/surface/lod.glsl"
#include "lib/surface/quadric.glsl"
#include "lib/surface/triangle_table.glsl"
#include "representation"
#include "environment"

uniform sampler2DArray triangles;
uniform vec3 camera_origin;
uniform vec3 ray_corner;    // towards film coordinate (0, 0), the top left corner
uniform vec3 ray_right;     // change per pixel to the right
uniform vec3 ray_down;      // change per pixel downwards
uniform vec3 uv_row0;       // texture transform: u' = dot(uv_row0, (u, v, 1))
uniform vec3 uv_row1;
uniform vec3 uv_turn;       // of the local frame by the texture transform: cosine, sine, -1 where it mirrors
uniform float scale;
uniform bool two_sided;
uniform vec3 emission;      // radiance of the shape's own light
uniform int pass;           // number of this picture among those that add up
#ifdef DRAWN_VIEWS
uniform uint frame;         // number of this frame, and the seed of all: with the pixel they draw
uniform uint seed;
#endif
#ifdef HAS_ENVIRONMENT
uniform int environment_passes;  // that the environment takes part in
#endif

#ifdef SEEN
uniform highp sampler2D seen;  // what each pixel sees, from hosts/seen.frag
uniform int mesh;              // that is drawn
#elif !defined(QUADRIC)
flat in int triangle;
#endif

out vec4 radiance;

void main() {
#ifdef SEEN
    vec2 identity = texelFetch(seen, ivec2(gl_FragCoord.xy), 0).rg;
    int triangle = int(identity.r) - 1;
    // No discard: it would put the depth test, which leaves the background out, behind the shading.
    if (triangle < 0 || int(identity.g) != mesh) {
        radiance = vec4(0.0);
        return;
    }
#endif
    vec2 film = film_coordinate(gl_FragCoord);
    vec3 direction = normalize(ray_corner + film.x * ray_right + film.y * ray_down);
#ifdef QUADRIC
    SurfacePoint point;
    float window;
    if (!quadric_intersect(film, point, window)) {
        discard;
    }
#ifndef SEEN
    gl_FragDepth = window;
#endif
#else
    SurfacePoint point = scene_intersect(triangles, triangle, camera_origin, direction);
#endif
    mat3 to_local = frame_turned(shading_frame(point.normal, point.dp_du, point.side), uv_turn);
    vec3 uv1 = vec3(point.uv, 1.0);
    vec2 uv = vec2(dot(uv_row0, uv1), dot(uv_row1, uv1));
    vec3 w_view = to_local * -direction;
    // As Mitsuba's twosided: seen from behind, both directions are mirrored at the surface, the frame stays.
    float side = two_sided && w_view.z < 0.0 ? -1.0 : 1.0;
    w_view.z *= side;
    float lod = lod_of(point, uv_row0, uv_row1, -direction, distance(point.position, camera_origin));
#ifdef DRAWN_VIEWS
    // One for all lights, so that the passes of a frame draw alike; rows count from the top, as in files.
    view_draw = hashed(uvec4(gl_FragCoord.x, film_height - gl_FragCoord.y, frame, seed));
#endif
#ifdef COUNT_FETCHES
    fetches = 0;  // of the geometry
#endif
    vec3 sum = vec3(0.0);
    // Passes add up: light is the sum of what each of them has.
#if N_LIGHTS > 0
    for (int i = light_first; i < light_end; ++i) {
        vec3 towards;
        vec3 irradiance = light_incident(i, point.position, towards);
        vec3 w_light = to_local * towards;
        w_light.z *= side;
        // Only light that would count is looked for.
        bool counts = w_light.z > 0.0 && max(irradiance.r, max(irradiance.g, irradiance.b)) > 0.0;
        if (counts && !light_reaches(i, point.position, point.plane_normal)) {
            continue;
        }
        // B holds the cosine of the light (design: conventions), nothing else is multiplied.
        sum += irradiance * btf_eval(uv, w_light, w_view, lod);
    }
#endif
#ifdef HAS_ENVIRONMENT
    mat3 to_world = transpose(to_local);
    to_world[2] *= side;
#ifdef HAS_BINS
    transfer_side = side < 0.0 ? 1 : 0;
    transfer_triangle = point.triangle;
    transfer_barycentric = point.barycentric;
    if (bin >= 0) {  // Clusters' bins overlap: one of its own, without the environment, has every triangle once.
        sum += btf_environment(uv, w_view, to_world, lod);
    }
#else
    if (pass < environment_passes) {
        sum += btf_environment(uv, w_view, to_world, lod);
    }
#endif
#endif
    // Mitsuba's area light shines on the side of the shading normal.
#if !defined(HAS_BINS)
    bool first = pass == 0;
#elif N_LIGHTS > 0
    bool first = bin < 0 && light_first == 0;
#else
    bool first = false;
#endif
    vec3 own_light = first && dot(point.normal, direction) < 0.0 ? emission : vec3(0.0);
#ifdef COUNT_FETCHES
    // Instead of coverage: the texels that the representation fetched.
    radiance = vec4(scale * sum, float(fetches));
#elif defined(HAS_BINS)
    // Coverage comes from the pass that drew the depth: bins add up.
    radiance = vec4(scale * sum, 0.0);
#else
    radiance = vec4(scale * sum, 1.0);
#endif
    radiance.rgb += own_light;
}
