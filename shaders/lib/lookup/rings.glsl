// Provides ring_stencil: neighbours of a direction among samples on rings and inside the first, where that is no pole.
// Expects a table with one texel a ring: polar angle, azimuth of the first sample, samples, index of the first.

#include "lib/lookup/angles.glsl"
#include "lib/lookup/stencil.glsl"
#include "lib/lookup/table.glsl"

// Sample of a ring at or before an azimuth, and the way from there to the next.
void ring_position(vec4 ring, Angle azimuth, out float first, out float fraction) {
    float count = ring.z;
    // Whole samples are split off before the remainder is added: 1e-7 of a step remains, not 1e-7 of a turn.
    float position = azimuth.eighths * count * 0.125 - ring.y * count * INVERSE_TWO_PI;
    float whole = floor(position);
    fraction = (position - whole) + azimuth.rest * count * INVERSE_TWO_PI;
    float carry = floor(fraction);
    fraction -= carry;
    whole += carry;
    // Half a sample away from the integers, the quotient cannot round to the wrong side.
    first = whole - count * floor((whole + 0.5) / count);
}

// Samples and weights on one ring: (first, following), (1 - fraction, fraction).
void ring_neighbours(vec4 ring, Angle azimuth, float share, out ivec2 index, out vec2 weight) {
    float count = ring.z, first, fraction;
    ring_position(ring, azimuth, first, fraction);
    float following = first + 1.0 < count ? first + 1.0 : 0.0;
    index = ivec2(int(ring.w + first), int(ring.w + following));
    weight = share * vec2(1.0 - fraction, fraction);
}

// cos(i) - cos(k) of corners i and k as a product: near the axis, differences of cosines cancel.
float corner_step(float count, float i, float k) {
    return 2.0 * on_circle(0.5 * (i + k) / count).y * on_circle(0.5 * (k - i) / count).y;
}

// Inside a first ring that is no pole; inset is 1 - theta / theta_first. The ring's samples are the corners of a regular
// polygon; a chord of it is blended linearly between the two edges that it meets. See across_the_cap in
// btfref/numerics/sphere/interpolation.py.
Stencil cap_stencil(vec4 ring, Angle azimuth, float inset) {
    float count = ring.z, turn = 6.28318530717958648 / count, radius = 1.0 - inset, first, fraction;
    ring_position(ring, azimuth, first, fraction);
    // The lower side is the mirror image of the upper one.
    bool lower = first + fraction > 0.5 * count;
    first = lower ? count - 1.0 - first : first;
    fraction = lower ? 1.0 - fraction : fraction;
    vec2 place = radius * mix(on_circle(first / count), on_circle((first + 1.0) / count), fraction);
    // The built-in acos of Mesa is off by 1e-4, which would take the wrong corner.
    float x = clamp(place.x, -1.0, 1.0);
    Angle chord = angle_of(sqrt((1.0 - x) * (1.0 + x)), x);
    float position = (chord.eighths * QUARTER_PI_HIGH + chord.rest) / turn;
    float corner = clamp(floor(position), 0.0, max(floor(0.5 * count) - 1.0, 0.0));
    float way = mix(corner_step(count, corner, first), corner_step(count, corner, first + 1.0), fraction);
    vec2 at_corner = on_circle(corner / count);
    way = inset * at_corner.x + radius * way;
    float width = corner_step(count, corner, corner + 1.0);
    float along = width > 0.0 ? clamp(way / width, 0.0, 1.0) : 0.0;
    float height = mix(at_corner.y, on_circle((corner + 1.0) / count).y, along);
    // 1e-30: at a corner on the axis the chord is a point, and any share of it will do.
    float far = clamp(0.5 - 0.5 * place.y / max(height, 1e-30), 0.0, 1.0);
    float below = lower ? 1.0 - far : far;
    // Opposite sample numbers: the chord's lower end lies as far after sample 0 as its upper end lies before it.
    float mirrored = count - 1.0 - corner;
    vec4 at = vec4(corner, corner + 1.0, mirrored, mirrored + 1.0);
    at -= count * floor((at + 0.5) / count);
    float above = 1.0 - below;
    return Stencil(
        ivec4(ring.w + at),
        vec4(above * (1.0 - along), above * along, below * along, below * (1.0 - along)));
}

// Beyond the last ring its samples are held.
Stencil ring_stencil(sampler2DArray rings, int n_rings, vec3 w) {
    Angle polar = angle_of(length(w.xy), w.z);
    Angle azimuth = angle_of(w.y, w.x);
    vec4 low = table_fetch(rings, 0);
    vec4 high = low;
    float above = angle_minus(polar, low.x);
    if (above < 0.0) {
        return cap_stencil(low, azimuth, -above / low.x);
    }
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
