// The flight report: the thinned cloud lies in the page itself.
async function unpacked(text) {
  let bytes;
  if (Uint8Array.fromBase64) bytes = Uint8Array.fromBase64(text);
  else { const raw = atob(text); bytes = new Uint8Array(raw.length); for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i); }
  const deflated = new DecompressionStream("gzip"), writer = deflated.writable.getWriter();
  writer.write(bytes); writer.close();
  return new Uint8Array(await new Response(deflated.readable).arrayBuffer());
}
// As viewer/packing.py has it: differences of whole millimetres along a curve, a plane for each byte. In four parts, each an even share.
function chunksOf(raw, shades) {
  const [count, planes] = new Uint32Array(raw.buffer, 0, 2), parts = [0, 1, 2, 3].map(k => ({places: new Float32Array(3 * Math.ceil((count - k) / 4)), bytes: {}}));
  const width = planes * count, [second, third, fourth] = [1, 2, 3].map(k => k < planes ? k * count : -1);
  for (let axis = 0, at = 8; axis < 3; axis++, at += width) {
    let value = 0;
    for (let i = 0; i < count; i++) {
      let zigzag = raw[at + i];
      if (second > 0) zigzag |= raw[at + second + i] << 8;
      if (third > 0) zigzag |= raw[at + third + i] << 16;
      if (fourth > 0) zigzag |= raw[at + fourth + i] << 24;
      value += (zigzag >>> 1) ^ -(zigzag & 1);
      parts[i & 3].places[3 * (i >> 2) + axis] = value * 0.001;
    }
  }
  shades.forEach((shade, k) => {
    const from = 8 + 3 * width + k * count;
    for (const [part, own] of parts.entries()) {
      const bytes = own.bytes[shade.name] = new Uint8Array(own.places.length / 3);
      for (let i = 0; i < bytes.length; i++) bytes[i] = raw[from + 4 * i + part];
    }
  });
  return parts;
}
async function showCloud() {
  const place = document.getElementById("viewer");
  if (!place) return;
  const scene = JSON.parse(document.getElementById("scene").textContent), holder = document.getElementById("cloud-data");
  try {
    const raw = unpacked(holder.textContent), viewer = window.swathViewer = new Viewer(place, scene);
    const parts = chunksOf(await raw, scene.shades);
    holder.remove();
    parts.forEach((part, k) => { viewer.renderer.put(k, part.places, part.bytes).first = k === 0; });
    viewer.ready = true; viewer.turned(); viewer.moving = 0;
    place.classList.add("ready");
  } catch (error) {
    place.replaceChildren(make("p", {className: "trouble", textContent: "The cloud cannot be shown: " + error.message}));
  }
}
// Layers of the map: one at a time on the screen, all of them on paper.
for (const group of document.querySelectorAll(".layers")) {
  const buttons = [...group.querySelectorAll("button[data-layer]")];
  const choose = name => {
    buttons.forEach(each => each.setAttribute("aria-pressed", String(each.dataset.layer === name)));
    group.querySelectorAll("figure[data-layer]").forEach(each => each.classList.toggle("chosen", each.dataset.layer === name));
  };
  buttons.forEach(each => each.addEventListener("click", () => choose(each.dataset.layer)));
  if (buttons.length) choose(buttons[0].dataset.layer);
}
document.documentElement.classList.add("scripted");
showCloud();
