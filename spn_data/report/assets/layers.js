// Layers of the 3D view: points, cameras, estimates, tracks, fixes, places to fly again, grid.

// Lines of one camera: its pyramid, with a small mark at the upper edge of the image.
function frustum(out, center, axes, tangents, size) {
  const at = (x, y, z) => [0, 1, 2].map(k => center[k] + size * (axes[0][k] * x + axes[1][k] * y + axes[2][k] * z));
  const [tx, ty] = tangents;
  const corners = [at(-tx, -ty, 1), at(tx, -ty, 1), at(tx, ty, 1), at(-tx, ty, 1)];
  for (let k = 0; k < 4; k++) out.push(...center, ...corners[k], ...corners[k], ...corners[(k + 1) % 4]);
  const top = at(0, -1.5 * ty, 1);
  out.push(...corners[0], ...top, ...top, ...corners[1]);
}

// Thin lines through the frames of each sequence, interrupted at frames without a pose.
function path(out, wanted) {
  let before = -1;
  for (let i = 0; i < frames.count; i++) {
    if (!wanted(i)) continue;
    if (before >= 0 && frames.sequence(before) === frames.sequence(i) && hasPose(before) && hasPose(i))
      out.push(...centerOf(before), ...centerOf(i));
    before = i;
  }
}

const rows = Array.from({length: frames.count}, (_, i) => i);
const posed = rows.filter(hasPose);
const stills = posed.filter(i => !frames.tracked[i]);

// Size of a camera's pyramid: slightly less than the typical distance between neighbours.
function usualSize() {
  const steps = [];
  for (let k = 1; k < stills.length; k++) {
    const a = centerOf(stills[k - 1]), b = centerOf(stills[k]);
    steps.push(Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]));
  }
  steps.sort((a, b) => a - b);
  const step = steps.length ? steps[steps.length >> 1] : 0;
  return Math.min(Math.max(0.8 * step, 0.008 * radius), 0.04 * radius);
}

const EVALUATION_COLORS = ["--evaluation", "--evaluation2", "--evaluation3"];

// Layer of a camera: what its frame is for. Colours of the paper: training green, truth blue, estimates red.
function purpose(i) {
  if (frames.evaluation[i]) return `truth: ${frames.sequence(i)}`;
  const group = frames.group(i);
  if (group === "train") return "training";
  if (group === "validation") return "validation";
  return !group ? "mapping" : `truth: ${group}`;
}

// Image of the ground; the view draws it once it is decoded.
const groundImage = new Image();
if (report.ground) groundImage.src = "data:image/webp;base64," + report.ground.webp;

const tangentsOf = i => report.fov[frames.camera(i)] || [0.6, 0.4];

function makeLayers(size) {
  const made = [];
  const add = (label, color, layer, on = true) => {
    if (layer.xyz.length) made.push({label, color, on, ...layer});
  };
  if (report.ground) {
    const {low: [west, south], high: [east, north], up} = report.ground;
    const [a, b, c, d] = [[west, north], [east, north], [east, south], [west, south]].map(([x, y]) => shown(x, y, up));
    add("ground", null, {image: groundImage, xyz: new Float32Array([...a, ...b, ...c, ...a, ...c, ...d])});
  }
  if (report.points) {
    const points = report.points;
    add("points", null, {xyz: unpack(points.xyz), step: points.step, rgb: unpack(points.rgb), size: innerWidth < 600 ? 1.4 : 2});
  }
  const fixed = {training: "--mapping", validation: "--validation", mapping: "--tracked"};
  const purposes = [...new Set(stills.map(purpose))];
  const truths = purposes.filter(name => !fixed[name]);
  for (const name of [...Object.keys(fixed).filter(name => purposes.includes(name)), ...truths]) {
    const mine = stills.filter(i => purpose(i) === name), xyz = [];
    for (const i of mine) frustum(xyz, centerOf(i), axesOf(i), tangentsOf(i), size);
    const color = fixed[name] || EVALUATION_COLORS[truths.indexOf(name) % EVALUATION_COLORS.length];
    add(name, color, {lines: true, xyz: new Float32Array(xyz), rgb: color, count: mine.length});
  }
  const track = (label, color, evaluation) => {
    const xyz = [];
    path(xyz, i => (frames.tracked[i] || hasPose(i)) && !!frames.evaluation[i] === evaluation && tried(i));
    if (rows.some(i => frames.tracked[i] && hasPose(i) && !!frames.evaluation[i] === evaluation))
      add(label, color, {lines: true, xyz: new Float32Array(xyz), rgb: color}, false);
  };
  track("tracked, mapping", "--tracked", false);
  track("tracked, evaluation", "--evaluation", true);
  const fixes = [], arm = 0.25 * size;
  for (const i of posed) {
    const g = frames.gnss_m.subarray(3 * i, 3 * i + 3);
    if (!Number.isFinite(g[0])) continue;
    const c = centerOf(i), d = rotated(g[0], g[1], Number.isFinite(g[2]) ? g[2] : 0);
    const f = [c[0] + d[0], c[1] + d[1], c[2] + d[2]];
    fixes.push(...c, ...f);
    for (let k = 0; k < 3; k++) {
      const e = [0, 0, 0];
      e[k] = arm;
      fixes.push(f[0] - e[0], f[1] - e[1], f[2] - e[2], f[0] + e[0], f[1] + e[1], f[2] + e[2]);
    }
  }
  add("GNSS fixes", "--gnss", {lines: true, xyz: new Float32Array(fixes), rgb: "--gnss"}, false);
  const again = [];
  for (const [e, n, u, heading, pitch] of report.again) {
    const c = shown(e, n, u);
    frustum(again, c, axesOfAngles(heading, pitch), [0.6, 0.4], 1.6 * size);
    again.push(...c, c[0], c[1], floor);
  }
  add("fly again", "--again", {lines: true, xyz: new Float32Array(again), rgb: "--again", count: report.again.length},
    !estimates.length);
  const grid = gridLines();
  add(`grid, ${grid.spacing} ${unit}`, "--skipped", {lines: true, xyz: grid.xyz, rgb: "--line"});
  if (report.units === "m") add("north", "--text", {lines: true, xyz: northLines(), rgb: "--text", });
  return made;
}

// Layers of estimates: pyramids, and lines to where the frames were. Those farther out than the view are counted.
function estimateLayers(one, size) {
  const found = {layers: [], shown: 0, far: 0};
  if (!one) return found;
  const cameras = [], joins = [];
  for (let k = 0; k < one.row.length; k++) {
    if (!one.located(k)) continue;
    const center = centerIn(one.center, k), i = one.row[k];
    if (Math.hypot(...center) > radius) { found.far++; continue; }
    found.shown++;
    frustum(cameras, center, axesIn(one.quat, k), tangentsOf(i), size);
    if (hasPose(i)) joins.push(...center, ...centerOf(i));
  }
  const layer = (label, xyz, color, count) => ({label, color, on: true, lines: true, xyz: new Float32Array(xyz), rgb: color, count});
  found.layers = [layer("estimates", cameras, "--estimate", found.shown), layer("lines to the truth", joins, "--join")];
  return found;
}

const tried = i => hasPose(i) || frames.status(i) === "failed";

// Height of the ground: a low percentile of the points.
const floor = (() => {
  if (!report.points || !report.points.shown) return posed.length ? Math.min(...stills.map(i => centerOf(i)[2])) : 0;
  const xyz = unpack(report.points.xyz), z = [];
  const every = 3 * Math.max(1, Math.floor(xyz.length / 3 / 5000));
  for (let k = 2; k < xyz.length; k += every) z.push(xyz[k] * report.points.step);
  z.sort((a, b) => a - b);
  return z[Math.floor(0.03 * z.length)];
})();

const half = radius / 1.5;  // half extent of the bulk of the map

function gridLines() {
  const spacing = roundDown(half / 4), n = Math.ceil(half / spacing), out = [];
  for (let k = -n; k <= n; k++) {
    const a = k * spacing, b = n * spacing;
    out.push(a, -b, floor, a, b, floor, -b, a, floor, b, a, floor);
  }
  return {spacing: Number(spacing.toPrecision(3)), xyz: new Float32Array(out)};
}

// An arrow beyond the northern edge of the grid; the letter N is a label at its tip.
const northTip = [0, half * 1.4, floor];

function northLines() {
  const s = half * 0.05, [x, y, z] = northTip;
  return new Float32Array([x, half * 1.1, z, ...northTip, ...northTip, x - s, y - 2 * s, z, ...northTip, x + s, y - 2 * s, z]);
}

