// scene.json, as `panolog.export.site.page` writes it. The world is that of the model: y is up.

export type Point = [number, number, number];

export interface Pose {
  position: Point;
  /** Degrees to the left of -z, seen from above. */
  yaw: number;
  /** Degrees above the horizon. */
  pitch: number;
}

/** From the model's coordinates to those of the page: rotation · (place − origin). */
export interface Frame {
  rotation: [Point, Point, Point];
  origin: Point;
}

export interface Camera extends Pose {
  name: string;
  /** The panorama's axes (x right, y down, z ahead) in the world, as a quaternion x y z w; null without a photograph. */
  rotation: [number, number, number, number] | null;
  /** Where its photograph is: equirectangular. */
  photograph: string | null;
}

export interface Page {
  title: string;
  /** Gaussians: drawn at most, and those of the model. */
  shown: number;
  total: number;
  /** Of a model in training; null of one that is done. */
  iteration: number | null;
  /** Seconds between two looks for a newer model, as the dashboard serves it; null where there will be none. */
  refresh: number | null;
  /** A .sog, or the lod-meta.json of Streamed SOG. */
  model: string;
  /** An equirectangular picture whose middle is towards -z; null if the model has none. */
  sky: string | null;
  start: Pose | null;
  cameras: Camera[];
  /** World units: the sense of scale of the controls; null where only the model's bounds say it. */
  step: number | null;
  metres_per_unit: number | null;
  /** Null where it is not known. */
  frame: Frame | null;
}
