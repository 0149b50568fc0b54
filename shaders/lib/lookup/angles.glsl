// Provides angle_of, the angle of a 2D vector as eighths of a turn plus a small remainder, and its inverse on_circle.
// Expects nothing.

struct Angle {
    float eighths;  // multiple of pi/4 in [0, 8]
    float rest;     // radians, |rest| <= pi/8
};

// pi/4 = QUARTER_PI_HIGH + QUARTER_PI_LOW to 48 bits: differences to a tabulated angle keep float accuracy.
const float QUARTER_PI_HIGH = 0.785398185253143310546875;
const float QUARTER_PI_LOW = -2.18556948040e-8;
const float INVERSE_TWO_PI = 0.159154943091895336;

// atan(x) for |x| <= tan(pi/8). Minimax fit of (atan(x)/x - 1)/x^2 in x^2, relative error below 1e-9, so that
// rounding alone is left (6e-8). The built-in atan of Mesa is only good to 1e-5, which a ring step multiplies.
float atan_small(float x) {
    float z = x * x;
    float p = -0.060823050;
    p = p * z + 0.10595571;
    p = p * z - 0.14243794;
    p = p * z + 0.19998487;
    p = p * z - 0.33333315;
    return x + x * z * p;
}

// Angle from (1, 0) to (x, y), counter-clockwise. (0, 0) has the angle 0.
Angle angle_of(float y, float x) {
    float ax = abs(x), ay = abs(y);
    float small = min(ax, ay), large = max(ax, ay);
    // tan(pi/8): beyond it the remainder is taken from the diagonal, atan(s/l) = pi/4 + atan((s - l)/(s + l)).
    bool diagonal = small > 0.41421357 * large;
    float rest = atan_small(diagonal ? (small - large) / (small + large) : small / max(large, 1e-37));
    float eighths = diagonal ? 1.0 : 0.0;
    if (ay > ax) {
        eighths = 2.0 - eighths;
        rest = -rest;
    }
    if (x < 0.0) {
        eighths = 4.0 - eighths;
        rest = -rest;
    }
    if (y < 0.0) {
        eighths = 8.0 - eighths;
        rest = -rest;
    }
    return Angle(eighths, rest);
}

// a - radians, without the rounding of a large sum.
float angle_minus(Angle a, float radians) {
    return ((a.eighths * QUARTER_PI_HIGH - radians) + a.eighths * QUARTER_PI_LOW) + a.rest;
}

// (cos, sin) of a share of a whole turn, in [-1, 2]. Taylor series over an eighth turn to either side of a quarter: off by
// 3e-8. Built-in sines may be off by 2^-11 (the precision that Vulkan asks for), which a ring multiplies.
vec2 on_circle(float turns) {
    float quarter = floor(4.0 * turns + 0.5);
    float a = 6.28318530717958648 * (turns - 0.25 * quarter), z = a * a;
    float s = a + a * z * (-1.0 / 6.0 + z * (1.0 / 120.0 + z * (-1.0 / 5040.0 + z / 362880.0)));
    float c = 1.0 + z * (-0.5 + z * (1.0 / 24.0 + z * (-1.0 / 720.0 + z / 40320.0)));
    float odd = quarter - 2.0 * floor(0.5 * quarter), half_turns = floor(0.5 * quarter);
    float turned = 1.0 - 2.0 * (half_turns - 2.0 * floor(0.5 * half_turns));
    return turned * mix(vec2(c, s), vec2(-s, c), odd);
}
