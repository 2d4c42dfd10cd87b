// Data of the page: typed arrays, and the transformation from the world to the view (z up, centred).
const report = JSON.parse(document.getElementById("data").textContent);
const KINDS = {f4: Float32Array, i2: Int16Array, i4: Int32Array, u1: Uint8Array};

function unpack(packed) {
  const text = atob(packed.base64), bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return new KINDS[packed.kind](bytes.buffer);
}

// Columns of the frame table: typed arrays, or functions of the row for texts.
const frames = {count: report.frames.count, name: i => report.frames.name[i]};
for (const [column, value] of Object.entries(report.frames)) {
  if (value.base64 !== undefined) frames[column] = unpack(value);
  else if (value.texts) {
    const which = unpack(value.which);
    frames[column] = i => value.texts[which[i]];
  }
}
const unit = report.units === "m" ? "m" : "units";
const turn = report.display.rotation, middle = report.display.center, radius = report.display.radius;

function rotated(x, y, z) {
  return [turn[0] * x + turn[1] * y + turn[2] * z, turn[3] * x + turn[4] * y + turn[5] * z,
          turn[6] * x + turn[7] * y + turn[8] * z];
}

function shown(x, y, z) { return rotated(x - middle[0], y - middle[1], z - middle[2]); }

const hasPose = i => frames.status(i) === "registered";
const centerIn = (centers, k) => shown(centers[3 * k], centers[3 * k + 1], centers[3 * k + 2]);
const centerOf = i => centerIn(frames.center, i);

// Rotation from camera axes (x right, y down, z forward) to the shown world, from a quaternion w, x, y, z.
function axesIn(quats, k) {
  const [w, x, y, z] = quats.subarray(4 * k, 4 * k + 4);
  const rows = [[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]];
  return rows.map(row => rotated(...row));
}
const axesOf = i => axesIn(frames.quat, i);

// The same for a camera with a heading and pitch in degrees, in an East-North-Up world.
function axesOfAngles(heading, pitch) {
  const h = heading * Math.PI / 180, p = pitch * Math.PI / 180;
  const forward = [Math.sin(h) * Math.cos(p), Math.cos(h) * Math.cos(p), Math.sin(p)];
  const right = [Math.cos(h), -Math.sin(h), 0];
  const down = [forward[1] * right[2] - forward[2] * right[1], forward[2] * right[0] - forward[0] * right[2],
                forward[0] * right[1] - forward[1] * right[0]];
  return [right, down, forward];
}

function roundDown(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return [5, 2, 1].find(m => m * power <= value * (1 + 1e-9)) * power;
}

function element(tag, attributes = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  node.append(...children);
  return node;
}

const css = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const rgb = name => [1, 3, 5].map(k => parseInt(css(name).slice(k, k + 2), 16));
const figure = (value, digits) => Number.isFinite(value) ? value.toFixed(digits) : "\u2013";
