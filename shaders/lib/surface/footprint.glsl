// Provides footprint_step and footprint_ratio, the lookups that a host spreads along a pixel's footprint; probe_weight.
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
