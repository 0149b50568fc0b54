// Provides field_view_hit and field_lit: rays through a periodic height field of bilinear patches, as exact roots.
// Expects cells [row, column, 4] (corner heights), TOP, BOTTOM, TANGENT_LIMIT, LIFT and MAXIMUM_STEPS.

// Conventions are those of btfref/numerics/heightfield.py. A ray through uv at z = 0 is at uv + z w.xy / w.z; heights
// stand at texel centres. Parallax occlusion mapping (Tatarchuk 2006) with the search replaced by the patch's quadratic.
#include "lib/lookup/table.glsl"
#include "lib/lookup/texels.glsl"

uniform sampler2DArray cells;

// Stands for "never": far beyond every ray parameter, which is at most 1.
const float FIELD_NEVER = 1e30;
const float FIELD_DEPTH = float(TOP) - float(BOTTOM);

struct FieldHit {
    ivec2 cell;   // column and row
    vec2 local;   // in [0, 1]^2
    float height; // tile units
};

struct FieldMarch {
    float s;      // parameter of the hit, FIELD_NEVER without one
    vec2 crossed; // cells crossed before it
};

vec2 field_tangent(vec3 w) {
    return w.xy / max(w.z, length(w.xy) * (1.0 / float(TANGENT_LIMIT)));
}

ivec2 field_wrapped(vec2 cell) {
    vec2 size = vec2(float(CELLS_DIM1), float(CELLS_DIM0));
    return ivec2(cell - size * floor((cell + 0.5) / size));
}

// Height at a position of a patch; slope receives the coefficients of x, y and xy.
float field_patch(ivec2 cell, vec2 at, out vec3 slope) {
    vec4 h = table_fetch(cells, cell.y * CELLS_DIM1 + cell.x);
    slope = vec3(h.y - h.x, h.z - h.x, 0.0);
    slope.z = (h.w - h.y) - slope.y;
    return h.x + slope.x * at.x + (slope.y + slope.z * at.x) * at.y;
}

// Smallest q >= 0 with f0 + f1 q + f2 q^2 <= 0, without cancellation.
float field_root(float f0, float f1, float f2) {
    if (f0 <= 0.0) {
        return 0.0;
    }
    float disc = f1 * f1 - 4.0 * f2 * f0;
    float root = sqrt(max(disc, 0.0));
    float numerator = f1 <= 0.0 ? 2.0 * f0 : f1 + root;
    float denominator = f1 <= 0.0 ? root - f1 : -2.0 * f2;
    return disc >= 0.0 && denominator > 0.0 ? numerator / denominator : FIELD_NEVER;
}

// A shadow ray (lift >= 0) starts on the surface: its first distance is the lift itself. View rays have lift < 0.
FieldMarch field_march(ivec2 cell, vec2 start, vec2 travel, float z0, float dz, float lift) {
    FieldMarch result = FieldMarch(FIELD_NEVER, vec2(0.0));
    bvec2 moving = notEqual(travel, vec2(0.0));
    vec2 inverse = vec2(moving.x ? 1.0 / travel.x : 0.0, moving.y ? 1.0 / travel.y : 0.0);
    vec2 forward = vec2(greaterThan(travel, vec2(0.0)));
    float s = 0.0;
    for (int n = 0; n < MAXIMUM_STEPS; ++n) {
        vec2 local = clamp(start - result.crossed + s * travel, 0.0, 1.0);
        vec3 slope;
        float height = field_patch(field_wrapped(vec2(cell) + result.crossed), local, slope);
        float f0 = z0 + s * dz - height;
        if (lift >= 0.0) {
            f0 = n == 0 ? lift : f0 + lift;
        }
        float f1 = dz - (slope.x + slope.z * local.y) * travel.x - (slope.y + slope.z * local.x) * travel.y;
        vec2 border = (result.crossed + forward - start) * inverse;
        border = vec2(moving.x ? border.x : FIELD_NEVER, moving.y ? border.y : FIELD_NEVER);
        float leave = max(min(min(border.x, border.y), 1.0), s);
        float q = field_root(f0, f1, -slope.z * travel.x * travel.y);
        if (q <= leave - s) {
            result.s = s + q;
            break;
        }
        if (leave >= 1.0) {
            break;
        }
        if (border.x <= border.y) {
            result.crossed.x += travel.x > 0.0 ? 1.0 : -1.0;
        } else {
            result.crossed.y += travel.y > 0.0 ? 1.0 : -1.0;
        }
        s = leave;
    }
    return result;
}

FieldHit field_view_hit(vec2 uv, vec3 w) {
    vec2 size = vec2(float(CELLS_DIM1), float(CELLS_DIM0));
    vec2 tangent = field_tangent(w);
    vec2 corner, start;
    texel_corner(uv, CELLS_DIM0, CELLS_DIM1, corner, start);
    start += tangent * size * float(TOP);
    vec2 whole = floor(start);
    start -= whole;
    FieldHit hit;
    hit.cell = field_wrapped(corner + whole);
    vec2 travel = tangent * size * -FIELD_DEPTH;
    FieldMarch march = field_march(hit.cell, start, travel, float(TOP), -FIELD_DEPTH, -1.0);
    hit.local = clamp(start - march.crossed + min(march.s, 1.0) * travel, 0.0, 1.0);
    hit.cell = field_wrapped(vec2(hit.cell) + march.crossed);
    vec3 unused;
    hit.height = field_patch(hit.cell, hit.local, unused);
    return hit;
}

bool field_lit(FieldHit hit, vec3 w) {
    float rise = float(TOP) - hit.height;
    if (rise <= float(LIFT)) {
        return true;
    }
    vec2 travel = field_tangent(w) * vec2(float(CELLS_DIM1), float(CELLS_DIM0)) * rise;
    return field_march(hit.cell, hit.local, travel, hit.height, rise, float(LIFT)).s > 1.0;
}
