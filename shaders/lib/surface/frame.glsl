// Provides shading_frame: rows tangent, bitangent and normal, which take world vectors to local ones; frame_turned.
// Expects nothing.

// As Mitsuba 3.9 (SurfaceInteraction::initialize_sh_frame): s = normalize(dp_du - n (n . dp_du)), t = n x s.
mat3 shading_frame(vec3 normal, vec3 dp_du) {
    vec3 s = normalize(dp_du - normal * dot(normal, dp_du));
    return transpose(mat3(s, cross(normal, s), normal));
}

// The frame followed by a rotation about the normal by the angle of the given cosine and sine, counter-clockwise.
mat3 frame_turned(mat3 to_local, vec2 rotation) {
    mat3 turn = mat3(rotation.x, rotation.y, 0.0, -rotation.y, rotation.x, 0.0, 0.0, 0.0, 1.0);
    return turn * to_local;
}
