// Provides shading_frame: rows tangent, bitangent and normal, which take world vectors to local ones; frame_turned.
// Expects nothing.

// As Mitsuba 3.9 (SurfaceInteraction::initialize_sh_frame): s = normalize(dp_du - n (n . dp_du)), t = n x s; but t follows
// the texture where that is mirrored. side: unit normal of the side on which dp/du x dp/dv points.
mat3 shading_frame(vec3 normal, vec3 dp_du, vec3 side) {
    vec3 s = normalize(dp_du - normal * dot(normal, dp_du));
    float hand = dot(side, normal) < 0.0 ? -1.0 : 1.0;
    return transpose(mat3(s, hand * cross(normal, s), normal));
}

// The frame of a transformed texture: y times turn.z, then a rotation about the normal by the angle whose cosine and sine
// are turn.x and turn.y, counter-clockwise.
mat3 frame_turned(mat3 to_local, vec3 turn) {
    vec2 y = turn.z * vec2(-turn.y, turn.x);
    return mat3(turn.x, turn.y, 0.0, y.x, y.y, 0.0, 0.0, 0.0, 1.0) * to_local;
}
