// The 3D view: layers of the map, and a camera that orbits a target.

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

function makeLayers(size) {
  const made = [];
  const add = (label, color, layer) => {
    if (layer.xyz.length) made.push({label, color, on: true, ...layer});
  };
  const tangents = i => report.fov[frames.camera(i)] || [0.6, 0.4];
  const cameras = (label, color, wanted) => {
    const xyz = [];
    for (const i of stills) if (wanted(i)) frustum(xyz, centerOf(i), axesOf(i), tangents(i), size);
    add(label, color, {lines: true, xyz: new Float32Array(xyz), rgb: color});
  };
  if (report.points) {
    const points = report.points;
    add("points", null, {xyz: unpack(points.xyz), step: points.step, rgb: unpack(points.rgb), size: innerWidth < 600 ? 1.4 : 2});
  }
  cameras("mapping cameras", "--mapping", i => !frames.evaluation[i]);
  const sequences = [...new Set(rows.filter(i => frames.evaluation[i]).map(i => frames.sequence(i)))];
  sequences.forEach((name, k) => cameras(`evaluation: ${name}`, EVALUATION_COLORS[k % EVALUATION_COLORS.length],
    i => frames.evaluation[i] && frames.sequence(i) === name));
  const track = (label, color, evaluation) => {
    const xyz = [];
    path(xyz, i => (frames.tracked[i] || hasPose(i)) && !!frames.evaluation[i] === evaluation && tried(i));
    if (rows.some(i => frames.tracked[i] && hasPose(i) && !!frames.evaluation[i] === evaluation))
      add(label, color, {lines: true, xyz: new Float32Array(xyz), rgb: color});
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
  add("GNSS fixes", "--gnss", {lines: true, xyz: new Float32Array(fixes), rgb: "--gnss"});
  const again = [];
  for (const [e, n, u, heading, pitch] of report.again) {
    const c = shown(e, n, u);
    frustum(again, c, axesOfAngles(heading, pitch), [0.6, 0.4], 1.6 * size);
    again.push(...c, c[0], c[1], floor);
  }
  add("fly again", "--again", {lines: true, xyz: new Float32Array(again), rgb: "--again"});
  const grid = gridLines();
  add(`grid, ${grid.spacing} ${unit}`, "--skipped", {lines: true, xyz: grid.xyz, rgb: "--line"});
  if (report.units === "m") add("north", "--text", {lines: true, xyz: northLines(), rgb: "--text", });
  return made;
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

function multiply(a, b) {
  const out = new Float32Array(16);
  for (let c = 0; c < 4; c++) for (let r = 0; r < 4; r++)
    for (let k = 0; k < 4; k++) out[4 * c + r] += a[4 * k + r] * b[4 * c + k];
  return out;
}

function makeView(onPick) {
  const canvas = document.getElementById("view");
  const drawing = glDrawing(canvas) || flatDrawing(canvas);
  if (drawing.kind === "2d")
    document.getElementById("fallback").textContent = " This browser has no WebGL: simplified drawing with fewer points.";
  const FOV = 45 * Math.PI / 180;
  const home = () => ({yaw: 0.45, pitch: 0.6, target: [0, 0, floor / 2], distance: fit()});
  const eye = {};
  let size = usualSize(), layers = makeLayers(size), marked = -1, mark = null, waiting = false;

  function fit() {
    const aspect = canvas.clientWidth / canvas.clientHeight;
    const narrow = Math.min(FOV, 2 * Math.atan(Math.tan(FOV / 2) * aspect));
    return (aspect < 1 ? 1.15 : 0.95) * half / Math.sin(narrow / 2);
  }
  const reset = pitch => Object.assign(eye, home(),
    pitch === undefined ? {} : {pitch, yaw: 0});

  function basis() {  // right, up, back of the viewer
    const [cy, sy, cp, sp] = [Math.cos(eye.yaw), Math.sin(eye.yaw), Math.cos(eye.pitch), Math.sin(eye.pitch)];
    return [[cy, sy, 0], [-sy * sp, cy * sp, cp], [sy * cp, -cy * cp, sp]];
  }

  function matrix() {
    const b = basis(), d = eye.distance, aspect = canvas.width / canvas.height, f = 1 / Math.tan(FOV / 2);
    const at = [0, 1, 2].map(k => eye.target[k] + d * b[2][k]);
    const dot = v => -(v[0] * at[0] + v[1] * at[1] + v[2] * at[2]);
    const look = new Float32Array([b[0][0], b[1][0], b[2][0], 0, b[0][1], b[1][1], b[2][1], 0,
      b[0][2], b[1][2], b[2][2], 0, dot(b[0]), dot(b[1]), dot(b[2]), 1]);
    const near = 0.02 * d, far = d + 4 * radius;
    return multiply(new Float32Array([f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) / (near - far), -1,
      0, 0, 2 * far * near / (near - far), 0]), look);
  }

  function draw() {
    waiting = false;
    const scale = window.devicePixelRatio || 1;
    const w = Math.max(1, Math.round(canvas.clientWidth * scale)), h = Math.max(1, Math.round(canvas.clientHeight * scale));
    if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
    const m = matrix();
    drawing.draw(m, [...layers.filter(l => l.on), ...(mark ? [mark] : [])], scale);
    const [x, y, depth] = onScreen(m, ...northTip), label = document.getElementById("north");
    label.hidden = depth <= 0 || x < 0 || y < 0 || x > canvas.clientWidth || y > canvas.clientHeight
      || !layers.some(l => l.label === "north" && l.on);
    label.style.transform = `translate(${x}px, ${y}px) translate(-50%, -110%)`;
  }
  const redraw = () => { if (!waiting) { waiting = true; requestAnimationFrame(draw); } };

  function legend() {
    const box = document.getElementById("legend");
    box.replaceChildren(element("summary", {}, "Layers"));
    for (const layer of layers) {
      const tick = element("input", {type: "checkbox"});
      tick.checked = layer.on;
      tick.onchange = () => { layer.on = tick.checked; redraw(); };
      const swatch = layer.color ? [element("i", {style: `background:var(${layer.color})`})] : [];
      box.append(element("label", {}, tick, ...swatch, layer.label));
    }
    const button = (text, title, act) => {
      const made = element("button", {type: "button", title}, text);
      made.onclick = () => { act(); redraw(); };
      return made;
    };
    box.append(element("div", {}, button("Reset", "Reset the view", () => reset()), " ",
      button("Top", "View from above, north up", () => reset(Math.PI / 2)), " ",
      button("\u2212", "Smaller cameras", () => resize(0.7)), " ", button("+", "Larger cameras", () => resize(1.4))));
  }

  function resize(factor) {
    const on = new Map(layers.map(l => [l.label, l.on]));
    size *= factor;
    layers = makeLayers(size);
    for (const layer of layers) layer.on = on.get(layer.label);
    pick(marked, false);
    legend();
  }

  function pick(i, center) {
    marked = i;
    mark = null;
    if (i >= 0 && hasPose(i)) {
      const xyz = [];
      frustum(xyz, centerOf(i), axesOf(i), report.fov[frames.camera(i)] || [0.6, 0.4], 2 * size);
      mark = {lines: true, xyz: new Float32Array(xyz), rgb: "--picked"};
      if (center) eye.target = centerOf(i);
    }
    redraw();
  }

  function onScreen(m, px, py, pz) {
    const w = m[3] * px + m[7] * py + m[11] * pz + m[15];
    return [(1 + (m[0] * px + m[4] * py + m[8] * pz + m[12]) / w) * canvas.clientWidth / 2,
            (1 - (m[1] * px + m[5] * py + m[9] * pz + m[13]) / w) * canvas.clientHeight / 2, w];
  }

  function nearest(x, y) {
    const m = matrix();
    let best = -1, least = 16;
    for (const i of posed) {
      const [px, py, w] = onScreen(m, ...centerOf(i));
      if (w <= 0) continue;
      const far = Math.hypot(px - x, py - y) + (frames.tracked[i] ? 4 : 0);
      if (far < least) { least = far; best = i; }
    }
    return best;
  }

  const clampPitch = () => { eye.pitch = Math.min(Math.PI / 2, Math.max(-0.3, eye.pitch)); };
  const zoom = factor => { eye.distance = Math.min(20 * radius, Math.max(0.01 * radius, eye.distance * factor)); };
  function turnBy(dx, dy) { eye.yaw -= dx * 0.006; eye.pitch += dy * 0.006; clampPitch(); }
  function moveBy(dx, dy) {
    const b = basis(), s = 2 * eye.distance * Math.tan(FOV / 2) / canvas.clientHeight;
    for (let k = 0; k < 3; k++) eye.target[k] += s * (dy * b[1][k] - dx * b[0][k]);
  }

  const fingers = new Map();
  let moved = 0;
  canvas.addEventListener("pointerdown", event => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, [event.offsetX, event.offsetY]);
    if (fingers.size === 1) moved = 0;
  });
  canvas.addEventListener("pointermove", event => {
    const was = fingers.get(event.pointerId);
    if (!was) return;
    const now = [event.offsetX, event.offsetY], dx = now[0] - was[0], dy = now[1] - was[1];
    moved += Math.abs(dx) + Math.abs(dy);
    if (fingers.size === 2) {
      const other = [...fingers].find(([id]) => id !== event.pointerId)[1];
      const span = p => Math.max(1, Math.hypot(p[0] - other[0], p[1] - other[1]));
      zoom(span(was) / span(now));
      moveBy(dx / 2, dy / 2);
    } else if (event.buttons & 2 || event.shiftKey) moveBy(dx, dy);
    else turnBy(dx, dy);
    fingers.set(event.pointerId, now);
    redraw();
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, event => {
    if (name === "pointerup" && fingers.size === 1 && moved < 6) onPick(nearest(event.offsetX, event.offsetY));
    fingers.delete(event.pointerId);
  });
  canvas.addEventListener("contextmenu", event => event.preventDefault());
  canvas.addEventListener("wheel", event => {
    if (document.activeElement !== canvas) return;  // otherwise the page could not be scrolled past the view
    event.preventDefault();
    zoom(Math.exp(event.deltaY * 0.001));
    redraw();
  }, {passive: false});
  canvas.addEventListener("keydown", event => {
    const act = {ArrowLeft: () => turnBy(-25, 0), ArrowRight: () => turnBy(25, 0), ArrowUp: () => turnBy(0, -25),
      ArrowDown: () => turnBy(0, 25), "+": () => zoom(0.8), "-": () => zoom(1.25)}[event.key];
    if (!act) return;
    event.preventDefault();
    act();
    redraw();
  });
  new ResizeObserver(redraw).observe(canvas);
  reset();
  document.getElementById("legend").open = canvas.clientWidth > 500;  // it would hide the map on a phone
  legend();
  draw();
  return {draw, redraw, pick, kind: drawing.kind, turnBy, canvas};
}
