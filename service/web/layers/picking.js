/** Which line of the path lies under the pointer, and which is worst. */

import { um } from "../lib/format.js";
import { ERROR_STEP_UM, LARGEST_ERROR, UNKNOWN_ERROR } from "./tiles.js";

/** @typedef {import("./tiles.js").Tile} Tile */

/**
 * Return the point whose line, from the point before it, is nearest to a place.
 *
 * @param {Tile} tile
 * @param {number} px In mm.
 * @param {number} py
 * @param {number} withinMm
 * @returns {number} -1 if none is near.
 */
export function nearestPoint(tile, px, py, withinMm) {
  const { x, y, on } = tile;
  let best = -1;
  let nearest = withinMm * withinMm;
  for (let k = 1; k < tile.points; k += 1) {
    if (!on[k]) continue;
    const [ax, ay] = [x[k - 1], y[k - 1]];
    const [bx, by] = [x[k] - ax, y[k] - ay];
    const size = bx * bx + by * by;
    const t = size > 0 ? Math.min(Math.max(((px - ax) * bx + (py - ay) * by) / size, 0), 1) : 0;
    const d = (ax + t * bx - px) ** 2 + (ay + t * by - py) ** 2;
    if (d <= nearest) {
      nearest = d;
      best = k;
    }
  }
  return best;
}

/**
 * Return the extruding point with the largest error of a channel.
 *
 * @param {Tile} tile
 * @param {string} channel
 * @returns {number} -1 if no error is known.
 */
export function worstPoint(tile, channel) {
  const error = tile.errors[channel];
  let best = -1;
  for (let k = 1; k < tile.points; k += 1) {
    if (tile.on[k] && error[k] !== UNKNOWN_ERROR && (best < 0 || error[k] > error[best])) best = k;
  }
  return best;
}

/**
 * @param {Tile} tile
 * @param {string} channel
 * @param {number} k
 * @returns {string} "12.3 µm"
 */
export function errorText(tile, channel, k) {
  const error = tile.errors[channel][k];
  if (error === UNKNOWN_ERROR) return "not known";
  return `${error === LARGEST_ERROR ? "at least " : ""}${um(error * ERROR_STEP_UM)} µm`;
}

/**
 * Return the next extruding point from `k` on in a direction.
 *
 * @param {Tile} tile
 * @param {number} k
 * @param {number} step 1 or -1.
 * @returns {number} `k` if there is none.
 */
export function nextPoint(tile, k, step) {
  for (let n = k + step; n > 0 && n < tile.points; n += step) {
    if (tile.on[n]) return n;
  }
  return k;
}
