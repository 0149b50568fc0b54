// Provides btf_eval for hosts that are not ours, btf_lod from derivatives, shading_frame and the count of malformed lookups.
// Expects a representation, LEVEL_0_COLUMNS and LEVEL_0_ROWS; no stage of its own: the host's main() comes after it.

#include "lib/surface/frame.glsl"
#include "lib/surface/footprint.glsl"
#include "lib/lookup/malformed.glsl"
#include "representation"
#include "environment"

// Level of detail of a pixel, from dFdx(uv) and dFdy(uv); sets the step along its footprint, which the next btf_eval
// follows. Without a call of it btf_eval makes a single lookup, at the lod that it is given.
float btf_lod(vec2 uv_dx, vec2 uv_dy) {
    vec2 texels = vec2(float(LEVEL_0_COLUMNS), float(LEVEL_0_ROWS));
    vec2 u = texels.x * vec2(uv_dx.x, uv_dy.x), v = texels.y * vec2(uv_dx.y, uv_dy.y);
    return footprint_level(dot(u, u), dot(v, v), dot(u, v), texels);
}
