// Provides parabolic_axis: the direction of parabolic coordinates, and parabolic_coordinates, its inverse.
// Expects nothing.

// Heidrich and Seidel 1998: (s, t) = (x, y) / (1 + z). The hemisphere fills the unit disc, the sphere the plane.
vec3 parabolic_axis(vec2 st) {
    float square = dot(st, st);
    return vec3(2.0 * st, 1.0 - square) / (1.0 + square);
}

vec2 parabolic_coordinates(vec3 w) {
    return w.xy / (1.0 + w.z);
}
