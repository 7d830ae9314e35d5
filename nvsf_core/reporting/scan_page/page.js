// Draws the points of one instant, recorded on the left and synthetic on the right, seen by one camera.
"use strict";

const facts = JSON.parse(document.getElementById("facts").textContent);
const element = (name) => document.getElementById(name);
const canvas = element("canvas");
const gl = canvas.getContext("webgl2", { antialias: false });
const MODES = ["intensity", "support", "error"];
const SIDES = ["recorded", "synthetic"];
// Metres and radians: where the camera looks, and from where. The sensor is at the origin, x forward, z up.
const camera = { target: [6, 0, -1], distance: 34, yaw: Math.PI, pitch: 0.55 };

const VERTEX = `#version 300 es
in vec3 place; in float intensity; in float support; in float error;
uniform vec3 low_m; uniform vec3 size_m; uniform mat4 to_clip; uniform float point_px; uniform int mode;
uniform sampler2D palette;
out vec3 colour;
void main() {
  gl_Position = to_clip * vec4(low_m + place * size_m, 1.0);
  gl_PointSize = clamp(point_px * 30.0 / max(gl_Position.w, 0.1), 1.0, 3.0 * point_px);
  float level = mode == 0 ? intensity : mode == 1 ? support : error;
  colour = texelFetch(palette, ivec2(int(level * 255.0 + 0.5), mode), 0).rgb;
}`;
const FRAGMENT = `#version 300 es
precision mediump float;
in vec3 colour; out vec4 shown;
void main() { shown = vec4(colour, 1.0); }`;

function decoded(text) {
  const raw = atob(text.trim());
  const bytes = new Uint8Array(raw.length);
  for (let k = 0; k < raw.length; k += 1) bytes[k] = raw.charCodeAt(k);
  return bytes;
}

function compiled() {
  const program = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
  return program;
}

// The file holds, of all points: x, y, z as 16 bits each, then intensity, support and error as a byte each.
function uploaded(program) {
  const bytes = decoded(element("points").textContent);
  const count = bytes.length / 9;
  let offset = 0;
  for (const [name, parts, kind, width] of [
    ["place", 3, gl.UNSIGNED_SHORT, 2], ["intensity", 1, gl.UNSIGNED_BYTE, 1],
    ["support", 1, gl.UNSIGNED_BYTE, 1], ["error", 1, gl.UNSIGNED_BYTE, 1],
  ]) {
    const length = count * parts * width;
    const where = gl.getAttribLocation(program, name);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, bytes.subarray(offset, offset + length), gl.STATIC_DRAW);
    gl.enableVertexAttribArray(where);
    gl.vertexAttribPointer(where, parts, kind, true, 0, 0);
    offset += length;
  }
  gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  const palette = new Uint8Array(MODES.flatMap((mode) => facts.palettes[mode].flat()));
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB8, 256, 3, 0, gl.RGB, gl.UNSIGNED_BYTE, palette);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
}

const minus = (a, b) => a.map((value, k) => value - b[k]);
const dot = (a, b) => a.reduce((sum, value, k) => sum + value * b[k], 0);
const unit = (a) => a.map((value) => value / Math.hypot(...a));
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

function axes() {
  const { yaw, pitch } = camera;
  const back = [Math.cos(yaw) * Math.cos(pitch), Math.sin(yaw) * Math.cos(pitch), Math.sin(pitch)];
  const right = unit(cross([0, 0, 1], back));
  return { back, right, up: cross(back, right) };
}

// The 4 x 4 matrix from metres to the picture, column by column as WebGL takes it.
function toClip(aspect) {
  const { back, right, up } = axes();
  const eye = camera.target.map((value, k) => value + camera.distance * back[k]);
  const near = 0.2, far = 600, scale = 1 / Math.tan(0.45);
  const rows = [right.map((v) => v * scale / aspect), up.map((v) => v * scale), back];
  const shift = rows.map((row) => -dot(row, eye));
  const depth = (near + far) / (near - far), depthShift = 2 * near * far / (near - far);
  const matrix = [];
  for (let k = 0; k < 3; k += 1) matrix.push(rows[0][k], rows[1][k], rows[2][k] * depth, -rows[2][k]);
  return [...matrix, shift[0], shift[1], shift[2] * depth + depthShift, -shift[2]];
}

function draw() {
  const ratio = window.devicePixelRatio || 1;
  canvas.width = Math.max(2, Math.round(canvas.clientWidth * ratio));
  canvas.height = Math.max(2, Math.round(canvas.clientHeight * ratio));
  gl.disable(gl.SCISSOR_TEST);
  gl.clearColor(0.063, 0.078, 0.102, 1);
  gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  const instant = facts.instants[Number(element("instant").value)];
  const shown = element("shown").value;
  const sides = SIDES.filter((side) => shown === "both" || shown === side);
  const width = Math.floor(canvas.width / sides.length);
  gl.uniformMatrix4fv(uniform.to_clip, false, toClip(width / canvas.height));
  gl.uniform1f(uniform.point_px, Number(element("size").value) * ratio);
  gl.uniform1i(uniform.mode, MODES.indexOf(element("mode").value));
  sides.forEach((side, column) => {
    gl.viewport(column * width, 0, width, canvas.height);
    gl.drawArrays(gl.POINTS, ...instant[side]);
  });
  tell(instant, sides);
}

function tell(instant, sides) {
  element("left").hidden = shownAlone(sides, "synthetic");
  element("right").hidden = shownAlone(sides, "recorded");
  element("left").textContent = instant.recorded[1] ? `recorded, frame ${instant.frame}` : "not recorded";
  element("right").style.left = sides.length === 2 ? "calc(50% + 12px)" : "12px";
  const counts = sides.map((side) => `${instant[side][1].toLocaleString("en")} points ${side}`);
  element("status").textContent = `${instant.time_s.toFixed(2)} s, ${counts.join(", ")}`;
}

const shownAlone = (sides, side) => sides.length === 1 && sides[0] === side;

function legend() {
  const mode = element("mode").value;
  const colour = (level) => `rgb(${facts.palettes[mode][level].join(",")})`;
  const place = element("legend");
  place.replaceChildren();
  if (mode === "support") {
    facts.supports.forEach((words, level) => {
      place.append(swatch("", colour(level)), words);
    });
    return;
  }
  const steps = [0, 51, 102, 153, 204, 255].map(colour).join(",");
  const [low, high] = facts.scales[mode];
  place.append(low, swatch("scale", `linear-gradient(90deg,${steps})`), high);
}

function swatch(kind, background) {
  const mark = document.createElement("i");
  mark.className = kind;
  mark.style.background = background;
  return mark;
}

let asked = false;
function redraw() {
  if (asked) return;
  asked = true;
  requestAnimationFrame(() => { asked = false; draw(); });
}

function steer() {
  let held = null;
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("pointerdown", (event) => {
    held = [event.clientX, event.clientY];
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointerup", () => { held = null; });
  canvas.addEventListener("pointermove", (event) => {
    if (!held) return;
    const [dx, dy] = [event.clientX - held[0], event.clientY - held[1]];
    held = [event.clientX, event.clientY];
    if (event.buttons === 2 || event.shiftKey) {
      const { right, up } = axes();
      const step = camera.distance / canvas.clientHeight;
      camera.target = camera.target.map((value, k) => value + step * (dy * up[k] - dx * right[k]));
    } else {
      camera.yaw -= 0.006 * dx;
      camera.pitch = Math.min(1.5, Math.max(-0.3, camera.pitch + 0.006 * dy));
    }
    redraw();
  });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    camera.distance = Math.min(300, Math.max(1, camera.distance * Math.exp(0.001 * event.deltaY)));
    redraw();
  }, { passive: false });
}

function play() {
  let timer = null;
  element("play").addEventListener("click", () => {
    if (timer !== null) {
      clearInterval(timer);
      timer = null;
    } else {
      const slider = element("instant");
      timer = setInterval(() => {
        slider.value = (Number(slider.value) + 1) % facts.instants.length;
        redraw();
      }, 250);
    }
    element("play").textContent = timer === null ? "play" : "stop";
  });
}

// `#instant=3&mode=error&shown=synthetic` opens the page as a link says.
function followLink() {
  for (const [name, value] of new URLSearchParams(location.hash.slice(1))) {
    if (["instant", "mode", "shown", "size"].includes(name)) element(name).value = value;
  }
}

let uniform = {};
if (gl === null) {
  element("status").textContent = "This browser has no WebGL 2, which draws the points.";
} else {
  const program = compiled();
  gl.useProgram(program);
  gl.enable(gl.DEPTH_TEST);
  uploaded(program);
  for (const name of ["low_m", "size_m", "to_clip", "point_px", "mode"]) {
    uniform[name] = gl.getUniformLocation(program, name);
  }
  gl.uniform3fv(uniform.low_m, facts.low_m);
  gl.uniform3fv(uniform.size_m, facts.size_m);
  element("instant").max = facts.instants.length - 1;
  followLink();
  for (const name of ["instant", "shown", "size"]) element(name).addEventListener("input", redraw);
  element("mode").addEventListener("input", () => { legend(); redraw(); });
  window.addEventListener("resize", redraw);
  steer();
  play();
  legend();
  draw();
}
