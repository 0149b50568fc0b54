// WebGL 2: programs, tables as array textures of 4096 RGBA texels a row, targets of floats.
const TABLE_WIDTH = 4096; // as shaders/lib/lookup/table.glsl

class Device {
  constructor(canvas) {
    const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, depth: false, powerPreference: "high-performance" });
    if (!gl) throw new NoWebGL();
    this.gl = gl;
    const full = gl.getExtension("EXT_color_buffer_float");
    const half = full ?? gl.getExtension("EXT_color_buffer_half_float");
    // What radiance is kept in: a picture as it is, and the sums and previews, which are filtered and blended.
    this.exact = full ? gl.RGBA32F : half ? gl.RGBA16F : gl.RGBA8;
    this.rough = half ? gl.RGBA16F : gl.RGBA8;
    this.floats = Boolean(half);
    const named = gl.getExtension("WEBGL_debug_renderer_info");
    this.name = named ? gl.getParameter(named.UNMASKED_RENDERER_WEBGL) : gl.getParameter(gl.RENDERER);
    gl.bindVertexArray(gl.createVertexArray()); // vertices come from their numbers
  }

  program(vertex, fragment) {
    const gl = this.gl, program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
      gl.deleteShader(shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
      const logs = gl.getAttachedShaders(program).map((shader) => gl.getShaderInfoLog(shader));
      throw new Error(`this browser does not compile the shader: ${[...logs, gl.getProgramInfoLog(program)].join(" ").trim()}`);
    }
    const uniforms = {};
    for (let i = 0; i < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); i++) {
      const { name, type } = gl.getActiveUniform(program, i);
      uniforms[name.replace("[0]", "")] = { type, at: gl.getUniformLocation(program, name) };
    }
    return { program, uniforms };
  }

  // Values by name: numbers, arrays, and textures in a unit each. What the compiler has dropped is skipped.
  use({ program, uniforms }, values) {
    const gl = this.gl;
    gl.useProgram(program);
    let unit = 0;
    for (const [name, { type, at }] of Object.entries(uniforms)) {
      const value = values[name];
      if (value === undefined) continue;
      if (value.texture) {
        gl.activeTexture(gl.TEXTURE0 + unit);
        gl.bindTexture(value.target, value.texture);
        gl.uniform1i(at, unit++);
      } else if (type === gl.FLOAT) gl.uniform1f(at, value);
      else if (type === gl.FLOAT_VEC2) gl.uniform2fv(at, value);
      else if (type === gl.FLOAT_VEC3) gl.uniform3fv(at, value);
      else if (type === gl.FLOAT_MAT4) gl.uniformMatrix4fv(at, false, value);
      else gl.uniform1i(at, value);
    }
  }

  table(values, type) {
    const gl = this.gl;
    const [internal, format, kind] = {
      float16: [gl.RGBA16F, gl.RGBA, gl.HALF_FLOAT],
      float32: [gl.RGBA32F, gl.RGBA, gl.FLOAT],
      uint32: [gl.RGBA32UI, gl.RGBA_INTEGER, gl.UNSIGNED_INT],
      uint8: [gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE],
    }[type];
    const texels = values.length / 4, width = Math.min(texels, TABLE_WIDTH), rows = Math.ceil(texels / width);
    const height = Math.min(rows, TABLE_WIDTH), layers = Math.ceil(rows / TABLE_WIDTH);
    let padded = values;
    if (texels < width * height * layers) {
      padded = new values.constructor(width * height * layers * 4);
      padded.set(values);
    }
    const texture = gl.createTexture(), target = gl.TEXTURE_2D_ARRAY;
    gl.bindTexture(target, texture);
    gl.texImage3D(target, 0, internal, width, height, layers, 0, format, kind, padded);
    gl.texParameteri(target, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(target, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    const error = gl.getError();
    if (error === gl.OUT_OF_MEMORY || error === gl.INVALID_VALUE)
      throw new Error(`The graphics device has no room for a table of ${Math.ceil(padded.byteLength / 2 ** 20)} MiB.`);
    return { texture, target };
  }

  target(width, height, internal, { depth = true, filtered = false } = {}) {
    const gl = this.gl, texture = gl.createTexture(), frame = gl.createFramebuffer();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, internal, width, height);
    for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, side, filtered ? gl.LINEAR : gl.NEAREST);
    for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, side, gl.CLAMP_TO_EDGE);
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
    let buffer = null;
    if (depth) {
      buffer = gl.createRenderbuffer();
      gl.bindRenderbuffer(gl.RENDERBUFFER, buffer);
      gl.renderbufferStorage(gl.RENDERBUFFER, gl.DEPTH_COMPONENT24, width, height);
      gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.RENDERBUFFER, buffer);
    }
    const release = () => {
      gl.deleteFramebuffer(frame);
      gl.deleteTexture(texture);
      gl.deleteRenderbuffer(buffer);
    };
    return { texture, target: gl.TEXTURE_2D, frame, width, height, internal, release };
  }

  // A pixel of the bound target; waits for all that was drawn.
  pixel(x, y) {
    return this.pixels(x, y, 1, 1);
  }

  pixels(x, y, width, height) {
    const gl = this.gl, bytes = !this.floats, found = new (bytes ? Uint8Array : Float32Array)(4 * width * height);
    gl.readPixels(x, y, width, height, gl.RGBA, bytes ? gl.UNSIGNED_BYTE : gl.FLOAT, found);
    return bytes ? Float32Array.from(found, (value) => value / 255) : found;
  }
}

class NoWebGL extends Error {
  constructor() {
    super("This browser gives the page no WebGL 2. Use a current browser, with hardware acceleration switched on in its settings.");
  }
}
