// Provides shading_frame: rows tangent, bitangent and normal, which take world vectors to the local frame.
// Expects nothing.

// As Mitsuba 3.9 (SurfaceInteraction::initialize_sh_frame): s = normalize(dp_du - n (n . dp_du)), t = n x s.
mat3 shading_frame(vec3 normal, vec3 dp_du) {
    vec3 s = normalize(dp_du - normal * dot(normal, dp_du));
    return transpose(mat3(s, cross(normal, s), normal));
}
