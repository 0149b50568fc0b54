// Provides light_incident: direction towards light i and the irradiance that it brings, perpendicular to the direction.
// Expects N_LIGHTS; light_position.w is 0 for directional lights (xyz towards the light) and 1 for points.

#if N_LIGHTS > 0
uniform vec4 light_position[N_LIGHTS];
uniform vec3 light_power[N_LIGHTS];  // irradiance in W/m^2, or radiant intensity in W/sr

vec3 light_incident(int i, vec3 point, out vec3 towards) {
    vec4 position = light_position[i];
    if (position.w == 0.0) {
        towards = position.xyz;
        return light_power[i];
    }
    vec3 offset = position.xyz - point;
    float square = dot(offset, offset);
    towards = offset * inversesqrt(square);
    return light_power[i] / square;
}
#endif
