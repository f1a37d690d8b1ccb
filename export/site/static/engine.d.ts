// Of PlayCanvas's engine, what is used here. engine.js is ../vendor/playcanvas.min.mjs, under this name in every page.

export class EventHandler {
  on(name: string, call: (...given: any[]) => void): unknown;
  once(name: string, call: (...given: any[]) => void): unknown;
  off(name: string, call: (...given: any[]) => void): unknown;
}

export class Vec3 {
  static readonly ZERO: Vec3;
  static readonly ONE: Vec3;
  x: number;
  y: number;
  z: number;
}

export class Vec4 {
  constructor(x: number, y: number, z: number, w: number);
  x: number;
  y: number;
  z: number;
  w: number;
}

export class Quat {
  constructor(x: number, y: number, z: number, w: number);
  invert(): this;
}

export class Mat4 {
  readonly data: Float32Array;
  mul2(first: Mat4, second: Mat4): this;
  setTRS(place: Vec3, rotation: Quat, scale: Vec3): this;
  transformVec4(vector: Vec4, result: Vec4): Vec4;
}

export class Color {
  constructor(r: number, g: number, b: number, a?: number);
}

export class GraphicsDevice {
  maxPixelRatio: number;
  readonly maxTextureSize: number;
  readonly scope: { resolve(name: string): { setValue(value: number[] | Float32Array | Texture): void } };
  setResolution(width: number, height: number): void;
}

export function createGraphicsDevice(canvas: HTMLCanvasElement, options: object): Promise<GraphicsDevice | null>;

export class Texture {
  constructor(device: GraphicsDevice, options: object);
  setSource(source: HTMLImageElement | HTMLCanvasElement): void;
  read(x: number, y: number, width: number, height: number, options: object): Promise<Uint8Array>;
  destroy(): void;
}

export class RenderTarget {
  constructor(options: object);
  destroy(): void;
}

export class Material {
  cull: number;
  depthTest: boolean;
  depthWrite: boolean;
  blendType: number;
  shaderChunksVersion: string;
  getShaderChunks(language: string): Map<string, string>;
  setParameter(name: string, value: number | Float32Array | Texture): void;
  update(): void;
}

export class ShaderMaterial extends Material {
  constructor(description: object);
}

export class SphereGeometry {
  constructor(options: object);
}

export class Mesh {
  static fromGeometry(device: GraphicsDevice, geometry: SphereGeometry): Mesh;
}

export class MeshInstance {
  constructor(mesh: Mesh, material: Material);
  cull: boolean;
  pick: boolean;
}

export class CameraComponent {
  nearClip: number;
  farClip: number;
  clearColor: Color;
  scissorRect: Vec4;
  renderTarget: RenderTarget | null;
  horizontalFov: boolean;
  readonly projectionMatrix: Mat4;
  readonly viewMatrix: Mat4;
}

export class GSplatComponent {
  lodRangeMin: number;
  lodRangeMax: number;
  lodBaseDistance: number;
  readonly resource: { octree?: { lodLevels: number }; aabb?: { center: Vec3; halfExtents: Vec3 } } | null;
}

export class Entity {
  constructor(name: string);
  enabled: boolean;
  setLocalEulerAngles(x: number, y: number, z: number): void;
  readonly camera?: CameraComponent;
  readonly gsplat?: GSplatComponent;
  addComponent(kind: string, options: object): unknown;
  addChild(child: Entity): void;
  destroy(): void;
  readonly right: Vec3;
  readonly up: Vec3;
  readonly forward: Vec3;
  getPosition(): Vec3;
  setPosition(x: number, y: number, z: number): void;
  setEulerAngles(x: number, y: number, z: number): void;
}

export class Asset extends EventHandler {
  constructor(name: string, kind: string, file: object);
  unload(): void;
}

export interface GSplatParams {
  radialSorting: boolean;
  readonly material: Material;
  minContribution: number;
  minPixelSize: number;
  colorUpdateAngle: number;
  lodBehindPenalty: number;
  lodUpdateDistance: number;
  splatBudget: number;
}

export class AppOptions {
  graphicsDevice: GraphicsDevice;
  componentSystems: unknown[];
  resourceHandlers: unknown[];
}

export class AppBase extends EventHandler {
  constructor(canvas: HTMLCanvasElement);
  autoRender: boolean;
  renderNextFrame: boolean;
  readonly graphicsDevice: GraphicsDevice;
  readonly root: Entity;
  readonly assets: { add(asset: Asset): void; load(asset: Asset): void };
  readonly scene: { readonly gsplat: GSplatParams };
  readonly stats: { readonly frame: { readonly gsplats: number } };
  readonly systems: { readonly gsplat: EventHandler };
  init(options: AppOptions): void;
  setCanvasFillMode(mode: string): void;
  setCanvasResolution(mode: string): void;
  start(): void;
  render(): void;
}

export const RenderComponentSystem: unknown;
export const CameraComponentSystem: unknown;
export const GSplatComponentSystem: unknown;
export const TextureHandler: unknown;
export const GSplatHandler: unknown;
export const FILLMODE_NONE: string;
export const RESOLUTION_AUTO: string;
export const DEVICETYPE_WEBGL2: string;
export const SEMANTIC_POSITION: string;
export const TONEMAP_NONE: number;
export const GAMMA_SRGB: number;
export const CULLFACE_NONE: number;
export const BLEND_NORMAL: number;
export const LAYERID_WORLD: number;
export const LAYERID_IMMEDIATE: number;
export const PIXELFORMAT_RGBA8: number;
export const PIXELFORMAT_R8: number;
export const SHADERLANGUAGE_GLSL: string;
export const FILTER_LINEAR: number;
export const ADDRESS_REPEAT: number;
export const ADDRESS_CLAMP_TO_EDGE: number;
