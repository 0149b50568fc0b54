// Provides B of a texel over all lights, or all views, as a disc: polar angle along the radius, azimuth 0 to the right.
// Expects hosts/screen.vert and a representation.

#include "representation"

uniform vec2 plot_uv;
uniform float plot_lod;
uniform vec3 plot_fixed;    // the other direction, local frame
uniform bool plot_lights;   // what varies: lights or views
uniform vec2 plot_size;     // pixels

out vec4 plotted;

const float PLOT_HALF_PI = 1.57079632679489662;

void main() {
    vec2 at = 2.0 * gl_FragCoord.xy / plot_size - 1.0;
    float radius = length(at);
    if (radius >= 1.0) {
        plotted = vec4(0.0);
        return;
    }
    float polar = PLOT_HALF_PI * radius;
    vec3 w = vec3(radius > 0.0 ? at * (sin(polar) / radius) : vec2(0.0), cos(polar));
    vec3 w_light = plot_lights ? w : plot_fixed, w_view = plot_lights ? plot_fixed : w;
    plotted = vec4(btf_eval(plot_uv, w_light, w_view, plot_lod), 1.0);
}
