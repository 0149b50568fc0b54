// Provides light_incident: direction towards light i and the irradiance that it brings, perpendicular to the direction.
// Expects N_LIGHTS and scene_lights [light, 3, 4], as btfref/rendering/gl/raster.py writes it: position and kind, power and
// the angle at which a spot ends, axis and the inverse of the angle over which it falls.

#include "lib/lookup/table.glsl"

#if N_LIGHTS > 0
uniform sampler2DArray scene_lights;
uniform int light_first;  // light of this pass, and the one after its last
uniform int light_end;

// As btfref/scene/emitters/lights.py numbers them.
const int LIGHT_DIRECTIONAL = 0, LIGHT_SPOT = 2, LIGHT_AREA = 3;

vec3 light_incident(int i, vec3 point, out vec3 towards) {
    vec4 position = table_read(scene_lights, 3 * i), power = table_read(scene_lights, 3 * i + 1);
    vec4 axis = table_read(scene_lights, 3 * i + 2);
    int kind = int(position.w);
    if (kind == LIGHT_DIRECTIONAL) {
        towards = position.xyz;
        return power.rgb;
    }
    vec3 offset = position.xyz - point;
    float square = dot(offset, offset);
    towards = offset * inversesqrt(square);
    float share = 1.0;
    if (kind == LIGHT_SPOT) {
        // Mitsuba 3.9, src/emitters/spot.cpp: linear in the angle, whose arc cosine would lose digits near the axis.
        float angle = atan(length(cross(towards, axis.xyz)), -dot(towards, axis.xyz));
        share = clamp((power.w - angle) * axis.w, 0.0, 1.0);
    } else if (kind == LIGHT_AREA) {
        share = max(-dot(towards, axis.xyz), 0.0);
    }
    return power.rgb * (share / square);
}
#endif
