// Provides triangle_stencil: barycentric neighbours of a direction on a spherical Delaunay triangulation.
// Expects triangles of six texels (btfref.numerics.sphere.interpolation.TriangleInterpolation) and a map of start cells.

#include "lib/lookup/stencil.glsl"
#include "lib/lookup/table.glsl"

const int TRIANGLE_TEXELS = 6;

struct Triangle {
    vec3 a, b;              // two vertices
    vec3 n_a, n_b, n_c;     // dual normals: barycentric coordinates are their products with w
    vec3 index;             // samples; the third is negative beyond the outermost samples
    vec3 across;            // neighbours opposite a, b and c
};

Triangle triangle_fetch(sampler2DArray triangles, int i) {
    int at = i * TRIANGLE_TEXELS;
    vec4 t0 = table_fetch(triangles, at), t1 = table_fetch(triangles, at + 1), t2 = table_fetch(triangles, at + 2);
    vec4 t3 = table_fetch(triangles, at + 3), t4 = table_fetch(triangles, at + 4), t5 = table_fetch(triangles, at + 5);
    return Triangle(
        t0.xyz, vec3(t0.w, t1.xy), vec3(t1.zw, t2.x), t2.yzw, t3.xyz, vec3(t3.w, t4.xy), vec3(t4.zw, t5.x));
}

// Differences to a vertex come first: each dual normal is orthogonal to it, so nothing cancels next to a sample.
vec3 triangle_barycentric(Triangle t, vec3 w) {
    return vec3(dot(t.n_a, w - t.b), dot(t.n_b, w - t.a), dot(t.n_c, w - t.a));
}

// Weights times fade: views hold the outermost samples, lights (fade_beyond) fall to zero at the horizon as cos(theta).
Stencil triangle_stencil(
    sampler2DArray triangles, int n_triangles, sampler2DArray cells, int n_cells, vec3 w, bool fade_beyond) {
    // Parabolic map of the hemisphere (Heidrich and Seidel 1998): (s, t) = (x, y) / (1 + z).
    vec2 square = w.xy / (1.0 + w.z);
    ivec2 cell = clamp(ivec2((square + 1.0) * (0.5 * float(n_cells))), ivec2(0), ivec2(n_cells - 1));
    int flat_cell = cell.y * n_cells + cell.x;
    int current = int(table_fetch(cells, flat_cell >> 2)[flat_cell & 3]);
    Triangle t = triangle_fetch(triangles, current);
    vec3 weight = triangle_barycentric(t, w);
    for (int i = 0; i < n_triangles; ++i) {
        float worst = min(weight.x, min(weight.y, weight.z));
        // -1e-7: rounding of a coordinate on an edge, where both sides agree anyway; without it the walk might not end.
        if (worst >= -1e-7) {
            break;
        }
        current = int(worst == weight.x ? t.across.x : worst == weight.y ? t.across.y : t.across.z);
        t = triangle_fetch(triangles, current);
        weight = triangle_barycentric(t, w);
    }
    weight = max(weight, 0.0);
    bool beyond = t.index.z < 0.0;
    if (beyond) {
        weight.z = 0.0;
    }
    weight /= weight.x + weight.y + weight.z;
    if (beyond && fade_beyond) {
        float cos_edge = normalize(weight.x * t.a + weight.y * t.b).z;
        // 1e-6: samples at the horizon itself have nothing beyond them.
        weight *= min(max(w.z, 0.0) / max(cos_edge, 1e-6), 1.0);
    }
    return Stencil(ivec4(ivec3(max(t.index, 0.0)), 0), vec4(weight, 0.0));
}
