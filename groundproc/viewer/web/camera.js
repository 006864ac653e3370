// Camera: looks at `centre` from azimuth and elevation [rad] at a distance [m]; straight down it is a map, north up.
const FOV = 0.8;
class Camera {
  constructor(low, high) {
    this.low = low; this.high = high;
    this.ortho = false;
    this.fit();
  }
  get size() { return Math.max(Math.hypot(...[0, 1, 2].map(i => this.high[i] - this.low[i])), 0.5); }
  // `aspect`: width over height of the picture.
  fit(aspect = 1.5) {
    this.centre = [0, 1, 2].map(i => (this.low[i] + this.high[i]) / 2);
    this.distance = 0.46 * this.size / Math.tan(FOV / 2) * Math.min(Math.max(1.1 / aspect, 1), 1.8);
    this.azimuth = -2.2; this.elevation = 0.6; this.ortho = false;
  }
  above() { this.azimuth = -Math.PI / 2; this.elevation = Math.PI / 2; }
  // What a frame needs: the matrix (column by column), the axes of the picture, metres of a pixel at the centre.
  matrices(width, height) {
    const {elevation: e, azimuth: a, centre: c, distance: d} = this;
    const back = [Math.cos(e) * Math.cos(a), Math.cos(e) * Math.sin(a), Math.sin(e)];
    const right = [-Math.sin(a), Math.cos(a), 0];
    const up = [back[1] * right[2] - back[2] * right[1], back[2] * right[0] - back[0] * right[2],
      back[0] * right[1] - back[1] * right[0]];
    const eye = [0, 1, 2].map(i => c[i] + d * back[i]);
    const dot = v => v[0] * eye[0] + v[1] * eye[1] + v[2] * eye[2];
    const rows = [[...right, -dot(right)], [...up, -dot(up)], [...back, -dot(back)]];
    const f = 1 / Math.tan(FOV / 2), reach = 2 * this.size + d;
    const near = this.ortho ? d - reach : Math.max(d / 200, 0.02), far = d + reach;
    const m = new Float64Array(16), half = d / f;
    for (let i = 0; i < 4; i++) {
      const last = i === 3 ? 1 : 0;
      if (this.ortho) {
        m[4 * i] = height / width / half * rows[0][i]; m[4 * i + 1] = rows[1][i] / half;
        m[4 * i + 2] = (-2 * rows[2][i] - last * (far + near)) / (far - near); m[4 * i + 3] = last;
      } else {
        m[4 * i] = f * height / width * rows[0][i]; m[4 * i + 1] = f * rows[1][i];
        m[4 * i + 2] = (far + near) / (near - far) * rows[2][i] + last * 2 * far * near / (near - far);
        m[4 * i + 3] = -rows[2][i];
      }
    }
    return {m, right, up, back, eye, near, far, perPixel: 2 * half / height, f, width, height, ortho: this.ortho, distance: d};
  }
}
// Place in the picture: pixels from the upper left corner, and how far away; null behind the eye.
function onScreen(view, p) {
  const m = view.m;
  const w = m[3] * p[0] + m[7] * p[1] + m[11] * p[2] + m[15];
  if (w <= 0) return null;
  const x = (m[0] * p[0] + m[4] * p[1] + m[8] * p[2] + m[12]) / w, y = (m[1] * p[0] + m[5] * p[1] + m[9] * p[2] + m[13]) / w;
  return [(x + 1) / 2 * view.width, (1 - y) / 2 * view.height, w];
}
// Mouse, fingers and keys. `on.turned()` after each change, `on.click(x, y)` in CSS pixels, `on.drag(kind, x, y)` where it takes drags.
function steer(canvas, camera, on) {
  const held = new Map();
  let start = null, pinch = 0;
  const spread = () => { const [a, b] = [...held.values()]; return Math.hypot(a.x - b.x, a.y - b.y); };
  const at = e => { const box = canvas.getBoundingClientRect(); return [e.clientX - box.left, e.clientY - box.top]; };
  function pan(dx, dy) {
    const {right, up, perPixel} = camera.matrices(canvas.clientWidth, canvas.clientHeight);
    camera.centre = camera.centre.map((v, i) => v - perPixel * dx * right[i] + perPixel * dy * up[i]);
  }
  // What is looked at from above, or as a section, is moved.
  function turn(dx, dy) {
    if (camera.elevation > 1.5 || camera.ortho) return pan(dx, dy);
    camera.azimuth -= 0.006 * dx; camera.elevation = Math.min(Math.max(camera.elevation + 0.006 * dy, -0.4), 1.48);
  }
  function zoom(factor, x, y) {
    const view = camera.matrices(canvas.clientWidth, canvas.clientHeight);
    const before = camera.distance;
    camera.distance = Math.min(Math.max(before * factor, 0.3), 20 * camera.size);
    const k = 1 - camera.distance / before, dx = (x - view.width / 2) * view.perPixel, dy = (view.height / 2 - y) * view.perPixel;
    camera.centre = camera.centre.map((v, i) => v + k * (dx * view.right[i] + dy * view.up[i]));
  }
  canvas.addEventListener("pointerdown", e => {
    held.set(e.pointerId, {x: e.clientX, y: e.clientY});
    canvas.setPointerCapture(e.pointerId);
    start = held.size === 1 ? {x: e.clientX, y: e.clientY, far: false} : null;
    if (held.size === 2) pinch = spread();
    if (on.drags() && held.size === 1 && e.button === 0) on.drag("begin", ...at(e));
  });
  canvas.addEventListener("pointermove", e => {
    const before = held.get(e.pointerId);
    if (!before) return;
    const dx = e.clientX - before.x, dy = e.clientY - before.y;
    before.x = e.clientX; before.y = e.clientY;
    if (start && Math.hypot(e.clientX - start.x, e.clientY - start.y) > 5) start.far = true;
    if (on.drags() && held.size === 1 && e.buttons & 1) return on.drag("move", ...at(e));
    if (held.size === 2) {
      pan(dx / 2, dy / 2);
      const now = spread(), [a, b] = [...held.values()], box = canvas.getBoundingClientRect();
      zoom(pinch / Math.max(now, 1), (a.x + b.x) / 2 - box.left, (a.y + b.y) / 2 - box.top);
      pinch = now;
    } else if (e.buttons & 6 || e.shiftKey) pan(dx, dy);
    else turn(dx, dy);
    on.turned();
  });
  const gone = e => {
    const own = start;
    held.delete(e.pointerId); start = null;
    if (on.drags() && e.button === 0 && e.type === "pointerup") return on.drag("end", ...at(e));
    if (own && !own.far && e.type === "pointerup" && e.button === 0) on.click(...at(e));
  };
  canvas.addEventListener("pointerup", gone);
  canvas.addEventListener("pointercancel", gone);
  canvas.addEventListener("contextmenu", e => e.preventDefault());
  canvas.addEventListener("wheel", e => {
    if (!on.wheel(e)) return;
    e.preventDefault();
    zoom(Math.exp(0.0012 * Math.max(-240, Math.min(240, e.deltaY * (e.deltaMode ? 30 : 1)))), ...at(e));
    on.turned();
  }, {passive: false});
  canvas.addEventListener("keydown", e => {
    const moves = {ArrowLeft: [40, 0], ArrowRight: [-40, 0], ArrowUp: [0, 40], ArrowDown: [0, -40]};
    if (moves[e.key] && e.shiftKey) turn(...moves[e.key]);
    else if (moves[e.key]) pan(...moves[e.key]);
    else if (e.key === "+" || e.key === "=") zoom(0.8, canvas.clientWidth / 2, canvas.clientHeight / 2);
    else if (e.key === "-") zoom(1.25, canvas.clientWidth / 2, canvas.clientHeight / 2);
    else return;
    e.preventDefault(); on.turned();
  });
}
