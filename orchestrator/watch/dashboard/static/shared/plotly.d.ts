// The part of plotly.js that the pages use, and what the server's figures add to its own.

export interface Plotly {
  react(node: HTMLElement, data: object[], layout: object, config: object): Promise<void>;
}

export type Axis = Record<string, any>;

export interface Layout {
  xaxis: Axis;
  yaxis: Axis;
  font?: object;
  [name: string]: any;
}

export interface Trace {
  name: string;
  [name: string]: any;
}

/** An array in base64. */
export interface Packed {
  dtype: "u1" | "i1" | "i2" | "i4";
  bdata: string;
  shape: string;
}

/** GET …/map: see `figures.map_figure`. */
export interface MapFigure {
  data: Trace[];
  layout: Layout;
  blocks: { planned: boolean; count: number; colors: string[]; names: string[]; grades: [string, string][]; layers: number; layer: number; stride: number };
}

declare global {
  interface Window {
    Plotly: Plotly;
  }
}
