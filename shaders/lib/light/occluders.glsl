// Provides what a shadow ray meets: occluder_meet, occluding_triangle by a tree of boxes, occluding_quadric.
// Expects SHADOW_TRACED, SHADOW_QUADRICS and the table of btfref.rendering.gl.shadows.

#include "lib/lookup/table.glsl"
#include "lib/surface/quadric.glsl"

#ifdef SHADOWS
uniform sampler2DArray occluders;  // four texels a triangle: its corners, the triangles across its edges; then the rest
uniform ivec4 shadow_at;           // first texel of lights, tiles, quadrics and the tree
uniform ivec2 shadow_own;          // quadric that is drawn, or -1; first texel of the tree's leaves

// Coordinates outside of a triangle by rounding: without them a ray may slip through an edge that two triangles share.
const float SHADOW_SLACK = 1e-6;

// Barycentric coordinates of the point where a ray meets a triangle's plane, and the distance (Moeller and Trumbore 1997).
vec4 occluder_meet(int triangle, vec3 origin, vec3 direction) {
    vec3 a = table_read(occluders, 4 * triangle).xyz;
    vec3 edge1 = table_read(occluders, 4 * triangle + 1).xyz - a, edge2 = table_read(occluders, 4 * triangle + 2).xyz - a;
    vec3 p = cross(direction, edge2), from_a = origin - a, q = cross(from_a, edge1);
    float inverse = 1.0 / dot(edge1, p);
    float beta = dot(from_a, p) * inverse, gamma = dot(direction, q) * inverse;
    return vec4(1.0 - beta - gamma, beta, gamma, dot(edge2, q) * inverse);
}

#if SHADOW_TRACED > 0
// Whether a ray meets any triangle. Nodes are those of a complete binary tree, numbered from 1 by rows, two texels each:
// least corner of the box and the node that comes next where the ray misses it; largest corner, and of a leaf its number.
bool occluding_triangle(vec3 origin, vec3 direction, float reach) {
    vec3 tiny = vec3(lessThan(abs(direction), vec3(1e-20))) * 1e-20, inverse = 1.0 / (direction + tiny);
    int node = 1;
    while (node > 0) {
        vec4 low = table_read(occluders, shadow_at.w + 2 * node), high = table_read(occluders, shadow_at.w + 2 * node + 1);
        vec3 one = (low.xyz - origin) * inverse, other = (high.xyz - origin) * inverse;
        vec3 enter = min(one, other), leave = max(one, other);
        float from = max(max(enter.x, enter.y), max(enter.z, 0.0)), to = min(min(leave.x, leave.y), min(leave.z, reach));
        if (from <= to && high.w < 0.0) {
            node *= 2;
            continue;
        }
        node = int(low.w);
        if (from <= to) {
            vec4 four = table_read(occluders, shadow_own.y + int(high.w));
            for (int k = 0; k < 4; ++k) {
                if (four[k] >= 0.0) {
                    vec4 met = occluder_meet(int(four[k]), origin, direction);
                    if (min(met.x, min(met.y, met.z)) >= -SHADOW_SLACK && met.w > 0.0 && met.w < reach) {
                        return true;
                    }
                }
            }
        }
    }
    return false;
}
#endif

// Whether a ray meets a sphere, disk or cylinder. The one that it starts at is met at the other end of the chord alone,
// whatever rounding says of this end.
bool occluding_quadric(vec3 origin, vec3 direction, float reach) {
#if SHADOW_QUADRICS > 0
    for (int i = 0; i < SHADOW_QUADRICS; ++i) {
        // Rows of the matrix to the canonical frame; its origin in world space and the kind.
        int row = shadow_at.z + 4 * i;
        vec3 x = table_read(occluders, row).xyz, y = table_read(occluders, row + 1).xyz;
        vec3 z = table_read(occluders, row + 2).xyz;
        vec4 centre = table_read(occluders, row + 3);
        int kind = int(centre.w);
        bool own = i == shadow_own.x;
        vec3 away = origin - centre.xyz;
        vec3 from = vec3(dot(x, away), dot(y, away), dot(z, away));
        vec3 ray = vec3(dot(x, direction), dot(y, direction), dot(z, direction));
        if (kind == QUADRIC_DISK) {
            float t = -from.z / ray.z;
            vec2 at = from.xy + t * ray.xy;
            if (!own && t > 0.0 && t < reach && dot(at, at) <= 1.0) {
                return true;
            }
            continue;
        }
        bool round = kind == QUADRIC_SPHERE;
        vec3 across = vec3(ray.xy, round ? ray.z : 0.0), flat_from = vec3(from.xy, round ? from.z : 0.0);
        float square = dot(across, across), middle = -dot(flat_from, across) / square;
        vec3 nearest = flat_from + middle * across;
        float inside = 1.0 - dot(nearest, nearest);
        // No number: a ray along a cylinder's axis.
        if (!own && !(inside > 0.0)) {
            continue;
        }
        float chord = own ? middle : sqrt(inside / square);
        for (int k = own ? 1 : 0; k < 2; ++k) {
            float t = middle + (k == 0 ? -chord : chord);
            float height = from.z + t * ray.z;
            if (t > 0.0 && t < reach && (round || (height >= 0.0 && height <= 1.0))) {
                return true;
            }
        }
    }
#endif
    return false;
}
#endif
