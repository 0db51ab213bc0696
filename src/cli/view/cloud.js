// Pixels as points in space, in WebGL: each goes along its ray by its depth.

const POINT = `
attribute vec3 place;
attribute vec3 colour;
uniform mat4 view;
uniform float size;
varying vec3 seen;
void main() {
  gl_Position = view * vec4(place, 1.0);
  gl_PointSize = clamp(size / gl_Position.w, 1.5, 12.0);
  seen = colour;
}`;
const PAINT = `
precision mediump float;
varying vec3 seen;
void main() { gl_FragColor = vec4(seen, 1.0); }`;

/** Places and colours of the points of a map; what lies near its far end (the sky) is left out. */
function points({ about, values }, picture, furthest) {
  const places = [], colours = [];
  for (let y = 0; y < about.height; y++) {
    for (let x = 0; x < about.width; x++) {
      const i = y * about.width + x, depth = 1 / values[i];
      if (!(depth < furthest)) continue;
      places.push(((x - about.cx) / about.fx) * depth, ((y - about.cy) / about.fy) * depth, depth);
      colours.push(picture.data[4 * i] / 255, picture.data[4 * i + 1] / 255, picture.data[4 * i + 2] / 255);
    }
  }
  return { places: new Float32Array(places), colours: new Float32Array(colours), count: places.length / 3 };
}

function shader(gl, kind, source) {
  const made = gl.createShader(kind);
  gl.shaderSource(made, source);
  gl.compileShader(made);
  if (!gl.getShaderParameter(made, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(made));
  return made;
}

/** The product of two matrices, columns first. */
function times(a, b) {
  const out = new Float32Array(16);
  for (let c = 0; c < 4; c++)
    for (let r = 0; r < 4; r++)
      for (let k = 0; k < 4; k++) out[4 * c + r] += a[4 * k + r] * b[4 * c + k];
  return out;
}

/**
 * Shows the points of a map on a canvas, to be turned. Throws an error if there is no WebGL.
 * Returns a function that shows another map and keeps the view.
 */
export function cloud(canvas, map, picture) {
  const gl = canvas.getContext("webgl", { antialias: true, preserveDrawingBuffer: true });
  if (!gl) throw new Error("this browser has no WebGL: points cannot be shown; parallax predict --ply writes them to a file");
  const program = gl.createProgram();
  gl.attachShader(program, shader(gl, gl.VERTEX_SHADER, POINT));
  gl.attachShader(program, shader(gl, gl.FRAGMENT_SHADER, PAINT));
  gl.linkProgram(program);
  gl.useProgram(program);
  const view = gl.getUniformLocation(program, "view"), size = gl.getUniformLocation(program, "size");
  const buffers = { place: gl.createBuffer(), colour: gl.createBuffer() };
  let count = 0, pivot = 10, fx = 1, wide = 1;
  let turn = { yaw: 0, pitch: 0, away: 0 };

  const load = (map, picture) => {
    const inverse = Float32Array.from(map.values).sort();
    // Sorted from far to near.
    const furthest = 0.85 / inverse[0];
    pivot = 1 / inverse[Math.floor(0.8 * inverse.length)];
    const found = points(map, picture, furthest);
    for (const [name, data] of [["place", found.places], ["colour", found.colours]]) {
      gl.bindBuffer(gl.ARRAY_BUFFER, buffers[name]);
      gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
      const at = gl.getAttribLocation(program, name);
      gl.enableVertexAttribArray(at);
      gl.vertexAttribPointer(at, 3, gl.FLOAT, false, 0, 0);
    }
    [count, fx, wide] = [found.count, map.about.fx / map.about.width, map.about.width];
    draw();
  };

  const draw = () => {
    const ratio = window.devicePixelRatio || 1;
    canvas.width = Math.round(canvas.clientWidth * ratio);
    canvas.height = Math.round(canvas.clientHeight * ratio);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(0.09, 0.1, 0.11, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    // x right, y down, z forward, as the camera has it; clip space has y up.
    const near = pivot / 200, far = pivot * 100, zoom = 2 * fx;
    const aspect = canvas.width / canvas.height;
    const project = [zoom, 0, 0, 0, 0, -zoom * aspect, 0, 0, 0, 0, (far + near) / (far - near), 1, 0, 0, (-2 * far * near) / (far - near), 0];
    const [cy, sy, cp, sp] = [Math.cos(turn.yaw), Math.sin(turn.yaw), Math.cos(turn.pitch), Math.sin(turn.pitch)];
    // About the pivot ahead of the camera, then away from it.
    const back = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, -pivot, 1];
    const yaw = [cy, 0, -sy, 0, 0, 1, 0, 0, sy, 0, cy, 0, 0, 0, 0, 1];
    const pitch = [1, 0, 0, 0, 0, cp, sp, 0, 0, -sp, cp, 0, 0, 0, 0, 1];
    const forth = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, pivot * (1 + turn.away), 1];
    gl.uniformMatrix4fv(view, false, times(project, times(forth, times(pitch, times(yaw, back)))));
    gl.uniform1f(size, (1.6 * pivot * canvas.width) / wide);
    gl.drawArrays(gl.POINTS, 0, count);
  };

  const change = (yaw, pitch, away) => {
    turn.yaw += yaw;
    turn.pitch = Math.max(-1.4, Math.min(1.4, turn.pitch + pitch));
    turn.away = Math.max(-0.9, Math.min(4, turn.away + away));
    draw();
  };
  // One finger or the mouse turns, two fingers come nearer.
  const fingers = new Map();
  canvas.addEventListener("pointerdown", (e) => {
    canvas.setPointerCapture(e.pointerId);
    fingers.set(e.pointerId, [e.clientX, e.clientY]);
  });
  for (const gone of ["pointerup", "pointercancel"]) canvas.addEventListener(gone, (e) => fingers.delete(e.pointerId));
  canvas.addEventListener("pointermove", (e) => {
    const before = fingers.get(e.pointerId);
    if (!before) return;
    const apart = () => {
      const [a, b] = [...fingers.values()];
      return Math.hypot(a[0] - b[0], a[1] - b[1]);
    };
    const distance = fingers.size === 2 ? apart() : 0;
    fingers.set(e.pointerId, [e.clientX, e.clientY]);
    if (fingers.size === 2) change(0, 0, (distance - apart()) / 200);
    else change((before[0] - e.clientX) / 400, (e.clientY - before[1]) / 400, 0);
  });
  canvas.addEventListener("wheel", (e) => {
    e.preventDefault();
    change(0, 0, Math.sign(e.deltaY) * 0.08);
  }, { passive: false });
  const keys = { ArrowLeft: [0.08, 0, 0], ArrowRight: [-0.08, 0, 0], ArrowUp: [0, -0.08, 0], ArrowDown: [0, 0.08, 0], "+": [0, 0, -0.1], "=": [0, 0, -0.1], "-": [0, 0, 0.1] };
  canvas.addEventListener("keydown", (e) => {
    if (e.key === "0") turn = { yaw: 0, pitch: 0, away: 0 };
    else if (!keys[e.key]) return;
    e.preventDefault();
    change(...(keys[e.key] || [0, 0, 0]));
  });
  new ResizeObserver(draw).observe(canvas);
  load(map, picture);
  return load;
}
