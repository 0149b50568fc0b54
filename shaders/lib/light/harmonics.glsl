// Provides harmonic_rotated: the coefficients of an environment in a local frame.
// Expects HARMONIC_ORDER, environment_harmonics [order^2, 3] and harmonic_turn [order^2, 2 order - 1].

#include "lib/lookup/table.glsl"

#define HARMONICS (HARMONIC_ORDER * HARMONIC_ORDER)

uniform sampler2DArray environment_harmonics;
uniform sampler2DArray harmonic_turn;  // quarter turn about x: row i of its band's block

// On the unit circle whatever the matrix rounds to.
vec2 harmonic_unit(float cosine, float sine) {
    float square = cosine * cosine + sine * sine;
    return square > 0.0 ? vec2(cosine, sine) * inversesqrt(square) : vec2(1.0, 0.0);
}

// Coefficients of L(Rz(angle) w): pairs of cosines and sines of m phi turn by m times the angle.
void harmonic_about_z(inout vec3 a[HARMONICS], vec2 angle) {
    vec2 turn = angle;
    for (int m = 1; m < HARMONIC_ORDER; ++m) {
        for (int l = m; l < HARMONIC_ORDER; ++l) {
            int plus = l * (l + 1) + m, minus = l * (l + 1) - m;
            vec3 p = a[plus], q = a[minus];
            a[plus] = turn.x * p + turn.y * q;
            a[minus] = turn.x * q - turn.y * p;
        }
        turn = vec2(turn.x * angle.x - turn.y * angle.y, turn.y * angle.x + turn.x * angle.y);
    }
}

float harmonic_turn_entry(int i, int j) {
    return table_fetch(harmonic_turn, i * HARMONIC_TURN_STRIDE + (j >> 2))[j & 3];
}

// Times the quarter turn about x (Green 2003), or, transposed, back.
void harmonic_about_x(inout vec3 a[HARMONICS], bool transposed) {
    vec3 before[2 * HARMONIC_ORDER - 1];
    for (int l = 1; l < HARMONIC_ORDER; ++l) {
        int first = l * l, size = 2 * l + 1;
        for (int j = 0; j < size; ++j) {
            before[j] = a[first + j];
        }
        for (int i = 0; i < size; ++i) {
            vec3 sum = vec3(0.0);
            for (int j = 0; j < size; ++j) {
                float entry = transposed ? harmonic_turn_entry(first + j, i) : harmonic_turn_entry(first + i, j);
                sum += entry * before[j];
            }
            a[first + i] = sum;
        }
    }
}

// R = Rz(alpha) Ry(beta) Rz(gamma), a rotation about y being one about z between quarter turns; columns of to_world are
// the local axes, mirrored where the back or a mirrored texture is seen. As btfref/numerics/sphere/harmonics.py.
void harmonic_rotated(mat3 to_world, out vec3 a[HARMONICS]) {
    for (int i = 0; i < HARMONICS; ++i) {
        a[i] = table_fetch(environment_harmonics, i).rgb;
    }
    bool mirrored = determinant(to_world) < 0.0;
    vec3 axis = mirrored ? -to_world[2] : to_world[2];
    vec2 alpha = harmonic_unit(axis.x, axis.y);
    vec2 beta = harmonic_unit(axis.z, length(axis.xy));
    vec3 s = to_world[0], t = to_world[1];
    // The y row of Rz(-alpha) R is that of Rz(gamma): as good at the poles as elsewhere.
    vec2 gamma = harmonic_unit(alpha.x * t.y - alpha.y * t.x, alpha.x * s.y - alpha.y * s.x);
    harmonic_about_z(a, alpha);
    harmonic_about_x(a, true);
    harmonic_about_z(a, beta);
    harmonic_about_x(a, false);
    harmonic_about_z(a, gamma);
    if (mirrored) {
        for (int l = 0; l < HARMONIC_ORDER; ++l) {
            for (int m = -l; m <= l; ++m) {
                if (((l + m) & 1) == 1) {
                    a[l * (l + 1) + m] = -a[l * (l + 1) + m];
                }
            }
        }
    }
}
