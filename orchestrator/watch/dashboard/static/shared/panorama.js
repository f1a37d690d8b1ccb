// A panorama in perspective from its centre: a small WebGL shader that samples the picture along the ray of each pixel.
// The picture is the render above the photograph; the render is shown left of the split, the photograph right of it.

const VERTEX = "attribute vec2 corner; void main() { gl_Position = vec4(corner, 0.0, 1.0); }";
const FRAGMENT = `
precision highp float;
uniform sampler2D picture;
uniform vec2 size;      // of the canvas, pixels
uniform vec2 angles;      // yaw and pitch, radians
uniform float focal;    // half the width of the canvas at distance 1
uniform float split;    // 0 to 1
uniform float part;     // height of one of the two pictures in the whole
const float PI = 3.14159265358979;
void main() {
  vec2 p = (gl_FragCoord.xy - 0.5 * size) / (0.5 * size.x);
  vec3 ray = vec3(p, focal);
  ray = vec3(ray.x, ray.y * cos(angles.y) + ray.z * sin(angles.y), ray.z * cos(angles.y) - ray.y * sin(angles.y));
  float u = fract(0.5 + (atan(ray.x, ray.z) + angles.x) / (2.0 * PI));
  float v = 0.5 - asin(clamp(normalize(ray).y, -1.0, 1.0)) / PI;
  bool photo = gl_FragCoord.x > split * size.x;
  // Half a texel from the edge, so that one picture does not bleed into the other.
  v = clamp(v, 0.002, 0.998) * part;
  gl_FragColor = texture2D(picture, vec2(u, photo ? 1.0 - part + v : v));
}`;
const STEP = Math.PI / 24; // of one arrow key
const PITCH = Math.PI / 2;
const FOCAL = [0.35, 4]; // widest and narrowest

/** @param {WebGLRenderingContext} gl */
function program(gl) {
  const made = gl.createProgram();
  for (const [kind, text] of /** @type {const} */ ([
    [gl.VERTEX_SHADER, VERTEX],
    [gl.FRAGMENT_SHADER, FRAGMENT],
  ])) {
    const shader = /** @type {WebGLShader} */ (gl.createShader(kind));
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  gl.useProgram(made);
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([-1, -1, 3, -1, -1, 3]), gl.STATIC_DRAW);
  gl.enableVertexAttribArray(0);
  gl.vertexAttribPointer(gl.getAttribLocation(made, "corner"), 2, gl.FLOAT, false, 0, 0);
  return made;
}

/** @typedef {HTMLImageElement | HTMLCanvasElement} Picture */

/** @param {WebGLRenderingContext} gl @param {Picture} image */
function upload(gl, image) {
  gl.bindTexture(gl.TEXTURE_2D, gl.getParameter(gl.TEXTURE_BINDING_2D) ?? gl.createTexture());
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB, gl.RGB, gl.UNSIGNED_BYTE, image);
  for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, side, gl.CLAMP_TO_EDGE);
  for (const way of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, way, gl.LINEAR);
}

/**
 * A canvas with a perspective view, moved by drag, arrow keys, plus and minus.
 * @param {HTMLElement} splitter the slider of the split, which is moved below the canvas
 */
export function panorama(splitter) {
  const canvas = document.createElement("canvas");
  canvas.tabIndex = 0;
  canvas.setAttribute("role", "application");
  canvas.setAttribute("aria-label", "360° view: drag or use the arrow keys to turn, plus and minus to zoom");
  const gl = canvas.getContext("webgl", { antialias: false, preserveDrawingBuffer: true });
  const made = gl && program(gl);
  /** @type {{yaw: number, pitch: number, focal: number, split: number, shown: boolean, image: Picture | null, part: number, waiting: boolean}} */
  const view = { yaw: 0, pitch: 0, focal: 0.8, split: 0.5, shown: false, image: null, part: 0.5, waiting: false };

  function paint() {
    view.waiting = false;
    if (!gl || !made || !view.shown || !view.image) return;
    /** @param {string} name */
    const at = (name) => gl.getUniformLocation(made, name);
    const scale = Math.min(window.devicePixelRatio || 1, 2);
    const [width, height] = [Math.round(canvas.clientWidth * scale), Math.round(canvas.clientHeight * scale)];
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    gl.viewport(0, 0, width, height);
    gl.uniform2f(at("size"), width, height);
    gl.uniform2f(at("angles"), view.yaw, view.pitch);
    gl.uniform1f(at("focal"), view.focal);
    gl.uniform1f(at("split"), view.split);
    gl.uniform1f(at("part"), view.part);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    canvas.dataset.angles = `${view.yaw.toFixed(3)} ${view.pitch.toFixed(3)} ${view.focal.toFixed(3)}`;
  }

  function repaint() {
    if (!view.waiting) requestAnimationFrame(paint);
    view.waiting = true;
  }

  /** @param {number} yaw radians @param {number} pitch radians */
  function turn(yaw, pitch) {
    view.yaw += yaw;
    view.pitch = Math.min(Math.max(view.pitch + pitch, -PITCH), PITCH);
    repaint();
  }

  /** @param {number} factor */
  function zoom(factor) {
    view.focal = Math.min(Math.max(view.focal * factor, FOCAL[0]), FOCAL[1]);
    repaint();
  }

  canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
  canvas.addEventListener("pointermove", (event) => {
    if (!canvas.hasPointerCapture(event.pointerId)) return;
    const scale = 2 / (view.focal * canvas.clientWidth); // what is under the pointer stays there
    turn(-event.movementX * scale, event.movementY * scale);
  });
  canvas.addEventListener("keydown", (event) => {
    /** @type {Record<string, () => void>} */
    const keys = {
      ArrowLeft: () => turn(-STEP, 0),
      ArrowRight: () => turn(STEP, 0),
      ArrowUp: () => turn(0, STEP),
      ArrowDown: () => turn(0, -STEP),
      "+": () => zoom(1.2),
      "=": () => zoom(1.2),
      "-": () => zoom(1 / 1.2),
    };
    if (!keys[event.key]) return;
    event.preventDefault();
    keys[event.key]();
  });
  canvas.addEventListener("webglcontextrestored", () => location.reload());
  new ResizeObserver(repaint).observe(canvas);
  canvas.hidden = true;

  return {
    canvas,
    possible: Boolean(gl),
    /** @param {boolean} on */
    show(on) {
      view.shown = on && Boolean(gl);
      canvas.hidden = !view.shown;
      splitter.classList.toggle("low", view.shown); // so that the canvas can be dragged
      repaint();
    },
    /** @param {number} share left of the split, 0 to 1 */
    split(share) {
      view.split = share;
      repaint();
    },
    /** Shows an image once it has loaded. @param {Picture} image */
    load(image) {
      const loaded = image instanceof HTMLImageElement;
      if (!gl || (loaded && (!image.complete || !image.naturalWidth))) return;
      view.image = image;
      view.part = (loaded ? image.naturalWidth / image.naturalHeight : image.width / image.height) / 2; // there may be a line between the two
      upload(gl, image);
      repaint();
    },
  };
}
