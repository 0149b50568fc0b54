// Provides scene_intersect: the exact point where a ray meets a mesh, given a triangle that it meets or just misses.
// Expects triangles of eight texels written by btfref.rendering.gl.renderer: positions, normals, uv, dp/du, side, neighbours.

#include "lib/lookup/table.glsl"

const int SCENE_TRIANGLE_TEXELS = 8;

struct SurfacePoint {
    vec3 position;
    vec3 normal;
    vec3 dp_du;
    vec2 uv;
    vec3 plane_normal;  // of the triangle, unit length
    vec3 side;          // the same or its opposite: where dp/du x dp/dv points
    vec3 gradient_u;    // change of u and v per unit length in the triangle's plane
    vec3 gradient_v;
    int triangle;       // and the place in it
    vec3 barycentric;
};

// Barycentric coordinates of the point where a ray meets a triangle's plane (Moeller and Trumbore 1997, eq. 6).
vec3 scene_barycentric(sampler2DArray triangles, int triangle, vec3 origin, vec3 direction) {
    int at = triangle * SCENE_TRIANGLE_TEXELS;
    vec3 a = table_fetch(triangles, at).xyz;
    vec3 edge1 = table_fetch(triangles, at + 1).xyz - a, edge2 = table_fetch(triangles, at + 2).xyz - a;
    vec3 p = cross(direction, edge2);
    float inverse = 1.0 / dot(edge1, p);
    vec3 from_a = origin - a;
    float beta = dot(from_a, p) * inverse;
    float gamma = dot(direction, cross(from_a, edge1)) * inverse;
    return vec3(1.0 - beta - gamma, beta, gamma);
}

// The rasterizer snaps vertices to 1/256 pixel and interpolates what it snapped. The ray gives the coordinates that a
// ray tracer has; where they lie outside, the ray belongs to the neighbour, whose dp/du differs.
SurfacePoint scene_intersect(sampler2DArray triangles, int rasterized, vec3 origin, vec3 direction) {
    int triangle = rasterized;
    vec3 own = scene_barycentric(triangles, triangle, origin, direction);
    vec3 at_point = own;
    // Four steps go around any vertex that is not a pole; a ray that finds no triangle passes the silhouette, and
    // the rasterizer's triangle is continued.
    for (int i = 0; i < 4; ++i) {
        float least = min(at_point.x, min(at_point.y, at_point.z));
        if (least >= 0.0) {
            break;
        }
        vec3 across = table_fetch(triangles, triangle * SCENE_TRIANGLE_TEXELS + 7).xyz;
        float next = least == at_point.x ? across.x : least == at_point.y ? across.y : across.z;
        if (next < 0.0) {
            break;
        }
        triangle = int(next);
        at_point = scene_barycentric(triangles, triangle, origin, direction);
    }
    if (min(at_point.x, min(at_point.y, at_point.z)) < 0.0) {
        triangle = rasterized;
        at_point = own;
    }
    int at = triangle * SCENE_TRIANGLE_TEXELS;
    vec4 a = table_fetch(triangles, at), b = table_fetch(triangles, at + 1), c = table_fetch(triangles, at + 2);
    vec4 n_a = table_fetch(triangles, at + 3), n_b = table_fetch(triangles, at + 4);
    vec4 n_c = table_fetch(triangles, at + 5);
    SurfacePoint s;
    // Differences to corner a: texture coordinates far from zero lose nothing.
    s.position = a.xyz + at_point.y * (b.xyz - a.xyz) + at_point.z * (c.xyz - a.xyz);
    s.normal = normalize(n_a.xyz * at_point.x + n_b.xyz * at_point.y + n_c.xyz * at_point.z);
    vec2 uv_a = vec2(a.w, n_a.w);
    s.uv = uv_a + at_point.y * (vec2(b.w, n_b.w) - uv_a) + at_point.z * (vec2(c.w, n_c.w) - uv_a);
    vec4 tangent = table_fetch(triangles, at + 6);
    s.dp_du = tangent.xyz;
    vec3 edge1 = b.xyz - a.xyz, edge2 = c.xyz - a.xyz, area = cross(edge1, edge2);
    float squared = max(dot(area, area), 1e-37);
    vec2 uv1 = vec2(b.w, n_b.w) - uv_a, uv2 = vec2(c.w, n_c.w) - uv_a;
    // Gradients of the barycentric coordinates of b and c.
    vec3 of_b = cross(edge2, area) / squared, of_c = cross(area, edge1) / squared;
    s.gradient_u = uv1.x * of_b + uv2.x * of_c;
    s.gradient_v = uv1.y * of_b + uv2.y * of_c;
    s.plane_normal = area * inversesqrt(squared);
    s.side = tangent.w * s.plane_normal;
    s.triangle = triangle;
    s.barycentric = at_point;
    return s;
}
