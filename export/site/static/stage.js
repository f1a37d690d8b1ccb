// The engine: loads the model, draws it only when something has changed, and keeps its cost within what the machine
// can do.

import * as pc from "./engine.js";
import { ALL, DEPTH, KEPT, volume } from "./shaders.js";

const FOV = 85; // degrees along the longer side of the window
const BUDGET = matchMedia("(pointer: coarse)").matches ? 800_000 : 2_000_000; // Gaussians that are drawn of a streamed model
const FIRST = 500_000; // of them until it is known how fast the machine is
const LEAST = 150_000; // of them, however slow the machine is
const SLOW = 90,
  QUICK = 35; // ms of a frame while the view moves: above, less is drawn; below, more again
const FRAMES = 5; // that are averaged
const REST = 220; // ms without movement after which a picture is drawn in full resolution
const SOLID = 100; // of 255: opacity from which on there is something that can be pointed at
const REACH = [0.05, 2000]; // steps in which what is pointed at is searched
const COARSEST = 0.4; // pixels of the picture for one of the screen

/** @typedef {import("./flight.js").Flight} Flight @typedef {import("./page.js").Page} Page @typedef {import("./page.js").Point} Point */

/** The page cannot be drawn here; the message is for the user. */
export class StageError extends Error {}

export class Stage {
  /** @param {HTMLCanvasElement} canvas @param {pc.GraphicsDevice} device */
  constructor(canvas, device) {
    const options = new pc.AppOptions();
    options.graphicsDevice = device;
    options.componentSystems = [pc.RenderComponentSystem, pc.CameraComponentSystem, pc.GSplatComponentSystem];
    options.resourceHandlers = [pc.TextureHandler, pc.GSplatHandler];
    const app = new pc.AppBase(canvas);
    app.init(options);
    app.setCanvasFillMode(pc.FILLMODE_NONE);
    app.setCanvasResolution(pc.RESOLUTION_AUTO);
    app.autoRender = true; // until the first picture is there
    this.app = app;
    this.canvas = canvas;
    this.camera = new pc.Entity("camera");
    this.camera.addComponent("camera", {
      clearColor: new pc.Color(0.05, 0.063, 0.082),
      fov: FOV,
      toneMapping: pc.TONEMAP_NONE,
      gammaCorrection: pc.GAMMA_SRGB,
    });
    app.root.addChild(this.camera);
    const splats = app.scene.gsplat;
    splats.radialSorting = true; // as our renderer does; and turning needs no new order
    splats.minContribution = 1;
    splats.minPixelSize = 0;
    splats.colorUpdateAngle = 2;
    splats.lodBehindPenalty = 4;
    splats.splatBudget = FIRST;
    /** Called after each picture. @type {(() => void)[]} */
    this.onDrawn = [];
    const chunks = splats.material.getShaderChunks(pc.SHADERLANGUAGE_GLSL);
    chunks.set("gsplatModifyPS", DEPTH);
    chunks.set("gsplatModifyVS", KEPT);
    splats.material.shaderChunksVersion = "2.8";
    splats.material.update();
    this._depths = device.scope.resolve("uDepths"); // of the device: a parameter of the material compiles its shaders anew
    this._depths.setValue([0, 0, 0, 0]);
    this._kept = device.scope.resolve("uKept");
    this._kept.setValue(ALL);
    this._limits = device.scope.resolve("uLimits");
    this._limits.setValue([0, 0]);
    this._near = device.scope.resolve("uNear");
    this._field = device.scope.resolve("uField");
    this.everywhere = volume(device, 1, new Uint8Array([255]));
    this._step = 1;
    /** What is around the view, and not of the model. @type {pc.Entity[]} */
    this.backdrops = [];
    /** @type {pc.GSplatComponent | null} */
    this.model = null;
    /** What is drawn of it. @type {{ entity: pc.Entity, asset: pc.Asset } | null} */
    this._shown = null;
    /** @type {number[]} */
    this._times = [];
    this._moved = this._ticked = 0;
    this.drawn = false;
    this._detail = COARSEST; // of the first picture
    this._busyDetail = 1; // while the view moves or gets finer
    this.loading = 0;
    new ResizeObserver(() => this.fit()).observe(canvas);
    app.on("postrender", () => {
      this.drawn = true;
      for (const call of this.onDrawn) call();
    });
    app.systems.gsplat.on("frame:request", () => this.draw());
    this.keepNear(ALL, this.everywhere);
    app.start();
    this.fit();
  }

  /** Draws as soon as possible. */
  draw() {
    this.app.renderNextFrame = true;
  }

  /** Fits the picture to the window and the screen. */
  fit() {
    const { app, canvas } = this;
    const full = Math.min(window.devicePixelRatio || 1, 2);
    const ratio = this._detail === 1 ? full : Math.max(COARSEST, this._detail);
    app.graphicsDevice.maxPixelRatio = Math.min(full, ratio);
    const width = Math.max(1, Math.round(canvas.clientWidth * Math.min(full, ratio))),
      height = Math.max(1, Math.round(canvas.clientHeight * Math.min(full, ratio)));
    if (canvas.width !== width || canvas.height !== height) app.graphicsDevice.setResolution(width, height);
    const camera = /** @type {pc.CameraComponent} */ (this.camera.camera);
    camera.horizontalFov = canvas.clientWidth > canvas.clientHeight;
    this.draw();
  }

  /** @param {Flight} flight  Moves the camera there. */
  follow(flight) {
    this.camera.setPosition(...flight.position);
    this.camera.setEulerAngles(flight.pitch, flight.yaw, 0);
    this._moved = performance.now();
    this.draw();
  }

  /**
   * Loads the model. Resolves at its first picture; a streamed one is coarse then, and gets finer.
   * @param {string} url @param {ArrayBuffer | null} contents  of a .sog, null to fetch it
   * @param {(share: number) => void} progress
   * @param {() => void} known  called when the bounds of the model are known, before the first picture
   */
  async load(url, contents, progress, known) {
    const { app } = this;
    const model = await this._add(url, contents, progress);
    const levels = model.resource?.octree?.lodLevels ?? 0;
    if (levels) {
      model.lodRangeMin = model.lodRangeMax = levels - 1; // all of the place first
    }
    known();
    await this._first(levels > 0);
    model.lodRangeMin = Math.max(0, levels - 2);
    app.autoRender = false;
    this.loading = levels > 1 ? 1 : 0;
    app.on("update", () => this._adapt());
    app.systems.gsplat.on(
      "frame:ready",
      (
        /** @type {unknown} */ _,
        /** @type {unknown} */ __,
        /** @type {boolean} */ ready,
        /** @type {number} */ loading,
      ) => {
        this.loading = ready ? loading : Math.max(1, loading);
        if (this.loading || !this.model?.lodRangeMin) return;
        this.model.lodRangeMin -= 1; // one level after the other: what is near is soon better, and the best comes last
        this.loading = 1;
        this.draw();
      },
    );
    this.draw();
  }

  /** Shows another model in place of the one that is there, from where the view is. @param {string} url */
  async replace(url) {
    const before = this._shown;
    await this._add(url, null, () => {});
    this.setStep(this._step);
    this.draw();
    await this._first(false);
    before?.entity.destroy();
    before?.asset.unload();
    this.draw();
  }

  /** Adds a model to what is drawn. @param {string} url @param {ArrayBuffer | null} contents @param {(share: number) => void} progress */
  async _add(url, contents, progress) {
    const { app } = this;
    const asset = new pc.Asset("model", "gsplat", contents ? { url, filename: url, contents } : { url });
    asset.on(
      "progress",
      (/** @type {number} */ loaded, /** @type {number} */ total) => total && progress(Math.min(1, loaded / total)),
    );
    app.assets.add(asset);
    await new Promise((resolve, reject) => {
      asset.once("load", resolve);
      asset.once("error", (/** @type {unknown} */ error) =>
        reject(new StageError(`The model cannot be read: ${error}`)),
      );
      app.assets.load(asset);
    });
    const entity = new pc.Entity("model");
    entity.setLocalEulerAngles(0, 0, 180); // SOG has y down, as PlayCanvas's own viewers expect it
    entity.addComponent("gsplat", { asset });
    this.model = /** @type {pc.GSplatComponent} */ (entity.gsplat);
    this._shown = { entity, asset };
    app.root.addChild(entity);
    return this.model;
  }

  /** @param {boolean} streamed  Resolves when the first picture has been drawn. */
  _first(streamed) {
    const { app } = this,
      { gsplat } = app.systems;
    let begun = !streamed;
    return new Promise((resolve) => {
      /** @param {unknown} _ @param {unknown} __ @param {boolean} ready @param {number} loading */
      const check = (_, __, ready, loading) => {
        begun ||= loading > 0 || app.stats.frame.gsplats > 0;
        if (!(begun && ready && loading === 0 && app.stats.frame.gsplats > 0)) return;
        gsplat.off("frame:ready", check);
        app.once("postrender", () => resolve(null));
      };
      gsplat.on("frame:ready", check);
    });
  }

  /** Once a tick: draws less on a slow machine while the view moves or gets finer, and in full once it rests. */
  _adapt() {
    const now = performance.now(),
      { drawn } = this;
    this.drawn = false;
    if (drawn) this._times.push(now - this._ticked);
    this._ticked = now;
    const busy = this.loading > 0 || now - this._moved < REST;
    if (!busy && this._detail !== 1) {
      this._busyDetail = this._detail;
      this._times = [];
      this._setDetail(1);
    } else if (busy && this._detail === 1 && this._busyDetail !== 1) {
      this._setDetail(this._busyDetail); // it was too slow before
    }
    if (this._times.length < FRAMES) return;
    const frame = this._times.reduce((sum, time) => sum + time) / this._times.length;
    this._times = [];
    const splats = this.app.scene.gsplat;
    if (frame > SLOW) {
      if (busy) this._setDetail(this._detail * 0.75);
      splats.splatBudget = Math.max(LEAST, Math.round(splats.splatBudget * 0.7));
    } else if (frame < QUICK) {
      if (busy) this._setDetail((this._busyDetail = Math.min(1, this._detail * 1.2)));
      splats.splatBudget = Math.min(BUDGET, Math.round(splats.splatBudget * 1.2));
    }
  }

  /** @param {number} detail  pixels of the picture for one of the screen, 1 for all */
  _setDetail(detail) {
    detail = Math.min(1, Math.max(COARSEST, detail));
    if (detail === this._detail) return;
    this._detail = detail;
    this.fit();
  }

  /** @param {Float32Array | null} matrix  from the world to [0, 1] of what is shown of the model; null for all of it */
  keep(matrix) {
    this._kept.setValue(matrix ?? ALL);
    this.draw();
  }

  /** @param {number} opacity  what is fainter is left out @param {number} size  and what is larger; 0 for none */
  limit(opacity, size) {
    this._limits.setValue([opacity, size]);
    this.draw();
  }

  /** @param {Float32Array} matrix  from the world to [0, 1] of a field @param {pc.Texture} texture  of it: less than a half is left out */
  keepNear(matrix, texture) {
    this._near.setValue(matrix);
    this._field.setValue(texture);
    this.draw();
  }

  /** @returns {{ middle: Point, half: Point, radius: number }} of the model */
  get bounds() {
    const box = this.model?.resource?.aabb;
    if (!box) return { middle: [0, 0, 0], half: [1, 1, 1], radius: 1 };
    const { center, halfExtents } = box;
    return {
      middle: [-center.x, -center.y, center.z],
      half: [halfExtents.x, halfExtents.y, halfExtents.z],
      radius: Math.hypot(halfExtents.x, halfExtents.y, halfExtents.z) || 1,
    };
  }

  /** @param {number} step  World units of a step: what the camera's range and the levels of detail depend on. */
  setStep(step) {
    const camera = /** @type {pc.CameraComponent} */ (this.camera.camera);
    [camera.nearClip, camera.farClip] = [step / 100, step * 20_000];
    this._step = step;
    this.app.scene.gsplat.lodUpdateDistance = step;
    if (this.model) this.model.lodBaseDistance = step * 3;
  }

  /**
   * The point of the model at a place of the picture, null where there is none: half of what is drawn there is nearer.
   * Many surfaces are made of Gaussians that are all thin, and some hang in front of them.
   * @param {number} x @param {number} y  in CSS pixels
   * @param {number} [rounds]  pictures in which the distance is searched, before the mean around it is taken
   * @returns {Promise<Point | null>}
   */
  async pick(x, y, rounds = 2) {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const column = Math.max(0, Math.min(width - 1, Math.floor(x))),
      row = Math.max(0, Math.min(height - 1, Math.floor(y)));
    const texture = new pc.Texture(this.app.graphicsDevice, {
      name: "depth",
      width,
      height,
      format: pc.PIXELFORMAT_RGBA8,
      mipmaps: false,
    });
    const target = new pc.RenderTarget({ colorBuffer: texture, depth: true });
    const pixel = new pc.Vec4((column - 1) / width, (height - 2 - row) / height, 3 / width, 3 / height);
    /** @param {number[]} depths @param {number} mode */
    const seen = (depths, mode) => {
      this._drawDepth(target, [...depths, mode], pixel);
      return texture.read(column, height - 1 - row, 1, 1, { renderTarget: target, immediate: true });
    };
    let [from, to] = REACH.map((steps) => Math.log(steps * this._step));
    try {
      for (let round = 0; round < rounds; round++) {
        const bounds = [0, 1, 2, 3, 4].map((part) => from + (part / 4) * (to - from));
        const shares = await seen(bounds.slice(1, 4).map(Math.exp), 1);
        if (shares[3] < SOLID) return null;
        const part = [0, 1, 2].find((i) => shares[i] >= shares[3] / 2) ?? 3;
        [from, to] = [bounds[part], bounds[part + 1]];
      }
      const [near, far] = [Math.exp(from), Math.exp(to)];
      const [weighed, weight] = await seen([near, far, 0], 2);
      return this._along(
        (2 * column + 1) / width - 1,
        1 - (2 * row + 1) / height,
        near + (weighed / Math.max(1, weight)) * (far - near),
      );
    } finally {
      target.destroy();
      texture.destroy();
      this.draw();
    }
  }

  /** @param {number} across @param {number} up  in [-1, 1] of the picture @param {number} depth  along the view. @returns {Point} */
  _along(across, up, depth) {
    const { data } = /** @type {pc.CameraComponent} */ (this.camera.camera).projectionMatrix;
    const from = this.camera.getPosition(),
      axes = [this.camera.right, this.camera.up, this.camera.forward];
    const by = [(across * depth) / data[0], (up * depth) / data[5], depth];
    /** @param {"x" | "y" | "z"} axis */
    const sum = (axis) => axes.reduce((place, direction, i) => place + by[i] * direction[axis], from[axis]);
    return [sum("x"), sum("y"), sum("z")];
  }

  /** @param {pc.RenderTarget} target @param {number[]} depths @param {pc.Vec4} part  of it. Draws the model as `DEPTH` says. */
  _drawDepth(target, depths, part) {
    const camera = /** @type {pc.CameraComponent} */ (this.camera.camera);
    const { clearColor } = camera,
      { x, y, z, w } = camera.scissorRect,
      hidden = this.backdrops.filter((entity) => entity.enabled);
    camera.renderTarget = target;
    camera.scissorRect = part;
    camera.clearColor = new pc.Color(0, 0, 0, 0);
    for (const entity of hidden) entity.enabled = false;
    this._depths.setValue(depths);
    this.app.render();
    this._depths.setValue([0, 0, 0, 0]);
    for (const entity of hidden) entity.enabled = true;
    camera.renderTarget = null;
    camera.scissorRect = new pc.Vec4(x, y, z, w);
    camera.clearColor = clearColor;
  }

  /** @param {Point} point @returns {{ x: number, y: number, ahead: number }} in CSS pixels; how far it is ahead of the view */
  project(point) {
    const camera = /** @type {pc.CameraComponent} */ (this.camera.camera);
    const place = new pc.Vec4(...point, 1);
    const matrix = new pc.Mat4().mul2(camera.projectionMatrix, camera.viewMatrix);
    matrix.transformVec4(place, place);
    const { clientWidth, clientHeight } = this.canvas;
    return {
      x: (place.x / place.w / 2 + 0.5) * clientWidth,
      y: (0.5 - place.y / place.w / 2) * clientHeight,
      ahead: place.w,
    };
  }
}

/** @param {HTMLCanvasElement} canvas  Throws StageError where the browser has no WebGL 2. */
export async function makeStage(canvas) {
  let device;
  try {
    device = await pc.createGraphicsDevice(canvas, {
      deviceTypes: [pc.DEVICETYPE_WEBGL2],
      antialias: false,
      alpha: false,
      powerPreference: "high-performance",
    });
  } catch {
    device = null;
  }
  if (!device)
    throw new StageError(
      "This browser cannot draw in 3D: WebGL 2 is missing or switched off. Try another browser, or switch on hardware acceleration.",
    );
  return new Stage(canvas, device);
}
