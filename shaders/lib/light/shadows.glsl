// Provides light_reaches: whether nothing stands between a point and light i, decided as a ray tracer decides it.
// Expects SHADOW_VIEWS, SHADOW_TRACED, SHADOW_QUADRICS and the table of btfref.rendering.gl.shadows, or no SHADOWS: every
// light then reaches.

#include "lib/light/occluders.glsl"

#ifdef SHADOWS
#if SHADOW_VIEWS > 0
uniform highp sampler2D shadow_map;  // tiles: the triangle that is nearest to the light, plus 1
#endif

// Mitsuba 3.9 (Interaction::spawn_ray_to, math::RayEpsilon, math::ShadowEpsilon in float32): a shadow ray starts beside
// the surface, on the side of the light, and ends before the light.
const float SHADOW_START = 8.940697e-5;
const float SHADOW_END = 8.940697e-4;

// Triangles that are passed on the way from the middle of a texel to the ray: fine meshes have some in a texel.
const int SHADOW_STEPS = 12;

// A surface that only continues the triangle at a texel must be so many texels in front to hide the light.
const float SHADOW_MARGIN = 4.0;

#if SHADOW_VIEWS > 0
// The map says which triangles may be in the way; the ray decides. So resolution and bias move no border of a shadow, and
// no surface shadows itself where a ray tracer's does not.
bool shadow_map_hides(int first_view, int end, vec3 origin, vec3 direction, float reach) {
    int view = first_view;
    vec4 clip = vec4(0.0), from = vec4(origin, 1.0);
    for (; view < end; ++view) {
        int row = shadow_at.y + 5 * view;
        clip = vec4(dot(table_read(occluders, row), from), dot(table_read(occluders, row + 1), from), 0.0,
                    dot(table_read(occluders, row + 3), from));
        if (clip.w > 0.0 && max(abs(clip.x), abs(clip.y)) <= clip.w) {
            break;
        }
    }
    if (view >= end) {
        return false;  // The map covers whatever is in the way of anything.
    }
    // Its lower left corner, its size, both in texels; size of a texel at w = 1.
    vec4 tile = table_read(occluders, shadow_at.y + 5 * view + 4);
    ivec2 corner = ivec2(tile.xy), last = ivec2(int(tile.z) - 1);
    ivec2 at = ivec2(floor((0.5 + 0.5 * clip.xy / clip.w) * tile.z - 0.5));
    float margin = SHADOW_MARGIN * tile.w * clip.w;
    bool behind = true;  // what is seen at all four texels around
    int before = -1;
    for (int k = 0; k < 4; ++k) {
        ivec2 texel = corner + clamp(at + ivec2(k & 1, k >> 1), ivec2(0), last);
        int first = int(texelFetch(shadow_map, texel, 0).r) - 1;
        if (first < 0) {
            behind = false;
            continue;
        }
        if (first == before) {
            continue;
        }
        before = first;
        int triangle = first;
        vec4 met = occluder_meet(triangle, origin, direction);
        float plane = met.w;
        for (int step = 0; step < SHADOW_STEPS; ++step) {
            float least = min(met.x, min(met.y, met.z));
            if (least >= -SHADOW_SLACK) {
                break;
            }
            vec3 across = table_read(occluders, 4 * triangle + 3).xyz;
            float next = least == met.x ? across.x : least == met.y ? across.y : across.z;
            if (next < 0.0) {
                break;
            }
            triangle = int(next);
            met = occluder_meet(triangle, origin, direction);
        }
        bool inside = min(met.x, min(met.y, met.z)) >= -SHADOW_SLACK;
        if (inside && met.w > 0.0 && met.w < reach) {
            return true;
        }
        behind = behind && !inside && plane > margin && plane < reach;
    }
    return behind;
}
#endif

bool light_reaches(int i, vec3 point, vec3 normal) {
    // Position and 0, or direction towards the light and the length of a ray; then the light's first tile, the one behind
    // its last one, and whether its rays go through the tree instead.
    vec4 light = table_read(occluders, shadow_at.x + 2 * i), how = table_read(occluders, shadow_at.x + 2 * i + 1);
    vec3 target = light.w > 0.0 ? point + light.w * light.xyz : light.xyz;
    float start = (1.0 + max(abs(point.x), max(abs(point.y), abs(point.z)))) * SHADOW_START;
    vec3 origin = point + (dot(normal, target - point) < 0.0 ? -start : start) * normal;
    vec3 direction = target - origin;
    float reach = length(direction);
    direction /= reach;
    reach *= 1.0 - SHADOW_END;
    bool hidden = occluding_quadric(origin, direction, reach);
#if SHADOW_TRACED > 0
    if (!hidden && how.z > 0.0) {
        hidden = occluding_triangle(origin, direction, reach);
    }
#endif
#if SHADOW_VIEWS > 0
    if (!hidden && how.y > how.x) {
        hidden = shadow_map_hides(int(how.x), int(how.y), origin, direction, reach);
    }
#endif
    return !hidden;
}
#else
#define light_reaches(i, point, normal) true
#endif
