// Provides malformed: whether a lookup asks for what is none, for hosts that count; its value is defined all the same.
// Expects nothing.

// By its bits: compilers may turn a comparison with NaN around.
bool is_finite(float x) {
    return (floatBitsToUint(x) & 0x7f800000u) != 0x7f800000u;
}

// x: a direction that is not finite or far from unit length (its value is 0); y: a coordinate that is not finite (it
// counts as 0). Directions below the horizon are ordinary.
vec2 malformed(vec2 uv, vec3 w_light, vec3 w_view) {
    float light = dot(w_light, w_light), view = dot(w_view, w_view);
    bool off = !is_finite(light) || !is_finite(view) || min(light, view) <= 0.25 || max(light, view) >= 4.0;
    return vec2(off ? 1.0 : 0.0, is_finite(uv.x) && is_finite(uv.y) ? 0.0 : 1.0);
}
