// Provides the triangle that is nearest to a light: its number plus 1.
// Expects hosts/shadow.vert; the depth is linear, so that its resolution is the same near and far.

flat in int triangle;
in float depth;

out float nearest;

void main() {
    nearest = float(triangle + 1);
    gl_FragDepth = depth;
}
