// GET …/map: see `plan_map.map_figure`.

/** An array in base64. */
export interface Packed {
  dtype: "u1" | "i1" | "i2" | "i4";
  bdata: string;
  shape: string;
}

/** A part of the map. */
export interface Trace {
  name: string;
  [name: string]: any;
}

export interface Axis {
  title: { text: string };
  range: [number, number];
}

export interface MapFigure {
  data: Trace[];
  layout: { xaxis: Axis; yaxis: Axis };
  blocks: { planned: boolean; count: number; colors: string[]; names: string[]; legend: [string, string][]; grades: [string, string][]; layers: number; layer: number; stride: number };
}
