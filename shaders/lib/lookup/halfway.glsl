// Provides half_vector and difference_vector of a pair of directions.
// Expects nothing.

vec3 half_vector(vec3 w_light, vec3 w_view) {
    vec3 h = w_light + w_view;
    // Mirrored to the last bit: the squares would underflow.
    h *= max(max(abs(h.x), abs(h.y)), abs(h.z)) < 1e-15 ? 1e20 : 1.0;
    float square = dot(h, h);
    // Opposite directions on the horizon have no half vector; any will do there.
    return square > 0.0 ? h / sqrt(square) : vec3(0.0, 0.0, 1.0);
}

// The light in the frame that is turned on the shortest way from the normal to h: smooth on the whole hemisphere, where
// the Gram-Schmidt frame of Kautz and McCool 1999 is singular at the tangent.
vec3 difference_vector(vec3 w_light, vec3 h) {
    float a = 1.0 / (1.0 + h.z);
    vec3 tangent = vec3(1.0 - h.x * h.x * a, -h.x * h.y * a, -h.x);
    vec3 bitangent = vec3(-h.x * h.y * a, 1.0 - h.y * h.y * a, -h.y);
    return vec3(dot(w_light, tangent), dot(w_light, bitangent), dot(w_light, h));
}
