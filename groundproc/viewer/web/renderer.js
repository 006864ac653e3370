// Points by WebGL 2: coloured in the vertex shader, shaded by the depths around them (eye-dome lighting, Boucheny 2009).
const VERTEX = `#version 300 es
  in vec3 place; in float value; in vec3 paint;
  uniform mat4 view; uniform int mode; uniform vec2 span; uniform sampler2D palette;
  uniform vec4 slab, ends; uniform vec3 centre; uniform float grains[8], perDepth, least, most;
  out vec3 tint;
  void main() {
    gl_Position = view * vec4(place, 1.);
    ivec3 side = ivec3(greaterThanEqual(place, centre));
    gl_PointSize = clamp(grains[side.x + 2 * side.y + 4 * side.z] * (perDepth > 0. ? perDepth / gl_Position.w : -perDepth), least, most);
    vec4 colour = vec4(paint, 1.);
    if (mode == 0) { float t = clamp((place.z - span.x) / (span.y - span.x), 0., 1.); colour = texelFetch(palette, ivec2(int(t * 255. + .5), 0), 0); }
    else if (mode == 1) {
      float t = clamp((value - span.x) / (span.y - span.x), 0., 1.);
      colour = value > 254.5 ? vec4(.43, .45, .49, 1.) : texelFetch(palette, ivec2(int(t * 255. + .5), 0), 0);
    } else if (mode == 2) colour = texelFetch(palette, ivec2(int(value + .5), 0), 0);
    bool out_of_slab = slab.w > 0. && (abs(dot(slab.xy, place.xy) - slab.z) > slab.w || abs(dot(ends.xy, place.xy) - ends.z) > ends.w);
    if (colour.a < .5 || out_of_slab) gl_Position = vec4(2., 2., 2., 1.);
    tint = colour.rgb;
  }`;
const FRAGMENT = `#version 300 es
  precision mediump float; in vec3 tint; out vec4 made;
  void main() { if (length(gl_PointCoord - .5) > .5) discard; made = vec4(tint, 1.); }`;
const SCREEN = `#version 300 es
  void main() { gl_Position = vec4(gl_VertexID == 1 ? 3. : -1., gl_VertexID == 2 ? 3. : -1., 0., 1.); }`;
const DOME = `#version 300 es
  precision highp float; precision highp sampler2D;
  uniform sampler2D colours, depths; uniform float near, far, strength, unit; uniform bool ortho; uniform int reach; uniform vec3 above, below; uniform vec2 size;
  out vec4 made;
  float distance_of(float d) {
    return ortho ? 1.4427 * (near + d * (far - near)) / unit : log2(2. * near * far / (far + near - (2. * d - 1.) * (far - near)));
  }
  void main() {
    ivec2 at = ivec2(gl_FragCoord.xy);
    float d = texelFetch(depths, at, 0).r;
    if (d >= 1.) { made = vec4(mix(below, above, gl_FragCoord.y / size.y), 1.); return; }
    float own = distance_of(d), sum = 0.;
    for (int i = 0; i < 8; i++) {
      float turn = float(i) * .785398;
      ivec2 next = clamp(at + ivec2(round(vec2(cos(turn), sin(turn)) * float(reach))), ivec2(0), ivec2(size) - 1);
      float other = texelFetch(depths, next, 0).r;
      if (other < 1.) sum += max(0., own - distance_of(other));
    }
    made = vec4(texelFetch(colours, at, 0).rgb * max(exp(-sum / 8. * strength), .12), 1.);
  }`;
class Renderer {
  constructor(canvas) {
    const gl = canvas.getContext("webgl2", {antialias: false, alpha: false, preserveDrawingBuffer: true, powerPreference: "high-performance"});
    if (!gl) throw new Error("this browser shows no WebGL 2, which the cloud needs; the rest of the page does without");
    this.canvas = canvas; this.gl = gl; this.chunks = new Map(); this.theme = {above: [0, 0, 0], below: [0, 0, 0]};
    this.points = this.program(VERTEX, FRAGMENT); this.dome = this.program(SCREEN, DOME);
    this.palette = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, this.palette);
    for (const name of ["TEXTURE_MIN_FILTER", "TEXTURE_MAG_FILTER"]) gl.texParameteri(gl.TEXTURE_2D, gl[name], gl.NEAREST);
    this.empty = gl.createVertexArray();
    this.target = null;
  }
  program(vertex, fragment) {
    const gl = this.gl, made = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text); gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(made, shader);
    }
    ["place", "value", "paint"].forEach((name, i) => gl.bindAttribLocation(made, i, name));
    gl.linkProgram(made);
    if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
    const places = {};
    return {made, at: name => name in places ? places[name] : places[name] = gl.getUniformLocation(made, name)};
  }
  // A chunk: places (Float32Array, from the scene's origin), bytes by attribute. Its points may be drawn with a width of their own in each
  // eighth around its centre: grains, in metres, by x + 2 y + 4 z.
  put(id, places, bytes, centre = [0, 0, 0]) {
    const gl = this.gl, chunk = {id, places, bytes, centre, grains: null, count: places.length / 3, shown: true, array: gl.createVertexArray(), buffers: {}, colour: null};
    gl.bindVertexArray(chunk.array);
    chunk.buffers.place = this.buffer(0, places, 3, gl.FLOAT, false);
    gl.bindVertexArray(null);
    this.chunks.set(id, chunk);
    return chunk;
  }
  buffer(at, data, width, kind, scaled) {
    const gl = this.gl, made = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, made); gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(at); gl.vertexAttribPointer(at, width, kind, scaled, 0, 0);
    return made;
  }
  drop(id) {
    const chunk = this.chunks.get(id), gl = this.gl;
    if (!chunk) return;
    for (const made of Object.values(chunk.buffers)) gl.deleteBuffer(made);
    gl.deleteVertexArray(chunk.array); this.chunks.delete(id);
  }
  // Bytes of a chunk were changed: they are handed over anew with the next frame.
  changed(chunk) { chunk.colour = null; }
  colour(chunk, name) {
    if (chunk.colour === name) return;
    const gl = this.gl;
    gl.bindVertexArray(chunk.array);
    for (const old of ["value", "paint"]) { gl.deleteBuffer(chunk.buffers[old] || null); delete chunk.buffers[old]; }
    gl.disableVertexAttribArray(1); gl.disableVertexAttribArray(2);
    if (name === "rgb") {
      const paint = new Uint8Array(3 * chunk.count);
      ["red", "green", "blue"].forEach((each, c) => { for (let i = 0; i < chunk.count; i++) paint[3 * i + c] = chunk.bytes[each][i]; });
      chunk.buffers.paint = this.buffer(2, paint, 3, gl.UNSIGNED_BYTE, true);
    } else if (chunk.bytes[name]) chunk.buffers.value = this.buffer(1, chunk.bytes[name], 1, gl.UNSIGNED_BYTE, false);
    chunk.colour = name;
  }
  resize() {
    const gl = this.gl, ratio = Math.min(devicePixelRatio || 1, 2);
    const w = Math.max(Math.round(this.canvas.clientWidth * ratio), 1), h = Math.max(Math.round(this.canvas.clientHeight * ratio), 1);
    if (this.target && this.target.w === w && this.target.h === h) return this.target;
    this.canvas.width = w; this.canvas.height = h;
    if (this.target) { gl.deleteTexture(this.target.colours); gl.deleteTexture(this.target.depths); gl.deleteFramebuffer(this.target.frame); }
    const texture = (inner, format, kind) => {
      const made = gl.createTexture();
      gl.bindTexture(gl.TEXTURE_2D, made);
      gl.texImage2D(gl.TEXTURE_2D, 0, inner, w, h, 0, format, kind, null);
      for (const name of ["TEXTURE_MIN_FILTER", "TEXTURE_MAG_FILTER"]) gl.texParameteri(gl.TEXTURE_2D, gl[name], gl.NEAREST);
      return made;
    };
    const frame = gl.createFramebuffer();
    const colours = texture(gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE), depths = texture(gl.DEPTH_COMPONENT24, gl.DEPTH_COMPONENT, gl.UNSIGNED_INT);
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, colours, 0);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, depths, 0);
    return this.target = {w, h, ratio, colours, depths, frame};
  }
  // One frame. look: {shade, span, palette (bytes), slab, grain, size, dome}; view: of the camera, in CSS pixels.
  draw(view, look, some) {
    const gl = this.gl, target = this.resize(), {at} = this.points;
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.frame);
    gl.viewport(0, 0, target.w, target.h);
    gl.clearColor(0, 0, 0, 1); gl.clearDepth(1); gl.enable(gl.DEPTH_TEST); gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.useProgram(this.points.made);
    gl.activeTexture(gl.TEXTURE0); gl.bindTexture(gl.TEXTURE_2D, this.palette);
    if (look.palette) { gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, 256, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, look.palette); look.palette = null; }
    gl.uniform1i(at("palette"), 0);
    gl.uniformMatrix4fv(at("view"), false, new Float32Array(view.m));
    gl.uniform1i(at("mode"), look.mode); gl.uniform2f(at("span"), ...look.span);
    const slab = look.slab || {plane: [0, 0, 0, -1], ends: [0, 0, 0, -1]};
    gl.uniform4f(at("slab"), ...slab.plane); gl.uniform4f(at("ends"), ...slab.ends);
    const perMetre = target.h / (2 * Math.tan(FOV / 2));
    gl.uniform1f(at("perDepth"), view.ortho ? -target.h / (view.perPixel * view.height) : perMetre);
    gl.uniform1f(at("least"), 1.6 * target.ratio * Math.sqrt(look.size)); gl.uniform1f(at("most"), 14 * target.ratio);
    const same = new Float32Array(8).fill(look.grain * look.size);
    let count = 0;
    for (const chunk of this.chunks.values()) {
      if (!chunk.shown || (some && !some(chunk))) continue;
      this.colour(chunk, look.name);
      gl.uniform3f(at("centre"), ...chunk.centre);
      gl.uniform1fv(at("grains"), chunk.grains ? chunk.grains.map(each => each * look.size) : same);
      gl.bindVertexArray(chunk.array);
      gl.drawArrays(gl.POINTS, 0, chunk.count);
      count += chunk.count;
    }
    gl.bindVertexArray(this.empty);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.disable(gl.DEPTH_TEST);
    gl.useProgram(this.dome.made);
    const to = this.dome.at;
    gl.activeTexture(gl.TEXTURE0); gl.bindTexture(gl.TEXTURE_2D, target.colours); gl.uniform1i(to("colours"), 0);
    gl.activeTexture(gl.TEXTURE1); gl.bindTexture(gl.TEXTURE_2D, target.depths); gl.uniform1i(to("depths"), 1);
    gl.uniform1f(to("near"), view.near); gl.uniform1f(to("far"), view.far); gl.uniform1f(to("unit"), view.distance);
    gl.uniform1i(to("ortho"), view.ortho ? 1 : 0); gl.uniform1f(to("strength"), look.dome ? 26 : 0);
    gl.uniform1i(to("reach"), Math.max(Math.round(1.4 * target.ratio), 1));
    gl.uniform3f(to("above"), ...this.theme.above); gl.uniform3f(to("below"), ...this.theme.below); gl.uniform2f(to("size"), target.w, target.h);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.activeTexture(gl.TEXTURE0);
    return count;
  }
}
