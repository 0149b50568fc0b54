// Provides film_coordinate: the place of a fragment's sample on the film, in pixels from the top left corner.
// Expects nothing.

uniform vec2 film_offset;   // from gl_FragCoord.x and height - gl_FragCoord.y to the film coordinate of the sample
uniform float film_height;

vec2 film_coordinate(vec4 fragment) {
    return vec2(fragment.x, film_height - fragment.y) + film_offset;
}
