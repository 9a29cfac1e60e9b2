/** Draws a layer on a 2D canvas, where there is no WebGL: slower, the same picture. */

import { STEPS, UNKNOWN } from "./colours.js";
import { ERROR_STEP_UM, UNKNOWN_ERROR } from "./tiles.js";

/**
 * @typedef {import("./tiles.js").Tile} Tile
 * @typedef {import("./camera.js").Camera} Camera
 * @typedef {import("./webgl-renderer.js").Pane} Pane
 */

const BUCKETS = 32;

export class CanvasRenderer {
  /** @param {HTMLCanvasElement} canvas */
  constructor(canvas) {
    this._canvas = canvas;
    this._pen = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));
    /** @type {string[]} The last one is for errors that are not known. */
    this._colours = [];
    this._dots = 1;
  }

  /** For people who ask what draws. */
  get name() {
    return "canvas";
  }

  /** @param {number} width @param {number} height In CSS pixels. */
  resize(width, height) {
    this._dots = Math.min(devicePixelRatio, 2);
    this._canvas.width = Math.round(width * this._dots);
    this._canvas.height = Math.round(height * this._dots);
  }

  /** @param {Uint8Array} map STEPS colours as RGBA. */
  setColours(map) {
    this._colours = Array.from({ length: BUCKETS }, (_, k) => {
      const at = 4 * Math.round((k / (BUCKETS - 1)) * (STEPS - 1));
      return `rgb(${map[at]} ${map[at + 1]} ${map[at + 2]})`;
    });
    this._colours.push(`rgb(${UNKNOWN.join(" ")})`);
  }

  /**
   * @param {Tile | null} tile
   * @param {Pane[]} panes
   * @param {Camera} camera
   * @param {{scaleUm: number, lineMm: number}} look
   */
  draw(tile, panes, camera, { scaleUm, lineMm }) {
    const pen = this._pen;
    pen.setTransform(this._dots, 0, 0, this._dots, 0, 0);
    pen.clearRect(0, 0, this._canvas.width, this._canvas.height);
    if (tile === null) return;
    for (const pane of panes) {
      pen.save();
      pen.beginPath();
      pen.rect(pane.x, pane.y, pane.width, pane.height);
      pen.clip();
      pen.translate(pane.x, pane.y);
      pen.lineCap = "round";
      pen.lineWidth = Math.max(1.2, Math.min(lineMm * camera.scale, 24));
      this._paths(tile, pane, camera, scaleUm).forEach((path, k) => {
        if (path === null) return;
        pen.strokeStyle = this._colours[k];
        pen.stroke(path);
      });
      pen.restore();
    }
  }

  /** Nothing is held. */
  dispose() {}

  /**
   * Sort the lines in view by colour; large errors are drawn last, unknown ones too.
   *
   * @param {Tile} tile @param {Pane} pane @param {Camera} camera @param {number} scaleUm
   */
  _paths(tile, pane, camera, scaleUm) {
    /** @type {(Path2D | null)[]} */
    const paths = Array.from({ length: BUCKETS + 1 }, () => null);
    const { x, y, on } = tile;
    const error = tile.errors[pane.channel];
    const [left, top] = camera.toWorld(0, 0);
    const [right, bottom] = camera.toWorld(pane.width, pane.height);
    const toBucket = (ERROR_STEP_UM / scaleUm) * BUCKETS;
    for (let k = 1; k < tile.points; k += 1) {
      if (!on[k]) continue;
      if (Math.max(x[k], x[k - 1]) < left || Math.min(x[k], x[k - 1]) > right) continue;
      if (Math.max(y[k], y[k - 1]) < bottom || Math.min(y[k], y[k - 1]) > top) continue;
      const bucket = error[k] === UNKNOWN_ERROR ? BUCKETS : Math.min(Math.floor(error[k] * toBucket), BUCKETS - 1);
      const path = (paths[bucket] ??= new Path2D());
      path.moveTo(...camera.toPane(x[k - 1], y[k - 1]));
      path.lineTo(...camera.toPane(x[k], y[k]));
    }
    return paths;
  }
}
