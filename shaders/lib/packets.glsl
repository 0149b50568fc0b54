// Provides packet_sum: the weighted sum of RGB colours that are stored back to back in RGBA texels.
// Expects PACKET_COLOURS, the number of colours of a packet; colour j, channel c is float 3j + c.

#include "lib/table.glsl"

vec3 packet_sum(sampler2DArray table, int first, float coefficient[PACKET_COLOURS]) {
    vec3 sum = vec3(0.0);
    // Four colours fill three texels.
    for (int j = 0; j < PACKET_COLOURS; j += 4) {
        int at = first + 3 * (j >> 2);
        vec4 a = table_fetch(table, at);
        sum += coefficient[j] * a.rgb;
        if (j + 1 < PACKET_COLOURS) {
            vec4 b = table_fetch(table, at + 1);
            sum += coefficient[j + 1] * vec3(a.a, b.rg);
            if (j + 2 < PACKET_COLOURS) {
                vec4 c = table_fetch(table, at + 2);
                sum += coefficient[j + 2] * vec3(b.ba, c.r);
                if (j + 3 < PACKET_COLOURS) {
                    sum += coefficient[j + 3] * c.gba;
                }
            }
        }
    }
    return sum;
}
