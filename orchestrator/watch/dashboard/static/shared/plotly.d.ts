// The part of plotly.js that the pages use.

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

declare global {
  interface Window {
    Plotly: Plotly;
  }
}
