// Provides a picture, or the difference of two, as a screen shows it: exposure, tone, sRGB, coverage over a background.
// Expects hosts/screen.vert and float pictures whose alpha is coverage.

uniform highp sampler2D picture_a;
uniform highp sampler2D picture_b;
uniform vec2 cell_origin;   // of the viewport, in pixels
uniform vec2 cell_size;
uniform vec2 picture_part;  // of the textures' sides that the picture takes
uniform float weight;       // 1 / samples that are summed
uniform float exposure;     // factor
uniform int tone;           // 0 clipped, 1 Reinhard, 2 filmic
uniform bool difference;
uniform float gain;         // of the difference
uniform vec3 background;    // linear

out vec4 colour;

// IEC 61966-2-1.
vec3 srgb(vec3 linear) {
    vec3 x = clamp(linear, 0.0, 1.0);
    return mix(12.92 * x, 1.055 * pow(max(x, 0.0031308), vec3(1.0 / 2.4)) - 0.055, step(0.0031308, x));
}

vec3 toned(vec3 radiance) {
    vec3 x = max(radiance, 0.0);
    if (tone == 1) {
        // Reinhard et al. 2002, eq. 3, on luminance (Rec. 709).
        return x / (1.0 + dot(x, vec3(0.2126, 0.7152, 0.0722)));
    }
    if (tone == 2) {
        // Narkowicz 2015: a fit of the ACES curve.
        return x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14);
    }
    return x;
}

void main() {
    vec2 at = (gl_FragCoord.xy - cell_origin) / cell_size * picture_part;
    vec4 a = weight * texture(picture_a, at);
    if (difference) {
        vec4 b = weight * texture(picture_b, at);
        // Signed, about the middle grey of the screen.
        vec3 shown = 0.5 + 0.5 * gain * exposure * (a.rgb - b.rgb);
        colour = vec4(mix(srgb(background), clamp(shown, 0.0, 1.0), clamp(max(a.a, b.a), 0.0, 1.0)), 1.0);
        return;
    }
    // What covers a part of a pixel is toned by itself, then blended: radiance of the background is no part of it.
    float coverage = clamp(a.a, 0.0, 1.0);
    vec3 own = coverage > 0.0 ? a.rgb / coverage : vec3(0.0);
    colour = vec4(srgb(mix(background, toned(exposure * own), coverage)), 1.0);
}
