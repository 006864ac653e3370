// Colours: scales, kinds, and the names of classes (ASPRS LAS 1.4, table 17).
const SCALES = {
  height: ["#2b3a8c", "#2b6cb3", "#2a9d9b", "#4fb86a", "#a9cf4c", "#f0dc55", "#f6b24a", "#f4f0e6"],
  plain: ["#440154", "#472d7b", "#3b528b", "#2c728e", "#21918c", "#28ae80", "#5ec962", "#addc30", "#fde725"],
  grey: ["#16181c", "#f7f5f0"],
  warm: ["#15224f", "#5b2a86", "#b5367a", "#ee6a50", "#fdb863", "#fdf5c9"],
};
const KINDS = ["#4c9be8", "#f2994a", "#62c370", "#e05d5d", "#b18ae0", "#d9c24a", "#4fc4c4", "#e887b8", "#9aa7b5", "#a0785a",
  "#7fd1ae", "#c9585e", "#6f7bd9", "#c0d860", "#de7ae0", "#579a9a"];
const CLASSES = {
  0: ["never classified", "#9aa4b0"], 1: ["unclassified", "#b9c2cc"], 2: ["ground", "#b5804d"], 3: ["low vegetation", "#a5d66a"],
  4: ["medium vegetation", "#5fbf5a"], 5: ["high vegetation", "#2f8f4e"], 6: ["building", "#e2725b"], 7: ["low noise", "#d04ad0"],
  8: ["reserved", "#cccccc"], 9: ["water", "#4a90e2"], 10: ["rail", "#8a7f99"], 11: ["road", "#7d8794"], 13: ["wire guard", "#ffd76a"],
  14: ["wire conductor", "#ffc21a"], 15: ["tower", "#c78c2a"], 16: ["wire connector", "#ffe9a8"], 17: ["bridge deck", "#8fb3d9"],
  18: ["high noise", "#e04fb3"], 19: ["overhead structure", "#c9a58a"], 20: ["ignored ground", "#c9b79c"], 21: ["snow", "#eef6ff"],
  22: ["temporal exclusion", "#f06a6a"], 64: ["mast", "#b98d4a"], 65: ["pole", "#d9a860"], 66: ["fence", "#9c7b5a"],
  67: ["stay", "#e0c48a"], 68: ["pane, and what is behind it", "#6fd0e8"], 69: ["what moved", "#ff6b57"],
};
function rgb(hex) { return [1, 3, 5].map(i => parseInt(hex.slice(i, i + 2), 16)); }
function scaleOf(name) {
  return {intensity: "grey", z: "height", range: "warm", gps_time: "plain"}[name] || (name.startsWith("sigma") ? "warm" : "plain");
}
// 256 colours of four bytes: a scale, or the kinds of a shade; alpha 0 is hidden.
function paletteOf(shade, hidden) {
  const out = new Uint8Array(1024);
  if (shade.kinds.length) {
    for (let byte = 0; byte < 256; byte++) out.set([110, 116, 124, hidden.has(byte) ? 0 : 255], 4 * byte);
    shade.kinds.forEach((kind, rank) => {
      const byte = shade.byCode ? kind : rank;
      out.set([...rgb(colourOfKind(shade, kind, rank)), hidden.has(byte) ? 0 : 255], 4 * byte);
    });
    return out;
  }
  const stops = SCALES[scaleOf(shade.name)].map(rgb);
  for (let i = 0; i < 256; i++) {
    const at = i / 255 * (stops.length - 1), k = Math.min(Math.floor(at), stops.length - 2), t = at - k;
    out.set([...[0, 1, 2].map(c => Math.round(stops[k][c] + t * (stops[k + 1][c] - stops[k][c]))), 255], 4 * i);
  }
  return out;
}
function colourOfKind(shade, kind, rank) {
  if (shade.name === "classification" && CLASSES[kind]) return CLASSES[kind][1];
  return KINDS[rank % KINDS.length];
}
function nameOfKind(shade, kind) {
  if (shade.name === "classification") return kind + " " + (CLASSES[kind] ? CLASSES[kind][0] : "class " + kind);
  return String(kind);
}
