// A cloud of any size: nodes of its octree are asked for as they are looked at, the largest in the picture first.
const scene = JSON.parse(document.getElementById("scene").textContent);
const SMALLEST = 110, AT_ONCE = 4;  // pixels of a node that is worth its points; requests
const WIDTH = 2.1;  // of a point, in distances between the points of its level: discs at random close a surface at about twice of them
const keyOf = (tree, level, x, y, z) => `${tree}-${level}-${x}-${y}-${z}`;
const childOf = (node, k) => keyOf(node.tree, node.level + 1, 2 * node.x + (k & 1), 2 * node.y + (k >> 1 & 1), 2 * node.z + (k >> 2));
class Octree {
  constructor(viewer) {
    this.viewer = viewer; this.nodes = new Map(); this.asked = 0; this.lost = 0; this.budget = 2e6; this.waiting = false;
    this.roots = [];
    scene.trees.forEach((tree, number) => this.plant(tree, number));
    this.overview = this.nodes.get(keyOf(scene.trees.findIndex(tree => tree.overview), 0, 0, 0, 0));
  }
  plant({corner, side: whole, spacing, nodes}, tree) {
    const add = (level, x, y, z, count, state) => {
      const side = whole / 2 ** level, centre = [x, y, z].map((v, i) => corner[i] + (v + 0.5) * side);
      this.nodes.set(keyOf(tree, level, x, y, z), {tree, level, x, y, z, count, side, centre, spacing: spacing / 2 ** level, chunk: null, state, seen: 0});
    };
    for (const node of nodes) add(...node, "away");
    // a parent without points of its own still leads to its children
    for (const [level, x, y, z] of nodes) for (let l = level - 1, k = 1; l >= 0; l--, k++) {
      if (this.nodes.has(keyOf(tree, l, x >> k, y >> k, z >> k))) break;
      add(l, x >> k, y >> k, z >> k, 0, "here");
    }
    this.roots.push(keyOf(tree, 0, 0, 0, 0));
  }
  // Pixels of a node in the picture; 0 where it is outside.
  pixels(view, node) {
    const radius = node.side * 0.87, slab = this.viewer.slab;
    if (slab) {
      const [x, y] = node.centre;
      if (Math.abs(slab.plane[0] * x + slab.plane[1] * y - slab.plane[2]) > slab.plane[3] + radius) return 0;
      if (Math.abs(slab.ends[0] * x + slab.ends[1] * y - slab.ends[2]) > slab.ends[3] + radius) return 0;
    }
    const d = [0, 1, 2].map(i => node.centre[i] - view.eye[i]), along = a => a[0] * d[0] + a[1] * d[1] + a[2] * d[2];
    const deep = -along(view.back), across = Math.abs(along(view.right)), up = Math.abs(along(view.up));
    const wide = view.ortho ? view.perPixel * view.height / 2 : Math.max(deep, 0) / view.f, aspect = view.width / view.height;
    if (!view.ortho && deep < -radius) return 0;
    const slack = radius * 1.3;
    if (across > wide * aspect + slack || up > wide + slack) return 0;
    return view.ortho ? node.side / view.perPixel : node.side * view.f * view.height / 2 / Math.max(deep - radius, node.side * 0.1);
  }
  choose() {
    const {viewer} = this, view = viewer.view, queue = [], wanted = new Set(), missing = [];
    let points = 0;
    // from afar the overview stands for the tiles
    const alone = node => node.level === 0 && (!this.overview || node === this.overview);
    const offer = key => { const node = this.nodes.get(key); if (!node) return; const size = this.pixels(view, node); if (size > 0 && (alone(node) || size > SMALLEST)) queue.push([size, key, node]); };
    for (const root of this.roots) offer(root);
    while (queue.length && points < this.budget) {
      let best = 0;
      for (let i = 1; i < queue.length; i++) if (queue[i][0] > queue[best][0]) best = i;
      const [, key, node] = queue.splice(best, 1)[0];
      points += node.count; wanted.add(key);
      if (node.state === "away") missing.push(key);
      else if (node.chunk) node.seen = ++this.tick || (this.tick = 1);
      for (let k = 0; k < 8; k++) offer(childOf(node, k));
    }
    let shown = 0, loaded = 0;
    for (const [key, node] of this.nodes) if (node.chunk) {
      node.chunk.shown = wanted.has(key); loaded += node.count;
      if (node.chunk.shown) shown += node.count;
    }
    if (loaded > 2.5 * this.budget) {
      const old = [...this.nodes.values()].filter(node => node.chunk && !node.chunk.shown).sort((a, b) => a.seen - b.seen);
      for (const node of old) { if (loaded <= 1.5 * this.budget) break; viewer.renderer.drop(node.chunk.id); node.chunk = null; node.state = "away"; loaded -= node.count; }
    }
    const roots = this.roots.filter(key => wanted.has(key)).map(key => this.nodes.get(key));
    for (const root of roots) this.spread(root, wanted, root === this.overview ? roots.filter(each => each !== root && each.chunk) : []);
    viewer.dirty = true;
    this.missing = missing; this.shown = shown;
    this.tell();
    while (this.asked < AT_ONCE && this.missing.length) this.load(this.missing.shift());
  }
  // Points are as wide as they are apart, so that surfaces close where no finer nodes are shown: in each eighth as the finest there.
  // Where tiles are shown, those of the overview are as narrow as can be.
  spread(node, wanted, tiles) {
    const half = node.side / 2, grains = new Float32Array(8);
    for (let k = 0; k < 8; k++) {
      const key = childOf(node, k), child = this.nodes.get(key), middle = [k & 1, k >> 1 & 1].map((far, i) => node.centre[i] + (far - 0.5) * half);
      if (wanted.has(key) && child.state === "here") grains[k] = this.spread(child, wanted, tiles);
      else grains[k] = tiles.some(({centre, side}) => [0, 1].every(i => Math.abs(centre[i] - middle[i]) < (side + half) / 2)) ? 0 : WIDTH * node.spacing;
    }
    if (node.chunk) node.chunk.grains = grains;
    return Math.min(...grains);
  }
  async load(key) {
    const node = this.nodes.get(key);
    node.state = "asked"; this.asked++;
    try {
      const answer = await fetch("/node?key=" + key);
      if (!answer.ok) throw new Error((await answer.text()).trim());
      const raw = await answer.arrayBuffer(), places = new Float32Array(raw, 0, 3 * node.count), bytes = {};
      scene.shades.forEach((shade, k) => { bytes[shade.name] = new Uint8Array(raw, (12 + k) * node.count, node.count).slice(); });
      node.chunk = this.viewer.renderer.put(key, places, bytes, node.centre);
      node.chunk.first = node.level <= 2;
      if (bytes.classification) this.viewer.meet(bytes.classification);
      if (this.onloaded) this.onloaded(node.chunk);
      node.state = "here";
    } catch (error) {
      node.state = "lost"; this.lost += node.count; this.trouble = error.message;
    }
    this.asked--;
    this.soon();
  }
  soon() { if (!this.waiting) { this.waiting = true; setTimeout(() => { this.waiting = false; this.choose(); }, 40); } }
  get settled() { return !this.waiting && !this.asked && !this.missing.length; }
  tell() {
    const lost = this.lost ? ` ${this.lost.toLocaleString("en")} points cannot be read: ${this.trouble}` : "";
    this.counts.textContent = `${Math.min(this.shown, scene.total).toLocaleString("en")} of ${scene.total.toLocaleString("en")} points shown.${lost}`;
  }
}
// Classes changed by loops; the program behind the page does the same to the whole cloud when it is saved.
class Editing {
  constructor(viewer, octree) {
    Object.assign(this, {viewer, octree, edits: [], version: scene.version, met: 0, sent: Promise.resolve()});
    const button = (text, press) => make("button", {type: "button", textContent: text, onclick: press});
    this.to = make("select", {id: "to-class", ariaLabel: "class that points get"});
    viewer.onmet = () => this.offer();
    this.offer(); this.to.value = "2";
    this.note = make("p", {id: "edit-note", textContent: "Points within a loop get this class; hidden classes, and what lies outside a section, stay as they are."});
    viewer.keys.lasso = button("lasso", () => { viewer.shade("classification"); viewer.tool(viewer.mode === "lasso" ? "look" : "lasso"); });
    viewer.keys.lasso.id = "lasso";
    const undo = button("undo", () => this.take(this.edits.slice(0, -1))), save = button("save", () => this.save());
    undo.id = "undo"; save.id = "save";
    viewer.extra.classList.add("edit");
    viewer.extra.append(make("label", {className: "row"}, make("span", {textContent: "class"}), this.to), make("div", {className: "row"}, viewer.keys.lasso, undo, save), this.note);
    viewer.onloop = loop => this.draw(loop);
    octree.onloaded = chunk => { chunk.original = chunk.bytes.classification.slice(); for (const edit of this.edits) reclassify(chunk, edit); };
    if (scene.edits.length) this.show(scene.edits.map(withBox));
  }
  // The classes that have names, and those of this cloud.
  offer() {
    const shade = this.viewer.shades.find(each => each.name === "classification"), chosen = this.to.value;
    const codes = [...new Set([...Object.keys(CLASSES).map(Number), ...shade.kinds])].sort((a, b) => a - b);
    this.to.replaceChildren(...codes.map(code => make("option", {value: code, textContent: nameOfKind(shade, code)})));
    if (chosen) this.to.value = chosen;
  }
  draw(loop) {
    const {viewer} = this, view = viewer.view, step = Math.ceil(loop.length / 500);
    const corners = loop.filter((_, i) => i % step === 0).map(([x, y]) => [2 * x / view.width - 1, 1 - 2 * y / view.height]);
    const shade = viewer.current, hidden = viewer.hidden;
    const of = shade.name === "classification" && hidden.size ? [...Array(256).keys()].filter(each => !hidden.has(each)) : null;
    const slab = viewer.slab ? {plane: viewer.slab.plane, ends: viewer.slab.ends} : null;
    if (corners.length > 2) this.take([...this.edits, withBox({matrix: [...view.m], loop: corners, to: +this.to.value, of, slab})]);
  }
  take(edits) {
    this.show(edits);
    // one after the other: each names the version that it changes; what was drawn on loops that another window changed is dropped
    const met = this.met, plain = edits.map(({matrix, loop, to, of, slab}) => ({matrix, loop, to, of, slab}));
    this.sent = this.sent.then(async () => { if (met === this.met) this.version = (await this.send("/edits", plain)).version; })
      .catch(error => this.say(error.message));
  }
  show(edits) {
    const {viewer} = this;
    this.edits = edits;
    let changed = 0;
    for (const chunk of viewer.renderer.chunks.values()) {
      chunk.bytes.classification.set(chunk.original);
      for (const edit of edits) changed += reclassify(chunk, edit);
      viewer.renderer.changed(chunk);
    }
    viewer.meet(edits.map(each => each.to));
    this.say(edits.length ? `${edits.length} loop${edits.length > 1 ? "s" : ""}, ${changed.toLocaleString("en")} of the points shown changed; not saved yet.` : "Nothing is changed.");
    viewer.dirty = true;
  }
  async save() {
    const met = this.met;
    this.say("Saving the whole cloud …");
    try {
      await this.sent;
      if (met !== this.met) return;
      const found = await this.send("/save");
      this.say(`${found.changed.toLocaleString("en")} of ${found.points.toLocaleString("en")} points changed; saved to ${found.file}.`);
    } catch (error) { this.say(error.message); }
  }
  async send(where, edits) {
    const body = JSON.stringify({version: this.version, edits});
    const answer = await fetch(where, {method: "POST", headers: {"X-Swath-Token": scene.token, "Content-Type": "application/json"}, body});
    if (answer.status === 409) {
      const now = await answer.json();
      this.met++; this.version = now.version; this.show(now.edits.map(withBox));
      throw new Error("Another window changed the loops: they are shown now. Look at them, and do it again.");
    }
    if (!answer.ok) throw new Error((await answer.text()).trim());
    return answer.json();
  }
  say(text) { this.note.textContent = text; }
}
function withBox(edit) {
  const x = edit.loop.map(p => p[0]), y = edit.loop.map(p => p[1]);
  return {...edit, box: [Math.min(...x), Math.min(...y), Math.max(...x), Math.max(...y)]};
}
try {
  const viewer = window.swathViewer = new Viewer(document.getElementById("viewer"), scene), octree = viewer.octree = new Octree(viewer);
  viewer.sheet.prepend(make("p", {className: "name", textContent: scene.name}));
  viewer.sheet.querySelector("summary").after(viewer.sheet.querySelector(".name"));
  octree.counts = make("p", {className: "counts", role: "status"});
  const detail = make("input", {type: "range", min: "-2", max: "2.5", step: "0.5", value: "0", ariaLabel: "points at once", oninput: () => { octree.budget = 2e6 * 2 ** detail.value; octree.choose(); }});
  viewer.section.before(make("label", {className: "row"}, make("span", {textContent: "detail"}), detail));
  viewer.results.before(octree.counts);
  octree.missing = [];
  if (scene.editable) viewer.editing = new Editing(viewer, octree);
  viewer.onturned = () => octree.soon();
  viewer.ready = true;
  octree.choose();
} catch (error) {
  document.getElementById("viewer").replaceChildren(make("p", {className: "trouble", textContent: "The cloud cannot be shown: " + error.message}));
}
