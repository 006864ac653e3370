// Controls around the cloud: buttons, legend, results, and what is drawn over the picture.
Viewer.prototype.panel = function () {
  const button = (name, text, title, press) => this.keys[name] = make("button", {type: "button", textContent: text, title, onclick: press});
  this.keys = {};
  this.chooser = make("select", {ariaLabel: "colour by", onchange: () => this.shade(this.chooser.value)},
    ...this.shades.map(each => make("option", {value: each.name, textContent: each.label + (each.unit ? " [" + each.unit + "]" : "")})));
  this.legend = make("div", {className: "legend"});
  this.size = make("input", {type: "range", min: "-1", max: "1.5", step: "0.1", value: "0", ariaLabel: "size of points",
    oninput: () => { this.look.size = 2 ** this.size.value; this.dirty = true; }});
  this.thickness = make("input", {type: "range", min: "-1.3", max: "1.3", step: "0.05", ariaLabel: "thickness of the section",
    oninput: () => this.thick(10 ** this.thickness.value / 2)});
  this.section = make("div", {className: "row", hidden: true}, make("span", {textContent: "section"}), this.thickness,
    make("button", {type: "button", textContent: "whole cloud", onclick: () => this.uncut()}));
  this.results = make("div", {className: "results"});
  const dome = make("input", {type: "checkbox", checked: true, onchange: () => { this.look.dome = dome.checked; this.dirty = true; }});
  const path = make("input", {type: "checkbox", checked: true, onchange: () => { this.nopath = !path.checked; this.dirty = true; }});
  this.extra = make("div", {className: "extra"});
  this.sheet = make("details", {className: "panel", open: innerWidth > 640}, make("summary", {textContent: "Colour and tools"}),
    make("label", {className: "row"}, make("span", {textContent: "colour by"}), this.chooser), this.legend,
    make("label", {className: "row"}, make("span", {textContent: "point size"}), this.size),
    make("div", {className: "row checks"}, make("label", {}, dome, " depth shading"), ...(this.scene.paths.length ? [make("label", {}, path, " flight path")] : [])),
    this.section, this.extra, this.results);
  this.bar = make("div", {className: "tools"},
    button("fit", "3D", "look from the side", () => { if (this.slab) this.uncut(); this.camera.fit(this.aspect); this.turned(); }),
    button("above", "from above", "look straight down, north up", () => { if (this.slab) this.uncut(); this.camera.above(); this.turned(); }),
    button("distance", "distance", "distance and difference of height", () => this.tool(this.mode === "distance" ? "look" : "distance")),
    button("area", "area", "area and length around it", () => this.tool(this.mode === "area" ? "look" : "area")),
    button("section", "section", "a slab along a line, from the side", () => this.tool(this.mode === "section" ? "look" : "section")),
    button("clear", "clear", "forget what was measured", () => this.tool("clear")),
    button("whole", "full screen", "over the whole screen", () => document.fullscreenElement ? document.exitFullscreen() : this.place.requestFullscreen()));
  this.hint = make("div", {className: "hint", hidden: true, role: "status"});
  this.place.append(this.sheet, this.bar, this.hint);
};
Viewer.prototype.buttons = function () { for (const [name, key] of Object.entries(this.keys)) key.classList.toggle("on", name === this.mode); };
function digitsOf(span) { return Math.max(0, Math.min(3, 2 - Math.floor(Math.log10(Math.max(span, 1e-3))))); }
function drawLegend(viewer) {
  const {current: shade, legend} = viewer;
  viewer.chooser.value = shade.name;
  legend.replaceChildren();
  if (shade.name === "rgb") return;
  if (shade.kinds.length) {
    const list = make("div", {className: "kinds"});
    shade.kinds.forEach((kind, rank) => {
      const byte = shade.byCode ? kind : rank, key = make("button", {type: "button", title: "show or hide", onclick: () => viewer.toggle(byte)});
      const dot = make("i");
      dot.style.background = colourOfKind(shade, kind, rank);
      key.append(dot, nameOfKind(shade, kind));
      key.classList.toggle("off", viewer.hidden.has(byte));
      list.append(key);
    });
    legend.append(list);
    return;
  }
  const strip = make("canvas", {width: 256, height: 1, className: "strip"}), pixels = new ImageData(new Uint8ClampedArray(paletteOf(shade, new Set())), 256, 1);
  strip.getContext("2d").putImageData(pixels, 0, 0);
  const [low, high] = [shade.low, shade.low + 254 * shade.step], base = shade.name === "z" ? viewer.scene.origin[2] : 0, digits = digitsOf(high - low);
  const ends = [0, 1].map(end => {
    const box = make("input", {type: "number", step: "any", value: number(viewer.span[end] + base, digits), ariaLabel: end ? "upper end of the colours" : "lower end of the colours",
      onchange: () => { if (box.value !== "" && isFinite(+box.value)) { viewer.span[end] = +box.value - base; viewer.spread(); } }});
    return box;
  });
  legend.append(strip, make("div", {className: "row ends"}, ends[0], make("span", {textContent: shade.unit}), ends[1]));
}
function drawResults(viewer) {
  const rows = [], table = lines => make("table", {}, make("tbody", {}, ...lines.map(line => make("tr", {}, ...line.map((text, i) => make(i ? "td" : "th", {textContent: text}))))));
  const current = viewer.taken.length && (viewer.mode === "distance" || viewer.mode === "area") ? [{kind: viewer.mode, points: viewer.taken}] : [];
  if (viewer.slab) rows.push(make("h4", {textContent: "Section"}), table([["length", metres(viewer.slab.length)], ["thickness", metres(2 * viewer.slab.half)]]));
  for (const {kind, points} of [...viewer.measured, ...current]) {
    if (points.length < 2) continue;
    if (kind === "distance") {
      const {whole, plan} = lengthOf(points);
      rows.push(make("h4", {textContent: "Distance"}), table([["in space", UNIT.plan === UNIT.height ? metres(whole) : "–"], ["in plan", metres(plan)],
        ["height difference", (points.at(-1)[2] >= points[0][2] ? "+" : "−") + metres(Math.abs(points.at(-1)[2] - points[0][2]), UNIT.height)]]));
    } else if (points.length > 2) {
      const {plan, own, round} = areaOf(points);
      rows.push(make("h4", {textContent: "Area"}), table([["in plan", metres(plan) + "²"], ["along its plane", UNIT.plan === UNIT.height ? metres(own) + "²" : "–"], ["around it", UNIT.plan === UNIT.height ? metres(round) : "–"]]));
    }
  }
  if (viewer.picked) rows.push(make("h4", {textContent: "Point"}), table(viewer.told(viewer.picked)));
  viewer.results.replaceChildren(...rows);
}
function drawOverlay(viewer, view) {
  const {overlay, camera} = viewer, ratio = Math.min(devicePixelRatio || 1, 2), paint = overlay.getContext("2d");
  overlay.width = Math.round(view.width * ratio); overlay.height = Math.round(view.height * ratio);
  paint.scale(ratio, ratio);
  paint.lineJoin = paint.lineCap = "round";
  const line = (points, colour, width, closed, dashes = []) => {
    paint.beginPath(); paint.strokeStyle = colour; paint.lineWidth = width; paint.setLineDash(dashes);
    let pen = false;
    for (const p of points) { if (p) { pen ? paint.lineTo(p[0], p[1]) : paint.moveTo(p[0], p[1]); pen = true; } else pen = false; }
    if (closed && pen) paint.closePath();
    paint.stroke(); paint.setLineDash([]);
  };
  const dot = (p, radius, colour) => { if (p) { paint.beginPath(); paint.arc(p[0], p[1], radius, 0, 7); paint.fillStyle = colour; paint.fill(); paint.strokeStyle = viewer.paper; paint.lineWidth = 1.5; paint.stroke(); } };
  if (!viewer.nopath && !viewer.slab) for (const path of viewer.scene.paths) {
    const places = path.map(p => onScreen(view, p));
    line(places, viewer.paper + "aa", 4); line(places, viewer.accent, 2);
    dot(places[0], 4, viewer.accent);
  }
  const label = (p, text) => {
    if (!p) return;
    paint.font = "600 12px system-ui, sans-serif";
    const width = paint.measureText(text).width;
    paint.fillStyle = viewer.paper; paint.globalAlpha = 0.86;
    paint.beginPath(); paint.roundRect(p[0] - width / 2 - 6, p[1] - 25, width + 12, 19, 5); paint.fill();
    paint.globalAlpha = 1; paint.fillStyle = viewer.ink; paint.textAlign = "center"; paint.fillText(text, p[0], p[1] - 11);
  };
  for (const {kind, points} of [...viewer.measured, {kind: viewer.mode, points: viewer.taken}]) {
    const places = points.map(p => onScreen(view, p));
    line(places, viewer.paper, 5, kind === "area" && places.length > 2); line(places, "#ff8a3d", 2.5, kind === "area" && places.length > 2);
    places.forEach(p => dot(p, 4.5, "#ff8a3d"));
    if (kind === "distance") for (let i = 1; i < points.length; i++) label(onScreen(view, points[i].map((v, k) => (v + points[i - 1][k]) / 2)), metres(lengthOf(points.slice(i - 1, i + 1))[UNIT.plan === UNIT.height ? "whole" : "plan"]));
    if (kind === "area" && points.length > 2) label(onScreen(view, [0, 1, 2].map(k => points.reduce((s, p) => s + p[k], 0) / points.length)), metres(areaOf(points).plan) + "²");
  }
  if (viewer.picked) dot(onScreen(view, viewer.placeOf(viewer.picked)), 5, viewer.accent);
  if (viewer.loop) { paint.fillStyle = viewer.accent + "33"; paint.beginPath(); viewer.loop.forEach((p, i) => i ? paint.lineTo(...p) : paint.moveTo(...p)); paint.fill("evenodd"); line(viewer.loop, viewer.accent, 2, true, [6, 4]); }
  // scale: true at the centre of the picture
  const long = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000].find(v => v / view.perPixel > 70) || 10000;
  const wide = long / view.perPixel, x = view.width - 16, y = view.height - 16;
  const ruler = [[x - wide, y - 5], [x - wide, y], [x, y], [x, y - 5]], words = (text, up) => {
    paint.font = "12px system-ui, sans-serif"; paint.textAlign = "right"; paint.lineWidth = 3; paint.strokeStyle = viewer.paper;
    paint.strokeText(text, x, y - up); paint.fillStyle = viewer.ink; paint.fillText(text, x, y - up);
  };
  line(ruler, viewer.paper, 4); line(ruler, viewer.ink, 1.5); words(long + " " + UNIT.plan, 9);
  if (viewer.slab) return words(UNIT.plan === UNIT.height ? "heights to the same scale" : "heights in " + UNIT.height, 26);
  // north arrow, as it lies on the ground
  const up = onScreen(view, camera.centre), north = onScreen(view, [camera.centre[0], camera.centre[1] + 30 * view.perPixel, camera.centre[2]]);
  if (up && north) {
    const turn = Math.atan2(north[0] - up[0], up[1] - north[1]), flat = Math.max(Math.hypot(north[0] - up[0], north[1] - up[1]) / 30, 0.35);
    paint.save(); paint.translate(view.width - 34, 40); paint.rotate(turn); paint.scale(1, flat);
    paint.beginPath(); paint.moveTo(0, -18); paint.lineTo(7, 12); paint.lineTo(0, 6); paint.lineTo(-7, 12); paint.closePath();
    paint.fillStyle = viewer.ink; paint.fill(); paint.restore();
    paint.textAlign = "center"; paint.fillStyle = viewer.ink; paint.font = "600 11px system-ui, sans-serif";
    paint.fillText("N", view.width - 34 + 27 * Math.sin(turn), 44 - 27 * flat * Math.cos(turn));
  }
}
