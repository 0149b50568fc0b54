// Provides held: a direction raised to the outermost measured cosine, and what lights below it fade by.
// Expects nothing.

// The convention for directions beyond the last ring: views hold it, lights hold it times cos(theta) / cos(theta_last).
vec3 held(vec3 w, float edge, out float fade) {
    fade = 1.0;
    if (w.z >= edge) {
        return w;
    }
    fade = w.z / edge;
    return vec3(w.xy * (sqrt(1.0 - edge * edge) / length(w.xy)), edge);
}
