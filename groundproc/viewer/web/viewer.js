// The viewer: a scene, its controls, its tools. Scene: {origin, low, high, total, spacing, shades, crs, paths, start}.
const HEIGHT = {name: "z", label: "height", unit: "m", kinds: [], low: 0, step: 1};
const UNIT = {plan: "m", height: "m"};  // of the scene's CRS
const make = (tag, options = {}, ...inside) => {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(options)) {
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (name in made) made[name] = value; else made.setAttribute(name, value);
  }
  made.append(...inside);
  return made;
};
const number = (value, digits) => value.toLocaleString("en", {minimumFractionDigits: digits, maximumFractionDigits: digits, useGrouping: false});
const metres = (value, unit = UNIT.plan) => number(value, 2) + " " + unit;
class Viewer {
  constructor(place, scene) {
    Object.assign(this, {place, scene, mode: "look", taken: [], measured: [], hidden: new Set(), slab: null, slow: false, dirty: true, moving: 0});
    [UNIT.plan, UNIT.height] = scene.units;
    this.canvas = make("canvas", {tabIndex: 0, className: "cloud", ariaLabel: "point cloud in three dimensions"});
    this.overlay = make("canvas", {className: "overlay"});
    place.append(this.canvas, this.overlay);
    this.renderer = new Renderer(this.canvas);
    this.camera = new Camera(...scene.core);
    this.look = {size: 1, dome: true, grain: scene.spacing || 0.1};
    this.shades = [{...HEIGHT, unit: UNIT.height, shown: scene.heights, low: scene.low[2], step: (scene.high[2] - scene.low[2]) / 254 || 1}, ...scene.shades];
    if (["red", "green", "blue"].every(name => scene.shades.some(each => each.name === name)))
      this.shades.push({name: "rgb", label: "colour", unit: "", kinds: [], shown: [0, 1]});
    steer(this.canvas, this.camera, {
      turned: () => this.turned(), click: (x, y) => this.click(x, y),
      drags: () => this.mode === "lasso", drag: (kind, x, y) => this.lasso(kind, x, y),
      wheel: e => document.fullscreenElement || place.classList.contains("whole") || e.ctrlKey || this.canvas === document.activeElement,
    });
    // wherever the focus is, as after a press on the tool
    place.addEventListener("keydown", e => { if (e.key === "Escape" && this.mode !== "look") { this.tool("look"); e.preventDefault(); } });
    this.canvas.addEventListener("dblclick", e => {
      const box = this.canvas.getBoundingClientRect(), hit = this.hit(e.clientX - box.left, e.clientY - box.top);
      if (hit) { this.camera.centre = this.placeOf(hit); this.camera.distance *= 0.6; this.turned(); }
    });
    this.camera.fit(this.aspect);
    this.panel();
    this.dress();
    // what was photographed is what people know again
    this.shade(this.shades.some(each => each.name === "rgb") ? "rgb" : "z");
    new ResizeObserver(() => { this.dirty = true; }).observe(this.canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.dress());
    const frame = () => { requestAnimationFrame(frame); this.frame(); };
    frame();
  }
  turned() { this.moving = performance.now(); this.dirty = true; if (this.onturned) this.onturned(); }
  // Colours of the page around.
  dress() {
    const style = getComputedStyle(this.place), read = name => rgb(style.getPropertyValue(name).trim()).map(v => v / 255);
    this.renderer.theme = {above: read("--sky"), below: read("--floor")};
    this.ink = style.getPropertyValue("--ink").trim(); this.paper = style.getPropertyValue("--paper").trim();
    this.accent = style.getPropertyValue("--accent").trim();
    this.dirty = true;
  }
  project(view, place) { return onScreen(view, place); }
  get aspect() { return this.canvas.clientWidth / Math.max(this.canvas.clientHeight, 1) || 1.5; }
  get view() { return this.camera.matrices(this.canvas.clientWidth, this.canvas.clientHeight); }
  frame() {
    const quiet = performance.now() - this.moving > 250;
    if (this.coarse && quiet) { this.coarse = false; this.dirty = true; }
    if (!this.dirty || !this.canvas.clientWidth) return;
    this.dirty = false;
    const began = performance.now(), view = this.view;
    // while it moves, a slow machine draws every fourth point
    this.coarse = this.slow && !quiet;
    this.drawn = this.renderer.draw(view, {...this.look, slab: this.slab, palette: this.fresh()}, this.coarse ? chunk => chunk.first : null);
    if (!this.coarse) {  // the answer comes when it is drawn
      const gl = this.renderer.gl;
      gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
      this.slow = performance.now() - began > 60;
      if (this.drawn && !this.shownAt) this.shownAt = performance.now();
    }
    drawOverlay(this, view);
    this.frames = (this.frames || 0) + 1;
  }
  fresh() { const made = this.palette; this.palette = null; return made; }
  // Colour by an attribute.
  shade(name) {
    const shade = this.shades.find(each => each.name === name);
    if (this.current !== shade) { this.current = shade; this.span = [...shade.shown]; this.hidden = new Set(); }
    this.look.name = name;
    this.look.mode = name === "rgb" ? 3 : name === "z" ? 0 : shade.kinds.length ? 2 : 1;
    this.spread();
    drawLegend(this);
  }
  spread() {
    const {current: shade, span} = this;
    const bytes = value => (value - shade.low) / shade.step;
    this.look.span = this.look.mode === 0 ? [span[0], Math.max(span[1], span[0] + 1e-3)] : this.look.mode === 1
      ? [bytes(span[0]), Math.max(bytes(span[1]), bytes(span[0]) + 1e-3)] : [0, 1];
    this.palette = paletteOf(shade.name === "rgb" ? HEIGHT : shade, this.hidden);
    this.dirty = true;
  }
  // Classes that may be new: the first points told of the frequent ones only.
  meet(classes) {
    const shade = this.shades.find(each => each.name === "classification"), known = new Set(shade.kinds), before = known.size;
    for (const each of classes) known.add(each);
    if (known.size === before) return;
    shade.kinds = [...known].sort((a, b) => a - b);
    if (this.current === shade) { this.spread(); drawLegend(this); }
    if (this.onmet) this.onmet();
  }
  toggle(byte) { if (!this.hidden.delete(byte)) this.hidden.add(byte); this.spread(); drawLegend(this); }
  visible(chunk, i) { return !this.hidden.size || !this.hidden.has(chunk.bytes[this.current.name][i]); }
  hit(x, y) { return pick(this.renderer.chunks.values(), this.view, this.slab, (chunk, i) => this.visible(chunk, i), x, y); }
  placeOf({chunk, i}) { return [0, 1, 2].map(axis => chunk.places[3 * i + axis]); }
  // What is known of a point, in the words of the table.
  told({chunk, i}) {
    const place = this.placeOf({chunk, i}), rows = ["easting", "northing", "height"].map((name, axis) => [name, number(place[axis] + this.scene.origin[axis], 3) + " " + (axis < 2 ? UNIT.plan : UNIT.height)]);
    for (const shade of this.scene.shades) {
      const byte = chunk.bytes[shade.name] && chunk.bytes[shade.name][i];
      if (byte === undefined) continue;
      if (shade.kinds.length) rows.push([shade.label, byte === 255 && !shade.byCode ? "–" : nameOfKind(shade, shade.byCode ? byte : shade.kinds[byte])]);
      else if (byte === 255) rows.push([shade.label, "–"]);
      else rows.push([shade.label, (shade.step === 1 ? "" : "≈ ") + number(shade.low + byte * shade.step, shade.step >= 1 ? 0 : shade.step > 0.05 ? 1 : 3) + (shade.unit ? " " + shade.unit : "")]);
    }
    return rows;
  }
  tool(mode) {
    if (this.taken.length > 1 && (this.mode === "distance" || this.mode === "area")) this.measured.push({kind: this.mode, points: this.taken});
    this.mode = mode; this.taken = []; this.loop = null;
    if (mode === "clear") { this.measured = []; this.picked = null; this.mode = "look"; }
    this.canvas.classList.toggle("aiming", this.mode !== "look");
    this.buttons(); this.say(HINTS[this.mode] || ""); drawResults(this); this.dirty = true;
  }
  click(x, y) {
    this.canvas.focus({preventScroll: true});
    const hit = this.hit(x, y);
    if (!hit) return this.mode === "look" ? (this.picked = null, drawResults(this), this.dirty = true) : this.say("No point there: click on one.");
    if (this.mode === "look") this.picked = hit;
    else if (this.mode === "distance" || this.mode === "area") this.taken.push(this.placeOf(hit));
    else if (this.mode === "section") {
      this.taken.push(this.placeOf(hit));
      if (this.taken.length === 2) { this.cut(...this.taken); this.tool("look"); }
    }
    drawResults(this); this.dirty = true;
  }
  // A section along a line: what lies near it, seen from the side without perspective.
  cut(a, b, half = this.slab ? this.slab.half : Math.min(Math.max(this.camera.size / 200, 0.1), 1)) {
    const slab = slabOf(a, b, half);
    if (!slab) return this.say("The two points lie above each other: choose others for a section.");
    if (!this.slab) this.before = {...this.camera};
    this.slab = slab;
    const {camera} = this;
    camera.ortho = true; camera.elevation = 0; camera.azimuth = Math.atan2(-slab.n[1], -slab.n[0]);
    camera.centre = [0, 1, 2].map(i => (a[i] + b[i]) / 2);
    // it stands beside the panel, not under it
    const {clientWidth: width, clientHeight: height} = this.canvas, covered = this.sheet.open && width > 640 ? this.sheet.offsetLeft + this.sheet.offsetWidth : 0;
    camera.distance = slab.length * 0.56 / Math.tan(FOV / 2) * Math.min(width / (width - covered), height / (width - covered));
    const {perPixel, right} = camera.matrices(width, height);
    camera.centre = camera.centre.map((v, i) => v - covered / 2 * perPixel * right[i]);
    this.thickness.value = String(Math.log10(2 * half)); this.section.hidden = false;
    this.turned(); drawResults(this);
  }
  thick(half) { if (this.slab) { this.slab = slabOf(this.slab.a, this.slab.b, half); this.dirty = true; drawResults(this); if (this.onturned) this.onturned(); } }
  uncut() {
    this.slab = null; this.section.hidden = true;
    Object.assign(this.camera, this.before || {}); this.camera.ortho = false;
    this.turned(); drawResults(this);
  }
  lasso(kind, x, y) {
    if (kind === "begin") this.loop = [[x, y]];
    else if (this.loop) {
      const last = this.loop[this.loop.length - 1];
      if (Math.hypot(x - last[0], y - last[1]) > 3) this.loop.push([x, y]);
      if (kind === "end") {
        if (this.loop.length > 2 && this.onloop) this.onloop(this.loop);
        this.loop = null;
      }
    }
    this.dirty = true;
  }
  say(text) { this.hint.textContent = text; this.hint.hidden = !text; }
}
const HINTS = {
  distance: "Click points along a line; the tool again, or Esc, ends it.",
  area: "Click the corners of an area; the tool again, or Esc, ends it.",
  section: "Click two points: what lies along the line between them is shown from the side.",
  lasso: "Draw a loop around points: they get the chosen class. The wheel zooms, the right button moves.",
};
