/** Layers as they come from the service: fetched when they are looked at, neighbours before. */

import { request } from "../lib/api.js";
import { either } from "../lib/signals.js";

/** What stands for an error that is not known. */
export const UNKNOWN_ERROR = 65535;
/** What stands for errors that are larger than can be written. */
export const LARGEST_ERROR = 65534;
/** Micrometres of one step of a stored error. */
export const ERROR_STEP_UM = 0.1;

const KEPT_BYTES = 96 << 20;
const NEIGHBOURS = [1, -1, 2, 3];

/**
 * One layer, a value per point; what stands at a point tells of the line that ends there. Errors are
 * the largest of the line.
 *
 * @typedef {object} Tile
 * @property {number} points
 * @property {Float32Array} x In mm.
 * @property {Float32Array} y
 * @property {Uint32Array} line Of the G-code.
 * @property {Record<string, Uint16Array>} errors By channel, in steps of 0.1 µm.
 * @property {Uint8Array} feature Index into the features of the print.
 * @property {Uint8Array} on 1: extruding.
 * @property {number} bytes
 */

/**
 * Read a tile: little-endian columns, each padded to four bytes.
 *
 * @param {ArrayBuffer} content
 * @param {number} points
 * @param {string[]} channels
 * @returns {Tile}
 */
export function decodeTile(content, points, channels) {
  let offset = 0;
  const take = (/** @type {any} */ Kind) => {
    const size = points * Kind.BYTES_PER_ELEMENT;
    if (offset + size > content.byteLength) {
      throw new RangeError(`The layer's data end after ${content.byteLength} bytes; ${points} points need more`);
    }
    const column = new Kind(content, offset, points);
    offset += Math.ceil(size / 4) * 4;
    return column;
  };
  return {
    points,
    x: take(Float32Array),
    y: take(Float32Array),
    line: take(Uint32Array),
    errors: Object.fromEntries(channels.map((name) => [name, take(Uint16Array)])),
    feature: take(Uint8Array),
    on: take(Uint8Array),
    bytes: content.byteLength,
  };
}

/** The tiles of a job: fetched once each, the ones used longest ago dropped. */
export class Tiles {
  /**
   * @param {string} where Address of the layers.
   * @param {any} index Document of the layers.
   * @param {AbortSignal} signal
   */
  constructor(where, index, signal) {
    this._where = where;
    this._index = index;
    this._signal = signal;
    /** @type {Map<number, Tile>} Oldest use first. */
    this._kept = new Map();
    /** @type {Map<number, {tile: Promise<Tile>, stop: AbortController}>} */
    this._coming = new Map();
    this._bytes = 0;
  }

  /**
   * @param {number} k Place in the index.
   * @returns {Tile | undefined} If it is here already.
   */
  here(k) {
    const tile = this._kept.get(k);
    if (tile) {
      this._kept.delete(k);
      this._kept.set(k, tile);
    }
    return tile;
  }

  /**
   * Return a tile, and fetch its neighbours once it is there. Whatever else was on its way is
   * stopped: a slider passes many layers that nobody looks at.
   *
   * @param {number} k
   * @param {number} direction +1 or -1: where the slider goes.
   * @returns {Promise<Tile>}
   */
  async get(k, direction) {
    const wanted = [k, ...NEIGHBOURS.map((step) => k + step * direction)]
      .filter((n) => n >= 0 && n < this._index.layers.length);
    for (const [n, { stop }] of this._coming) {
      if (!wanted.includes(n)) stop.abort();
    }
    const tile = this.here(k) ?? await this._fetch(k);
    for (const n of wanted) {
      if (!this._kept.has(n)) this._fetch(n).catch(() => {});
    }
    return tile;
  }

  /** @param {number} k @returns {Promise<Tile>} */
  _fetch(k) {
    const coming = this._coming.get(k);
    if (coming) return coming.tile;
    const stop = new AbortController();
    const signal = either(stop.signal, this._signal);
    const tile = this._load(k, signal).finally(() => {
      this._coming.delete(k);
    });
    this._coming.set(k, { tile, stop });
    return tile;
  }

  /** @param {number} k @param {AbortSignal} signal */
  async _load(k, signal) {
    const answer = await request(`${this._where}/${k}`, { signal });
    const tile = decodeTile(await answer.arrayBuffer(), this._index.layers[k].points, this._index.channels);
    this._kept.set(k, tile);
    this._bytes += tile.bytes;
    for (const [n, old] of this._kept) {
      if (this._bytes <= KEPT_BYTES || n === k) break;
      this._kept.delete(n);
      this._bytes -= old.bytes;
    }
    return tile;
  }
}

