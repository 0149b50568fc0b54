// BTF port packages in plain WebGL 2: textures, programs, and lookups point by point. Part of btfref, BSD-3-Clause.
// A port is layout.json with the shader's text in layout.shader.text, and the bytes of its textures.
"use strict";
const BtfPort = (() => {
  const fail = (text) => { throw new Error(text); };

  // A WebGL 2 context of a canvas; extensions that are named must be there.
  function connect(canvas, extensions = [], attributes = {}) {
    const gl = canvas.getContext("webgl2", { antialias: false, alpha: false, ...attributes });
    if (!gl) fail("no WebGL 2 in this browser");
    for (const name of extensions) {
      if (!gl.getExtension(name)) fail(`WebGL 2 lacks the extension ${name}`);
    }
    return gl;
  }

  function renderer(gl) {
    const more = gl.getExtension("WEBGL_debug_renderer_info");
    return gl.getParameter(more ? more.UNMASKED_RENDERER_WEBGL : gl.RENDERER);
  }

  // Whatever went wrong since the last call.
  function check(gl, what) {
    if (gl.isContextLost()) fail(`${what}: the device was lost`);
    const error = gl.getError();
    if (error !== gl.NO_ERROR) fail(`${what}: WebGL error 0x${error.toString(16)}`);
  }

  function decode(base64) {
    if (Uint8Array.fromBase64) return Uint8Array.fromBase64(base64);
    const text = atob(base64), bytes = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i += 1) bytes[i] = text.charCodeAt(i);
    return bytes;
  }

  function encode(array) {
    const bytes = new Uint8Array(array.buffer, array.byteOffset, array.byteLength), parts = [];
    for (let i = 0; i < bytes.length; i += 32768) parts.push(String.fromCharCode(...bytes.subarray(i, i + 32768)));
    return btoa(parts.join(""));
  }

  const ARRAYS = { FLOAT: Float32Array, HALF_FLOAT: Uint16Array, UNSIGNED_INT: Uint32Array, UNSIGNED_BYTE: Uint8Array };

  function texture(gl, entry, bytes) {
    if (bytes.byteLength !== entry.bytes) fail(`${entry.name}: ${bytes.byteLength} bytes, not ${entry.bytes}`);
    const most = [gl.getParameter(gl.MAX_TEXTURE_SIZE), gl.getParameter(gl.MAX_ARRAY_TEXTURE_LAYERS)];
    if (Math.max(entry.width, entry.height) > most[0] || entry.layers > most[1]) {
      fail(`${entry.name}: ${entry.width} × ${entry.height} × ${entry.layers} texels; this device has ${most.join("² × ")}`);
    }
    const made = gl.createTexture(), target = gl[entry.target];
    gl.bindTexture(target, made);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    gl.pixelStorei(gl.UNPACK_FLIP_Y_WEBGL, false);
    gl.texStorage3D(target, 1, gl[entry.internal_format], entry.width, entry.height, entry.layers);
    const data = new ARRAYS[entry.type](bytes.buffer, bytes.byteOffset, bytes.byteLength / ARRAYS[entry.type].BYTES_PER_ELEMENT);
    gl.texSubImage3D(target, 0, 0, 0, 0, entry.width, entry.height, entry.layers, gl[entry.format], gl[entry.type], data);
    for (const side of ["TEXTURE_MIN_FILTER", "TEXTURE_MAG_FILTER"]) gl.texParameteri(target, gl[side], gl[entry.filter]);
    for (const side of ["TEXTURE_WRAP_S", "TEXTURE_WRAP_T"]) gl.texParameteri(target, gl[side], gl[entry.wrap]);
    check(gl, entry.name);
    return made;
  }

  function program(gl, vertex, fragment) {
    const made = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost()) {
        fail(`the shader does not compile: ${gl.getShaderInfoLog(shader)}`);
      }
      gl.attachShader(made, shader);
    }
    gl.linkProgram(made);
    if (!gl.getProgramParameter(made, gl.LINK_STATUS) && !gl.isContextLost()) {
      fail(`the program does not link: ${gl.getProgramInfoLog(made)}`);
    }
    check(gl, "program");
    return made;
  }

  // The port on the device; bytesOf(entry) gives the bytes of a texture.
  function open(gl, layout, bytesOf = (entry) => decode(entry.base64)) {
    const textures = {};
    for (const entry of layout.textures) textures[entry.name] = [gl[entry.target], texture(gl, entry, bytesOf(entry))];
    return { layout, textures };
  }

  function close(gl, port) {
    for (const [, made] of Object.values(port.textures)) gl.deleteTexture(made);
  }

  // Units for the textures of a port, from `first` on; the program must be in use. Returns the next free unit.
  function bind(gl, made, port, first = 0) {
    let unit = first;
    for (const [name, [target, one]] of Object.entries(port.textures)) {
      const place = gl.getUniformLocation(made, name);
      if (place === null) continue;  // the compiler found no use for it
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(target, one);
      gl.uniform1i(place, unit);
      unit += 1;
    }
    return unit;
  }

  const source = (layout, main) => `${layout.shader.versions["300 es"]}\n${layout.shader.text}${main}`;

  // One triangle over everything.
  const COVER = `#version 300 es
    void main() { gl_Position = vec4(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0, 0.0, 1.0); }`;

  // Values leave as their bits, in integers: that needs no extension and rounds nothing. What is drawn bears a mark.
  const WIDTH = 1024, MARK = 0x5ab10000;
  const PROBE = `
    uniform highp sampler2D btf_points;
    out uvec4 btf_found;
    void main() {
        ivec2 at = ivec2(gl_FragCoord.xy) * ivec2(3, 1);
        vec4 a = texelFetch(btf_points, at, 0), b = texelFetch(btf_points, at + ivec2(1, 0), 0);
        vec4 c = texelFetch(btf_points, at + ivec2(2, 0), 0);
        vec3 w_light = vec3(a.zw, b.x), w_view = b.yzw;
        vec2 bad = malformed(a.xy, w_light, w_view);
        btf_found = uvec4(floatBitsToUint(btf_eval(a.xy, w_light, w_view, c.x)), ${MARK}u + uint(bad.x + 2.0 * bad.y));
    }`;

  // Lookups to be evaluated: rows u, v, light x y z, view x y z, level of detail.
  function prepare(gl, port, rows) {
    const n = rows.length / 9, width = Math.min(n, WIDTH), height = Math.ceil(n / width);
    const laid = new Float32Array(width * height * 12);
    for (let i = 0; i < n; i += 1) laid.set(rows.subarray(9 * i, 9 * i + 9), 12 * i);
    const points = gl.createTexture();
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, points);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA32F, 3 * width, height);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, 3 * width, height, gl.RGBA, gl.FLOAT, laid);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    const target = gl.createTexture(), frame = gl.createFramebuffer();
    gl.bindTexture(gl.TEXTURE_2D, target);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA32UI, width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, target, 0);
    if (gl.checkFramebufferStatus(gl.FRAMEBUFFER) !== gl.FRAMEBUFFER_COMPLETE && !gl.isContextLost()) {
      fail("integers cannot be drawn to");
    }
    const made = program(gl, COVER, source(port.layout, PROBE));
    check(gl, "lookups");
    return { gl, port, n, width, height, points, target, frame, made };
  }

  function run(lookups) {
    const { gl } = lookups;
    gl.bindFramebuffer(gl.FRAMEBUFFER, lookups.frame);
    gl.viewport(0, 0, lookups.width, lookups.height);
    gl.disable(gl.BLEND);
    gl.disable(gl.DEPTH_TEST);
    gl.clearBufferuiv(gl.COLOR, 0, new Uint32Array(4));
    gl.useProgram(lookups.made);
    const unit = bind(gl, lookups.made, lookups.port);
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, lookups.points);
    gl.uniform1i(gl.getUniformLocation(lookups.made, "btf_points"), unit);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    // A pixel that is read is waited for.
    gl.readPixels(0, 0, 1, 1, gl.RGBA_INTEGER, gl.UNSIGNED_INT, new Uint32Array(4));
    check(gl, "lookups");
  }

  // { values: Float32Array (n × 3), malformed: [directions, coordinates] }
  function read(lookups) {
    const { gl, n, width, height } = lookups, bits = new Uint32Array(4 * width * height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, lookups.frame);
    gl.readPixels(0, 0, width, height, gl.RGBA_INTEGER, gl.UNSIGNED_INT, bits);
    check(gl, "lookups");
    const values = new Uint32Array(3 * n), malformed = [0, 0];
    for (let i = 0; i < n; i += 1) {
      const flags = (bits[4 * i + 3] - MARK) >>> 0;
      if (flags > 3) fail(`lookups: a blank frame (lookup ${i} was not drawn)`);
      malformed[0] += flags & 1;
      malformed[1] += flags >> 1;
      values.set(bits.subarray(4 * i, 4 * i + 3), 3 * i);
    }
    return { values: new Float32Array(values.buffer), malformed };
  }

  function release(lookups) {
    const { gl } = lookups;
    gl.deleteTexture(lookups.points);
    gl.deleteTexture(lookups.target);
    gl.deleteFramebuffer(lookups.frame);
    gl.deleteProgram(lookups.made);
  }

  return { connect, renderer, check, decode, encode, texture, program, open, close, bind, source, prepare, run, read, release, COVER };
})();
