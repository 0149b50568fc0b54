// Provides quadric_intersect: the exact point where a camera ray meets a sphere, a disk or a cylinder; quadric_depth.
// Expects what btfref/rendering/gl/quadrics.py writes; film coordinates in pixels from the top left corner.

#include "lib/lookup/angles.glsl"
#include "lib/surface/triangle_table.glsl"

const int QUADRIC_SPHERE = 0, QUADRIC_DISK = 1, QUADRIC_CYLINDER = 2;
const float QUADRIC_TWO_PI = 6.28318530717958648;

uniform int quadric_kind;
// The ray in the canonical frame: the sphere of radius 1, the disk of radius 1 in z = 0, the cylinder of radius 1 from
// z = 0 to 1. Taken there in float64, so that nothing cancels here. Distances along it are depths, as of the camera.
uniform vec3 quadric_origin;
uniform vec3 quadric_corner;
uniform vec3 quadric_right;
uniform vec3 quadric_down;
uniform mat3 quadric_to_world;   // vectors of the canonical frame
uniform vec3 quadric_centre;     // its origin in world space
uniform mat3 quadric_normals;    // inverse transpose: normals of the canonical frame
uniform mat3 quadric_to_own;     // to the shape's own frame, in which u and v are taken
uniform mat3 quadric_own_to_world;
uniform vec2 quadric_sides;      // signs against the outward normal: of the shading normal, of dp/du x dp/dv
uniform vec2 quadric_range;      // nearest and farthest depth that is seen
uniform vec2 quadric_window;     // value of the depth buffer: x + y / depth

bool quadric_seen(float depth) {
    return depth >= quadric_range.x && depth <= quadric_range.y;
}

// Value of the depth buffer at a depth.
float quadric_depth(float depth) {
    return clamp(quadric_window.x + quadric_window.y / depth, 0.0, 1.0);
}

// Where the ray meets the shape first, in the canonical frame, and the depth there; false where it does not.
bool quadric_hit(vec2 film, out vec3 at, out float depth) {
    vec3 ray = quadric_corner + film.x * quadric_right + film.y * quadric_down;
    if (quadric_kind == QUADRIC_DISK) {
        depth = -quadric_origin.z / ray.z;
        at = vec3(quadric_origin.xy + depth * ray.xy, 0.0);
        return quadric_seen(depth) && dot(at, at) <= 1.0;
    }
    bool round = quadric_kind == QUADRIC_SPHERE;
    // A cylinder is a circle, seen along its axis. From the ray's nearest point to the centre half a chord leads to
    // either point of the surface: the difference of two large distances is never taken.
    vec3 across = vec3(ray.xy, round ? ray.z : 0.0), from = vec3(quadric_origin.xy, round ? quadric_origin.z : 0.0);
    float square = dot(across, across), middle = -dot(from, across) / square;
    vec3 nearest = from + middle * across;
    float inside = 1.0 - dot(nearest, nearest);
    if (!(inside >= 0.0)) {
        return false;
    }
    float chord = sqrt(inside / square);
    for (int i = 0; i < 2; ++i) {
        float step = i == 0 ? -chord : chord;
        depth = middle + step;
        at = normalize(nearest + step * across);
        if (!round) {
            at.z = quadric_origin.z + depth * ray.z;
        }
        if (quadric_seen(depth) && (round || (at.z >= 0.0 && at.z <= 1.0))) {
            return true;
        }
    }
    return false;
}

// First tangent of Mitsuba's frame around a unit vector (Duff et al. 2017, listing 3).
vec3 quadric_tangent(vec3 n) {
    float sign = n.z < 0.0 ? -1.0 : 1.0, a = -1.0 / (sign + n.z);
    return vec3(1.0 + sign * n.x * n.x * a, sign * n.x * n.y * a, -sign * n.x);
}

// u and v, and dp/du and dp/dv in the shape's own frame, as sphere.cpp, disk.cpp and cylinder.cpp of Mitsuba 3.9 take
// them: azimuth and polar angle; radius and azimuth; azimuth and height.
vec2 quadric_uv(vec3 at, out vec3 dp_du, out vec3 dp_dv) {
    Angle azimuth = angle_of(at.y, at.x);
    float turns = azimuth.eighths * 0.125 + azimuth.rest * INVERSE_TWO_PI, radius = length(at.xy);
    vec2 outward = radius > 0.0 ? at.xy / radius : vec2(1.0, 0.0);
    vec3 around = QUADRIC_TWO_PI * vec3(-at.y, at.x, 0.0);
    if (quadric_kind == QUADRIC_DISK) {
        dp_du = radius > 0.0 ? vec3(outward, 0.0) : vec3(0.0);
        dp_dv = around;
        return vec2(radius, turns);
    }
    dp_du = around;
    if (quadric_kind == QUADRIC_CYLINDER) {
        dp_dv = vec3(0.0, 0.0, 1.0);
        return vec2(turns, at.z);
    }
    dp_dv = 0.5 * QUADRIC_TWO_PI * vec3(at.z * outward, -radius);
    // From the chord to the nearer pole, which is good to all digits there.
    float sine = 0.5 * length(vec3(at.xy, abs(at.z) - 1.0));
    Angle half_angle = angle_of(sine, sqrt(max(1.0 - sine * sine, 0.0)));
    float polar = 4.0 * (half_angle.eighths * 0.125 + half_angle.rest * INVERSE_TWO_PI);
    return vec2(turns, at.z < 0.0 ? 1.0 - polar : polar);
}

// The point where the ray meets the shape, and the value of the depth buffer there; false where it does not.
bool quadric_intersect(vec2 film, out SurfacePoint s, out float window) {
    vec3 at, dp_du, dp_dv;
    float depth;
    if (!quadric_hit(film, at, depth)) {
        return false;
    }
    window = quadric_depth(depth);
    s.position = quadric_centre + quadric_to_world * at;
    vec3 normal = quadric_kind == QUADRIC_DISK ? vec3(0.0, 0.0, 1.0)
                : quadric_kind == QUADRIC_CYLINDER ? vec3(at.xy, 0.0) : at;
    s.plane_normal = normalize(quadric_normals * normal);
    s.normal = quadric_sides.x * s.plane_normal;
    s.side = quadric_sides.y * s.plane_normal;
    s.uv = quadric_uv(quadric_to_own * at, dp_du, dp_dv);
    dp_du = quadric_own_to_world * dp_du;
    dp_dv = quadric_own_to_world * dp_dv;
    // Rows of the inverse of (dp/du, dp/dv) in the tangent plane; at a pole u has none.
    float e = dot(dp_du, dp_du), f = dot(dp_du, dp_dv), g = dot(dp_dv, dp_dv), area = e * g - f * f;
    float inverse = area > 0.0 ? 1.0 / area : 0.0;
    s.gradient_u = inverse * (g * dp_du - f * dp_dv);
    s.gradient_v = inverse * (e * dp_dv - f * dp_du);
    // At a pole, or the centre of a disk, u runs nowhere: Mitsuba's frame around the normal.
    s.dp_du = e > 0.0 ? dp_du : quadric_tangent(s.normal);
    s.triangle = 0;
    s.barycentric = vec3(0.0);
    return true;
}
