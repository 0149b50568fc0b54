// Provides what each pixel sees: the number of the triangle plus 1, and the mesh.
// Expects hosts/mesh.vert.

uniform int mesh;

flat in int triangle;

out vec2 seen;

void main() {
    seen = vec2(float(triangle + 1), float(mesh));
}
