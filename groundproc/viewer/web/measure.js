// What is measured between points of the cloud: lengths, differences of height, areas; and which points a loop encloses.
function lengthOf(points) {
  let whole = 0, plan = 0;
  for (let i = 1; i < points.length; i++) {
    const [a, b] = [points[i - 1], points[i]];
    plan += Math.hypot(b[0] - a[0], b[1] - a[1]);
    whole += Math.hypot(b[0] - a[0], b[1] - a[1], b[2] - a[2]);
  }
  return {whole, plan};
}
// In plan, and along the polygon's own plane (half the length of the sum of cross products).
function areaOf(points) {
  const sum = [0, 0, 0], o = points[0];
  for (let i = 1; i + 1 < points.length; i++) {
    const a = points[i].map((v, k) => v - o[k]), b = points[i + 1].map((v, k) => v - o[k]);
    sum[0] += a[1] * b[2] - a[2] * b[1]; sum[1] += a[2] * b[0] - a[0] * b[2]; sum[2] += a[0] * b[1] - a[1] * b[0];
  }
  return {plan: Math.abs(sum[2]) / 2, own: Math.hypot(...sum) / 2, round: lengthOf([...points, o]).whole};
}
// A wall along a line in plan: what lies within `half` of it, and between its ends.
function slabOf(a, b, half) {
  const length = Math.hypot(b[0] - a[0], b[1] - a[1]);
  if (length < 0.05) return null;
  const t = [(b[0] - a[0]) / length, (b[1] - a[1]) / length], n = [-t[1], t[0]];
  const along = t[0] * (a[0] + b[0]) / 2 + t[1] * (a[1] + b[1]) / 2;
  return {a, b, half, t, n, length, plane: [n[0], n[1], n[0] * a[0] + n[1] * a[1], half], ends: [t[0], t[1], along, length / 2 + 1e-4]};
}
function inSlab(slab, x, y) {
  return !slab || (Math.abs(slab.plane[0] * x + slab.plane[1] * y - slab.plane[2]) <= slab.plane[3]
    && Math.abs(slab.ends[0] * x + slab.ends[1] * y - slab.ends[2]) <= slab.ends[3]);
}
// Even-odd rule; the server's copy of it is viewer/edits.py.
function inLoop(loop, x, y) {
  let inside = false;
  for (let i = 0, j = loop.length - 1; i < loop.length; j = i++) {
    const [xi, yi] = loop[i], [xj, yj] = loop[j];
    if (yi > y !== yj > y && x < (xj - xi) * (y - yi) / (yj - yi) + xi) inside = !inside;
  }
  return inside;
}
// The point that a click means: the nearest to the eye of those within a few pixels, else the nearest in the picture.
function pick(chunks, view, slab, visible, x, y) {
  const m = view.m, best = {near: null, w: Infinity, off: 14 * 14, any: null};
  const sx = view.width / 2, sy = view.height / 2;
  for (const chunk of chunks) {
    if (!chunk.shown) continue;
    const p = chunk.places;
    for (let i = 0, k = 0; i < chunk.count; i++, k += 3) {
      const w = m[3] * p[k] + m[7] * p[k + 1] + m[11] * p[k + 2] + m[15];
      if (w <= 0) continue;
      const dx = ((m[0] * p[k] + m[4] * p[k + 1] + m[8] * p[k + 2] + m[12]) / w + 1) * sx - x;
      if (dx > 14 || dx < -14) continue;
      const dy = (1 - (m[1] * p[k] + m[5] * p[k + 1] + m[9] * p[k + 2] + m[13]) / w) * sy - y;
      if (dy > 14 || dy < -14 || !inSlab(slab, p[k], p[k + 1]) || !visible(chunk, i)) continue;
      const off = dx * dx + dy * dy;
      const deep = view.ortho ? m[2] * p[k] + m[6] * p[k + 1] + m[10] * p[k + 2] : w;
      if (off < best.off) { best.off = off; best.any = {chunk, i}; }
      if (off < 12 && deep < best.w) { best.w = deep; best.near = {chunk, i}; }
    }
  }
  return best.near || best.any;
}
// Gives points within a loop another class; the number of those that changed. The same as viewer/edits.py does to the whole cloud.
function reclassify(chunk, edit) {
  const bytes = chunk.bytes.classification, p = chunk.places, m = edit.matrix;
  if (!bytes) return 0;
  let changed = 0;
  for (let i = 0, k = 0; i < chunk.count; i++, k += 3) {
    if (bytes[i] === edit.to || (edit.of && !edit.of.includes(bytes[i])) || !inSlab(edit.slab, p[k], p[k + 1])) continue;
    const w = m[3] * p[k] + m[7] * p[k + 1] + m[11] * p[k + 2] + m[15];
    if (w <= 0) continue;
    const x = (m[0] * p[k] + m[4] * p[k + 1] + m[8] * p[k + 2] + m[12]) / w;
    const y = (m[1] * p[k] + m[5] * p[k + 1] + m[9] * p[k + 2] + m[13]) / w;
    if (x < edit.box[0] || x > edit.box[2] || y < edit.box[1] || y > edit.box[3] || !inLoop(edit.loop, x, y)) continue;
    bytes[i] = edit.to; changed++;
  }
  return changed;
}
