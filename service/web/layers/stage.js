/** The picture: one canvas with one or two panes that look at the same place of a layer. */

import { fill, h } from "../lib/dom.js";
import { isDark, onThemeChange } from "../lib/theme.js";
import { Camera } from "./camera.js";
import { CanvasRenderer } from "./canvas-renderer.js";
import { colourMap, drawLegend } from "./colours.js";

/** @typedef {import("./tiles.js").Tile} Tile */

const LINE_MM = 0.38;
const GAP_PX = 10;
const [LOWEST_PX, HIGHEST_PX] = [240, 620];

export class Stage {
  /**
   * @param {any} index Document of the layers.
   * @param {Record<string, string>} labels Of the channels.
   * @param {AbortSignal} signal
   */
  constructor(index, labels, signal) {
    this._index = index;
    this._labels = labels;
    this._signal = signal;
    this.camera = new Camera(index.bounds_mm);
    /** @type {Tile | null} */
    this._tile = null;
    /** @type {string[]} */
    this._channels = [];
    /** @type {any[]} */
    this._panes = [];
    this._mark = -1;
    this._isDue = false;
    /** @type {any} */
    this._renderer = null;
    this._over = h("div.over");
    this.element = h("div.stage", { tabindex: "0", role: "group" }, this._over);
    this.legend = h("canvas", { "aria-hidden": "true" });
  }

  /** Make a renderer: WebGL, or a 2D canvas where there is none. */
  async start() {
    this._renderer = await this._bestRenderer();
    if (this._signal.aborted) return this._renderer.dispose();
    this.element.dataset.renderer = this._renderer.name;
    const sizes = new ResizeObserver(() => this.layOut());
    sizes.observe(this.element);
    onThemeChange(() => this._setColours(), this._signal);
    this._signal.addEventListener("abort", () => {
      sizes.disconnect();
      this._renderer.dispose();
      this._renderer = null;
    });
    this._setColours();
  }

  /** @param {string[]} channels A pane for each. */
  setChannels(channels) {
    this._channels = channels;
    this.layOut();
  }

  /** @param {Tile | null} tile */
  setTile(tile) {
    this._tile = tile;
    this._mark = -1;
    this.redraw();
  }

  /** @param {number} k A point of the tile, -1 for none. */
  mark(k) {
    this._mark = k;
    this.redraw();
  }

  /**
   * @param {number} px Of the stage.
   * @param {number} py
   * @returns {[number, number]} The same place, within the pane it is in.
   */
  inPane(px, py) {
    const pane = this._panes.find((p) => px >= p.x && px <= p.x + p.width && py >= p.y && py <= p.y + p.height) ?? this._panes[0];
    return pane ? [px - pane.x, py - pane.y] : [px, py];
  }

  /** Share the stage among the panes. */
  layOut() {
    const width = this.element.clientWidth;
    if (width === 0 || this._renderer === null) return;
    const count = Math.max(this._channels.length, 1);
    const each = (width - GAP_PX * (count - 1)) / count;
    const height = Math.round(Math.min(Math.max(each * Math.min(this.camera.aspect, 1.1) + 24, LOWEST_PX), HIGHEST_PX, innerHeight * 0.75));
    this.element.style.height = `${height}px`;
    this._panes = this._channels.map((channel, k) => ({ channel, x: Math.round(k * (each + GAP_PX)), y: 0, width: Math.floor(each), height }));
    this.camera.resize(Math.floor(each), height);
    this._renderer.resize(width, height);
    fill(this._over, this._panes.map((pane) => {
      const box = h("div.pane", null, h("span.caption", null, this._labels[pane.channel] ?? pane.channel), h("i.mark", { hidden: true }));
      Object.assign(box.style, { left: `${pane.x}px`, width: `${pane.width}px` });
      return box;
    }));
    this.redraw();
  }

  /** Draw before the next frame; many calls draw once. */
  redraw() {
    if (this._isDue) return;
    this._isDue = true;
    requestAnimationFrame(() => {
      this._isDue = false;
      if (this._renderer === null) return;
      this._renderer.draw(this._tile, this._panes, this.camera, { scaleUm: this._index.scale_um, lineMm: LINE_MM });
      this._placeMarks();
    });
  }

  _placeMarks() {
    const tile = this._tile;
    const k = this._mark;
    for (const mark of this._over.querySelectorAll(".mark")) {
      mark.hidden = tile === null || k < 0;
      if (tile === null || k < 0) continue;
      const [px, py] = this.camera.toPane(tile.x[k], tile.y[k]);
      mark.style.transform = `translate(${px}px, ${py}px)`;
    }
  }

  _setColours() {
    const map = colourMap(isDark());
    this._renderer.setColours(map);
    drawLegend(this.legend, map);
    this.redraw();
  }

  async _bestRenderer() {
    const canvas = () => {
      this.element.querySelector("canvas")?.remove();
      const made = h("canvas", { "aria-hidden": "true" });
      this.element.prepend(made);
      return made;
    };
    // Asked first: three.js writes an error into the console where there is none.
    if (document.createElement("canvas").getContext("webgl2") !== null) {
      try {
        const { WebglRenderer } = await import("./webgl-renderer.js");
        return new WebglRenderer(canvas());
      } catch (error) {
        console.warn("WebGL cannot be used; layers are drawn on a 2D canvas.", error);
      }
    }
    return new CanvasRenderer(canvas());
  }
}
