// Provides light_reaches: whether nothing stands between a point and light i, decided as a ray tracer decides it.
// Expects SHADOW_VIEWS and the tables of btfref.rendering.gl.shadows, or no SHADOWS: every light then reaches.

#ifdef SHADOWS
uniform sampler2DArray occluders;           // four texels a triangle: its corners, the triangles across its edges
uniform highp sampler2D shadow_map;         // tiles: the triangle that is nearest to the light, plus 1
uniform mat4 shadow_view[SHADOW_VIEWS];     // from the world to a tile's clip space
uniform vec4 shadow_tile[SHADOW_VIEWS];     // its lower left corner, its size, both in texels; size of a texel at w = 1
uniform vec4 shadow_light[N_LIGHTS];        // position and 0, or direction towards the light and the length of a ray
uniform vec4 shadow_views[N_LIGHTS];        // its first tile, and the one behind its last one

// Mitsuba 3.9 (Interaction::spawn_ray_to, math::RayEpsilon, math::ShadowEpsilon in float32): a shadow ray starts beside
// the surface, on the side of the light, and ends before the light.
const float SHADOW_START = 8.940697e-5;
const float SHADOW_END = 8.940697e-4;

// Coordinates outside of a triangle by rounding: without them a ray may slip through an edge that two triangles share.
const float SHADOW_SLACK = 1e-6;

// Triangles that are passed on the way from the middle of a texel to the ray: fine meshes have some in a texel.
const int SHADOW_STEPS = 12;

// A surface that only continues the triangle at a texel must be so many texels in front to hide the light.
const float SHADOW_MARGIN = 4.0;

// As table_fetch, but no fetch of the representation: it is not counted.
vec4 occluder_fetch(int i) {
    return texelFetch(occluders, ivec3(i & 4095, (i >> 12) & 4095, i >> 24), 0);
}

// Barycentric coordinates of the point where a ray meets a triangle's plane, and the distance (Moeller and Trumbore 1997).
vec4 occluder_meet(int triangle, vec3 origin, vec3 direction) {
    vec3 a = occluder_fetch(4 * triangle).xyz;
    vec3 edge1 = occluder_fetch(4 * triangle + 1).xyz - a, edge2 = occluder_fetch(4 * triangle + 2).xyz - a;
    vec3 p = cross(direction, edge2), from_a = origin - a, q = cross(from_a, edge1);
    float inverse = 1.0 / dot(edge1, p);
    float beta = dot(from_a, p) * inverse, gamma = dot(direction, q) * inverse;
    return vec4(1.0 - beta - gamma, beta, gamma, dot(edge2, q) * inverse);
}

// The map says which triangles may be in the way; the ray decides. So resolution and bias move no border of a shadow, and
// no surface shadows itself where a ray tracer's does not.
bool light_reaches(int i, vec3 point, vec3 normal) {
    vec4 light = shadow_light[i];
    vec3 target = light.w > 0.0 ? point + light.w * light.xyz : light.xyz;
    float start = (1.0 + max(abs(point.x), max(abs(point.y), abs(point.z)))) * SHADOW_START;
    vec3 origin = point + (dot(normal, target - point) < 0.0 ? -start : start) * normal;
    vec3 direction = target - origin;
    float reach = length(direction);
    direction /= reach;
    reach *= 1.0 - SHADOW_END;

    int view = int(shadow_views[i].x), end = int(shadow_views[i].y);
    vec4 clip = vec4(0.0);
    for (; view < end; ++view) {
        clip = shadow_view[view] * vec4(origin, 1.0);
        if (clip.w > 0.0 && max(abs(clip.x), abs(clip.y)) <= clip.w) {
            break;
        }
    }
    if (view >= end) {
        return true;  // The map covers whatever is in the way of anything.
    }
    vec4 tile = shadow_tile[view];
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
            vec3 across = occluder_fetch(4 * triangle + 3).xyz;
            float next = least == met.x ? across.x : least == met.y ? across.y : across.z;
            if (next < 0.0) {
                break;
            }
            triangle = int(next);
            met = occluder_meet(triangle, origin, direction);
        }
        bool inside = min(met.x, min(met.y, met.z)) >= -SHADOW_SLACK;
        if (inside && met.w > 0.0 && met.w < reach) {
            return false;
        }
        behind = behind && !inside && plane > margin && plane < reach;
    }
    return !behind;
}
#else
#define light_reaches(i, point, normal) true
#endif
