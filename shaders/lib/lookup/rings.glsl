// Provides ring_stencil: neighbours of a direction among samples on rings, linear in azimuth and in polar angle.
// Expects a table with one texel a ring: polar angle, azimuth of the first sample, samples, index of the first.

#include "lib/lookup/angles.glsl"
#include "lib/lookup/stencil.glsl"
#include "lib/lookup/table.glsl"

// Samples and weights on one ring: (first, following), (1 - fraction, fraction).
void ring_neighbours(vec4 ring, Angle azimuth, float share, out ivec2 index, out vec2 weight) {
    float count = ring.z;
    // Whole samples are split off before the remainder is added: 1e-7 of a step remains, not 1e-7 of a turn.
    float position = azimuth.eighths * count * 0.125 - ring.y * count * INVERSE_TWO_PI;
    float whole = floor(position);
    float fraction = (position - whole) + azimuth.rest * count * INVERSE_TWO_PI;
    float carry = floor(fraction);
    fraction -= carry;
    whole += carry;
    // Half a sample away from the integers, the quotient cannot round to the wrong side.
    float first = whole - count * floor((whole + 0.5) / count);
    float following = first + 1.0 < count ? first + 1.0 : 0.0;
    index = ivec2(int(ring.w + first), int(ring.w + following));
    weight = share * vec2(1.0 - fraction, fraction);
}

// Beyond the last ring its samples are held.
Stencil ring_stencil(sampler2DArray rings, int n_rings, vec3 w) {
    Angle polar = angle_of(length(w.xy), w.z);
    Angle azimuth = angle_of(w.y, w.x);
    vec4 low = table_fetch(rings, 0);
    vec4 high = low;
    float above = angle_minus(polar, low.x);
    float t = 0.0;
    for (int i = 1; i < n_rings; ++i) {
        high = table_fetch(rings, i);
        float excess = angle_minus(polar, high.x);
        t = above / (high.x - low.x);
        if (excess < 0.0) {
            break;
        }
        low = high;
        above = excess;
        t = 0.0;
    }
    t = clamp(t, 0.0, 1.0);
    ivec2 index_low, index_high;
    vec2 weight_low, weight_high;
    ring_neighbours(low, azimuth, 1.0 - t, index_low, weight_low);
    ring_neighbours(high, azimuth, t, index_high, weight_high);
    return Stencil(ivec4(index_low, index_high), vec4(weight_low, weight_high));
}

// cos(theta) / cos(theta_last) beyond the last ring, else 1; cos_last is the z of any sample of that ring.
float ring_fade(sampler2DArray rings, int n_rings, vec3 w, float cos_last) {
    float last = table_fetch(rings, n_rings - 1).x;
    bool beyond = angle_minus(angle_of(length(w.xy), w.z), last) > 0.0;
    // 1e-6: a ring at the horizon itself has nothing beyond it.
    return beyond && cos_last > 1e-6 ? max(w.z, 0.0) / cos_last : 1.0;
}
