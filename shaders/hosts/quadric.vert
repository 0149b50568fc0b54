// Provides a rectangle of the picture that holds a shape, on the far plane: two triangles, without vertex buffers.
// Expects its left, lower, right and upper side in normalized device coordinates.

uniform vec4 quadric_bounds;

void main() {
    bool right = gl_VertexID == 1 || gl_VertexID == 2 || gl_VertexID == 4;
    bool upper = gl_VertexID == 2 || gl_VertexID == 4 || gl_VertexID == 5;
    gl_Position = vec4(right ? quadric_bounds.z : quadric_bounds.x, upper ? quadric_bounds.w : quadric_bounds.y, 1.0, 1.0);
}
