// Provides a picture as it is, for sums of pictures by blending.
// Expects hosts/screen.vert and targets of the picture's size.

uniform highp sampler2D picture_a;

out vec4 added;

void main() {
    added = texelFetch(picture_a, ivec2(gl_FragCoord.xy), 0);
}
