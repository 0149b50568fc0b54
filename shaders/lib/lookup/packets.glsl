// Provides packet_sum: the weighted sum of RGB colours that are stored back to back in RGBA texels.
// Expects PACKET_COLOURS, the number of colours of a packet; colour j, channel c is float 3j + c.

#include "lib/lookup/table.glsl"

// Colours 4g to 4g + 3 of a packet; those beyond its end are not fetched and not meant to be used.
struct PacketGroup {
    vec3 colour[4];
};

PacketGroup packet_group(sampler2DArray table, int first, int g) {
    // Four colours fill three texels.
    int at = first + 3 * g, left = PACKET_COLOURS - 4 * g;
    vec4 a = table_fetch(table, at), b = vec4(0.0), c = vec4(0.0);
    if (left > 1) {
        b = table_fetch(table, at + 1);
    }
    if (left > 2) {
        c = table_fetch(table, at + 2);
    }
    return PacketGroup(vec3[4](a.rgb, vec3(a.a, b.rg), vec3(b.ba, c.r), c.gba));
}

vec3 packet_sum(sampler2DArray table, int first, float coefficient[PACKET_COLOURS]) {
    vec3 sum = vec3(0.0);
    for (int j = 0; j < PACKET_COLOURS; j += 4) {
        PacketGroup group = packet_group(table, first, j >> 2);
        for (int k = 0; k < min(4, PACKET_COLOURS - j); ++k) {
            sum += coefficient[j + k] * group.colour[k];
        }
    }
    return sum;
}

// The same with coefficients in two parts, high + low, for sums whose terms cancel: there, the rounding of each product
// would show. A high part of 12 bits times a half (11 bits) is exact in the 24 bits of a float.
vec3 packet_sum(sampler2DArray table, int first, vec2 coefficient[PACKET_COLOURS]) {
    vec3 sum = vec3(0.0), rest = vec3(0.0);
    for (int j = 0; j < PACKET_COLOURS; j += 4) {
        PacketGroup group = packet_group(table, first, j >> 2);
        for (int k = 0; k < min(4, PACKET_COLOURS - j); ++k) {
            sum += coefficient[j + k].x * group.colour[k];
            rest += coefficient[j + k].y * group.colour[k];
        }
    }
    return sum + rest;
}
