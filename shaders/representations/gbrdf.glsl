// Provides btf_eval of g-BRDFs: a height field with self-shadowing and a few microfacet materials.
// Expects cells, surface (slopes, cosine and sine of the tangent's turn), colour (c_d, r0), gloss (material, c_s), ndf.

// Menzel and Guthe 2009, eq. 1 and 2, times the light's cosine:
// B = c_d/pi (k1.n) + c_s p(h) F(k1.h) k1.n / (k1.n + k2.n - (k1.n)(k2.n)), F(u) = r0 + (1 - r0)(1 - u)^5.
#include "lib/lookup/directions.glsl"
#include "lib/lookup/halfway.glsl"
#include "lib/surface/heightfield.glsl"
#include "lib/lookup/parabolic_maps.glsl"

uniform sampler2DArray surface;
uniform sampler2DArray colour;
uniform sampler2DArray gloss;
uniform sampler2DArray ndf;

// Texels that a point blends; the nearest filter takes the maps' nearest texel, heights stay bilinear.
Stencil surface_stencil(FieldHit hit) {
    ivec2 next = hit.cell + 1;
    next = ivec2(next.x == CELLS_DIM1 ? 0 : next.x, next.y == CELLS_DIM0 ? 0 : next.y);
    float a = hit.local.x, b = hit.local.y;
#if FILTER_BILINEAR
    ivec2 row = ivec2(hit.cell.y, next.y) * CELLS_DIM1;
    return Stencil(
        ivec4(row.x + hit.cell.x, row.x + next.x, row.y + hit.cell.x, row.y + next.x),
        vec4((1.0 - a) * (1.0 - b), a * (1.0 - b), (1.0 - a) * b, a * b));
#else
    int nearest = (b < 0.5 ? hit.cell.y : next.y) * CELLS_DIM1 + (a < 0.5 ? hit.cell.x : next.x);
    return Stencil(ivec4(nearest, 0, 0, 0), vec4(1.0, 0.0, 0.0, 0.0));
#endif
}

// Rows tangent, bitangent, normal: the tangent is x in the tangent plane, turned about the normal.
mat3 surface_frame(vec4 s) {
    vec3 normal = normalize(vec3(-s.xy, 1.0));
    // (1 - nx^2, -nx ny, -nx nz) up to its length, with the cancellation taken out.
    vec3 u = normalize(vec3(1.0 + s.y * s.y, -s.x * s.y, s.x));
    vec3 v = cross(normal, u);
    // Below 0.01 tangents of all directions meet, and rounding would make a turn up.
    float size = length(s.zw);
    vec2 turn = size > 0.01 ? s.zw / size : vec2(1.0, 0.0);
    return transpose(mat3(turn.x * u + turn.y * v, turn.x * v - turn.y * u, normal));
}

vec3 btf_eval(vec2 uv, vec3 w_light, vec3 w_view, float lod) {
    if (!directions_valid(w_light, w_view)) {
        return vec3(0.0);
    }
    FieldHit hit = field_view_hit(uv, w_view);
    Stencil texels = surface_stencil(hit);
    vec4 s = vec4(0.0);
    for (int x = 0; x < 4; ++x) {
        s += texels.weight[x] * table_fetch(surface, texels.index[x]);
    }
    mat3 frame = surface_frame(s);
    float light = (frame * w_light).z;
    if (light <= 0.0 || !field_lit(hit, w_light)) {
        return vec3(0.0);
    }
    float view = max((frame * w_view).z, 0.0);
    vec3 h = half_vector(w_light, w_view);
    vec3 facet = frame * h;
    // The denominator is at least k1.n > 0; microfacets behind the surface reflect nothing.
    float factor = facet.z > 0.0 ? light / (light + view * (1.0 - light)) : 0.0;
    float grazing = 1.0 - clamp(dot(w_light, h), 0.0, 1.0);
    float fifth = grazing * grazing * grazing * grazing * grazing;
    Stencil half_stencil = parabolic_stencil(facet, NDF_DIM1);
    vec3 diffuse = vec3(0.0), specular = vec3(0.0);
    for (int x = 0; x < 4; ++x) {
        if (texels.weight[x] == 0.0) {
            continue;
        }
        vec4 own = table_fetch(colour, texels.index[x]);
        vec2 kind = table_fetch(gloss, texels.index[x]).xy;
        diffuse += texels.weight[x] * own.rgb;
        float share = texels.weight[x] * kind.y * (own.a + (1.0 - own.a) * fifth);
        specular += share * parabolic_lookup(ndf, int(kind.x), NDF_DIM1, half_stencil, 1);
    }
    // 0.318... = 1/pi
    return light * 0.3183098861837907 * diffuse + factor * specular;
}
