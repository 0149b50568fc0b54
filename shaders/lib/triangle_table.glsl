// Provides SceneTriangle and triangle_intersect: a mesh triangle from its table, and the exact point that a ray meets.
// Expects triangles of seven texels written by btfref.render.realtime: positions with u, normals with v, dp/du.

#include "lib/table.glsl"

const int SCENE_TRIANGLE_TEXELS = 7;

struct SurfacePoint {
    vec3 position;
    vec3 normal;
    vec3 dp_du;
    vec2 uv;
};

// Ray and triangle by Moeller and Trumbore 1997. The rasterizer snaps vertices to 1/256 pixel and interpolates what
// it snapped; the ray gives the same barycentric coordinates as a ray tracer, to float accuracy. The ray is taken to
// meet the triangle's plane: the rasterizer has decided that the pixel belongs to it.
SurfacePoint triangle_intersect(sampler2DArray triangles, int i, vec3 origin, vec3 direction) {
    int at = i * SCENE_TRIANGLE_TEXELS;
    vec4 a = table_fetch(triangles, at), b = table_fetch(triangles, at + 1), c = table_fetch(triangles, at + 2);
    vec4 n_a = table_fetch(triangles, at + 3), n_b = table_fetch(triangles, at + 4);
    vec4 n_c = table_fetch(triangles, at + 5), tangent = table_fetch(triangles, at + 6);
    vec3 edge1 = b.xyz - a.xyz, edge2 = c.xyz - a.xyz;
    vec3 p = cross(direction, edge2);
    float inverse = 1.0 / dot(edge1, p);
    vec3 from_a = origin - a.xyz;
    float beta = dot(from_a, p) * inverse;
    float gamma = dot(direction, cross(from_a, edge1)) * inverse;
    SurfacePoint s;
    s.position = a.xyz + beta * edge1 + gamma * edge2;
    s.normal = normalize(n_a.xyz * (1.0 - beta - gamma) + n_b.xyz * beta + n_c.xyz * gamma);
    vec2 uv_a = vec2(a.w, n_a.w);
    s.uv = uv_a + beta * (vec2(b.w, n_b.w) - uv_a) + gamma * (vec2(c.w, n_c.w) - uv_a);
    s.dp_du = tangent.xyz;
    return s;
}
