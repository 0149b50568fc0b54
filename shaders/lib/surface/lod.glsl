// Provides lod_of: level of detail of a surface point, from the pixel's footprint or from the distance; sets the step.
// Expects lib/surface/triangle_table.glsl's SurfacePoint.

#include "lib/surface/footprint.glsl"
#include "lib/surface/triangle_table.glsl"

uniform float lod_angle;    // that a sample subtends in radians; 0 leaves the footprint out
uniform float lod_unit;     // distance at which the level of detail is 0; 0 leaves the distance out
uniform float lod_bias;
uniform vec2 lod_texels;    // columns and rows of level 0

// A disk of diameter angle * distance across the ray, stretched by 1/cos(theta) along the ray's projection, is an
// ellipse of texels (Heckbert 1986).
float lod_of(SurfacePoint point, vec3 uv_row0, vec3 uv_row1, vec3 towards, float distance) {
    if (lod_unit > 0.0) {
        return lod_bias + log2(clamp(distance / lod_unit, LOD_TINY, 1e30));
    }
    if (lod_angle <= 0.0) {
        return lod_bias;
    }
    vec3 u = lod_texels.x * (uv_row0.x * point.gradient_u + uv_row0.y * point.gradient_v);
    vec3 v = lod_texels.y * (uv_row1.x * point.gradient_u + uv_row1.y * point.gradient_v);
    float along_u = dot(u, towards), along_v = dot(v, towards), cosine = dot(point.plane_normal, towards);
    float stretch = 1.0 / max(cosine * cosine, LOD_TINY);
    float square = lod_angle * distance * lod_angle * distance;
    float uu = square * (dot(u, u) + along_u * along_u * stretch);
    float vv = square * (dot(v, v) + along_v * along_v * stretch);
    float uv = square * (dot(u, v) + along_u * along_v * stretch);
    return lod_bias + footprint_level(uu, vv, uv, lod_texels);
}
