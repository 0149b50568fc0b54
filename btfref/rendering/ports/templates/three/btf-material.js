// The port package as a material of three.js: const material = await loadBtf(THREE, "..");
// Geometries need the attributes uv, normal and tangent (geometry.computeTangents()).

const MAIN = `
in vec3 seen_position, seen_normal, seen_tangent;
in float seen_hand;
in vec2 seen_uv;
uniform vec3 cameraPosition;
uniform vec3 light_direction;   // towards the light, in world space, of unit length
uniform vec3 light_irradiance;  // perpendicular to it
uniform float exposure;
out vec4 pixel;

void main() {
    vec3 normal = normalize(seen_normal);
    mat3 to_local = shading_frame(normal, seen_tangent, seen_hand * normal);
    vec3 w_view = to_local * normalize(cameraPosition - seen_position);
    float lod = btf_lod(dFdx(seen_uv), dFdy(seen_uv));
    // B holds the light's cosine already.
    vec3 radiance = light_irradiance * btf_eval(seen_uv, to_local * light_direction, w_view, lod);
    vec3 linear = clamp(exposure * radiance, 0.0, 1.0);
    pixel = vec4(mix(1.055 * pow(linear, vec3(1.0 / 2.4)) - 0.055, 12.92 * linear, lessThan(linear, vec3(0.0031308))), 1.0);
}`;

const VERTEX = `
in vec3 position, normal;
in vec4 tangent;
in vec2 uv;
uniform mat4 modelMatrix, viewMatrix, projectionMatrix;
uniform vec2 repeat;
out vec3 seen_position, seen_normal, seen_tangent;
out float seen_hand;
out vec2 seen_uv;

void main() {
    vec4 world = modelMatrix * vec4(position, 1.0);
    seen_position = world.xyz;
    seen_normal = transpose(inverse(mat3(modelMatrix))) * normal;
    seen_tangent = mat3(modelMatrix) * tangent.xyz;
    seen_hand = tangent.w;
    seen_uv = repeat * uv;
    gl_Position = projectionMatrix * viewMatrix * world;
}`;

const ARRAYS = { FLOAT: Float32Array, HALF_FLOAT: Uint16Array, UNSIGNED_INT: Uint32Array, UNSIGNED_BYTE: Uint8Array };

function texture(THREE, entry, buffer) {
  const made = new THREE.DataArrayTexture(new ARRAYS[entry.type](buffer), entry.width, entry.height, entry.layers);
  made.format = entry.format === "RGBA_INTEGER" ? THREE.RGBAIntegerFormat : THREE.RGBAFormat;
  made.type = { FLOAT: THREE.FloatType, HALF_FLOAT: THREE.HalfFloatType,
    UNSIGNED_INT: THREE.UnsignedIntType, UNSIGNED_BYTE: THREE.UnsignedByteType }[entry.type];
  made.internalFormat = entry.internal_format;
  made.minFilter = made.magFilter = THREE.NearestFilter;
  made.generateMipmaps = false;
  made.unpackAlignment = 1;
  made.needsUpdate = true;
  return made;
}

export async function loadBtf(THREE, folder) {
  const get = async (name) => {
    const answer = await fetch(`${folder}/${name}`);
    if (!answer.ok) throw new Error(`${name}: ${answer.status}`);
    return answer;
  };
  const layout = await (await get("layout.json")).json();
  const text = await (await get(layout.shader.file)).text();
  const uniforms = {
    light_direction: { value: new THREE.Vector3(0, 0, 1) },
    light_irradiance: { value: new THREE.Vector3(Math.PI, Math.PI, Math.PI) },
    exposure: { value: 1 },
    repeat: { value: new THREE.Vector2(1, 1) },
  };
  for (const entry of layout.textures) {
    uniforms[entry.name] = { value: texture(THREE, entry, await (await get(entry.file)).arrayBuffer()) };
  }
  return new THREE.RawShaderMaterial({
    glslVersion: THREE.GLSL3, uniforms, vertexShader: VERTEX, fragmentShader: text + MAIN,
  });
}
