// Provides SplitSum: a sum of vectors in two parts, for terms that cancel.
// Expects nothing.

struct SplitSum {
    vec3 high;  // multiples of 2^-14: below 2^10 they add up without rounding
    vec3 rest;  // at most 2^-15 a term
};

// By floor, because compilers cancel the differences of a compensated sum, and GLSL 3.30 has no "precise". Values of
// B in 1/sr lie below 2^10; where they do not, the sum is as exact as a plain one.
SplitSum split_add(SplitSum s, vec3 term) {
    vec3 high = floor(term * 16384.0 + 0.5) * 6.103515625e-5;
    return SplitSum(s.high + high, s.rest + (term - high));
}
