// An equirectangular picture around the viewer, infinitely far away: the sky behind the model, or a photograph in
// front of it.

import * as pc from "./engine.js";

// At the far plane, and always around the camera: only the direction counts.
const VERTEX = `
attribute vec3 aPosition;
uniform mat4 matrix_view;
uniform mat4 matrix_projection;
varying vec3 vDirection;
void main(void) {
  vDirection = aPosition;
  vec4 place = matrix_projection * vec4(mat3(matrix_view) * aPosition, 1.0);
  gl_Position = vec4(place.xy, place.w * 0.99999, place.w);
}`;

// uAxes turns a direction into the picture's axes: x right, y down, z ahead (scene/projection.py).
const FRAGMENT = `
precision highp float;
uniform sampler2D uPicture;
uniform mat4 uAxes;
uniform float uOpacity;
varying vec3 vDirection;
void main(void) {
  vec3 d = normalize(mat3(uAxes) * vDirection);
  vec2 place = vec2(atan(d.x, d.z) / 6.283185307179586 + 0.5, asin(clamp(d.y, -1.0, 1.0)) / 3.141592653589793 + 0.5);
  gl_FragColor = vec4(textureLod(uPicture, place, 0.0).rgb, uOpacity);
}`;

const MIDDLE = [1, 0, 0, 0]; // x y z w: half a turn around x, so that y is down and z is towards -z

export class Panorama {
  /** @param {pc.AppBase} app @param {"behind" | "before"} where  the model */
  constructor(app, where) {
    this._app = app;
    const before = where === "before";
    const material = new pc.ShaderMaterial({
      uniqueName: `panorama-${where}`,
      vertexGLSL: VERTEX,
      fragmentGLSL: FRAGMENT,
      attributes: { aPosition: pc.SEMANTIC_POSITION },
    });
    material.cull = pc.CULLFACE_NONE;
    material.depthTest = false;
    material.depthWrite = false;
    if (before) material.blendType = pc.BLEND_NORMAL;
    this._material = material;
    const mesh = pc.Mesh.fromGeometry(
      app.graphicsDevice,
      new pc.SphereGeometry({ radius: 1, latitudeBands: 32, longitudeBands: 32 }),
    );
    const shape = new pc.MeshInstance(mesh, material);
    shape.cull = false;
    shape.pick = false;
    this.entity = new pc.Entity(`panorama-${where}`);
    this.entity.addComponent("render", {
      meshInstances: [shape],
      layers: [before ? pc.LAYERID_IMMEDIATE : pc.LAYERID_WORLD],
    });
    this.entity.enabled = false;
    app.root.addChild(this.entity);
    this.opacity = before ? 0 : 1;
    /** @type {pc.Texture | null} */
    this._texture = null;
    this._latest = "";
  }

  /**
   * Loads a picture. Returns whether it is this one that is shown, false if a later one was requested meanwhile.
   * @param {string} url @param {number[]} [rotation]  the picture's axes in the world, as a quaternion x y z w
   */
  async show(url, rotation = MIDDLE) {
    this._latest = url;
    const image = new Image();
    image.crossOrigin = "anonymous";
    image.src = url;
    await image.decode();
    if (this._latest !== url) return false;
    const device = this._app.graphicsDevice;
    const picture = fitted(image, device.maxTextureSize);
    this._texture?.destroy();
    this._texture = new pc.Texture(device, {
      name: "panorama",
      width: picture.width,
      height: picture.height,
      format: pc.PIXELFORMAT_RGBA8,
      mipmaps: false,
      flipY: false,
      minFilter: pc.FILTER_LINEAR,
      magFilter: pc.FILTER_LINEAR,
      addressU: pc.ADDRESS_REPEAT,
      addressV: pc.ADDRESS_CLAMP_TO_EDGE,
    });
    this._texture.setSource(picture);
    const [x, y, z, w] = rotation;
    const axes = new pc.Mat4().setTRS(pc.Vec3.ZERO, new pc.Quat(x, y, z, w).invert(), pc.Vec3.ONE);
    this._material.setParameter("uPicture", this._texture);
    this._material.setParameter("uAxes", axes.data);
    this.setOpacity(this.opacity);
    return true;
  }

  /** Forgets a picture that is not there yet. */
  forget() {
    this._latest = "";
  }

  /** @param {number} opacity in [0, 1] */
  setOpacity(opacity) {
    this.opacity = opacity;
    this._material.setParameter("uOpacity", opacity);
    this._material.update();
    this.entity.enabled = opacity > 0 && this._texture !== null;
    this._app.renderNextFrame = true;
  }
}

/** @param {HTMLImageElement} image @param {number} most @returns {HTMLImageElement | HTMLCanvasElement}  within a texture's size */
function fitted(image, most) {
  const scale = most / Math.max(image.naturalWidth, image.naturalHeight);
  if (scale >= 1) return image;
  const canvas = document.createElement("canvas");
  canvas.width = Math.floor(image.naturalWidth * scale);
  canvas.height = Math.floor(image.naturalHeight * scale);
  canvas.getContext("2d")?.drawImage(image, 0, 0, canvas.width, canvas.height);
  return canvas;
}
