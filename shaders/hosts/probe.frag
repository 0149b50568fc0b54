// Provides the fragment stage that OpenGL ES demands beside hosts/probe.vert; rasterization is off while probing.
// Expects nothing.

out vec4 colour;

void main() {
    colour = vec4(0.0);
}
