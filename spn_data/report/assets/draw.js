// Two renderers for layers of points and lines: WebGL, and a 2D canvas as a fallback.
// Layer: {lines, xyz (Float32Array or Int16Array), step, rgb (Uint8Array per vertex, or a CSS name), size},
// or {image, xyz (of two triangles: its corners in the order of CORNERS)}, which only WebGL draws.

const VERTEX = `attribute vec3 position; attribute vec3 color; uniform mat4 matrix; uniform float step, size;
varying vec3 tint; void main() { gl_Position = matrix * vec4(position * step, 1.0); gl_PointSize = size; tint = color; }`;
const FRAGMENT = "precision mediump float; varying vec3 tint; void main() { gl_FragColor = vec4(tint, 1.0); }";

const IMAGE_VERTEX = `attribute vec3 position; attribute vec2 corner; uniform mat4 matrix; varying vec2 at;
void main() { gl_Position = matrix * vec4(position, 1.0); at = corner; }`;
const IMAGE_FRAGMENT = `precision mediump float; varying vec2 at; uniform sampler2D image;
void main() { gl_FragColor = texture2D(image, at); if (gl_FragColor.a < 0.5) discard; }`;
const CORNERS = new Float32Array([0, 0, 1, 0, 1, 1, 0, 0, 1, 1, 0, 1]);

function glProgram(gl, vertex, fragment, ...attributes) {
  const program = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  attributes.forEach((name, slot) => gl.bindAttribLocation(program, slot, name));
  gl.linkProgram(program);
  return gl.getProgramParameter(program, gl.LINK_STATUS) ? program : null;
}

function glDrawing(canvas) {
  const gl = canvas.getContext("webgl", {antialias: true, preserveDrawingBuffer: true});
  if (!gl) return null;
  const program = glProgram(gl, VERTEX, FRAGMENT, "position", "color");
  const imageProgram = glProgram(gl, IMAGE_VERTEX, IMAGE_FRAGMENT, "position", "corner");
  if (!program || !imageProgram) return null;
  const place = name => gl.getUniformLocation(program, name);
  const uniforms = {matrix: place("matrix"), step: place("step"), size: place("size")};
  const buffers = new WeakMap();

  function bind(values, slot, type, normalized, size = 3) {
    if (!buffers.has(values)) {
      buffers.set(values, gl.createBuffer());
      gl.bindBuffer(gl.ARRAY_BUFFER, buffers.get(values));
      gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
    }
    gl.bindBuffer(gl.ARRAY_BUFFER, buffers.get(values));
    gl.enableVertexAttribArray(slot);
    gl.vertexAttribPointer(slot, size, type, normalized, 0, 0);
  }

  const textures = new WeakMap();

  // An image lies below all else: what is drawn later is seen in front of it.
  function drawImage(layer, matrix) {
    if (!layer.image.complete || !layer.image.naturalWidth) return;
    gl.useProgram(imageProgram);
    gl.uniformMatrix4fv(gl.getUniformLocation(imageProgram, "matrix"), false, matrix);
    if (!textures.has(layer.image)) {
      textures.set(layer.image, gl.createTexture());
      gl.bindTexture(gl.TEXTURE_2D, textures.get(layer.image));
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, layer.image);
      for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, side, gl.CLAMP_TO_EDGE);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
    }
    gl.bindTexture(gl.TEXTURE_2D, textures.get(layer.image));
    bind(layer.xyz, 0, gl.FLOAT, false);
    bind(CORNERS, 1, gl.FLOAT, false, 2);
    gl.depthMask(false);
    gl.drawArrays(gl.TRIANGLES, 0, 6);
    gl.depthMask(true);
  }

  return {
    kind: "webgl",
    draw(matrix, layers, scale) {
      gl.viewport(0, 0, canvas.width, canvas.height);
      const back = rgb("--canvas");
      gl.clearColor(back[0] / 255, back[1] / 255, back[2] / 255, 1);
      gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
      gl.enable(gl.DEPTH_TEST);
      gl.depthFunc(gl.LEQUAL);  // a later layer is seen where it coincides: exact estimates on the truth
      for (const layer of layers) if (layer.image) drawImage(layer, matrix);
      gl.useProgram(program);
      gl.uniformMatrix4fv(uniforms.matrix, false, matrix);
      for (const layer of layers) {
        if (layer.image || !layer.xyz.length) continue;
        gl.uniform1f(uniforms.step, layer.step || 1);
        gl.uniform1f(uniforms.size, (layer.size || 2) * scale);
        bind(layer.xyz, 0, layer.xyz instanceof Int16Array ? gl.SHORT : gl.FLOAT, false);
        if (layer.rgb instanceof Uint8Array) bind(layer.rgb, 1, gl.UNSIGNED_BYTE, true);
        else {
          gl.disableVertexAttribArray(1);
          gl.vertexAttrib3f(1, ...rgb(layer.rgb).map(v => v / 255));
        }
        gl.drawArrays(layer.lines ? gl.LINES : gl.POINTS, 0, layer.xyz.length / 3);
      }
    },
  };
}

function flatDrawing(canvas) {
  const context = canvas.getContext("2d");
  const MAX_POINTS = 20000;
  const project = (m, x, y, z) => {
    const w = m[3] * x + m[7] * y + m[11] * z + m[15];
    return [(1 + (m[0] * x + m[4] * y + m[8] * z + m[12]) / w) * canvas.width / 2,
            (1 - (m[1] * x + m[5] * y + m[9] * z + m[13]) / w) * canvas.height / 2, w];
  };
  return {
    kind: "2d",
    draw(matrix, layers, scale) {
      context.fillStyle = css("--canvas");
      context.fillRect(0, 0, canvas.width, canvas.height);
      for (const layer of layers) {
        if (layer.image) continue;
        const step = layer.step || 1, n = layer.xyz.length / 3, v = layer.xyz;
        const at = k => project(matrix, v[3 * k] * step, v[3 * k + 1] * step, v[3 * k + 2] * step);
        if (layer.lines) {
          context.strokeStyle = css(layer.rgb);
          context.lineWidth = scale;
          context.beginPath();
          for (let k = 0; k + 1 < n; k += 2) {
            const a = at(k), b = at(k + 1);
            if (a[2] <= 0 || b[2] <= 0) continue;
            context.moveTo(a[0], a[1]);
            context.lineTo(b[0], b[1]);
          }
          context.stroke();
          continue;
        }
        const every = Math.max(1, Math.ceil(n / MAX_POINTS)), size = (layer.size || 2) * scale;
        for (let k = 0; k < n; k += every) {
          const [x, y, w] = at(k);
          if (w <= 0) continue;
          context.fillStyle = layer.rgb instanceof Uint8Array
            ? `rgb(${layer.rgb[3 * k]},${layer.rgb[3 * k + 1]},${layer.rgb[3 * k + 2]})` : css(layer.rgb);
          context.fillRect(x - size / 2, y - size / 2, size, size);
        }
      }
    },
  };
}
