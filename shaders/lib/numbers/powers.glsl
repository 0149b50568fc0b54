// Provides safe_power, lobe_power and unit_lobe: powers of cosines that saturate at 2^15 and never overflow.
// Expects nothing.

// The same numbers as btfref/numerics/powers.py.
const float POWER_FLOOR = 5.9604644775390625e-8;  // 2^-24: bases below count as zero
const float POWER_LOWEST = -126.0;                // exponents of two below give zero
const float POWER_LIMIT = 15.0;                   // largest exponent of two

// log2(1 + f) for 1/sqrt(2) <= 1 + f <= sqrt(2), to 2e-7 of itself: 2 log2(e) atanh(f / (2 + f)), the series up to the
// ninth power. The built-in log2 of Mesa is only good to 1e-5 or so, which an exponent multiplies.
float log2_near_one(float f) {
    float s = f / (2.0 + f);
    float z = s * s;
    float p = 0.111111111;
    p = p * z + 0.142857143;
    p = p * z + 0.2;
    p = p * z + 0.333333333;
    p = p * z + 1.0;
    return 2.88539008 * s * p;
}

// log2 of a positive, normal number: exponent bits, and the logarithm of a mantissa in [1/sqrt(2), sqrt(2)).
float log2_accurate(float x) {
    int bits = floatBitsToInt(x);
    // 0x3f3504f3 is 1/sqrt(2): the shift rounds the exponent so that the mantissa starts there.
    int exponent = (bits - 0x3f3504f3) >> 23;
    float mantissa = intBitsToFloat(bits - exponent * 8388608);
    return float(exponent) + log2_near_one(mantissa - 1.0);
}

// 2^e for POWER_LOWEST <= e <= POWER_LIMIT, to 1e-7: a whole power by its bits, the rest by the series up to e^7.
float exp2_accurate(float e) {
    float whole = floor(e + 0.5);
    float f = e - whole;
    float p = 1.52527338e-5;
    p = p * f + 1.54035304e-4;
    p = p * f + 1.33335581e-3;
    p = p * f + 9.61812911e-3;
    p = p * f + 5.55041087e-2;
    p = p * f + 2.40226507e-1;
    p = p * f + 6.93147181e-1;
    p = p * f + 1.0;
    return p * intBitsToFloat((int(whole) + 127) << 23);
}

// A product that is infinite is as good as any other beyond the limits.
float power_from_log(float log_base, float exponent) {
    float product = clamp(log_base * exponent, POWER_LOWEST, POWER_LIMIT);
    return product > POWER_LOWEST ? exp2_accurate(product) : 0.0;
}

// base^exponent.
float safe_power(float base, float exponent) {
    return base >= POWER_FLOOR ? power_from_log(log2_accurate(base), exponent) : 0.0;
}

// (t . l)^n for t of any length (Meseth, Mueller, Klein 2004, eq. 1).
float lobe_power(vec3 t, vec3 l, float n) {
    float scale = max(abs(t.x), max(abs(t.y), abs(t.z)));
    if (!(scale >= POWER_FLOOR)) {
        return 0.0;
    }
    float cosine = dot(t / scale, l);
    return cosine >= POWER_FLOOR ? power_from_log(log2_accurate(scale) + log2_accurate(cosine), n) : 0.0;
}

// (axis . l)^n of unit vectors, from the square of their distance: near the axis the product would lose the digits that
// a large exponent multiplies.
float unit_lobe(vec3 axis, vec3 l, float n) {
    vec3 d = axis - l;
    float h = 0.5 * dot(d, d);
    float cosine = 1.0 - h;
    if (!(cosine >= POWER_FLOOR)) {
        return 0.0;
    }
    // 0.29 < 1 - 1/sqrt(2), the range of the series.
    return power_from_log(h < 0.29 ? log2_near_one(-h) : log2_accurate(cosine), n);
}
