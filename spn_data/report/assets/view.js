// The 3D view: layers of the map, and a camera that orbits a target.

function multiply(a, b) {
  const out = new Float32Array(16);
  for (let c = 0; c < 4; c++) for (let r = 0; r < 4; r++)
    for (let k = 0; k < 4; k++) out[4 * c + r] += a[4 * k + r] * b[4 * c + k];
  return out;
}

function makeView(onPick, onEstimates) {
  const canvas = document.getElementById("view");
  const drawing = glDrawing(canvas) || flatDrawing(canvas);
  if (drawing.kind === "2d")
    document.getElementById("fallback").textContent = " This browser has no WebGL: simplified drawing with fewer points.";
  const FOV = 45 * Math.PI / 180;
  const home = () => ({yaw: 0.45, pitch: 0.6, target: [0, 0, floor / 2], distance: fit()});
  const eye = {};
  let size = usualSize(), layers = makeLayers(size), guessed = estimateLayers(chosenEstimates, size);
  let marked = -1, mark = null, waiting = false;
  const all = () => [...layers, ...guessed.layers];

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
    drawing.draw(m, [...all().filter(l => l.on), ...(mark ? [mark] : [])], scale);
    const [x, y, depth] = onScreen(m, ...northTip), label = document.getElementById("north");
    label.hidden = depth <= 0 || x < 0 || y < 0 || x > canvas.clientWidth || y > canvas.clientHeight
      || !layers.some(l => l.label === "north" && l.on);
    label.style.transform = `translate(${x}px, ${y}px) translate(-50%, -110%)`;
  }
  const redraw = () => { if (!waiting) { waiting = true; requestAnimationFrame(draw); } };

  function legend() {
    const box = document.getElementById("legend");
    box.replaceChildren(element("summary", {}, "Layers"));
    if (estimates.length) box.append(choice());
    for (const layer of all()) {
      const tick = element("input", {type: "checkbox"});
      tick.checked = layer.on;
      tick.onchange = () => { layer.on = tick.checked; redraw(); };
      const swatch = layer.color ? [element("i", {style: `background:var(${layer.color})`})] : [];
      const count = layer.count === undefined ? [] : [element("small", {}, ` (${layer.count.toLocaleString("en")})`)];
      box.append(element("label", {}, tick, ...swatch, element("span", {}, layer.label, ...count)));
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

  // The choice of a run and of the network alone or fixes.
  function choice() {
    const select = element("select", {id: "estimates", "aria-label": "Estimates"});
    estimates.forEach((one, k) => select.append(element("option", {value: k}, one.label)));
    select.append(element("option", {value: -1}, "no estimates"));
    select.value = estimates.indexOf(chosenEstimates);
    select.onchange = () => {
      chosenEstimates = estimates[select.value] || null;
      build();
      onEstimates();
    };
    return select;
  }

  function resize(factor) {
    size *= factor;
    build();
  }

  function build() {
    const on = new Map(all().map(l => [l.label, l.on]));
    layers = makeLayers(size);
    guessed = estimateLayers(chosenEstimates, size);
    for (const layer of all()) if (on.has(layer.label)) layer.on = on.get(layer.label);
    pick(marked, false);
    legend();
    describeEstimates();
  }

  function describeEstimates() {
    if (!chosenEstimates) { document.getElementById("estimated").textContent = ""; return; }
    const n = chosenEstimates.row.length, none = n - guessed.shown - guessed.far;
    document.getElementById("estimated").textContent = `${chosenEstimates.label}: ${guessed.shown} estimates of ${n} frames are drawn`
      + (none ? `; frames without an estimate: ${none}` : "")
      + (guessed.far ? `; farther out than the view: ${guessed.far}` : "")
      + ". Estimates are red, and joined to where the frame was. Those of training images are left out.";
  }

  function pick(i, center) {
    marked = i;
    mark = null;
    if (i >= 0 && hasPose(i)) {
      const xyz = [], k = chosenEstimates ? chosenEstimates.of.get(i) : undefined;
      frustum(xyz, centerOf(i), axesOf(i), tangentsOf(i), 2 * size);
      if (k !== undefined && chosenEstimates.located(k)) {
        const center = centerIn(chosenEstimates.center, k);
        frustum(xyz, center, axesIn(chosenEstimates.quat, k), tangentsOf(i), 2 * size);
        xyz.push(...center, ...centerOf(i));
      }
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
    const ask = (i, center, more) => {
      const [px, py, w] = onScreen(m, ...center), far = Math.hypot(px - x, py - y) + more;
      if (w > 0 && far < least) { least = far; best = i; }
    };
    for (const i of posed) ask(i, centerOf(i), frames.tracked[i] ? 4 : 0);
    if (chosenEstimates)
      chosenEstimates.row.forEach((i, k) => { if (chosenEstimates.located(k)) ask(i, centerIn(chosenEstimates.center, k), 2); });
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
  groundImage.onload = redraw;
  reset();
  document.getElementById("legend").open = canvas.clientWidth > 500;  // it would hide the map on a phone
  legend();
  describeEstimates();
  draw();
  // Where a frame and its estimate are on the canvas, for tests.
  function placeOf(name) {
    const i = rows.find(k => frames.name(k) === name), m = matrix(), k = chosenEstimates && chosenEstimates.of.get(i);
    return {truth: onScreen(m, ...centerOf(i)), estimate: chosenEstimates && onScreen(m, ...centerIn(chosenEstimates.center, k))};
  }
  return {draw, redraw, pick, kind: drawing.kind, turnBy, canvas, placeOf};
}
