// Provides footprint_step and footprint_ratio, lookups spread along a pixel's footprint; probe_weight; footprint_level.
// Expects nothing; representations without levels of detail need not look at them.

vec2 footprint_step = vec2(0.0);  // between lookups, in texture coordinates
float footprint_ratio = 1.0;      // of the footprint's length to a step: 1 is a single lookup

// Lookups on each side of the middle.
int probe_count() {
    return int(ceil(0.5 * footprint_ratio - 0.5));
}

// Of the lookup j steps from the middle; all sum to 1, continuously in the ratio.
float probe_weight(int j) {
    return clamp(0.5 * footprint_ratio + 0.5 - abs(float(j)), 0.0, 1.0) / footprint_ratio;
}

const float LOD_TINY = 1e-30;  // squared lengths below this count as this

// The same numbers as btfref/numerics/footprint.py, where they are derived.
const float LOD_ANISOTROPY = 7.0;
const float LOD_BLUR = 5.0;

// Level of detail of an ellipse of texels, and the step; uu, vv, uv: its squared diameters along u and v and their product.
// Lookups at the level of its shorter axis are spread along the longer one (Heckbert 1986). texels: columns, rows.
float footprint_level(float uu, float vv, float uv, vec2 texels) {
    float difference = 0.5 * (uu - vv);
    float longer = max(0.5 * (uu + vv) + sqrt(difference * difference + uv * uv), LOD_TINY);
    float shorter = max(uu * vv - uv * uv, LOD_TINY) / longer;
    footprint_ratio = sqrt(clamp(longer / max(shorter, LOD_TINY), 1.0, LOD_ANISOTROPY * LOD_ANISOTROPY));
    float square = longer / (footprint_ratio * footprint_ratio);
    vec2 axis = uu >= vv ? vec2(longer - vv, uv) : vec2(uv, longer - uu);
    footprint_step = axis * sqrt(square / max(dot(axis, axis), LOD_TINY)) / texels;
    return 0.5 * log2(1.0 + square / LOD_BLUR);
}
