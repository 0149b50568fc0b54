// Provides black where a surface is: the pass that fills the depth buffer before others add up.
// Expects nothing.

out vec4 radiance;

void main() {
    radiance = vec4(0.0);
}
