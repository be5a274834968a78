"use strict";
// A face in WebGL without libraries: maps, recovered SH lighting that can be turned, and a key light.
(function () {
  const canvas = document.getElementById("view3d");
  const note = document.getElementById("view3d-note");
  const data = JSON.parse(document.getElementById("view3d-data").textContent);
  const gl = canvas.getContext("webgl", { antialias: true, preserveDrawingBuffer: true });
  if (!gl) { note.textContent = "This browser shows no WebGL, so there is no 3D view."; canvas.hidden = true; return; }

  const vertexSource = `
    attribute vec3 position; attribute vec2 uv; attribute vec3 normal; attribute vec4 colour;
    uniform mat4 projection, pose;
    varying vec2 vUv; varying vec3 vNormal, vPosition; varying vec4 vColour;
    void main() {
      vUv = uv; vNormal = normal; vColour = colour; vPosition = position;
      gl_Position = projection * pose * vec4(position, 1.0);
    }`;
  const fragmentSource = `
    precision highp float;
    varying vec2 vUv; varying vec3 vNormal, vPosition; varying vec4 vColour;
    uniform sampler2D diffuseMap, specularMap, normalMap;
    uniform mat3 toWorld;         // object -> capture world, where the lighting lives
    uniform mat3 turnBack;        // world -> lighting, undoes the turn of the light
    uniform sampler2D glossyMap;  // lighting blurred by the lobe, lat-long, square roots
    uniform vec3 eye, keyDirection, irradiance[9];
    uniform float lobeAlbedo[6], lobeTilt[6], glossyScale, ambient, exponent;
    uniform int mode, light;
    vec3 expand(vec3 n, vec3 c[9]) {
      float x = n.x, y = n.y, z = n.z;
      return 0.28209479 * c[0]
        - 0.48860251 * (y * c[1] - z * c[2] + x * c[3])
        + 1.09254843 * (x * y * c[4] - y * z * c[5] - x * z * c[7])
        + 0.31539157 * (3.0 * z * z - 1.0) * c[6] + 0.54627422 * (x * x - y * y) * c[8];
    }
    vec3 code(vec3 c) {
      c = clamp(c, 0.0, 1.0);
      return mix(12.92 * c, 1.055 * pow(max(c, vec3(0.0031308)), vec3(1.0 / 2.4)) - 0.055, step(0.0031308, c));
    }
    vec3 decode(vec3 c) { return mix(c / 12.92, pow((c + 0.055) / 1.055, vec3(2.4)), step(0.04045, c)); }
    void main() {
      bool face = vColour.a > 0.5;
      vec3 albedo = face ? decode(texture2D(diffuseMap, vUv).rgb) : decode(vColour.rgb);
      float specular = face ? texture2D(specularMap, vUv).r * float(SPECULAR_SCALE) : 0.0;
      vec3 objectNormal = normalize(face ? texture2D(normalMap, vUv).rgb * 2.0 - 1.0 : vNormal);
      vec3 n = normalize(toWorld * objectNormal);
      vec3 v = normalize(toWorld * (eye - vPosition));
      if (mode == 2) { gl_FragColor = vec4(code(albedo), 1.0); return; }
      if (mode == 3) { gl_FragColor = vec4(vec3(specular / float(SPECULAR_SCALE)), 1.0); return; }
      if (mode == 4) { gl_FragColor = vec4(objectNormal * 0.5 + 0.5, 1.0); return; }
      if (mode == 5) { albedo = vec3(0.5); specular = 0.0; }
      if (mode == 1) specular = 0.0;
      vec3 colour;
      if (light == 0) {
        colour = albedo * max(expand(turnBack * n, irradiance), 0.0) + ambient;
        float mu = clamp(dot(n, v), 0.05, 1.0);
        float reflected = lobeAlbedo[5], tilt = lobeTilt[5];
        for (int k = 4; k >= 0; k--) { reflected = reflected * mu + lobeAlbedo[k]; tilt = tilt * mu + lobeTilt[k]; }
        vec3 d = turnBack * normalize(mix(reflect(-v, n), n, tilt));
        vec2 place = vec2(atan(-d.x, d.z) / 6.28318531 + 0.5, 1.0 - acos(clamp(d.y, -1.0, 1.0)) / 3.14159265);
        vec3 root = texture2D(glossyMap, place).rgb;
        colour += specular * reflected * glossyScale * root * root;
      } else {
        float cosine = max(dot(n, keyDirection), 0.0);
        float highlight = pow(max(dot(n, normalize(keyDirection + v)), 0.0), exponent) * (exponent + 8.0) / 8.0;
        colour = albedo * (2.0 * cosine + 0.12) + 2.0 * specular * highlight * cosine;
      }
      gl_FragColor = vec4(code(colour), 1.0);
    }`.replace(/SPECULAR_SCALE/g, data.specular_scale.toFixed(6));

  function shader(type, source) {
    const s = gl.createShader(type);
    gl.shaderSource(s, source); gl.compileShader(s);
    if (!gl.getShaderParameter(s, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(s));
    return s;
  }
  const program = gl.createProgram();
  gl.attachShader(program, shader(gl.VERTEX_SHADER, vertexSource));
  gl.attachShader(program, shader(gl.FRAGMENT_SHADER, fragmentSource));
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
  gl.useProgram(program);
  const at = name => gl.getUniformLocation(program, name);

  const bytes = text => Uint8Array.from(atob(text), c => c.charCodeAt(0)).buffer;
  function attribute(name, array, size, normalized, type) {
    const buffer = gl.createBuffer(), place = gl.getAttribLocation(program, name);
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer); gl.bufferData(gl.ARRAY_BUFFER, array, gl.STATIC_DRAW);
    if (place < 0) return;
    gl.enableVertexAttribArray(place); gl.vertexAttribPointer(place, size, type, normalized, 0, 0);
  }
  const count = data.vertices;
  const packed = new Int16Array(bytes(data.position)), positions = new Float32Array(count * 3);
  for (let i = 0; i < positions.length; i++) positions[i] = packed[i] / 32767 * data.radius + data.centre[i % 3];
  attribute("position", positions, 3, false, gl.FLOAT);
  const packedUv = new Uint16Array(bytes(data.uv)), uv = new Float32Array(count * 2);
  for (let i = 0; i < uv.length; i++) uv[i] = packedUv[i] / 65535;
  attribute("uv", uv, 2, false, gl.FLOAT);
  const packedNormal = new Int8Array(bytes(data.normal)), normals = new Float32Array(count * 3);
  for (let i = 0; i < normals.length; i++) normals[i] = packedNormal[i] / 127;
  attribute("normal", normals, 3, false, gl.FLOAT);
  attribute("colour", new Uint8Array(bytes(data.colour)), 4, true, gl.UNSIGNED_BYTE);
  const wide = data.index_bits === 32;
  if (wide) gl.getExtension("OES_element_index_uint");
  const index = new (wide ? Uint32Array : Uint16Array)(bytes(data.index));
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, index, gl.STATIC_DRAW);

  function texture(unit, name, source, wraps) {
    gl.uniform1i(at(name), unit);
    const t = gl.createTexture(), image = new Image();
    gl.activeTexture(gl.TEXTURE0 + unit); gl.bindTexture(gl.TEXTURE_2D, t);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB, 1, 1, 0, gl.RGB, gl.UNSIGNED_BYTE, new Uint8Array([128, 128, 128]));
    image.onload = () => {
      gl.activeTexture(gl.TEXTURE0 + unit); gl.bindTexture(gl.TEXTURE_2D, t);
      gl.pixelStorei(gl.UNPACK_FLIP_Y_WEBGL, true);
      gl.pixelStorei(gl.UNPACK_COLORSPACE_CONVERSION_WEBGL, gl.NONE);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB, gl.RGB, gl.UNSIGNED_BYTE, image);
      if (wraps) {  // no mipmaps: the seam at the back would pick the coarsest one
        gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
        gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
      } else {
        gl.generateMipmap(gl.TEXTURE_2D);
        gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_LINEAR);
      }
      draw();
    };
    image.src = source;
  }
  texture(0, "diffuseMap", data.maps.diffuse);
  texture(1, "specularMap", data.maps.specular);
  texture(2, "normalMap", data.maps.normal);
  texture(3, "glossyMap", data.glossy, true);

  gl.uniform3fv(at("irradiance"), data.irradiance);
  gl.uniform1fv(at("lobeAlbedo"), data.lobe_albedo);
  gl.uniform1fv(at("lobeTilt"), data.lobe_tilt);
  gl.uniform1f(at("glossyScale"), data.glossy_scale);
  gl.uniform1f(at("ambient"), data.ambient);
  gl.uniform1f(at("exponent"), data.exponent);
  gl.uniformMatrix3fv(at("toWorld"), false, transpose(data.rotation));
  gl.enable(gl.DEPTH_TEST); gl.enable(gl.CULL_FACE);

  function transpose(m) { return [m[0], m[3], m[6], m[1], m[4], m[7], m[2], m[5], m[8]]; }
  const wanted = new URLSearchParams(location.hash.slice(1));
  const start = name => parseFloat(wanted.get(name)) || 0;
  const state = { yaw: start("yaw"), pitch: start("pitch"), zoom: 1 };
  const control = id => document.getElementById(id);
  for (const [id, key] of [["view3d-turn", "light"], ["view3d-mode", "mode"], ["view3d-light", "source"]])
    if (wanted.has(key)) control(id).value = wanted.get(key);

  function draw() {
    const width = Math.round(canvas.clientWidth * devicePixelRatio);
    const height = Math.round(canvas.clientHeight * devicePixelRatio);
    if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
    gl.viewport(0, 0, width, height);
    gl.clearColor(0.15, 0.16, 0.18, 1); gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const field = 0.42, distance = data.radius * 3.7 / state.zoom;
    const f = 1 / Math.tan(field / 2 * Math.max(1, height / width)), near = distance / 50, far = distance * 4;
    gl.uniformMatrix4fv(at("projection"), false, [
      f * height / width, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) / (near - far), -1, 0, 0, 2 * far * near / (near - far), 0]);
    const cy = Math.cos(state.yaw), sy = Math.sin(state.yaw), cp = Math.cos(state.pitch), sp = Math.sin(state.pitch);
    // Camera axes in object space: the camera circles the head at rest.
    const back = [sy * cp, sp, cy * cp], right = [cy, 0, -sy];
    const up = [back[1] * right[2] - back[2] * right[1], back[2] * right[0] - back[0] * right[2], back[0] * right[1] - back[1] * right[0]];
    const eye = [0, 1, 2].map(i => data.focus[i] + back[i] * distance);
    const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    gl.uniformMatrix4fv(at("pose"), false, [
      right[0], up[0], back[0], 0, right[1], up[1], back[1], 0, right[2], up[2], back[2], 0,
      -dot(right, eye), -dot(up, eye), -dot(back, eye), 1]);
    gl.uniform3fv(at("eye"), eye);
    const turn = parseFloat(control("view3d-turn").value) * Math.PI / 180, c = Math.cos(turn), s = Math.sin(turn);
    gl.uniformMatrix3fv(at("turnBack"), false, [c, 0, s, 0, 1, 0, -s, 0, c]);
    gl.uniform3fv(at("keyDirection"), [Math.sin(turn) * 0.92, 0.39, Math.cos(turn) * 0.92]);
    gl.uniform1i(at("mode"), parseInt(control("view3d-mode").value));
    const light = parseInt(control("view3d-light").value);
    gl.uniform1i(at("light"), light);
    gl.drawElements(gl.TRIANGLES, index.length, wide ? gl.UNSIGNED_INT : gl.UNSIGNED_SHORT, 0);
    canvas.dataset.drawn = "yes";
  }
  const pointers = new Map();
  let spread = 0;
  canvas.addEventListener("pointerdown", e => { canvas.setPointerCapture(e.pointerId); pointers.set(e.pointerId, e); spread = 0; });
  const release = e => { pointers.delete(e.pointerId); spread = 0; };
  canvas.addEventListener("pointerup", release);
  canvas.addEventListener("pointercancel", release);
  canvas.addEventListener("pointermove", e => {
    if (!pointers.has(e.pointerId)) return;
    const last = pointers.get(e.pointerId);
    pointers.set(e.pointerId, e);
    if (pointers.size === 1) {
      state.yaw -= (e.clientX - last.clientX) * 0.008;
      state.pitch = Math.max(-1.3, Math.min(1.3, state.pitch + (e.clientY - last.clientY) * 0.008));
    } else {
      const [a, b] = [...pointers.values()], now = Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY);
      if (spread) zoom(now / spread);
      spread = now;
    }
    draw();
  });
  function zoom(factor) { state.zoom = Math.max(0.5, Math.min(6, state.zoom * factor)); }
  canvas.addEventListener("wheel", e => { e.preventDefault(); zoom(Math.exp(-e.deltaY * 0.001)); draw(); }, { passive: false });
  canvas.addEventListener("keydown", e => {
    const step = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[e.key];
    if (step) { state.yaw += step[0]; state.pitch = Math.max(-1.3, Math.min(1.3, state.pitch + step[1])); e.preventDefault(); draw(); }
  });
  for (const id of ["view3d-turn", "view3d-mode", "view3d-light"]) control(id).addEventListener("input", draw);
  new ResizeObserver(draw).observe(canvas);
  draw();
})();
