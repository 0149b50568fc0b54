// Provides one triangle that covers the picture: pixels are shaded once each, whatever the size of the scene's triangles.
// Expects a depth test "greater", which lets it through wherever a surface is: it lies on the far plane.

void main() {
    gl_Position = vec4(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0, 1.0, 1.0);
}
