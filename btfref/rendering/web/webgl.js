// The calls of btfref's renderer in WebGL 2: lists of commands, and objects by number. See btfref/rendering/web/context.py.
"use strict";
const BtfGl = (() => {
  const FORMATS = {
    "f4 1": ["R32F", "RED", "FLOAT", Float32Array], "f4 2": ["RG32F", "RG", "FLOAT", Float32Array],
    "f4 4": ["RGBA32F", "RGBA", "FLOAT", Float32Array], "f2 4": ["RGBA16F", "RGBA", "HALF_FLOAT", Uint16Array],
    "u4 4": ["RGBA32UI", "RGBA_INTEGER", "UNSIGNED_INT", Uint32Array], "f1 4": ["RGBA8", "RGBA", "UNSIGNED_BYTE", Uint8Array],
  };
  const COMPARE = { "<": "LESS", "<=": "LEQUAL", ">": "GREATER" };
  // Type of a uniform → what sets it.
  const SET = {
    FLOAT: "uniform1fv", FLOAT_VEC2: "uniform2fv", FLOAT_VEC3: "uniform3fv", FLOAT_VEC4: "uniform4fv", FLOAT_MAT3: "uniformMatrix3fv",
    FLOAT_MAT4: "uniformMatrix4fv", INT_VEC2: "uniform2iv", INT_VEC3: "uniform3iv", INT_VEC4: "uniform4iv",
  };

  // What is given: the bytes of textures to come, by their numbers.
  function renderer(gl, given) {
    const things = new Map();
    const of = (id) => things.get(id);
    const setters = Object.fromEntries(Object.entries(SET).map(([type, name]) => [gl[type], name]));

    const calls = {
      texture(id, target, size, components, dtype, filled) {
        const [internal, format, type, Kind] = FORMATS[`${dtype} ${components}`], made = gl.createTexture(), where = gl[target];
        gl.activeTexture(gl.TEXTURE0);
        gl.bindTexture(where, made);
        gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
        const flat = target === "TEXTURE_2D";
        if (flat) gl.texStorage2D(where, 1, gl[internal], ...size);
        else gl.texStorage3D(where, 1, gl[internal], ...size);
        if (filled) {
          const values = new Kind(given.get(id).buffer);
          given.delete(id);
          if (flat) gl.texSubImage2D(where, 0, 0, 0, ...size, gl[format], gl[type], values);
          else gl.texSubImage3D(where, 0, 0, 0, 0, ...size, gl[format], gl[type], values);
        }
        for (const side of ["TEXTURE_MIN_FILTER", "TEXTURE_MAG_FILTER"]) gl.texParameteri(where, gl[side], gl.NEAREST);
        things.set(id, { kind: "Texture", made, where });
      },
      depth(id, size) {
        const made = gl.createRenderbuffer();
        gl.bindRenderbuffer(gl.RENDERBUFFER, made);
        gl.renderbufferStorage(gl.RENDERBUFFER, gl.DEPTH_COMPONENT24, ...size);
        things.set(id, { kind: "Renderbuffer", made });
      },
      framebuffer(id, colour, depth) {
        const made = gl.createFramebuffer();
        gl.bindFramebuffer(gl.FRAMEBUFFER, made);
        gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, of(colour).made, 0);
        gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.RENDERBUFFER, of(depth).made);
        if (gl.checkFramebufferStatus(gl.FRAMEBUFFER) !== gl.FRAMEBUFFER_COMPLETE && !gl.isContextLost()) {
          throw new Error("floats cannot be drawn to");
        }
        things.set(id, { kind: "Framebuffer", made });
      },
      program(id, vertex, fragment) {
        const made = BtfPort.program(gl, vertex, fragment), uniforms = {};
        for (let i = 0; i < gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS); i += 1) {
          const { name, type } = gl.getActiveUniform(made, i);
          uniforms[name.replace("[0]", "")] = [gl.getUniformLocation(made, name), setters[type] || "uniform1iv"];
        }
        things.set(id, { kind: "Program", made, uniforms });
        return Object.keys(uniforms);
      },
      uniform(id, name, values) {
        const { made, uniforms } = of(id), [place, set] = uniforms[name];
        gl.useProgram(made);
        if (set.startsWith("uniformMatrix")) gl[set](place, false, values);
        else gl[set](place, values);
      },
      bind(id, unit) {
        gl.activeTexture(gl.TEXTURE0 + unit);
        gl.bindTexture(of(id).where, of(id).made);
      },
      use(id, viewport) {
        gl.bindFramebuffer(gl.FRAMEBUFFER, of(id).made);
        gl.viewport(...viewport);
      },
      clear(colour) {
        gl.depthMask(true);
        gl.clearColor(...colour);
        gl.clearDepth(1);
        gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
      },
      state(names, on) { for (const name of names) gl[on ? "enable" : "disable"](gl[name]); },
      depth_func(sign) { gl.depthFunc(gl[COMPARE[sign]]); },
      depth_mask(on) { gl.depthMask(on); },
      add() { gl.blendFunc(gl.ONE, gl.ONE); },
      draw(id, first, count) {
        gl.useProgram(of(id).made);
        gl.drawArrays(gl.TRIANGLES, first, count);
      },
      read(id, width, height) {
        const pixels = new Float32Array(4 * width * height);
        gl.bindFramebuffer(gl.FRAMEBUFFER, of(id).made);
        gl.readPixels(0, 0, width, height, gl.RGBA, gl.FLOAT, pixels);
        return BtfPort.encode(pixels);
      },
      release(id) {
        const thing = of(id);
        gl[`delete${thing.kind}`](thing.made);
        things.delete(id);
      },
    };

    // What the last command gives.
    return (commands) => {
      let found = null;
      for (const [name, ...rest] of commands) found = calls[name](...rest) ?? null;
      BtfPort.check(gl, commands.length ? commands[commands.length - 1][0] : "nothing");
      return found;
    };
  }
  return { renderer };
})();
